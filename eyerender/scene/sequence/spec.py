"""The keys of a sequence: what moves, by a model or by a table of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from ...base.arrays import Bools, Floats, Ints
from ...base.errors import InputError, InputWarning
from ...base.spec import NonNegative, Number, Positive, Spec, Vec2, Vec3
from ...rig.screen import ScreenPlane
from .files import LATEST_S, MAX_ROWS, read_columns, read_times

Closure = Annotated[float, Field(ge=0, le=1)]
Times = Annotated[tuple[Number, ...], Field(min_length=1, max_length=MAX_ROWS)]
_StoredTime = Annotated[float, Field(ge=-LATEST_S, le=LATEST_S)]
Angle = Annotated[float, Field(gt=-90, lt=90)]
Aiming = Callable[[Floats, Floats, Floats, int], tuple[Floats, Floats]]
"""Turns an eye (0 right, 1 left) with a torsion (k,) rad beyond Listing's towards targets (k, 3) mm with the head at
(k, 3) mm: azimuth and elevation, rad."""


def _source(value: Any) -> str:
    """Return the tag by which pydantic selects among a file, a table and a model."""
    for key, tag in (("file", "[file]"), ("time_s", "[table]")):
        if value.get(key) if isinstance(value, Mapping) else getattr(value, key, None):
            return tag
    return "[model]"


class TraceFile(Spec):
    """A CSV table with a column for each key; a point has three, `target_x` to `target_z` for `target_mm`.

    Columns are `time_s` and, for gaze, `azimuth_deg`, `elevation_deg`, `torsion_deg` or `target_x`, `target_y`,
    `target_z`; for lids `blink`, `squint`, `wide`; for the pupil and the head `mm` and `x`, `y`, `z`; for the rig
    `rotation_x`, ... and `translation_x`, ...
    """

    file: Annotated[str, Field(min_length=1)] = Field(description="path, relative to the scene")
    columns: dict[str, str] | None = Field(
        default=None, description="names of columns that are called otherwise, such as `{azimuth_deg: x}`"
    )
    unit_s: Positive = Field(default=1.0, description="length of the file's unit of time: 0.001 for milliseconds")

    def read(self, table: type[_Table], base: Path | None) -> _Table:
        """Read the file as a table; its path is relative to `base`. Rows with missing values are left out.

        Raises:
            InputError: the file cannot be read, or its values do not fit.
        """
        path = (base or Path()) / self.file
        parts = {key: _parts(key, vector=key in table.VECTORS) for key in table.model_fields}
        every = [part for columns in parts.values() for part in columns]
        if unknown := sorted((self.columns or {}).keys() - set(every)):
            raise InputError(f"must be one of {', '.join(every)}", path=f"columns.{unknown[0]}")
        needed = [parts[key] for key, field in table.model_fields.items() if field.is_required()]
        names = {part: part for part in every} | (self.columns or {})
        found = read_columns(path, names, tuple(part for columns in needed for part in columns))
        found["time_s"] = found["time_s"] * self.unit_s
        data = {}
        for key, columns in parts.items():
            if all(part in found for part in columns):
                values = np.stack([found[part] for part in columns], axis=-1)
                data[key] = (values if key in table.VECTORS else values[:, 0]).tolist()
        return table.from_mapping(data, source=str(path))


def _parts(key: str, *, vector: bool) -> tuple[str, ...]:
    """Return the columns of a key: itself, or one per axis."""
    stem = key.rpartition("_")[0]
    return tuple(f"{stem}_{axis}".lstrip("_") for axis in "xyz") if vector else (key,)


class _Table(Spec):
    """Values of the user's own at times, with straight lines between them; the ends are held."""

    VECTORS: ClassVar[tuple[str, ...]] = ()
    """Keys whose values are points or vectors."""

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
        """Interpolate one of its values at times (n,): (n,) or (n, 3); values that are not given are 0."""
        if getattr(self, name) is None:
            return np.zeros((len(times_s), 3) if name in self.VECTORS else len(times_s))
        values = np.array(getattr(self, name), dtype=float)
        if values.ndim == 1:
            return np.asarray(np.interp(times_s, self.time_s, values))
        return np.stack([np.interp(times_s, self.time_s, column) for column in values.T], axis=-1)


class GazeTable(_Table):
    """The user's own gaze: the optic axes of both eyes, or targets in the world, which both eyes fixate."""

    VECTORS: ClassVar[tuple[str, ...]] = ("target_mm",)

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


class Torsion(_Table):
    """Torsion in time."""

    value_deg: tuple[Angle, ...] = Field(description="torsion; straight between its times")


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
    distance_mm: Annotated[float, Field(ge=20)] = Field(default=600.0, description="distance of drawn targets")
    frame: Literal["world", "rig"] = Field(
        default="world", description="what the targets belong to: a headset's display moves with its cameras"
    )
    fixation_ms: Annotated[float, Field(ge=50, le=1e6)] = Field(
        default=330.0,
        description="mean duration of fixations between two saccades, times a person's factor; none is shorter than "
        "80 ms (scenes: 330 ms, Rayner 1998, Psychol. Bull. 124, 372-422)",
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
    torsion_deg: Annotated[
        Annotated[Angle, Tag("NumberSpec")] | Annotated[Torsion, Tag("Torsion")],
        Discriminator(lambda value: "Torsion" if isinstance(value, Mapping | Torsion) else "NumberSpec"),
    ] = Field(default=0.0, description="torsion, added to that of Listing's law; a number, or a table")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(given is not None for given in (self.targets, self.screen_mm, self.grid)) > 1:
            raise ValueError("give only one of targets, screen_mm and grid")
        listed = self.targets or self.screen_mm or self.grid
        for name in ("field_deg", "distance_mm") if listed else ():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name}: is of drawn targets, and cannot be combined with listed ones")
        return self

    def torsion_at(self, times_s: Floats) -> Floats:
        """Return the added torsion (n,) degrees at times."""
        torsion = self.torsion_deg
        return torsion.at("value_deg", times_s) if isinstance(torsion, Torsion) else np.full(len(times_s), torsion)

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

    task: Literal["watching", "fixating"] = Field(
        default="watching", description="sets the rate: 19.8 per minute watching a film, 10.3 fixating (Doughty 2002)"
    )
    blinks_per_minute: Annotated[float, Field(ge=0, le=120)] | None = Field(
        default=None, description="mean rate of spontaneous blinks, whose intervals are log-normal; default: the task's"
    )
    complete_share: Closure = Field(
        default=0.47, description="share of blinks that shut the eye (52.9 % of 1,414 are partial, Ousler et al. 2014)"
    )
    at_s: tuple[NonNegative, ...] = Field(default=(), description="voluntary, complete blinks begin at these times")

    @property
    def rate_hz(self) -> float:
        """Mean rate of spontaneous blinks, per second."""
        task = {"watching": 19.8, "fixating": 10.3}[self.task]
        return (task if self.blinks_per_minute is None else self.blinks_per_minute) / 60.0


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

    VECTORS: ClassVar[tuple[str, ...]] = ("mm",)

    mm: tuple[Vec3, ...] = Field(description="displacement")


class HeadModel(Spec):
    """Slow sway of the head."""

    sway_mm: NonNegative = Field(default=0.0, description="standard deviation of the sway along each axis")
    sway_hz: Annotated[float, Field(ge=0.01, le=5)] = Field(default=0.3, description="its highest frequency (chosen)")


class RigTable(_Table):
    """The user's own motion of the rig, x' = R x + t about the world's origin."""

    VECTORS: ClassVar[tuple[str, ...]] = ("rotation_rad", "translation_mm")

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
    time_s: Annotated[tuple[_StoredTime, ...], Field(min_length=1, max_length=MAX_ROWS)] | None = Field(
        default=None,
        description="the times that a user's own cameras stored, with their gaps, in place of frame rates; the first "
        "frame begins with the sequence",
    )
    file: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="a file of such times, .npy or CSV with a column `time_s`, relative to the scene"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.time_s is None and self.file is None:
            return self
        if self.time_s is not None and self.file is not None:
            raise ValueError("give only one of time_s and file")
        if self.jitter_ms or self.dropped_share:
            raise ValueError("times of one's own have neither jitter_ms nor dropped_share")
        if self.time_s is not None and np.any(np.diff(self.time_s) <= 0):
            raise ValueError("time_s: must rise")
        return self

    def resolved(self, base: Path | None = None) -> Self:
        """Return it with its file read in. Raises InputError if the file cannot be read, or its times do not rise."""
        if self.file is None:
            return self
        path = (base or Path()) / self.file
        data = {**self.to_mapping(), "file": None, "time_s": read_times(path).tolist()}
        return self.from_mapping(data, source=str(path))

    def starts_s(self) -> Floats | None:
        """Return when (n,) the frames of a user's own times begin, after the first one; None without such times."""
        own = self.resolved().time_s
        return None if own is None else np.asarray(own, dtype=np.float64) - own[0]

    def stored_s(self, start_s: Floats, exposure_s: Floats, number: Ints, camera: Ints) -> Floats:
        """Return the stored times (n,) of frames that start at (n,), the `number`-th ones of their cameras."""
        if (own := self.resolved().time_s) is not None:
            return np.array(own, dtype=np.float64)[number]
        part = {"start": 0.0, "middle": 0.5, "end": 1.0}[self.meaning]
        jitter = 1e-3 * self.jitter_ms * self._drawn(number, camera, 0x717E).standard
        return np.asarray(start_s + part * exposure_s + 1e-3 * self.offset_ms + jitter)

    def dropped(self, number: Ints, camera: Ints) -> Bools:
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


class _Drawn(NamedTuple):
    """Standard normal and uniform numbers of frames (n,)."""

    standard: Floats
    uniform: Floats


_File = Annotated[TraceFile, Tag("[file]")]
Gaze = Annotated[
    _File | Annotated[GazeTable, Tag("[table]")] | Annotated[GazeModel, Tag("[model]")],
    Discriminator(_source),
]
Lids = Annotated[
    _File | Annotated[LidTable, Tag("[table]")] | Annotated[LidModel, Tag("[model]")],
    Discriminator(_source),
]
Pupil = Annotated[
    _File | Annotated[PupilTable, Tag("[table]")] | Annotated[PupilModel, Tag("[model]")],
    Discriminator(_source),
]
HeadMotion = Annotated[
    _File | Annotated[HeadTable, Tag("[table]")] | Annotated[HeadModel, Tag("[model]")],
    Discriminator(_source),
]
RigMotion = Annotated[
    _File | Annotated[RigTable, Tag("[table]")] | Annotated[SlippageModel, Tag("[model]")],
    Discriminator(_source),
]
_TABLES: dict[str, type[_Table]] = {
    "gaze": GazeTable, "lids": LidTable, "pupil": PupilTable, "head": HeadTable, "rig": RigTable,
}  # fmt: skip


class Sequence(Spec):
    """Eyes, lids, pupils, head and rig as functions of time; each by a model, a table with `time_s`, or a file.

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

    def resolved(self, base: Path | None = None) -> Self:
        """Return the sequence with its files read in; paths are relative to `base`.

        Raises:
            InputError: a file cannot be read, its values do not fit, or a table has another zero of time.
        """
        changes: dict[str, Any] = {}
        try:
            for key, table in _TABLES.items():
                if isinstance(source := getattr(self, key), TraceFile):
                    changes[key] = source.read(table, base)
                    self._check_times(changes[key], str((base or Path()) / source.file))
                else:
                    self._check_times(source)
            key = "timestamps"
            if self.timestamps is not None and self.timestamps.file is not None:
                changes[key] = self.timestamps.resolved(base)
        except InputError as error:
            raise error if error.source else error.placed(under=key) from None
        return self.model_copy(update=changes) if changes else self

    def _check_times(self, table: Spec, source: str = "") -> None:
        """Check that a table, unless it has one row alone, has values at some time of the sequence."""
        if not isinstance(table, _Table) or len(table.time_s) == 1:
            return
        first, last, end = table.time_s[0], table.time_s[-1], self.duration_s
        if first > end or last < 0.0:
            reason = (
                f"{first:g} to {last:g} s is outside the sequence, which begins at 0 s and lasts {end:g} s; "
                "count from the trace's beginning, and name another unit with unit_s"
            )
            raise InputError(reason, source=source, path="time_s")

    def warnings(self, *, bare: bool) -> list[InputWarning]:
        """Warn of tables that cover less than half of it, of frames after its end, and of lids that an eye lacks."""
        found, end = [], self.duration_s
        for key in _TABLES:
            table = getattr(self, key)
            if isinstance(table, _Table) and len(table.time_s) > 1:
                first, last = table.time_s[0], table.time_s[-1]
                if min(last, end) - max(first, 0.0) < end / 2:
                    reason = f"covers {first:g} to {last:g} s of a sequence of {end:g} s; its ends are held"
                    found.append(InputWarning(code="coverage", reason=reason, path=f"sequence.{key}"))
        own = None if self.timestamps is None else self.timestamps.starts_s()
        if own is not None and own[-1] >= end:
            reason = f"{np.sum(own >= end)} of {len(own)} are after the sequence's {end:g} s, and have no frame"
            found.append(InputWarning(code="coverage", reason=reason, path="sequence.timestamps"))
        quiet = isinstance(self.lids, LidModel) and not (self.lids.rate_hz or self.lids.at_s)
        if bare and "lids" in self.model_fields_set and not quiet:
            reason = "covers nothing: the scene has no region, so no lids"
            found.append(InputWarning(code="lids", reason=reason, path="sequence.lids"))
        return found
