"""Where the figures of the pages come from: `docs/data/figures.yaml`, and the line that the site shows for it."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from pathlib import Path

import yaml

DATA = Path(__file__).resolve().parents[1] / "data" / "figures.yaml"
UNITS = "px|deg|°|%|µm|ms|s|mm|cm|dB|MB|GB|times|seconds|minutes|hours"
FIGURE = re.compile(rf"(?<![\w.])(?:\d[\d,.]*|\.\d+)\s?(?:{UNITS})(?!\w)")
HEADING = re.compile(r"^(#{1,4}) (.*)$", re.MULTILINE)


def load() -> dict[str, dict[str, str]]:
    """Return the origin of each section that has one, by page."""
    pages = yaml.safe_load(DATA.read_text(encoding="utf-8"))
    return {page: {title: str(where) for title, where in rows.items()} for page, rows in pages.items()}


def sections(text: str) -> Iterator[tuple[list[str], str]]:
    """Yield the headings that lead to each section, the innermost last, and the section's own text without code."""
    parts = HEADING.split(re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    path: list[tuple[int, str]] = []
    for marks, title, body in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        path = [*(one for one in path if one[0] < len(marks)), (len(marks), title)]
        yield [title for _, title in path], body


def states_figures(body: str) -> bool:
    """Whether a section has a number with a unit, or a table with three numbers or more."""
    cells = [cell.strip() for line in body.splitlines() if line.startswith("|") for cell in line.split("|")[1:-1]]
    return bool(FIGURE.search(body)) or sum(bool(re.match(r"[-+<>~≤≥]?\s*\.?\d", cell)) for cell in cells) >= 3


def origin(rows: dict[str, str], path: list[str]) -> str | None:
    """Return the origin of a section: its own, or that of the next section above it."""
    return next((rows[title] for title in [*reversed(path), ""] if title in rows), None)


def measured(text: str) -> tuple[datetime.date, str] | None:
    """Split the origin of a measurement into its day and its command, which may be empty."""
    day, _, command = text.partition(" ")
    return (datetime.date.fromisoformat(day), command) if re.match(r"\d{4}-", day) else None


def mark(page: str, text: str) -> str:
    """Add a line below each heading whose figures were measured once, or are compared in each run of the tests."""
    for title, where in load().get(page, {}).items():
        done = measured(where)
        if done is not None:
            by = f"of {done[0]}" + (f", by <code>{done[1]}</code>" if done[1] else "")
        elif where.startswith("tests/"):
            by = f"compared with the product in each run of <code>{where}</code>"
        else:
            continue
        head = re.search(rf"^#{{1,4}} {re.escape(title)}$" if title else r"^# .*$", text, re.MULTILINE)
        if head is not None:
            text = f'{text[: head.end()]}\n\n<p class="origin">Figures {by}</p>\n{text[head.end() :]}'
    return text
