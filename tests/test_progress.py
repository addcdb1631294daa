"""Progress of long work."""

from eyerender.base.progress import followed


def test_the_first_report_states_the_total():
    heard = []
    assert list(followed("abc", lambda *report: heard.append(report))) == ["a", "b", "c"]
    assert heard == [(0, 3, ""), (1, 3, ""), (2, 3, ""), (3, 3, "")]
    assert list(followed([], lambda *report: heard.append(report))) == []
    assert heard[-1] == (0, 0, "")
    assert list(followed(range(2), None)) == [0, 1]
