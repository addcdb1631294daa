"""The command `live` where its extra is missing, and where its input is bad."""

from __future__ import annotations

import importlib.util

import pytest

from eyerender.cli.main import run


@pytest.mark.skipif(importlib.util.find_spec("nicegui") is not None, reason="the extra `live` is installed")
def test_a_missing_extra_is_one_line(capsys):
    assert run(["live", "headset"]) == 2
    assert capsys.readouterr().err == "error: live: needs NiceGUI (the extra 'live'); run: pip install nicegui\n"
