"""Child processes, progress, statuses, and arguments that are checked."""

from __future__ import annotations

import contextlib
import inspect
import multiprocessing
import re
import time
from typing import Any

import numpy as np
import pytest

import eyerender
from eyerender.base.processes import mapper, process_pool
from eyerender.base.progress import followed
from eyerender.base.status import Status, mark
from eyerender.cli import output
from eyerender.cli.main import run


def test_results_come_in_the_order_of_the_arguments_in_this_process_and_in_a_pool():
    for processes in (1, 2):
        with mapper(processes, chunksize=3) as mapped:
            assert list(mapped(pow, range(8), [2] * 8)) == [k * k for k in range(8)]


def _work_and_interrupt():
    with process_pool(2) as pool:
        pool.submit(int).result()  # a child is up
        for _ in range(8):
            pool.submit(time.sleep, 60)
        raise KeyboardInterrupt


def test_an_interrupted_pool_ends_its_children_in_the_middle_of_their_work():
    before, start = multiprocessing.active_children(), time.perf_counter()  # children of other tests
    with pytest.raises(KeyboardInterrupt):
        _work_and_interrupt()
    assert time.perf_counter() - start < 30  # the first task alone would take 60 s
    # The pool's own thread may have waited for a child first; then this one learns of its end a moment later.
    end = time.perf_counter() + 10
    while (left := set(multiprocessing.active_children()) - set(before)) and time.perf_counter() < end:
        time.sleep(0.05)
    assert not left


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


def test_every_failure_has_a_reason_of_its_own():
    assert int(Status.OK) == 0
    assert Status.OK.reason is None
    reasons = [s.reason for s in Status if s != Status.OK]
    assert all(reasons)
    assert len(set(reasons)) == len(reasons)


def test_statuses_fit_the_arrays_of_batches():
    values = np.array(list(Status), dtype=np.int64)
    assert np.array_equal(values.astype(np.int8), values)
    assert [Status(v) for v in values.astype(np.int8)] == list(Status)


def test_a_record_has_a_word_for_every_status_and_reads_it_back():
    assert {s.label for s in Status} == {"", "ok", "partial", "missing"}
    for status in set(Status) - {Status.NONE}:
        assert Status.of_record(status.label, status.reason) == status
    assert Status.of_record("missing", "outside the limbus (3 of 30 boundary points)") == Status.OUTSIDE_LIMBUS
    assert Status.of_record("missing", "too dark") == Status.NOT_FOUND
    assert Status.of_record("missing", None) == Status.NOT_FOUND
    assert Status.of_record("missing", Status.PARTIAL.reason) == Status.NOT_FOUND
    assert Status.of_record("blink", None) == Status.NOT_FOUND


def test_the_first_failure_stays():
    status = np.array([Status.OK, Status.MISSED, Status.OK], dtype=np.int8)
    mark(status, np.array([True, True, False]), Status.TOTAL_REFLECTION)
    assert status.tolist() == [Status.TOTAL_REFLECTION, Status.MISSED, Status.OK]
    assert status.dtype == np.int8


er: Any = eyerender  # whose types forbid what is tried here

FUNCTIONS = [name for name in dir(er) if inspect.isfunction(getattr(er, name))]
PARAMETERS = [
    (function, name)
    for function in FUNCTIONS
    for name, one in inspect.signature(getattr(er, function)).parameters.items()
    if one.kind != one.VAR_KEYWORD
]


@pytest.mark.parametrize(("function", "name"), PARAMETERS)
def test_each_argument_of_a_wrong_type_is_named(function, name):
    with pytest.raises(er.InputError, match=rf"^{function}: {name}: must be .*, not ") as refused:
        getattr(er, function)(**{name: object()})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: er.generate("dataset_quick", "out", count="20"), "count: must be a whole number or None, not '20'"),
        (lambda: er.generate("dataset_quick", "out", count=True), "count: must be a whole number"),
        (lambda: er.detect("x.png"), "images: must be EyeImage or a series of EyeImage, not 'x.png'"),
        (lambda: er.extract("x.png"), "image: must be an array, not 'x.png'"),
        (lambda: er.load_scene({"format": 2}), "scene: must be text or a path"),
        (lambda: er.load_scene("hedset"), "did you mean headset?"),
        (lambda: er.Eye("E44"), "E44: no such eye; did you mean E4?"),
        (lambda: er.gaze.Regression("R33"), "'R33' is not a regression function; did you mean R3?"),
        (lambda: er.Camera(distortion={"k1": -0.2}), r"must be the five numbers \[k1, k2, p1, p2, k3\]"),
        (lambda: er.Camera(distortion=[0.1]), r"must be the five numbers \[k1, k2, p1, p2, k3\]"),
    ],
)
def test_what_is_wrong_ends_with_what_to_write(call, words):
    with pytest.raises(er.InputError, match=words):
        call()


def test_a_misspelt_name_is_answered_with_a_near_one():
    with pytest.raises(AttributeError, match=re.escape("eyerender has no 'renderr'; did you mean render?")):
        _ = er.renderr


def test_a_name_of_a_namespace_is_found():
    with pytest.raises(
        AttributeError, match=re.escape("eyerender has no 'Regression'; write eyerender.gaze.Regression")
    ):
        _ = er.Regression


def test_a_function_takes_what_its_annotation_names(tmp_path):
    scene = er.load_scene("quickstart", spp=np.int64(2), eye=None)
    assert er.trace(scene, boundary_points=np.int32(12)).pupil.points_px.shape[-2] == 12
    assert er.sensor_noise(scene, fixation_deg=0) is not None
    assert er.render is er.render
    assert er.load_eye.__doc__.startswith("Load an eye of the catalogue")


def test_an_eye_distance_in_metres_warns():
    spec = er.load_scene("headset").spec
    with pytest.warns(UserWarning, match=r"subject\.ipd_mm: is 0\.063 mm; lengths are in mm; did you mean metres\?"):
        er.Scene(er.Subject(er.Eye("E2"), ipd_mm=0.063), spec.rig, targets=spec.targets)


@pytest.mark.parametrize("data", [b"PK\x03\x04 workbook", b"\xd0\xcf\x11\xe0 workbook"])
def test_an_excel_workbook_is_called_what_it_is(tmp_path, data):
    path = tmp_path / "features.csv"
    path.write_bytes(data)
    with pytest.raises(er.InputError, match=r"features\.csv: is an Excel workbook .* save the sheet as CSV"):
        er.load_scene(path)
