"""Tables of the validation page, from the files that `scripts/tools/measure_validation.py` writes to `docs/data`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

DATA = Path(__file__).resolve().parents[1] / "data"


def tables(data: dict[str, Any]) -> str:
    """The tables of one file: a section for each group of rows."""
    text = f"Measured {data['measured']} with version {data['version']}, on {data['on']}.\n\n"
    for title, rows in data["groups"].items():
        text += (
            f"## {title}\n\n| quantity | compared with | largest deviation | tolerance of the test | comparisons |\n"
        )
        text += "|---|---|---|---|---|\n"
        for row in rows:
            value, limit = (quantity(row[key], row["unit"]) for key in ("value", "limit"))
            text += f"| {row['what']} | {row['oracle']} | {value} | {limit} | {row['cases']} |\n"
        text += "\n"
    return text


def quantity(number: float, unit: str) -> str:
    """A number with two digits and its unit."""
    if unit == "relative":
        return f"{100 * number:.2g} %"
    return f"{number:.2g}{'' if unit == '°' else ' '}{unit}"


def write(folder: Path) -> None:
    """Write the tables as a page to include."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [tables(json.loads(path.read_text(encoding="utf-8"))) for path in sorted(DATA.glob("*.json"))]
    (folder / "validation_tables.md").write_text("\n".join(parts), encoding="utf-8")
