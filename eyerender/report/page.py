"""Self-contained HTML pages: cards, and sections of text, figures, tables and pictures.

A page is plain data; `page.html.j2` turns it into HTML. All text is escaped; figures and pictures hold markup of this
package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from ..base.storage.files import write_text


@dataclass(frozen=True, slots=True)
class Card:
    """An important number and its meaning."""

    value: str
    text: str


@dataclass(frozen=True, slots=True)
class Figure:
    """An <svg> element and its caption; `small` ones stand side by side."""

    svg: str
    caption: str
    small: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Header, rows of text, a caption; `wide` columns (by index) hold sentences and may wrap."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    wide: Sequence[int] = ()
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Gallery:
    """Pictures in a grid, each as markup and lines of text, of which the first is its name."""

    pictures: Sequence[tuple[str, Sequence[str]]]  # the pictures
    heading: str = ""  # a heading above them
    width_rem: float = 13.5  # smallest width of a picture
    rows: int | None = None  # number of rows, filled column by column; None: as many columns as fit, filled row by row


@dataclass(frozen=True, slots=True)
class Key:
    """Colours of marks and their meanings; with `switches` (classes of the marks), each kind can be hidden."""

    colours: Sequence[tuple[str, str]]
    switches: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Listing:
    """Preformatted text under its caption, folded."""

    caption: str
    text: str


Content = str | Figure | Table | Gallery | Key | Listing | None
"""Content of a section: a paragraph, one of the classes above, or None, which adds nothing."""


class Section:
    """A heading and its content."""

    def __init__(self, heading: str, *content: Content) -> None:
        self.heading, self.content = heading, content


@dataclass(frozen=True, slots=True)
class Page:
    """A report; sections that are None add nothing."""

    title: str
    lead: Sequence[str]
    cards: Sequence[Card]
    sections: Sequence[Section | None]


def degrees_text(value: float | None) -> str:
    """Format an angle for reading."""
    return "not seen" if value is None else f"{value:.3g}°"


def number(value: float | None, decimals: int = 4) -> str:
    """Format a number of a table; a dash for None and for what is not finite."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def table_of(
    items: Iterable[Any], columns: Mapping[str, str | Callable[[Any], Any]], caption: str = "", **options: Any
) -> Table:
    """Make a table of records; each column has the name of a key, or a function of the record.

    Columns without any value are left out. `options` are fields of `Table`; `wide` counts the columns as given.
    """
    rows = [[source(one) if callable(source) else _value(one, source) for source in columns.values()] for one in items]
    kept = [k for k in range(len(columns)) if not rows or any(row[k] not in (None, "") for row in rows)]
    header = list(columns)
    wide = tuple(kept.index(k) for k in options.pop("wide", ()) if k in kept)
    cells = [[cell(row[k]) for k in kept] for row in rows]
    return Table([header[k] for k in kept], cells, caption, wide=wide, **options)


def _value(item: Any, key: str) -> Any:
    return item[key] if isinstance(item, Mapping) else getattr(item, key)


def cell(value: Any) -> str:
    """Format a value of a table: numbers with four decimals, truths as yes or no, a dash for None."""
    if value is None or isinstance(value, bool):
        return "-" if value is None else "yes" if value else "no"
    return number(value) if isinstance(value, float) else str(value)


def write_page(path: Path, page: Page) -> None:
    """Write one self-contained HTML file; on an error, nothing is left."""
    environment = Environment(
        loader=PackageLoader("eyerender.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["kind"] = lambda content: type(content).__name__
    write_text(path, environment.get_template("page.html.j2").render(page=page))
