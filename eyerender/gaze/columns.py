"""The meaning of a table's columns: given by the user or recognised from their names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from ..base.errors import Problems
from ..base.spec import FileSpec, Positive, Side, Spec, Vec2, Vec3
from ..base.storage.files import shown
from ..rig.light import MAX_LIGHTS
from ..scene.observation import EYES

ColumnName = Annotated[str, Field(min_length=1, max_length=200)]
ColumnPair = tuple[ColumnName, ColumnName]


class EyeColumns(Spec):
    """Column names of one eye."""

    pupil: ColumnPair | None = Field(default=None, description="x and y of the pupil's centre, px")
    pupil_axes: ColumnPair | None = Field(default=None, description="lengths of the ellipse's axes, px")
    pupil_angle: ColumnName | None = Field(default=None, description="angle of the first axis, from +x towards +y")
    pupil_diameter: ColumnName | None = Field(default=None, description="diameter of a round pupil, px")
    glints: Annotated[tuple[ColumnPair | None, ...], Field(max_length=MAX_LIGHTS)] | None = Field(
        default=None, description="x and y of the glint of light 0, 1, ..., px; null for a light without a column"
    )
    confidence: ColumnName | None = Field(default=None, description="confidence in the pupil")
    eye_position: tuple[ColumnName, ColumnName, ColumnName] | None = Field(
        default=None, description="x, y and z of the eye (the apex of its cornea) in the world, mm"
    )


class CsvColumns(FileSpec, EyeColumns):
    """Names and units of columns that are not recognised automatically."""

    time: ColumnName | None = Field(
        default=None, description="rows with the same time are one frame, if there is no `frame`"
    )
    frame: ColumnName | None = None
    fixation: ColumnName | None = Field(
        default=None, description="number of the target; default: equal targets are one"
    )
    camera: ColumnName | None = Field(default=None, description="index of the camera; default: 0")
    eye: ColumnName | None = None
    light: ColumnName | None = Field(default=None, description="the light of a row that holds one glint")
    target: Annotated[tuple[ColumnName, ...], Field(min_length=2, max_length=3)] | None = Field(
        default=None, description="x, y and z in the world (mm), or x and y on the screen"
    )
    right: EyeColumns | None = Field(default=None, description="columns of the right eye, if a row holds both")
    left: EyeColumns | None = None

    eyes: dict[str, Literal["right", "left"]] = Field(default={}, description="what the words in `eye` mean")
    method: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="detector whose rows are read, as the column `method` begins, if it names several"
    )
    axes: Literal["full", "semi"] | None = Field(default=None, description="default: semi if the name says so, or full")
    angle_unit: Literal["deg", "rad"] | None = Field(default=None, description="default: rad if the name says so")
    pupil_unit: Literal["px", "fraction"] | None = Field(
        default=None,
        description="unit of pupils and glints: px, or shares of the picture's sides; default: as the names say",
    )
    pupil_origin: Literal["top-left", "bottom-left"] = Field(
        default="top-left", description="where pupils and glints count from"
    )
    offset_px: Vec2 = Field(default=(0.0, 0.0), description="added to all positions in the image")
    min_confidence: float | None = Field(default=None, description="pupils below it are missing")
    target_unit: Literal["mm", "px", "fraction", "deg", "height", "norm"] | None = Field(
        default=None,
        description="unit of targets on the screen: deg at the eyes, heights of the screen, or norm, from -1 to 1; "
        "default: as the names say",
    )
    target_origin: Literal["centre", "top-left", "bottom-left"] | None = Field(
        default=None, description="where targets on the screen count from; default: the top left for px and fraction"
    )
    screen_px: tuple[Positive, Positive] | None = Field(default=None, description="width and height of the screen, px")
    eye_position_mm: dict[Literal["right", "left"], Vec3] = Field(
        default={}, description="places of eyes that keep still"
    )
    delimiter: Literal[",", ";", "\t", "|", " "] | None = Field(default=None, description="default: as the header says")


# Recognised names, without units, in lower case and with _ in place of everything else.
_PLAIN_NAMES = {
    "time": (
        "time",
        "timestamp",
        "t",
        "pupil_timestamp",
        "recording_timestamp",
        "device_time_stamp",
        "system_time_stamp",
    ),
    "frame": ("frame", "frame_index", "frame_number", "frame_id", "image_index", "world_index"),
    "fixation": ("fixation", "target_index", "target_id", "target_number", "point_index"),
    "camera": ("camera", "camera_id", "camera_index"),
    "eye": ("eye", "eye_id", "side"),
    "light": ("light", "light_id", "led", "glint_id", "glint_index"),
}
_CENTRES = ("pupil", "pupil_centre", "pupil_center", "ellipse_centre", "ellipse_center")
_AXES = (
    ("pupil_axis_a", "pupil_axis_b"), ("ellipse_axis_a", "ellipse_axis_b"), ("pupil_major", "pupil_minor"),
    ("pupil_major_axis", "pupil_minor_axis"), ("pupil_width", "pupil_height"),
    ("pupil_semi_axis_a", "pupil_semi_axis_b"), ("pupil_semi_major", "pupil_semi_minor"),
    ("pupil_semi_major_axis", "pupil_semi_minor_axis"),
)  # fmt: skip
_TARGETS = ("target", "target_screen", "screen_target", "target_world", "stimulus", "calibration_point")
_POSITIONS = ("eye_position", "eye_centre", "eye_center")
_GLINT = re.compile(r"(?:glint|cr|reflection|corneal_reflection)_?(\d{1,3})_([xy])")
_UNIT = re.compile(r"_(px|pixels?|mm|deg|degrees|rad|radians|ms|us|ns|s|norm|fraction|normali[sz]ed)$")
_SIDES = re.compile(r"^(right|left|r|l)_(.*)$|^(.*)_(right|left|r|l)$")


def completed(given: CsvColumns, header: list[str], source: str, problems: Problems) -> CsvColumns:
    """Complete the given columns by those recognised from their names.

    Raises:
        InputError: a given column does not exist, or a name is ambiguous.
    """
    data = given.to_mapping()
    named = {name for name in _names_in(data) if name is not None}
    wrong = Problems(source)
    for name in sorted(named - set(header)):
        wrong.add(f"there is no column {shown(name)}; the columns are {shown(', '.join(header), 200)}")
    wrong.check()
    free = [name for name in header if name not in named]
    found = _found(free, problems)
    if ("time" in found or "time" in data) and found.get("frame", "").strip().lower() == "world_index":
        del found["frame"]  # counts frames of the world's camera, of which each has several of an eye's
    for side in EYES:
        if side in data or (side in found and not set(EyeColumns.model_fields) & set(data)):
            data[side] = {**found.pop(side, {}), **data.get(side, {})}
        found.pop(side, None)
    problems.check()
    if "pupil_axes" in data or "pupil_diameter" in data:
        found = {key: value for key, value in found.items() if key not in ("pupil_axes", "pupil_diameter")}
    return CsvColumns.from_mapping({**found, **data})


def _names_in(data: Mapping[str, Any]) -> set[str | None]:
    """Return the column names in a mapping of columns."""
    keys = {*EyeColumns.model_fields, "time", "frame", "fixation", "camera", "eye", "light", "target"}
    out: set[str | None] = set()
    for key, value in data.items():
        if key in EYES:
            out |= _names_in(value)
        elif key in keys:
            for one in value if isinstance(value, list) else [value]:
                out.update(one if isinstance(one, list) else [one])
    return out


class _Names:
    """Columns of a table by their bare names: lower case, without units."""

    def __init__(self, problems: Problems) -> None:
        self.columns: dict[str, list[str]] = {}
        self._problems = problems

    def add(self, bare: str, column: str) -> None:
        self.columns.setdefault(_UNIT.sub("", bare), []).append(column)

    def all_of(self, *bare: str) -> list[str] | None:
        """Return the columns of names that belong together; None if one is missing."""
        if not all(name in self.columns for name in bare):
            return None
        for name in bare:
            if len(self.columns[name]) > 1:
                meant = " and ".join(self.columns[name])
                self._problems.add(f"the columns {meant} could both be meant; say which with --columns")
        return [self.columns[name][0] for name in bare]

    def first(self, choices: Iterable[tuple[str, ...]]) -> list[str] | None:
        """Return the columns of the first choice that the table has."""
        return next((found for choice in choices if (found := self.all_of(*choice))), None)

    def one(self, choices: Iterable[str]) -> str | None:
        """Return the column of the first name that the table has."""
        found = self.first((name,) for name in choices)
        return found[0] if found else None

    def glints(self) -> list[list[str] | None] | None:
        """Return the glint columns of each light; if no name has the number 0, lights are counted from 1."""
        named = {(int(m[1]), m[2]): name for name in self.columns if (m := _GLINT.fullmatch(name))}
        if not named:
            single = self.first((f"{glint}_x", f"{glint}_y") for glint in ("glint", "cr"))
            return None if single is None else [single]
        lights = {light for light, _ in named}
        start = 1 if min(lights) == 1 else 0
        pairs = [(named.get((k, "x")), named.get((k, "y"))) for k in range(start, max(lights) + 1)]
        return [self.all_of(x, y) if x and y else None for x, y in pairs]

    def eye(self) -> dict[str, Any]:
        """Return the `EyeColumns` that are recognised, by key."""
        axes = self.first(_AXES)
        found = {
            "pupil": self.first((f"{name}_x", f"{name}_y") for name in _CENTRES),
            "pupil_axes": axes,
            "pupil_angle": self.one(("pupil_angle", "ellipse_angle", "pupil_rotation")),
            "pupil_diameter": None if axes else self.one(("pupil_diameter", "diameter")),
            "glints": self.glints(),
            "confidence": self.one(("confidence", "pupil_confidence")),
            "eye_position": self.first(tuple(f"{name}_{axis}" for axis in "xyz") for name in _POSITIONS),
        }
        return {key: value for key, value in found.items() if value is not None}


def _found(header: list[str], problems: Problems) -> dict[str, Any]:
    """Return the columns that are recognised from their names."""
    whole, sides = _Names(problems), {side: _Names(problems) for side in EYES}
    for column in header:
        bare = re.sub(r"[^a-z0-9]+", "_", column.lower()).strip("_")
        if bare.endswith("diameter_mm"):
            continue  # a size in mm is not a size in the image
        whole.add(bare, column)
        split = _SIDES.match(_UNIT.sub("", bare)) or _SIDES.match(bare)
        if split:
            side: Side = "right" if (split[1] or split[4]).startswith("r") else "left"
            sides[side].add(split[2] or split[3], column)
    found = whole.eye()
    for key, names in _PLAIN_NAMES.items():
        if (column_of := whole.one(names)) is not None:
            found[key] = column_of
    axes = ("xyz", "xy")
    target = whole.first(tuple(f"{name}_{axis}" for axis in which) for name in _TARGETS for which in axes)
    if target is not None:
        found["target"] = target
    if "pupil" not in found and "glints" not in found:
        found |= {side: eye for side, names_of in sides.items() if {"pupil", "glints"} & (eye := names_of.eye()).keys()}
    return found
