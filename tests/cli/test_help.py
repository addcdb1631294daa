"""Help, examples and the grammar of the command line: input by position, output as -o."""

from __future__ import annotations

import inspect
import json
import shlex
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from eyerender.cli.app import app
from eyerender.cli.dataset import _validate_text
from eyerender.cli.examples import EXAMPLES
from eyerender.cli.main import run

INPUTLESS = {"doctor", "setup-llvm", "schema", "eyes", "population", "quickstart"}
"""Commands whose input is optional, or that have none."""


def commands(found=app, before=""):
    """Every command with its application."""
    for name in found:
        if not name.startswith("-"):
            sub = found[name]
            deeper = [word for word in sub if not word.startswith("-")]
            yield from commands(sub, f"{before}{name} ") if deeper else [(before + name, sub)]


COMMANDS = dict(commands())


@pytest.mark.parametrize("name", ["render", "gaze predict"])
def test_help_ends_with_examples_and_shows_defaults_that_say_something(name, capsys):
    assert run([*name.split(), "--help"]) == 0
    printed = capsys.readouterr().out
    assert EXAMPLES[name][0].split(" -")[0] in printed.partition("Examples:")[2]
    assert "[default: False]" not in printed
    assert "[default: None]" not in printed
    assert ("[default: auto]" in printed) == (name == "render")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_examples_that_parse(name):
    assert COMMANDS[name].help_epilogue
    for line in EXAMPLES[name]:
        program, *words = shlex.split(line.partition(" > ")[0])
        assert program == "eyerender"
        assert " ".join(words).startswith(name)
        command, _, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        assert command is COMMANDS[name].default_command


@pytest.mark.parametrize("name", COMMANDS)
def test_input_is_positional_and_output_is_an_option(name):
    parameters = inspect.signature(COMMANDS[name].default_command).parameters
    first = next(iter(parameters.values()), None)
    if name not in INPUTLESS:
        assert first is not None
        assert first.kind in (first.POSITIONAL_ONLY, first.VAR_POSITIONAL)
    if "output" in parameters:
        found = get_type_hints(COMMANDS[name].default_command, include_extras=True)["output"]
        assert "-o" in get_args(found)[1].name


@pytest.mark.parametrize("argv", [["quickstart", "x"], ["quickstart", "-o", "x"], ["quickstart", "--output", "x"]])
def test_quickstart_takes_its_folder_both_ways(argv):
    _, given, _ = app.parse_args(argv, exit_on_error=False, print_error=False)
    assert given.arguments["output"] == Path("x")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("render quickstart x", "--output: missing; write where the result goes as '-o x'"),
        ("render quickstart", "'-o PATH' ('eyerender render --help' shows examples)"),
        ("rendr quickstart", "did you mean render? 'eyerender --help' lists the commands"),
        ("frobnicate", "Unknown command \"frobnicate\"; 'eyerender --help' lists the commands"),
        ("gaze prdict x", "did you mean predict? 'eyerender gaze --help' lists"),
        ("features quickstart x", "x: is one argument too many; outputs are given as -o"),
        ("compare x --functoin R3", "'eyerender compare --help' shows examples"),
    ],
)
def test_a_wrong_line_says_what_to_write_instead(line, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(line.split()) == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1
    assert words in printed
    assert not list(tmp_path.iterdir())


def test_statistics_have_short_numbers():
    report: dict[str, Any] = {
        "images": 2,
        "recomputed": 2,
        "notes": [],
        "statistics": {"pupil_px": [8.14546379332457, 9.5], "share": {"right": 0.123456789, "left": 1}, "images": 7},
        "problems": [],
        "problems_left_out": 0,
        "ok": True,
    }
    text = _validate_text(report)
    assert "8.145 9.5\n" in text
    assert "right 0.1235, left 1\n" in text
    assert json.dumps(report["statistics"]["pupil_px"]) not in text
