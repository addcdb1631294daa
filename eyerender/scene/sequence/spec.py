"""The keys of a sequence: what moves, by a model or by a table of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from ...base.arrays import Floats, Ints
from ...base.spec import NonNegative, Number, Positive, Spec, Vec2, Vec3
from ...rig.screen import ScreenPlane

Closure = Annotated[float, Field(ge=0, le=1)]
Times = Annotated[tuple[Number, ...], Field(min_length=1, max_length=20_000)]
Angle = Annotated[float, Field(gt=-90, lt=90)]
Aiming = Callable[[Floats, Floats, int], tuple[Floats, Floats]]
"""Turns an eye (0 right, 1 left) towards targets (k, 3) mm with the head at (k, 3) mm: azimuth and elevation, rad."""


def _by_times(table: str, model: str) -> Callable[[Any], str]:
    def tag(value: Any) -> str:
        return (
            table if (value.get("time_s") if isinstance(value, Mapping) else getattr(value, "time_s", None)) else model
        )

    return tag


class _Table(Spec):
    """Values of the user's own at times, with straight lines between them; the ends are held."""

    time_s: Times = Field(description="times, rising")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s: must rise")
        for name in type(self).model_fields:
            value = getattr(self, name)
            if name != "time_s" and value is not None and len(value) != len(self.time_s):
                raise ValueError(f"{name}: has {len(value)} values, but time_s has {len(self.time_s)}")
        return self

    def at(self, name: str, times_s: Floats) -> Floats:
        """Interpolate one of its values at times (n,): (n,) or (n, 3)."""
        values = np.array(getattr(self, name), dtype=float)
        if values.ndim == 1:
            return np.asarray(np.interp(times_s, self.time_s, values))
        return np.stack([np.interp(times_s, self.time_s, column) for column in values.T], axis=-1)


class GazeTable(_Table):
    """The user's own gaze: the optic axes of both eyes, or targets in the world, which both eyes fixate."""

    azimuth_deg: tuple[Angle, ...] | None = Field(default=None, description="azimuth of the optic axes")
    elevation_deg: tuple[Angle, ...] | None = Field(default=None, description="elevation of the optic axes")
    target_mm: tuple[Vec3, ...] | None = Field(default=None, description="points in the world that the eyes fixate")
    torsion_deg: tuple[Angle, ...] | None = Field(default=None, description="torsion, added to that of Listing's law")

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.azimuth_deg is None) != (self.elevation_deg is None) or (self.azimuth_deg is None) == (
            self.target_mm is None
        ):
            raise ValueError("give either azimuth_deg and elevation_deg, or target_mm")
        return self


class GazeModel(Spec):
    """Fixations with drift and microsaccades, saccades between them, and pursuit."""

    targets: Annotated[tuple[Vec3, ...], Field(min_length=1, max_length=10_000)] | None = Field(
        default=None, description="points in the world, looked at in turn; default: points drawn within `field_deg`"
    )
    screen_mm: Annotated[tuple[Vec2, ...], Field(min_length=1, max_length=10_000)] | None = Field(
        default=None, description="points on the rig's screen instead, to the subject's right and up from its centre"
    )
    grid: tuple[Annotated[int, Field(ge=1, le=100)], Annotated[int, Field(ge=1, le=100)]] | None = Field(
        default=None, description="columns and rows of points up to the edges of the rig's screen instead"
    )
    order: Literal["in turn", "random"] = Field(default="in turn", description="order of the targets")
    field_deg: tuple[Annotated[float, Field(ge=0, le=60)], Annotated[float, Field(ge=0, le=45)]] = Field(
        default=(15.0, 10.0), description="half-widths of the field of drawn targets, horizontal and vertical (chosen)"
    )
    distance_mm: Positive = Field(default=600.0, description="distance of drawn targets")
    frame: Literal["world", "rig"] = Field(
        default="world", description="what the targets belong to: a headset's display moves with its cameras"
    )
    fixation_ms: Annotated[float, Field(ge=50, le=1e6)] = Field(
        default=330.0,
        description="mean duration of fixations (scenes: 330 ms, Rayner 1998, Psychol. Bull. 124, 372-422)",
    )
    fixation_spread: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.4, description="standard deviation of the logarithm of their durations (chosen)"
    )
    drift_arcmin2_s: NonNegative = Field(
        default=40.0, description="diffusion constant of drift, whose velocity is correlated over 20 ms (chosen)"
    )
    microsaccades_per_s: Annotated[float, Field(ge=0, le=5)] = Field(
        default=1.0, description="rate of microsaccades, 0.1 to 1 degree (1 to 2 per second)"
    )
    pursuit_share: Closure = Field(default=0.0, description="share of the fixations whose target moves")
    pursuit_deg_s: Annotated[float, Field(ge=0, le=40)] = Field(default=10.0, description="speed of these targets")
    oscillation: bool = Field(default=True, description="whether the pupil oscillates in the eye after saccades")
    torsion_deg: Angle = Field(default=0.0, description="torsion, added to that of Listing's law")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(given is not None for given in (self.targets, self.screen_mm, self.grid)) > 1:
            raise ValueError("give only one of targets, screen_mm and grid")
        return self

    def placed(self, screen: ScreenPlane | None) -> Self:
        """Return the model with its targets in the world.

        Raises:
            ValueError: they are on a screen, and there is none.
        """
        if self.screen_mm is None and self.grid is None:
            return self
        if screen is None:
            raise ValueError("targets on a screen need rig.screen")
        world = screen.grid(*self.grid) if self.grid is not None else screen.world(np.array(self.screen_mm))
        changes = {"targets": tuple(map(tuple, world.tolist())), "screen_mm": None, "grid": None}
        return self.model_copy(update=changes)


class LidTable(_Table):
    """The user's own lids."""

    blink: tuple[Closure, ...] = Field(description="closure of the lids, 0 to 1")
    squint: tuple[Closure, ...] | None = Field(default=None, description="lower lid raised")
    wide: tuple[Closure, ...] | None = Field(default=None, description="upper lid raised above its rest")


class LidModel(Spec):
    """Spontaneous blinks, and voluntary ones at stated times."""

    blinks_per_minute: Annotated[float, Field(ge=0, le=120)] = Field(
        default=15.0,
        description="mean rate of spontaneous blinks; intervals are log-normal (19.8 +- 4.9 watching a film; 10.3 +- "
        "3.1 fixating, Doughty 2002, Optom. Vis. Sci. 79)",
    )
    complete_share: Closure = Field(
        default=0.47, description="share of blinks that shut the eye (52.9 % of 1,414 are partial, Ousler et al. 2014)"
    )
    at_s: tuple[NonNegative, ...] = Field(default=(), description="voluntary, complete blinks begin at these times")


class PupilTable(_Table):
    """The user's own diameter of the stop."""

    mm: tuple[Annotated[float, Field(ge=0.5, le=12)], ...] = Field(description="diameter of the stop")


class Luminance(_Table):
    """Luminance of what the eyes see."""

    cd_m2: tuple[Annotated[float, Field(gt=0, le=1e5)], ...] = Field(description="luminance; held until the next value")


class PupilModel(Spec):
    """Hippus, reflex to light and near response about the scene's own pupil."""

    hippus: Annotated[float, Field(ge=0, le=0.2)] = Field(
        default=0.03, description="standard deviation of hippus over the diameter, 0.05 to 1 Hz (0.02 to 0.05)"
    )
    luminance: Luminance | None = Field(
        default=None, description="luminance in time; the scene's own pupil belongs to the first value"
    )
    near_mm_per_d: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="constriction per dioptre of the target's vergence beyond the first target's"
    )


class HeadTable(_Table):
    """The user's own displacement of the head."""

    mm: tuple[Vec3, ...] = Field(description="displacement")


class HeadModel(Spec):
    """Slow sway of the head."""

    sway_mm: NonNegative = Field(default=0.0, description="standard deviation of the sway along each axis")
    sway_hz: Annotated[float, Field(ge=0.01, le=5)] = Field(default=0.3, description="its highest frequency (chosen)")


class RigTable(_Table):
    """The user's own motion of the rig, x' = R x + t about the world's origin."""

    rotation_rad: tuple[Vec3, ...] | None = Field(default=None, description="rotation vector")
    translation_mm: tuple[Vec3, ...] | None = Field(default=None, description="translation")


class SlippageModel(Spec):
    """Slippage of the rig against the head: drift in one direction, and jumps."""

    drift_mm_s: NonNegative = Field(default=0.0, description="speed of the drift, in a drawn direction")
    drift_deg_s: NonNegative = Field(default=0.0, description="speed of its turn, about a drawn axis")
    jumps_per_minute: Annotated[float, Field(ge=0, le=600)] = Field(default=0.0, description="rate of jumps")
    jump_mm: NonNegative = Field(default=0.5, description="standard deviation of a jump along each axis")
    jump_deg: NonNegative = Field(default=0.5, description="standard deviation of its turn about each axis")


class Timestamps(Spec):
    """The time that cameras store for each frame; `time_s` of records stays the truth."""

    meaning: Literal["start", "middle", "end"] = Field(default="middle", description="the moment of the exposure")
    offset_ms: Number = Field(default=0.0, description="error of the clock's zero")
    jitter_ms: NonNegative = Field(default=0.0, description="standard deviation of each stored time")
    dropped_share: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.0, description="share of the frames that are lost, of a scene (a dataset's clips are whole)"
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=0, description="selects jitter and lost frames")

    def stored_s(self, start_s: Floats, exposure_s: Floats, number: Ints, camera: Ints) -> Floats:
        """Return the stored times (n,) of frames that start at (n,), the `number`-th ones of their cameras."""
        part = {"start": 0.0, "middle": 0.5, "end": 1.0}[self.meaning]
        jitter = 1e-3 * self.jitter_ms * self._drawn(number, camera, 0x717E).standard
        return np.asarray(start_s + part * exposure_s + 1e-3 * self.offset_ms + jitter)

    def dropped(self, number: Ints, camera: Ints) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return which frames are lost."""
        return np.asarray(self._drawn(number, camera, 0xD409).uniform < self.dropped_share)

    def _drawn(self, number: Ints, camera: Ints, tag: int) -> _Drawn:
        standard, uniform = np.zeros(len(number)), np.zeros(len(number))
        for c in np.unique(camera).tolist():
            own = camera == c
            count = int(number[own].max()) + 1
            standard[own] = np.random.default_rng((self.seed, c, tag)).standard_normal(count)[number[own]]
            uniform[own] = np.random.default_rng((self.seed, c, tag, 1)).random(count)[number[own]]
        return _Drawn(standard, uniform)


class _Drawn:
    """Standard normal and uniform numbers of frames."""

    def __init__(self, standard: Floats, uniform: Floats) -> None:
        self.standard, self.uniform = standard, uniform


Gaze = Annotated[
    Annotated[GazeTable, Tag("[table]")] | Annotated[GazeModel, Tag("[model]")],
    Discriminator(_by_times("[table]", "[model]")),
]
Lids = Annotated[
    Annotated[LidTable, Tag("[table]")] | Annotated[LidModel, Tag("[model]")],
    Discriminator(_by_times("[table]", "[model]")),
]
Pupil = Annotated[
    Annotated[PupilTable, Tag("[table]")] | Annotated[PupilModel, Tag("[model]")],
    Discriminator(_by_times("[table]", "[model]")),
]
HeadMotion = Annotated[
    Annotated[HeadTable, Tag("[table]")] | Annotated[HeadModel, Tag("[model]")],
    Discriminator(_by_times("[table]", "[model]")),
]
RigMotion = Annotated[
    Annotated[RigTable, Tag("[table]")] | Annotated[SlippageModel, Tag("[model]")],
    Discriminator(_by_times("[table]", "[model]")),
]


class Sequence(Spec):
    """Eyes, lids, pupils, head and rig as functions of time; each by a model, or by a table with `time_s`.

    >>> er.Sequence(duration_s=2, gaze={"field_deg": [10, 5]}).duration_s
    2.0
    """

    duration_s: Annotated[float, Field(gt=0, le=600)] = Field(default=10.0, description="duration")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(default=0, description="selects all that is drawn")
    gaze: Gaze = Field(default=GazeModel(), description="where the eyes look")
    lids: Lids = Field(default=LidModel(), description="blinks")
    pupil: Pupil = Field(default=PupilModel(), description="size of the pupils")
    head: HeadMotion = Field(default=HeadModel(), description="displacement of the head")
    rig: RigMotion = Field(default=SlippageModel(), description="motion of the rig against the head, beyond its mount")
    timestamps: Timestamps | None = Field(default=None, description="times that the cameras store; default: none")
    instants: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] | None = Field(
        default=None,
        description="the instants whose frames are taken, by their numbers, as in a dataset's samples; default: all",
    )
