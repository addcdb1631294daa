"""The one status type: small, complete and readable."""

import numpy as np

from eyerender.base.status import Status, mark


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
