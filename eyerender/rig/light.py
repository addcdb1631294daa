"""Infrared LEDs: positions, sizes and radiation patterns.

Radiant intensity in direction w: I(w) = I0 max(0, cos(angle to the axis))^m (m = 0: the same everywhere).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Discriminator, Field, Tag, model_validator

from ..base.arrays import ArrayValue, Floats, frozen
from ..base.spec import EYES, NonNegative, Number, Positive, Side, Spec, Vec3
from .camera import EyeNames, PinholeCamera, facing, serves
from .mirror import Mirror
from .timing import ALWAYS_S, Pulse

# Largest number of LEDs of a rig, including each LED of a ring: each has a glint with a status and a reason in every
# frame.
MAX_LIGHTS = 1000

NEAREST_EYE: Literal["nearest_eye"] = "nearest_eye"
# Corneal apexes of an adult with the mean distance of the pupils, 63.5 mm, whose head is at the world's origin. A lamp
# has one aim for all who sit before it.
_EYES_MM = np.array([[0.0, -31.75, 0.0], [0.0, 31.75, 0.0]])


Aim = Annotated[
    Annotated[Literal["nearest_eye"], Tag("TextSpec")] | Annotated[Vec3, Tag("PointSpec")],
    Discriminator(lambda value: "TextSpec" if isinstance(value, str) else "PointSpec"),
]


class LedRing(Spec):
    """LEDs evenly spaced on a circle about a camera's axis, in the plane of its nodal point, or about `centre_mm`.

    >>> er.Led(ring=er.rig.LedRing(radius_mm=20, count=6)).ring.count
    6
    """

    camera: Annotated[int, Field(ge=0)] = Field(default=0, description="the camera that the ring surrounds")
    centre_mm: Vec3 | None = Field(
        default=None, description="middle of a ring that surrounds no camera, for example a display lens, in the world"
    )
    axis: Vec3 | None = Field(
        default=None, description="with `centre_mm`: vector along its axis, away from the eye; default: (1, 0, 0)"
    )
    radius_mm: Positive = Field(description="radius of the circle")
    count: Annotated[int, Field(ge=1, le=MAX_LIGHTS)] = Field(description="number of LEDs on the circle")
    phase_deg: Number = Field(
        default=0.0,
        description="angle of the first LED, from the right of the image towards its bottom; with `centre_mm`, of the "
        "image of a camera there that looks against the axis",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.centre_mm is None and self.axis is not None:
            raise ValueError("axis is that of a ring with centre_mm")
        if self.centre_mm is not None and self.camera:
            raise ValueError("give either camera or centre_mm")
        if self.axis is not None and not np.linalg.norm(self.axis) > 1e-9:
            raise ValueError("axis must not be zero")
        return self

    def places_mm(self, cameras: Sequence[PinholeCamera]) -> list[Floats]:
        """Compute the places, (3,) mm each, of the LEDs among cameras."""
        if self.centre_mm is None:
            camera = cameras[self.camera]
            middle, (right, down, _) = camera.nodal_point_mm, camera.R
        else:
            middle, (right, down, _) = np.array(self.centre_mm), facing(-np.array(self.axis or (1.0, 0.0, 0.0))).T
        angles = np.radians(self.phase_deg) + 2 * np.pi * np.arange(self.count) / self.count
        return [middle + self.radius_mm * (np.cos(a) * right + np.sin(a) * down) for a in angles]


class Led(Spec):
    """One LED at `position_mm`, or a `ring` of equal LEDs.

    >>> er.Led((600, 120, 0)).radius_mm
    0.0
    """

    POSITIONAL: ClassVar[tuple[str, ...]] = ("position_mm",)
    if TYPE_CHECKING:

        def __init__(self, position_mm: Any = None, **fields: Any) -> None: ...

    position_mm: Vec3 | None = Field(default=None, description="place in the world; give this or `ring`")
    ring: LedRing | None = Field(default=None, description="a circle of LEDs, in place of one LED")
    radius_mm: NonNegative = Field(default=0.0, description="radius of the emitting disc; 0 is a point")
    inner_radius_mm: NonNegative = Field(default=0.0, description="radius of the hole of a ring-shaped emitter")
    aim_mm: Aim = Field(
        default=NEAREST_EYE,
        description="world point on its axis, or `nearest_eye`: the nearer of (0, -31.75, 0) and (0, 31.75, 0), where "
        "an adult's corneas are, and the origin for a light midway",
    )
    intensity_mw_sr: Positive = Field(default=20.0, description="radiant intensity on the axis")
    lobe_exponent: NonNegative = Field(default=1.0, description="m of cos^m; 1 is Lambertian, 0 isotropic")
    eyes: EyeNames | None = Field(
        default=None,
        description="eyes that it lights, all LEDs of a ring alike; the nose or a seal keeps its light "
        "from the other eye; default: both",
    )
    mirror: Mirror | None = Field(
        default=None,
        description="plane mirror over which its light comes; place and aim are those of the LED itself, and the "
        "default aim is over the mirror; it has no outline and no ghosts",
    )
    duty_cycle: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None,
        description="share of the time in which it is on, for eye safety alone; pictures expose while it is on; "
        "default: that of its pulses, else 1",
    )
    pulse: Pulse | None = Field(
        default=None, description="when it is on in each frame of the cameras, with a `sequence`; default: always"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.position_mm is None) == (self.ring is None):
            raise ValueError("give either position_mm or ring")
        if self.inner_radius_mm > 0 and self.inner_radius_mm >= self.radius_mm:
            raise ValueError("inner_radius_mm must be less than radius_mm")
        if self.position_mm is not None and np.allclose(self.position_mm, self._aim(self.position_mm), atol=1e-6):
            raise ValueError("aim_mm is the light's own position")
        if self.mirror is not None and self.mirror.outline_mm is not None:
            raise ValueError("mirror.outline_mm: the mirror of an LED has no outline")
        return self

    def _aim(self, place_mm: ArrayLike) -> Floats:
        """Compute the world point, (3,) mm, that a light at a place, (3,) mm, aims at."""
        if self.aim_mm != NEAREST_EYE:
            return np.array(self.aim_mm, dtype=float)
        right, left = np.linalg.norm(_EYES_MM - np.asarray(place_mm, dtype=float), axis=1)
        if abs(right - left) < 1e-9:
            return np.zeros(3)
        nearest: Floats = _EYES_MM[0 if right < left else 1]
        return nearest

    def pulsed_share(self, rates_hz: Sequence[float]) -> float:
        """Return the share of the time in which its pulses are on, for the rates of the cameras that start them."""
        return 1.0 if self.pulse is None or not rates_hz else min(sum(rates_hz) * self.pulse.width_ms * 1e-3, 1.0)

    def build(self, cameras: tuple[PinholeCamera, ...], rates_hz: Sequence[float] = ()) -> tuple[Lamp, ...]:
        """Build the numeric lights of this entry; `rates_hz` are those of the cameras that start its pulses."""
        if self.position_mm is not None:
            places = [np.array(self.position_mm, dtype=float)]
        else:
            assert self.ring is not None
            places = self.ring.places_mm(cameras)
        share, aims = 1.0, [self._aim(place) for place in places]
        if self.mirror is not None:
            places, share = [self.mirror.image_of(place) for place in places], self.mirror.reflectance
            own = self.aim_mm == NEAREST_EYE
            aims = [self._aim(p) if own else self.mirror.image_of(aim) for p, aim in zip(places, aims, strict=True)]
        return tuple(
            Lamp(
                position_mm=frozen(p),
                axis=frozen((aim - p) / np.linalg.norm(aim - p)),
                radius_mm=self.radius_mm,
                intensity_mw_sr=share * self.intensity_mw_sr,
                lobe_exponent=self.lobe_exponent,
                inner_radius_mm=self.inner_radius_mm,
                duty_cycle=self.pulsed_share(rates_hz) if self.duty_cycle is None else self.duty_cycle,
                eyes=self.eyes,
                pulse_s=ALWAYS_S if self.pulse is None else self.pulse.span_s,
            )
            for p, aim in zip(places, aims, strict=True)
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Lamp(ArrayValue):
    """An LED in the world.

    Attributes:
        position_mm: (3,) mm.
        axis: (3,) unit vector.
        radius_mm: radius of the emitting disc; 0 for a point.
        intensity_mw_sr: radiant intensity on the axis.
        lobe_exponent: m of cos^m.
        inner_radius_mm: radius of the hole of a ring-shaped emitter.
        duty_cycle: share of the time in which it is on; used for eye safety only.
        pulse_s: start and end of its pulse after the start of a frame, s; -inf and inf if it is always on.
        eyes: eyes that it lights; None: both. Eye safety counts its light for both eyes all the same.
    """

    position_mm: Floats
    axis: Floats
    radius_mm: float
    intensity_mw_sr: float
    lobe_exponent: float
    inner_radius_mm: float = 0.0
    duty_cycle: float = 1.0
    eyes: tuple[Side, ...] | None = None
    pulse_s: tuple[float, float] = ALWAYS_S

    def lights(self, eye: int) -> bool:
        """Return whether the LED lights an eye: 0 right, 1 left, -1 unknown (then yes)."""
        return eye < 0 or serves(self.eyes, EYES[eye])

    def towards(self, point_mm: Floats) -> tuple[float, float, float]:
        """Compute the radiant intensity I cos^m (mW/sr) towards a point (3,), this cosine, and the distance (mm)."""
        gap = point_mm - self.position_mm
        distance = float(np.linalg.norm(gap))
        cosine = max(float(gap @ self.axis) / distance, 0.0) if distance else 0.0
        return self.intensity_mw_sr * cosine**self.lobe_exponent, cosine, distance
