"""Examples at the end of each command's `--help`: the lines of examples.txt."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

EXAMPLES: dict[str, list[str]] = {}
"""Example command lines, by command."""

for _line in (Path(__file__).parent / "examples.txt").read_text(encoding="utf-8").splitlines():
    _words = _line.split()[1:]
    EXAMPLES.setdefault(" ".join(_words[: 2 if _words[0] == "gaze" else 1]), []).append(_line)


def add_examples(app: App) -> None:
    """Add the examples to the help of each command."""
    for command, lines in EXAMPLES.items():
        found = app
        for word in command.split():
            found = found[word]
        found.help_epilogue = "Examples:\n\n" + "\n".join(f"    {line}" for line in lines)
