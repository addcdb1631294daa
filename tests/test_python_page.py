"""docs/python.md names what there is, and its examples of gaze run."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

import eyerender as er
from tests.support.paths import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")


def blocks():
    return re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_every_name_on_the_page_exists():
    names = set(re.findall(r"\ber\.((?:gaze\.)?\w+)", PAGE)) - {"gaze"}
    assert len(names) > 20
    for name in names:
        found = er
        for part in name.split("."):
            found = getattr(found, part)
    for name in re.findall(r"^\| `(\w+)\(", PAGE, re.MULTILINE):
        assert hasattr(er.gaze, name)


def test_the_example_of_statuses_runs(capsys):
    (block,) = [block for block in blocks() if "er.Status" in block]
    exec(block, {"er": er, "np": np})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "270 of 270 pupils"
    assert lines[2:] == ["<Status.OK: 0> None"]


def test_the_examples_of_gaze_run(capsys):
    space: dict[str, Any] = {"er": er}
    for block in blocks():
        if "leave_one_target_out" in block or "class Middle" in block:
            exec(block, space)
    mean, largest = map(float, capsys.readouterr().out.split())
    assert 0 < mean < largest < 5
    middle = space["Middle"]().fit(space["truth"], space["scene"].rig)
    again = type(middle).from_mapping(middle.to_mapping())
    gaze = again.predict(space["truth"], space["scene"].rig)
    assert gaze.ok.all()
    assert gaze == middle.predict(space["truth"], space["scene"].rig)
