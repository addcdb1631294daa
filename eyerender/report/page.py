"""Self-contained HTML pages: cards, and sections with text, figures and tables.

A page is a `Page`, or a separate template that extends `page.html.j2` and fills its blocks with the macros of
`parts.html.j2`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Header, rows of text, a caption; `wide` columns (by index) hold sentences and may wrap."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    wide: Sequence[int] = ()
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Section:
    """A heading and its content in this order: text, figures, tables."""

    heading: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True, slots=True)
class Page:
    """A report."""

    title: str
    lead: Sequence[str]
    cards: Sequence[Card] = ()
    sections: Sequence[Section] = field(default_factory=tuple)


def degrees_text(value: float | None) -> str:
    """Format an angle for reading."""
    return "not seen" if value is None else f"{value:.3g}°"


def write_page(path: Path, page: Page) -> None:
    """Write one self-contained HTML file; on an error, nothing is left."""
    write_template(path, "page.html.j2", {"page": page})


def write_template(path: Path, template: str, values: Mapping[str, Any], package: str = "eyerender.report") -> None:
    """Fill a template of a package and write it as a self-contained HTML file; on an error, nothing is left."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("eyerender.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # `contents` collects the headings while the sections are rendered; the page lists them at the top.
    write_text(path, environment.get_template(template).render(contents=[], **values))
