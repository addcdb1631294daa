"""The reference of every key of scene, eye and dataset files, as MyST pages made from the pydantic records.

A record has a section, and a field of it a row: type, unit, range, default, description and source. The unit comes from
the suffix of the field's name. The source of a default stands in parentheses at the end of its description.
"""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from eyerender.base.spec import LARGEST, Spec
from eyerender.dataset.spec import DatasetSpec
from eyerender.eye.catalogue import catalogue_names, load_eye
from eyerender.eye.spec import EyeSpec
from eyerender.scene.spec import SceneSpec

FILES: dict[str, type[Spec]] = {"scene": SceneSpec, "eye": EyeSpec, "dataset": DatasetSpec}

# Longer suffixes come first.
UNITS = {
    "_w_m2_sr": "W/(m² sr)",
    "_w_m2": "W/m²",
    "_mw_sr": "mW/sr",
    "_mm_per_mm": "mm/mm",
    "_dn_per_e": "DN/e⁻",
    "_deg_s": "°/s",
    "_mm_s": "mm/s",
    "_deg": "°",
    "_mm": "mm",
    "_um": "µm",
    "_nm": "nm",
    "_px": "px",
    "_ms": "ms",
    "_dn": "DN",
    "_e": "e⁻",
}
OWN_UNITS = {"K": "px", "spp": "samples", "t_mm": "mm", "right_eye": "of the file", "left_eye": "of the file"}

# Modules that put the source of each default in parentheses at the end of its description.
SOURCED = ("eyerender.region.anatomy", "eyerender.region.look", "eyerender.eye.margin")


@dataclass(frozen=True)
class Row:
    """One key of a file."""

    record: str
    key: str
    kind: str
    unit: str
    range: str
    default: str
    description: str
    source: str


def records_of(root: type[Spec]) -> dict[type[Spec], list[str]]:
    """The records inside a record, itself first, each with the dotted paths at which it may stand."""
    found: dict[type[Spec], list[str]] = {}

    def walk(record: type[Spec], path: str) -> None:
        places = found.setdefault(record, [])
        if path in places:
            return
        places.append(path)
        if len(places) == 1:
            for name, field in record.model_fields.items():
                for inner, many in nested(field.annotation):
                    walk(inner, f"{path}.{name}{'[]' if many else ''}".lstrip("."))

    walk(root, "")
    return found


def nested(annotation: Any, many: bool = False) -> Iterator[tuple[type[Spec], bool]]:
    """The records that a type may hold, and whether it holds a list of them."""
    if isinstance(annotation, type) and not typing.get_args(annotation) and issubclass(annotation, Spec):
        yield annotation, many
    for part in typing.get_args(annotation):
        yield from nested(part, many or typing.get_origin(annotation) is tuple)


def rows_of(record: type[Spec]) -> list[Row]:
    """A row for each field of a record."""
    rows = []
    for key, field in record.model_fields.items():
        description = re.sub(r"; -?[\d.]+ to -?[\d.]+$", "", field.description or "")  # the range has a column
        stated = re.fullmatch(r"(.*) \((.*)\)", description) if record.__module__ in SOURCED else None
        source = "none stated" if isinstance(field.default, float) and field.default != 0 else ""
        if stated:
            description, source = stated.groups()
        row = (kind_of(field.annotation), unit_of(key), range_of(field), default_of(field), description, source)
        rows.append(Row(record.__name__, key, *row))
    return rows


def unit_of(key: str) -> str:
    """Unit of a key, from its suffix."""
    if key in OWN_UNITS:
        return OWN_UNITS[key]
    return next((unit for suffix, unit in UNITS.items() if key.endswith(suffix)), "")


def kind_of(annotation: Any) -> str:
    """A type in words, with records as links."""
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return kind_of(args[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(kind_of(a) for a in args if a is not type(None)))
    if origin is typing.Literal:
        return ", ".join(f"`{value}`" for value in args)
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"list of {kind_of(args[0])}"
        inner = dict.fromkeys(kind_of(a) for a in args)
        return f"{len(args)} of {' or '.join(inner)}"
    if origin is dict:
        return "mapping"
    if isinstance(annotation, type) and issubclass(annotation, Spec):
        return f"[{annotation.__name__}](#{anchor(annotation)})"
    return {int: "integer", float: "number", str: "text", bool: "yes or no"}.get(annotation, "any value")


def limits(annotation: Any, metadata: list[Any]) -> dict[str, float]:
    """The constraints of a field, or of what it holds."""
    found: dict[str, float] = {}
    for part in metadata:
        for name in ("ge", "gt", "le", "lt", "min_length", "max_length"):
            if getattr(part, name, None) is not None:
                found[name] = getattr(part, name)
        if isinstance(part, FieldInfo):
            found |= limits(None, list(part.metadata))
    for part in typing.get_args(annotation) if annotation is not None else ():
        if typing.get_origin(part) is typing.Annotated:
            inner, *more = typing.get_args(part)
            found = {**limits(inner, more), **found}
        elif typing.get_args(part):
            found = {**limits(part, []), **found}
    return found


def range_of(field: FieldInfo) -> str:
    """The range of numbers, and of the length of lists, in words."""
    found = limits(field.annotation, list(field.metadata))
    low = f"≥ {found['ge']:g}" if "ge" in found else f"> {found['gt']:g}" if "gt" in found else ""
    high = f"≤ {shorter(found['le'])}" if "le" in found else f"< {shorter(found['lt'])}" if "lt" in found else ""
    parts = [f"{low}, {high}"] if low and high else [low or high]
    if found.get("ge") == -LARGEST and found.get("le") == LARGEST:
        parts = ["any"]
    elif found.get("le") == LARGEST and "float" in str(field.annotation):
        parts = [low]
    listed = any(typing.get_origin(a) is tuple for a in (field.annotation, *typing.get_args(field.annotation)))
    if listed and ("min_length" in found or "max_length" in found):
        least, most = found.get("min_length", 0), found.get("max_length")
        parts.append(f"{least:g} or more entries" if most is None else f"{least:g} to {most:g} entries")
    return "; ".join(part for part in parts if part)


def shorter(limit: float) -> str:
    """A limit, large powers of two as such."""
    power = int(limit).bit_length() - 1
    return f"2^{power}" if limit == 2**power and power >= 31 else f"{limit:g}"


def default_of(field: FieldInfo) -> str:
    """The default, as YAML would say it."""
    if field.is_required():
        return "**required**"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "none"
    if isinstance(value, Spec):
        return "its defaults"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{plain(value)}`" if value != "" else "empty"


def plain(value: Any) -> str:
    """A default without Python's marks."""
    if isinstance(value, tuple):
        return "[" + ", ".join(plain(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {plain(v)}" for k, v in value.items()) + "}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def anchor(record: type[Spec]) -> str:
    """The label of a record's section."""
    return f"keys-{record.__name__.lower()}"


def plain_doc(record: type[Spec]) -> str:
    """The docstring of a record as text, without its example; Markdown marks outside its code are escaped."""
    parts = " ".join((record.__doc__ or "").partition(">>>")[0].split()).split("`")
    return "`".join(part if i % 2 else re.sub(r"([<*_])", r"\\\1", part) for i, part in enumerate(parts))


def cell(text: str) -> str:
    """Text that a cell of a table may hold."""
    return text.replace("|", "\\|").replace("<", "\\<").replace("*", "\\*") if "**" not in text else text


def section(record: type[Spec], places: list[str], level: int = 2) -> str:
    """The section of one record: where it stands, what it is, and its table."""
    where = ", ".join(f"`{place}`" for place in places if place) or "the top of the file"
    lines = [f"({anchor(record)})=", f"{'#' * level} {record.__name__}", "", f"At {where}. {plain_doc(record)}", ""]
    lines += ["| key | type | unit | range | default | what it is | source of the default |", "|---" * 7 + "|"]
    for row in rows_of(record):
        cells = (f"`{row.key}`", row.kind, row.unit, row.range, row.default, row.description, row.source)
        lines.append("| " + " | ".join(cell(text) for text in cells) + " |")
    return "\n".join([*lines, "", ""])


INTRODUCTION = """Lists may be written as YAML lists; an integer may stand for a number. `[]` in a path stands for an
entry of a list. Lengths are in mm and angles in degrees unless a key ends in another unit. Unless a row says otherwise,
numbers lie between -1e9 and 1e9. The last column says where a default comes from: "chosen" means that it was set by eye
or lacks a published source, and "none stated" that the code names none. An empty cell means that there is no default,
or that it is a convention or switches something off. [Conventions](../conventions.md) defines the frames."""


def pages() -> dict[str, str]:
    """The three pages of keys by their names. A record that several files hold is described once."""
    made: dict[str, str] = {}
    described: set[type[Spec]] = set()
    for name in ("eye", "scene", "dataset"):
        root = FILES[name]
        text = f"# Keys of {'an' if name == 'eye' else 'a'} {name} file\n\n{INTRODUCTION}\n\n"
        text += f"`eyerender schema {name}` prints the same as a JSON Schema for editors.\n\n"
        for record, places in records_of(root).items():
            if record not in described:
                described.add(record)
                text += section(record, places)
        if name == "eye":
            text += sources_of_eyes()
        made[f"keys_{name}"] = text
    return made


def sources_of_eyes() -> str:
    """The sources of the values of the shipped eyes, as their files state them."""
    lines = ["## Sources of the shipped eyes", ""]
    for name in catalogue_names():
        eye = load_eye(name)
        lines += [f"### {name}", "", eye.description, "", "| keys | source |", "|---|---|"]
        lines += [f"| `{key}` | {cell(text)} |" for key, text in eye.sources.items()]
        lines.append("")
    return "\n".join(lines)


def write(folder: Path) -> None:
    """Write the pages."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
