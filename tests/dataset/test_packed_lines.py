"""What several lines of metadata share is written once, and each comes back as it was."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.folders.packed import pack_lines, read_line, rounded

OBJECTS = [
    {"a": 1, "b": {"c": [1, 2.0], "d": None}, "e": [{"f": 1, "g": 2}, {"f": 3}], "h": {}, "i": []},
    {"a": 1.0, "b": {"c": [1, 2], "d": None}, "e": [{"f": 1, "g": 5}, {"f": 3}, {"f": 4}], "h": {}, "i": []},
    {"a": 1, "b": {"c": [1, 2.0], "d": {}}, "e": [], "h": {"k": 1}, "i": [[{"l": True}]]},
]


def lines_of(objects):
    return [
        {
            "subject": k // 10,
            "records": [{"eye": "left", "x": k / 3}],
            "parameters": {"scene_json": json.dumps({"s": k / 7}), "eye_json": "{}"},
            "object": one,
        }
        for k, one in enumerate(objects)
    ]


@pytest.mark.parametrize("chosen", [[0], [0, 1], [0, 2], [1, 2], [0, 1, 2], [0, 0]])
def test_objects_come_back_as_they_were(chosen, tmp_path):
    lines = lines_of([OBJECTS[k] for k in chosen])
    data, blocks = pack_lines(lines)
    (tmp_path / "lines.jsonl.gz").write_bytes(data)
    for row, line in enumerate(lines):
        again = read_line(tmp_path / "lines.jsonl.gz", row, blocks[row])
        # 1 is not 1.0
        assert json.dumps(again["object"], sort_keys=True) == json.dumps(line["object"], sort_keys=True)


def test_equal_lines_have_no_rest():
    lines = lines_of(OBJECTS[:1]) * 1000
    assert len(pack_lines(lines)[0]) < 1.05 * len(pack_lines(lines[:1])[0]) + 4 * 1000


def test_rounding_twice_changes_nothing():
    values = np.random.default_rng(1).normal(size=1000) * 10.0 ** np.arange(-20, 20).repeat(25)
    once = rounded(values.tolist())
    assert rounded(once) == once
    assert np.all(np.abs(np.array(once) - values) <= 5e-9 * np.abs(values))


def test_lines_are_read_one_by_one(tmp_path):
    lines = lines_of([{}] * 70)
    data, blocks = pack_lines(lines)
    path = tmp_path / "lines.jsonl.gz"
    path.write_bytes(data)
    for row in (69, 0, 33):
        line = read_line(path, row, blocks[row])
        assert line["parameters"] == lines[row]["parameters"]  # exact
        assert line["records"] == rounded(lines[row]["records"])
    assert pack_lines([read_line(path, row, blocks[row]) for row in range(70)]) == (data, blocks)
    assert len(set(blocks)) == 3
