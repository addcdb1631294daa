"""The conventions of an extractor's numbers, and their conversion to this package's.

This package: pixel centres at integers, x right, y down, semi-axes a >= b, angle of a from +x toward +y in [0, pi).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args, get_type_hints

from ...base.errors import InputError
from ...base.storage.files import shown
from ...optics.ellipse import Ellipse


@dataclass(frozen=True, slots=True, kw_only=True)
class Conventions:
    """Conventions of an extractor for positions, axes and angles; the defaults are this package's.

    OpenCV's rotated rectangle is full, deg, first, down, centre.

    Attributes:
        pixel_origin: meaning of (0, 0): the centre of the first pixel, or its outer corner (the centre is then (.5,
            .5)).
        axes: semi-axes or full ones.
        angle_unit: unit of the angle.
        angle_of: the axis to which the angle belongs: the major one, the minor one, or the first of the two.
        angle_toward: direction from +x that counts as positive: toward +y, down the image ("down"), or up.
    """

    pixel_origin: Literal["centre", "corner"] = "centre"
    axes: Literal["semi", "full"] = "semi"
    angle_unit: Literal["rad", "deg"] = "rad"
    angle_of: Literal["major", "minor", "first"] = "major"
    angle_toward: Literal["down", "up"] = "down"

    @classmethod
    def of(cls, stated: object) -> Conventions:
        """Create conventions from a mapping of some of the names above.

        Raises:
            InputError: a name or a value is unknown.
        """
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
    """Parse a finite number of plausible size.

    Raises:
        InputError: naming the path.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"must be a number, not {shown(value, 40)}", path=path)
    if abs(value) > limit or not math.isfinite(value):  # in this order, because an integer may be too large for a float
        raise InputError(f"must be a finite number within {limit:g}, not {shown(value, 40)}", path=path)
    return float(value)


def pair(value: Any, path: str) -> tuple[float, float]:
    """Parse two numbers.

    Raises:
        InputError: naming the path.
    """
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence) or len(value) != 2:
        raise InputError(f"must be two numbers, not {shown(value, 40)}", path=path)
    return number(value[0], f"{path}.0"), number(value[1], f"{path}.1")
