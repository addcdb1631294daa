"""Progress of long work."""

import contextlib

import eyerender as er
from eyerender.base.progress import followed
from eyerender.cli import output
from eyerender.cli.main import run


def test_the_first_report_states_the_total():
    heard = []
    assert list(followed("abc", lambda *report: heard.append(report), "letters")) == ["a", "b", "c"]
    assert heard == [(k, 3, "letters") for k in range(4)]
    assert list(followed([], lambda *report: heard.append(report), "images")) == []
    assert heard[-1] == (0, 0, "images")
    assert list(followed(range(2), None, "images")) == [0, 1]


def test_a_rendering_command_says_what_it_counts_and_that_kernels_compile(tmp_path, capsys, monkeypatch):
    path, whole = tmp_path / "one.yaml", er.load_scene("guestrin2006", spp=1).spec
    subject = {**whole.subject.to_mapping(), "eyes": ["right"], "head_positions_mm": [[0, 0, 0]]}
    spec = {**whole.to_mapping(), "subject": subject, "targets": {"grid": [1, 1]}}
    path.write_text(er.SceneSpec.from_mapping(spec).to_yaml())
    monkeypatch.setattr(output, "PATIENCE_S", 0.0)
    assert run(["render", str(path), "-o", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["rendering: 0/1 images; kernels are compiled before the first one", "rendering: 1/1 images"]


def test_an_error_before_the_first_item_is_the_only_line(capsys):
    with contextlib.suppress(ValueError), output.progress("rendering") as steps:
        steps(0, 9, "images")
        raise ValueError
    assert capsys.readouterr().err == ""
