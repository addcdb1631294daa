"""Protocol between the benchmark and an extractor: versioned JSON lines.

    extractor -> bench  {"schema": "eyerender/extractor/1", "name", "conventions": {..}, "reports": ["pupil", "glints"]}
    bench -> extractor  {"schema": "eyerender/extractor/1", "id", "image", "bit_depth", "hints": {..}}
    extractor -> bench  {"id", "record": {"pupil": {..}, "glints": [..]}, "cpu_s": null, "wall_s": null}
                    or  {"id", "error": "why this image could not be processed"}

Every line is one object. The greeting comes once, then an answer to each request in turn; the extractor ends with its
input. The record is the package's (eyerender/record/3). Only `pupil.status` is required, and with "ok" centre, axes and
angle: either `semi_axes_px` and `angle_rad`, whose names define them, or `axes_px` and `angle` as `conventions`
declares. Places are relative to the image.

This package: pixel centres at integers, x right, y down, semi-axes a >= b, angle of a from +x toward +y in [0, pi).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Protocol, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ...base.errors import InputError, one_line
from ...base.storage.files import shown
from ...optics.ellipse import Ellipse


@dataclass(frozen=True, slots=True, kw_only=True)
class Conventions:
    """Conventions of an extractor for positions, axes and angles; the defaults are this package's.

    OpenCV's rotated rectangle is full, deg, first, down, centre.
    """

    # meaning of (0, 0): the centre of the first pixel, or its outer corner (the centre is then (.5, .5))
    pixel_origin: Literal["centre", "corner"] = "centre"
    axes: Literal["semi", "full"] = "semi"  # semi-axes or full ones
    angle_unit: Literal["rad", "deg"] = "rad"  # unit of the angle
    # the axis to which the angle belongs: the major one, the minor one, or the first of the two
    angle_of: Literal["major", "minor", "first"] = "major"
    # direction from +x that counts as positive: toward +y, down the image ("down"), or up
    angle_toward: Literal["down", "up"] = "down"

    @classmethod
    def of(cls, stated: object) -> Conventions:
        """Create conventions from a mapping of some of the names above; InputError if a name or a value is unknown."""
        if isinstance(stated, Conventions):
            return stated
        if stated is None:
            return cls()
        if not isinstance(stated, Mapping):
            raise InputError("must be an object", path="conventions")
        kinds = get_type_hints(cls)
        known = [f.name for f in fields(cls)]
        for name, value in stated.items():
            if name not in known:
                raise InputError(f"unknown; there are {', '.join(known)}", path=f"conventions.{name}")
            if value not in get_args(kinds[name]):
                raise InputError(
                    f"must be one of {', '.join(get_args(kinds[name]))}, not {value!r}", path=f"conventions.{name}"
                )
        return cls(**stated)

    def to_mapping(self) -> dict[str, str]:
        """Convert to a mapping for JSON."""
        return asdict(self)

    def point(self, xy: Sequence[float]) -> tuple[float, float]:
        """Convert a position in the image to px."""
        shift = 0.5 if self.pixel_origin == "corner" else 0.0
        return xy[0] - shift, xy[1] - shift

    def ellipse(self, centre: Sequence[float], axes: Sequence[float], angle: float) -> Ellipse:
        """Convert an ellipse to centre, semi-axes (px) and angle (rad) of this package.

        Raises:
            InputError: an axis is not positive, or a number is not finite.
        """
        first, second = axes
        if (self.angle_of == "major" and second > first) or (self.angle_of == "minor" and second < first):
            first, second = second, first
        half = 0.5 if self.axes == "full" else 1.0
        turn = math.radians(angle) if self.angle_unit == "deg" else angle
        turn = -turn if self.angle_toward == "up" else turn
        return Ellipse(self.point(centre), (half * first, half * second), turn)  # type: ignore[arg-type]


OPENCV = Conventions(axes="full", angle_unit="deg", angle_of="first")


def number(value: Any, path: str, limit: float = 1e6) -> float:
    """Parse a finite number of plausible size; InputError naming the path."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"must be a number, not {shown(value, 40)}", path=path)
    if abs(value) > limit or not math.isfinite(value):  # in this order, because an integer may be too large for a float
        raise InputError(f"must be a finite number within {limit:g}, not {shown(value, 40)}", path=path)
    return float(value)


def pair(value: Any, path: str) -> tuple[float, float]:
    """Parse two numbers; InputError naming the path."""
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence) or len(value) != 2:
        raise InputError(f"must be two numbers, not {shown(value, 40)}", path=path)
    return number(value[0], f"{path}.0"), number(value[1], f"{path}.1")


SCHEMA = "eyerender/extractor/1"
FEATURES = ("pupil", "glints")
_MOST_GLINTS = 1000
Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


class Extractor(Protocol):
    """Interface of an extractor in Python: a stateless function of an image.

    Two optional attributes of the function declare more: `conventions`, the meaning of the numbers in its records (the
    keys of `Conventions`; by default this package's), and `reports`, the features that it detects (`FEATURES`).
    """

    def __call__(self, image: Image, request: Mapping[str, Any], /) -> Mapping[str, Any]:
        """Extract features from an image: `{"pupil": {..}, "glints": [..]}`, as in the protocol above.

        `image`: (h, w) values as stored in the file; `request`: the request above, with `bit_depth` and `hints`.
        """
        ...


@dataclass(frozen=True, slots=True)
class Greeting:
    """Self-description of an extractor."""

    name: str  # its name and version
    conventions: Conventions  # the meaning of its numbers
    reports: tuple[str, ...]  # the features that it detects
    # whether its first answer takes longer, because it loads libraries or compiles; the time limit of the start is then
    # added for that answer
    warms_up: bool = False

    @classmethod
    def parse(cls, line: str) -> Greeting:
        """Parse a line. Raises InputError if the line is wrong; the message says why."""
        data = _object(line)
        if data.get("schema") != SCHEMA:
            raise InputError(f"is {data.get('schema')!r}; this version speaks {SCHEMA!r}", path="schema")
        name, reports = data.get("name"), data.get("reports", list(FEATURES))
        if not isinstance(name, str) or not name.strip() or len(name) > 80:
            raise InputError("must be a name", path="name")
        if not isinstance(reports, list) or "pupil" not in reports or any(r not in FEATURES for r in reports):
            raise InputError(f"must name 'pupil' and at most {', '.join(FEATURES)}", path="reports")
        known = tuple(f for f in FEATURES if f in reports)
        return cls(name.strip(), Conventions.of(data.get("conventions")), known, data.get("warms_up") is True)


@dataclass(frozen=True, slots=True)
class Request:
    """One image to process; `hints` is the information given to every extractor, never the truth."""

    id: int
    image: str
    bit_depth: int
    hints: Mapping[str, Any]

    def to_line(self) -> str:
        """Return the request as a line of JSON."""
        data = {"schema": SCHEMA, "id": self.id, "image": self.image, "bit_depth": self.bit_depth}
        return json.dumps({**data, "hints": dict(self.hints)}, allow_nan=False) + "\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """Answer of an extractor, in this package's conventions."""

    ellipse: Ellipse | None = None  # the pupil; None if it found none
    reason: str | None = None  # why it found none
    confidence: float | None = None  # its confidence, if reported
    glints: tuple[tuple[tuple[float, float], int | None], ...] = ()  # ((x, y), light or None) in px
    cpu_s: float | None = None  # processor time, if reported
    wall_s: float | None = None  # elapsed time, if reported
    error: str | None = None  # why it failed on this image, in its own words; the rest is then empty
    line: str = ""  # the answer as it was sent

    @classmethod
    def parse(cls, line: str, request_id: int, conventions: Conventions) -> Reply:
        """Parse a line. Raises InputError if the line is wrong; the message says why."""
        data = _object(line)
        if data.get("id") != request_id:
            raise InputError(f"must be {request_id}, not {shown(data.get('id'))}", path="id")
        if data.get("error") is not None:
            return cls(error=_words(data["error"]) or "no reason given")
        record = data.get("record")
        if not isinstance(record, dict) or not isinstance(record.get("pupil"), dict):
            raise InputError("must hold the pupil", path="record")
        pupil = record["pupil"]
        ellipse = None
        if pupil.get("status") == "ok":
            ellipse = _ellipse(pupil, conventions)
        elif pupil.get("status") != "missing":
            raise InputError(f"must be 'ok' or 'missing', not {shown(pupil.get('status'))}", path="pupil.status")
        reason = pupil.get("reason")
        return cls(
            ellipse=ellipse,
            reason=_words(reason) if reason else None,
            confidence=_optional(pupil.get("confidence"), "pupil.confidence"),
            glints=_glints(record.get("glints"), conventions),
            cpu_s=_optional(data.get("cpu_s"), "cpu_s"),
            wall_s=_optional(data.get("wall_s"), "wall_s"),
            line=line,
        )


def _ellipse(pupil: Mapping[str, Any], conventions: Conventions) -> Ellipse:
    centre = pair(pupil.get("centre_px"), "pupil.centre_px")
    if "semi_axes_px" in pupil:
        axes = pair(pupil["semi_axes_px"], "pupil.semi_axes_px")
        angle = number(pupil.get("angle_rad"), "pupil.angle_rad")
        # The names define these values; only the origin remains to be declared.
        conventions = Conventions(pixel_origin=conventions.pixel_origin)
    else:
        axes = pair(pupil.get("axes_px"), "pupil.axes_px")
        angle = number(pupil.get("angle"), "pupil.angle")
    return conventions.ellipse(centre, axes, angle)


def _glints(entries: Any, conventions: Conventions) -> tuple[tuple[tuple[float, float], int | None], ...]:
    if entries is None:
        return ()
    if not isinstance(entries, list) or len(entries) > _MOST_GLINTS:
        raise InputError(f"must be a list of at most {_MOST_GLINTS}", path="glints")
    out = []
    for k, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise InputError("must be an object", path=f"glints.{k}")
        if entry.get("status", "ok") != "ok":
            continue
        light = entry.get("light")
        if light is not None and (isinstance(light, bool) or not isinstance(light, int)):
            raise InputError("must be a whole number or null", path=f"glints.{k}.light")
        known = light if light is not None and light >= 0 else None
        out.append((conventions.point(pair(entry.get("xy_px"), f"glints.{k}.xy_px")), known))
    return tuple(out)


def _words(value: Any) -> str:
    """Convert the text of an extractor to one printable line."""
    return one_line(" ".join(str(value).split()), 200)


def _optional(value: Any, path: str) -> float | None:
    return None if value is None else number(value, path)


def _object(line: str) -> dict[str, Any]:
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        raise InputError(f"printed a line that is not JSON: {shown(line.strip())}") from None
    if not isinstance(data, dict):
        raise InputError("printed JSON that is not an object")
    return data
