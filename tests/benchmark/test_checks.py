"""Benches as regression tests: identical reruns, interrupted runs, required figures, losses, the assumed gamma."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from eyerender.apps.benchmark.asking import ANSWERS
from eyerender.apps.benchmark.checks import Requirement, compare_with, problems_of
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.intervals import mcnemar
from eyerender.apps.benchmark.run import bench_extractors
from eyerender.base.errors import InputError
from eyerender.cli.main import run

COUNTING = """
from pathlib import Path

def find(image, request):
    with open({log!r}, "a") as file:
        file.write(Path(request["image"]).name + " ")
    return {{"pupil": {{"status": "ok", "centre_px": [100.0, 80.0], "semi_axes_px": [{a}, 14.0], "angle_rad": 0.0}}}}
"""


@pytest.fixture
def counting(tmp_path, monkeypatch):
    """A function that makes a module whose extractor writes down the images about which it is asked."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")

    def make(name, a=15.0):
        log = tmp_path / f"{name}.log"
        (tmp_path / f"{name}.py").write_text(COUNTING.format(log=str(log), a=a))
        log.write_text("")
        return f"{name}:find", lambda: log.read_text().split()

    return make


def interrupted(drawn, out, extractor, after, **options):
    """A run that ends with a KeyboardInterrupt after some answers."""

    def progress(done, _total, _what):
        if done == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench_extractors(drawn, out, [extractor], progress=progress, **options)


def test_an_interrupted_run_resumes_to_equal_bytes(drawn, counting, tmp_path):
    extractor, asked = counting("first")
    whole, out = tmp_path / "whole", tmp_path / "out"
    bench_extractors(drawn, whole, [extractor], jobs=2)
    assert len(asked()) == 6 + 2  # twice the first image of each process: the first call loads libraries
    interrupted(drawn, out, extractor, 4)
    assert len(asked()) == 8 + 5
    with open(out / ANSWERS, "a") as file:
        file.write('["first:find", 5, "')  # as of a killed run
    bench_extractors(drawn, out, [extractor])
    assert len(asked()) == 13 + 3
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "results.csv", "results.json", "times.json"]
    for name in ("report.html", "results.json", "results.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    assert json.loads((out / "times.json").read_text())["extractors"][0]["round_trip_ms"]["n"] == 6


@pytest.mark.packaging
@pytest.mark.usefixtures("no_report")
def test_answers_of_another_task_are_asked_again(drawn, counting, tmp_path):
    extractor, asked = counting("first")
    out, folder = tmp_path / "out", shutil.copytree(drawn, tmp_path / "copy")
    bench_extractors(folder, out, [extractor])
    interrupted(folder, out, extractor, 3)  # beside the results of an earlier run
    assert len(asked()) == 7 + 4
    image = folder / "images/small-010002.png"
    image.write_bytes(image.read_bytes() + b" ")  # the same picture, but another file
    interrupted(folder, out, extractor, 3)
    assert len(asked()) == 11 + 4
    interrupted(folder, out, extractor, 5, fresh=True)
    assert len(asked()) == 15 + 6
    _, asked = counting("first", a=16.0)  # other code
    bench_extractors(folder, out, [extractor])
    assert len(asked()) == 7


@pytest.mark.usefixtures("no_report")
def test_failures_are_not_stored(drawn, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    (tmp_path / "moody.py").write_text("def find(image, request):\n    raise RuntimeError('not today')\n")
    interrupted(drawn, tmp_path / "out", "moody:find", 6)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("nosuchmodule:find", "there is no module 'nosuchmodule'"),
        ("json:find", "json has no find"),
        ("json:__doc__", "neither a callable nor a Command"),
    ],
)
def test_a_misspelt_reference_is_refused_at_once(reference, words, drawn, tmp_path, capsys):
    out = tmp_path / "out"
    argv = ["bench-extractors", str(drawn), "-o", str(out), "--extractor", "opencv-contour", "--extractor", reference]
    assert run(argv) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: --extractor {reference}: ")
    assert words in said
    assert "opencv-contour" not in said  # nothing was run
    assert not out.exists()


@pytest.mark.packaging
@pytest.mark.usefixtures("no_report")
def test_required_figures_decide_the_exit_code(drawn, counting, tmp_path, capsys):
    blind, _ = counting("blind", a=90.0)
    argv = ["bench-extractors", str(drawn), "--extractor", "opencv-contour", "--extractor", f"blind={blind}"]
    assert run([*argv, "-o", str(tmp_path / "a"), "--require", "opencv-contour:right>=.95"]) == 0
    assert run([*argv, "-o", str(tmp_path / "b"), "--require", "opencv-contour:right>=.95", "--require", "iou>.9"]) == 1
    assert "error: blind: iou>.9 is not met (-)" in capsys.readouterr().err
    assert run([*argv, "-o", str(tmp_path / "c"), "--require", "right=.95"]) == 2
    assert run([*argv, "-o", str(tmp_path / "c"), "--require", "rihgt>=.95"]) == 2
    assert run([*argv, "-o", str(tmp_path / "c"), "--require", "other:right>=.95"]) == 2
    said = capsys.readouterr().err
    assert "must be [NAME:]FIGURE>=NUMBER" in said
    assert "there is no figure 'rihgt'; there are right, wrong" in said
    assert "there is no extractor 'other'" in said


def test_a_name_may_hold_a_colon():
    got = Requirement.parse("mine:find:centre_px <= 1e-1", ["mine:find"])
    assert (got.name, got.figure, got.how, got.bar) == ("mine:find", "centre_px", "<=", 0.1)


def outcomes(right, errors=0):
    """Results of one extractor on images of which it finds some right."""
    n = len(right)
    answers = [{"image": f"{k}.png", "outcome": "right" if ok else "wrong"} for k, ok in enumerate(right)]
    entry = {"name": "it", "answers": answers, "summary": {"errors": errors}}
    return {"extractors": [entry], "image_digests": {f"{k}.png": "x" for k in range(n)}, "images": n, "required": []}


def test_a_planted_loss_of_five_percent_is_found():
    """400 images of which 85 % are right; 5 % are lost, while chance moves eight images in either direction."""
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(50):
        old = rng.random(400) < 0.85
        new = old.copy()
        for was in (True, False):
            new[rng.permutation(np.flatnonzero(old == was))[:4]] = not was
        new[rng.permutation(np.flatnonzero(old & new))[:20]] = False
        (change,) = compare_with(outcomes(old), outcomes(new), "old.json")
        assert (len(change["lost"]), len(change["gained"])) == (24, 4)
        found += change["significant_loss"]
    assert found == 50
    identical = outcomes(np.ones(400, dtype=bool))
    (change,) = compare_with(identical, identical, "old.json")
    assert (change["p"], change["significant_loss"]) == (1.0, False)


def test_the_false_alarms_of_the_comparison_are_as_rare_as_stated():
    """Losses and gains equally likely: at most 2.5 % of the cases alarm, half of the two-sided 5 %."""
    rng = np.random.default_rng(1)
    lost = rng.binomial(30, 0.5, 20_000)
    alarms = np.mean([mcnemar(k, 30 - k) < 0.05 and k > 15 for k in range(31)] @ np.eye(31)[lost].T)
    assert alarms < 0.025 + 3 * np.sqrt(0.025 / 20_000)


def test_mcnemar_is_the_exact_binomial_test():
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(5, 5) == 1.0
    assert mcnemar(0, 6) == pytest.approx(2 / 2**6)
    assert mcnemar(1, 7) == pytest.approx(2 * (1 + 8) / 2**8)


def test_errors_count_only_where_checks_are_asked_for():
    data = {**outcomes([True, False], errors=1), "against": []}
    assert problems_of(data, gated=False) == []
    assert problems_of(data, gated=True) == ["it: gave no usable answer to 1 of 2 images"]


@pytest.mark.packaging
@pytest.mark.usefixtures("no_report")
def test_against_an_earlier_bench(drawn, counting, tmp_path, capsys):
    argv = ["bench-extractors", str(drawn), "--extractor", "opencv-contour"]
    assert run([*argv, "-o", str(tmp_path / "a")]) == 0
    old = tmp_path / "a" / "results.json"
    assert run([*argv, "-o", str(tmp_path / "b"), "--against", str(old)]) == 0
    assert "opencv-contour: 6 -> 6 of 6 right; 0 lost, 0 gained (p = 1)" in capsys.readouterr().out
    blind, _ = counting("blind", a=90.0)
    assert run([*argv[:-1], f"opencv-contour={blind}", "-o", str(tmp_path / "c"), "--against", str(old)]) == 1
    assert "error: opencv-contour: lost 6 images and gained 0 of 6 (p = 0.031)" in capsys.readouterr().err
    other = json.loads(old.read_text())
    other["image_digests"] = dict.fromkeys(other["image_digests"], "0")
    (tmp_path / "other.json").write_text(json.dumps(other))
    assert run([*argv, "-o", str(tmp_path / "d"), "--against", str(tmp_path / "other.json")]) == 2
    assert "other.json: shares no image with this bench" in capsys.readouterr().err


def table_of(drawn, folder):
    """The drawn images as a person's own folder, which states no gamma."""
    (folder / "images").mkdir(parents=True)
    lines = ["image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg"]
    for image in load_labelled(drawn):
        shutil.copy(image.path, folder / "images")
        x, y, a, b, angle = image.pupil.numbers()
        lines.append(f"{image.path.name},{x},{y},{a},{b},{np.degrees(angle)}")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")


@pytest.mark.packaging
@pytest.mark.usefixtures("no_report")
def test_the_gamma_is_given_stated_or_assumed_and_said(drawn, tmp_path, capsys):
    own = tmp_path / "own"
    table_of(drawn, own)
    argv = ["bench-extractors", str(own), "--extractor", "opencv-contour", "-o"]
    assert run([*argv, str(tmp_path / "a")]) == 0
    assert "6 images state no gamma; 1 (linear) is assumed (--gamma)" in capsys.readouterr().err
    assert run([*argv, str(tmp_path / "b"), "--gamma", "2.2"]) == 0
    assert "assumed" not in capsys.readouterr().err
    assert json.loads((tmp_path / "b/results.json").read_text())["gamma"] == [
        {"gamma": 2.2, "from": "given", "images": 6}
    ]
    (own / "hints.json").write_text('{"schema": "eyerender/hints/1", "gamma": 1.8, "polarity": "dark"}')
    assert {i.hints["gamma"] for i in load_labelled(own)} == {1.8}
    assert {i.hints["polarity"] for i in load_labelled(own)} == {"dark"}
    assert run([*argv, str(tmp_path / "c"), "--gamma", "2.2"]) == 2
    assert "states a gamma of 1.8, not 2.2" in capsys.readouterr().err
    (own / "hints.json").write_text('{"schema": "eyerender/hints/1", "gama": 1.8}')
    with pytest.raises(InputError, match=r"hints\.json: gama"):
        load_labelled(own)


@pytest.mark.slow
def test_the_right_gamma_removes_the_bias_of_encoded_images(drawn, tmp_path):
    """Encoding brightens the dark side of the edge, so the half level moves inward."""
    from eyerender.folders.imagefile import read_image, write_png

    own = tmp_path / "own"
    table_of(drawn, own)
    for path in (own / "images").iterdir():
        image = read_image(path)[0].astype(float) / 255.0
        write_png(path, np.rint(255.0 * image ** (1 / 2.2)).astype(np.uint8))
    bias = []
    for gamma in (1.0, 2.2):
        data = bench_extractors(own, tmp_path / f"out{gamma}", ["own-fast"], gamma=gamma)
        bias.append(np.mean(data["extractors"][0]["summary"]["semi_axes_bias_px"]))
    assert bias[0] < -0.1
    assert abs(bias[1]) < 0.03  # the bound on an axis is about 0.01 px here
