"""Child processes, progress and statuses."""

import contextlib
import multiprocessing
import time

import numpy as np
import pytest

import eyerender as er
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
