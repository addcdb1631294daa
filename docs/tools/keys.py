"""The reference of every key of scene, eye and dataset files, as MyST pages made from the pydantic records.

A record has a section, and a field of it a row: type, unit, range, default, description and source. The unit comes from
the suffix of the field's name. The source of a default stands in parentheses at the end of its description.
"""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterable, Iterator
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
    lines += ["| key | value | what it is |", "|---|---|---|"]
    for row in rows_of(record):
        value = ", ".join(part for part in (cell(row.kind), row.unit, cell(row.range)) if part)
        if row.default not in ("none", "empty"):
            value += f"; {row.default}" if row.default.startswith("**") else f"; default {row.default}"
        source = f" ({row.source})" if row.source else ""
        lines.append(f"| `{row.key}` | {value} | {cell(row.description + source)} |")
    return "\n".join([*lines, "", ""])


INTRODUCTION = """Lists may be written as YAML lists; an integer may stand for a number. `[]` in a path stands for an
entry of a list. Lengths are in mm and angles in degrees unless a key ends in another unit. Unless a row says otherwise,
numbers lie between -1e9 and 1e9. Parentheses at the end of a description say where a default comes from: "chosen" means
that it was set by eye or lacks a published source, and "none stated" that the code names none.
[Conventions](../conventions.md) defines the frames."""


@dataclass(frozen=True)
class Block:
    """A page of keys: those of a kind of file that stand at some of its paths, with an example of them."""

    kind: str
    title: str
    paths: tuple[str, ...]
    example: str


# Page of each block. A record stands on the page of the longest path that begins one of its own.
BLOCKS = {
    "keys_scene": Block("scene", "Keys of a scene file", ("",), """
name: two lamps
eye: {model: E4}
rig:
  cameras: [{position_mm: [500, 0, -200], look_at_mm: [0, 0, 0], focal_length_px: 6000, resolution_px: [1280, 960]}]
  lights: [{position_mm: [500, 120, -200]}, {position_mm: [500, -120, -200]}]
  screen: {centre_mm: [600, 0, 0], size_mm: [500, 300]}
targets: {grid: [3, 3]}
region: {seed: 1}
"""),
    "keys_subject": Block("scene", "Eyes and glasses", ("eye", "subject"), """
eye: {model: E4, pupil_diameter_mm: 4}
subject:
  ipd_mm: 63
  spectacles: {sphere_d: -3, cylinder_d: -1, axis_deg: 20}
"""),
    "keys_people": Block("scene", "People", ("population", "person"), """
population: {preset: adults, seed: 0, subject: 5}
"""),
    "keys_rig": Block("scene", "Lamps, screen and what is in the way", ("rig",), """
rig:
  cameras: [{position_mm: [40, -38, -15], look_at_mm: [0, -31.5, 0], focal_length_px: 720, resolution_px: [640, 480]}]
  lights: [{ring: {camera: 0, radius_mm: 13, count: 8}, radius_mm: 0.5, aim_mm: nearest_eye}]
  screen: {centre_mm: [1000, 0, 0], size_mm: [960, 720]}
"""),
    "keys_cameras": Block("scene", "Cameras", ("rig.cameras[]",), """
rig:
  cameras:
    - {position_mm: [500, 90, -200], look_at_mm: [0, 0, 0], focal_length_px: 6000, resolution_px: [1280, 960]}
    - {position_mm: [500, -90, -200], look_at_mm: [0, 0, 0], focal_length_px: 6000, resolution_px: [1280, 960]}
  lights: [{position_mm: [500, 0, -200]}]
  screen: {centre_mm: [600, 0, 0], size_mm: [500, 300]}
"""),
    "keys_gaze": Block("scene", "Where the eyes look, and motion", ("targets", "poses", "motion"), """
targets: {screen_mm: [[-100, 0], [0, 0], [100, 0]]}
motion: {eye_deg_s: [100, 0]}
"""),
    "keys_sequence": Block("scene", "Sequences: eyes, lids, pupils and rigs in time", ("sequence",), """
sequence:
  duration_s: 2
  lids: {blinks_per_minute: 20}
  rig: {jumps_per_minute: 6, jump_mm: 0.5, jump_deg: 0.5}
"""),
    "keys_image": Block("scene", "The picture: window, sensor and lens", ("image", "sensor", "lens"), """
image: {spp: 32, window_px: [320, 240]}
sensor: {exposure_ms: 8, f_number: 2.8, psf_sigma_px: 1.2}
lens: {glare: 0.05}
"""),
    "keys_look": Block("scene", "Iris, sclera and fundus", ("look",), """
look: {iris_seed: 7, iris_albedo: 0.4}
"""),
    "keys_region": Block("scene", "Lids, lashes, brows and skin", ("region",), """
region:
  seed: 12
  lids: {upper_follows: 0.9}
  lashes: {diameter_mm: 0.1}
  skin: {albedo: 0.5}
"""),
    "keys_light": Block("scene", "Ambient light", ("ambient",), """
ambient:
  irradiance_w_m2: 0.2
  panels: [{centre_mm: [700, 400, 300], size_mm: [400, 600], radiance_w_m2_sr: 0.5}]
"""),
    "keys_eye": Block("eye", "Keys of an eye file", ("",), """
format: 3
name: my eye
cornea:
  - {name: anterior cornea, shape: {kind: conic, radius_mm: 7.8, conic_constant: -0.25}, medium: {index: 1.3375}}
retina: {shape: {kind: sphere, radius_mm: -12}, position_mm: [-24, 0, 0]}
stop: {diameter_mm: 4, position_mm: [-3.6, 0, 0]}
limbus_radius_mm: 5.85
iris: {root_radius_mm: 5.5}
sclera: {radius_mm: 12}
rotation: {azimuth_centre_mm: [-13.5, 0, 0], elevation_centre_mm: [-13.5, 0, 0]}
fovea: {field_deg: [5.45, 2.5], distance_mm: 1500}
"""),
    "keys_surfaces": Block("eye", "Surfaces of eyes", ("cornea[]",), """
cornea:
  - shape: {kind: biconic, radii_mm: [7.8, 7.6], conic_constants: [-0.25, -0.2]}
    name: anterior cornea
    medium: {index: 1.376}
  - {name: posterior cornea, shape: {kind: sphere, radius_mm: 6.5}, position_mm: [-0.55, 0, 0], medium: {index: 1.336}}
"""),
    "keys_dataset": Block("dataset", "Keys of a dataset file", ("",), """
format: 3
kind: dataset
name: mine
count: 400
shard_size: 40
subjects: 40
splits: {train: 0.8, test: 0.2}
population: {preset: adults}
scene:
  rig:
    cameras: [{position_mm: [500, 0, -200], look_at_mm: [0, 0, 0], focal_length_px: 6000, resolution_px: [1280, 960]}]
    lights: [{position_mm: [500, {draw: uniform, low: 60, high: 120}, -200]}, {position_mm: [500, -120, -200]}]
    screen: {centre_mm: [600, 0, 0], size_mm: [500, 300]}
  targets:
    screen_mm: [[{draw: sobol, low: -250, high: 250}, {draw: sobol, low: -150, high: 150}]]
  image: {window_px: [320, 240]}
  region: {seed: {draw: integer, low: 0, high: 1000000}}
"""),
}  # fmt: skip


def page_of(places: list[str], kind: str) -> str:
    """The page on which a record stands that may stand at these places of a kind of file."""
    fits = [
        (len(path), page)
        for page, block in BLOCKS.items()
        if block.kind == kind
        for path in block.paths
        for place in places
        if not path or place == path or place.startswith((f"{path}.", f"{path}["))
    ]
    return max(fits)[1]


def pages() -> dict[str, str]:
    """The pages of keys by their names. A record that several files hold is described once."""
    made = {page: head(block) for page, block in BLOCKS.items()}
    described: dict[type[Spec], str] = {}
    for kind in ("eye", "scene", "dataset"):
        for record, places in records_of(FILES[kind]).items():
            if record not in described:
                described[record] = page_of(places, kind)
                made[described[record]] += section(record, places)
    linked_pages = {page: linked(text, page, described) for page, text in made.items()}
    return {**linked_pages, "eye_sources": sources_of_eyes()}


def toctree(names: Iterable[str]) -> str:
    """A hidden table of contents, which puts generated pages below the one that holds it."""
    return "\n```{toctree}\n:hidden:\n" + "".join(f"/generated/{name}\n" for name in names) + "```\n"


def head(block: Block) -> str:
    """The head of a page: what holds for its keys, and an example."""
    text = f"# {block.title}\n\n"
    if "" in block.paths:
        text += f"{INTRODUCTION}\n\n`eyerender schema {block.kind}` prints the same as a JSON Schema for editors.\n\n"
        parts = {page: one.title for page, one in BLOCKS.items() if one.kind == block.kind and one != block}
        if block.kind == "eye":
            parts["eye_sources"] = "Sources of the shipped eyes"
        if parts:
            text += "Pages of their own:\n\n" + "".join(f"- [{its}]({page}.md)\n" for page, its in parts.items())
            text += toctree(parts) + "\n"
    else:
        start = "keys_" + block.kind
        text += f"Part of the [keys of {'an' if block.kind == 'eye' else 'a'} {block.kind} file]({start}.md)"
        text += ", which says how to read the tables.\n\n"
    return text + (f"```yaml{block.example}```\n\n" if block.example else "")


def linked(text: str, page: str, described: dict[type[Spec], str]) -> str:
    """The text of a page, whose links to records of other pages name these."""
    others = {anchor(record): its for record, its in described.items() if its != page}
    return re.sub(
        r"\(#(keys-\w+)\)", lambda one: f"({others[one[1]]}.md#{one[1]})" if one[1] in others else one[0], text
    )


def sources_of_eyes() -> str:
    """The sources of the values of the shipped eyes, as their files state them."""
    lines = ["# Sources of the shipped eyes", ""]
    for name in catalogue_names():
        eye = load_eye(name)
        lines += [f"## {name}", "", eye.description, "", "<details>", f"<summary>Sources of {name}</summary>", ""]
        lines += ["| keys | source |", "|---|---|"]
        links = {key: re.sub(r"docs/(\w+)\.md", r"[\1](../\1.md)", cell(text)) for key, text in eye.sources.items()}
        lines += [f"| `{key}` | {text} |" for key, text in links.items()]
        lines += ["", "</details>", ""]
    return "\n".join(lines)


def write(folder: Path) -> None:
    """Write the pages."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
