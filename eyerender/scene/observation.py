"""Observations: what an observer reports of every (frame, eye), as structs of arrays, and their JSON records.

Both observers report this type, and gaze estimators take nothing else. A frame is one exposure of one camera and may
contain both eyes; an observation belongs to (frame, eye). Where a status is not OK the numbers beside it are NaN in
memory and null in the record, and there is a reason. A pupil of which only arcs are visible has a status of its own,
PARTIAL. In a record a status is a word: "ok", "partial", or "missing" for all others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Bools, Columns, Floats, Ints, Objects, Statuses, column, frozen
from ..base.errors import InputError, Problems
from ..base.spec import EYES as EYES
from ..base.status import Status
from ..base.storage.files import shown

RECORD_SCHEMA = "eyerender/record/3"
"""Schema of a record."""

# Largest number of boundary points of one pupil (ten per degree) and of all pupils of a batch; a point takes 25 bytes.
MAX_BOUNDARY_POINTS, MAX_POINTS = 3600, 50_000_000
# Largest number of glints of all observations of a batch; each has a status and a reason.
MAX_GLINTS = 5_000_000
# Limits in a record: glints (as many as lights of a rig), characters of a text, and the size of a number.
_MAX_ENTRIES, _MAX_TEXT, _LARGEST = 1000, 500, 1e30

EVENTS = ("fixation", "microsaccade", "saccade", "oscillation", "pursuit", "blink")
"""What an eye may do at a time, as `events` of records name it."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Index(Columns):
    """Identity of each observation; all arrays (n,) or (n, 3).

    Attributes:
        frame: number of the frame.
        instant: number that the frames of all cameras at one moment share; -1 is unknown.
        subject: number of the person; -1 is unknown.
        fixation: index of the fixation. Fixations, cameras and heads are counted from 0 in the scene's order; -1 is
            unknown.
        camera: index of the camera.
        head: index of the head position.
        eye: 0 for the right and 1 for the left eye, -1 where unknown.
        eye_model: name of the eye model.
        target_mm: (n, 3) NaN where there is no target.
        head_mm: (n, 3) head position.
        eye_position_mm: (n, 3) apex of the unrotated eye in the world, without `head_mm`.
        time_s: time of mid-exposure, or of the middle of the LEDs' light in it.
        start_s: start of the exposure of the first row, in a sequence.
        timestamp_s: time that the camera stored.
        rig_rotation_rad: (n, 3) rotation vector of the rig: x' = R x + t about the world's origin, its mount included.
        rig_translation_mm: (n, 3) t of it.
        stop_mm: diameter of the stop; NaN is the scene's own.
        stop_shift_mm: (n, 2) displacement of the stop along y and z in the eye's frame.
        lids: (n, 3) `blink`, `squint` and `wide` of the lids; NaN are the scene's own.
        events: what the eye does, words joined by +, of `EVENTS`; None is unknown.
        blink_phase: closing, closed or opening; None in no blink.
    """

    frame: Ints
    instant: Ints = column()
    subject: Ints = column()
    fixation: Ints = column()
    camera: Ints = column()
    head: Ints = column()
    eye: Ints = column()
    eye_model: Objects = column()
    target_mm: Floats = column(3)
    head_mm: Floats = column(3)
    eye_position_mm: Floats = column(3)
    time_s: Floats = column()
    start_s: Floats = column()
    timestamp_s: Floats = column()
    rig_rotation_rad: Floats = column(3)
    rig_translation_mm: Floats = column(3)
    stop_mm: Floats = column()
    stop_shift_mm: Floats = column(2)
    lids: Floats = column(3)
    events: Objects = column()
    blink_phase: Objects = column()

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def moment(self) -> Ints:
        """Number (n,) by which rows of one moment are joined: the instant, or the frame if instants are unknown."""
        return self.instant if (self.instant >= 0).all() else self.frame


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PoseTruth(Columns):
    """True pose of the eye, arrays (n,) in radians, NaN where unknown; `residual_mm` is its miss of the target."""

    azimuth_rad: Floats
    elevation_rad: Floats = column()
    torsion_rad: Floats = column()
    residual_mm: Floats = column()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PupilFeatures(Columns):
    """The apparent pupil in full-sensor pixels, arrays with a leading axis n.

    Where the status is PARTIAL, centre, axes and angle are NaN, `points_px` holds the visible points with NaN in place
    of the others, and `arc_ellipse` is the ellipse of the visible points.

    Attributes:
        status: (n,) of `Status`.
        reason: (n,) why it is not OK, in words, with details where there are any.
        in_image: (n,) whether the pupil lies on the sensor.
        centre_px: (n, 2) centre of the direct least-squares ellipse of the boundary.
        semi_axes_px: (n, 2) a >= b of that ellipse.
        angle_rad: (n,) angle of a, in [0, pi).
        anatomical_centre_px: (n, 2) image of the stop's centre.
        points_px: (n, k, 2) the boundary itself.
        covariance: (n, 5, 5) over (cx, cy, a, b, angle).
        arcs_deg: (n, m, 2) visible arcs of the true boundary, from and to in degrees of the stop's parameter; NaN where
            there are fewer than m.
        arc_ellipse: (n, 5) (cx, cy, a, b px, angle rad); NaN where the visible points do not determine it.
        confidence: (n,) probability that the pupil is right, from an extractor; NaN if unknown.
        time_s: (n,) when the row of its centre is exposed, in a sequence.
    """

    status: Statuses
    reason: Objects = column()
    in_image: Bools = column()
    centre_px: Floats = column(2)
    semi_axes_px: Floats = column(2)
    angle_rad: Floats = column()
    anatomical_centre_px: Floats = column(2)
    points_px: Floats = column(0, 2)
    covariance: Floats = column(5, 5)
    arcs_deg: Floats = column(0, 2)
    arc_ellipse: Floats = column(5)
    confidence: Floats = column()
    time_s: Floats = column()

    @property
    def ok(self) -> Bools:
        """Whether the whole pupil was found, (n,)."""
        return np.asarray(self.status == Status.OK)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GlintFeatures(Columns):
    """Glints in full-sensor pixels, arrays with leading axes (n, m); `light` is -1 where it is unknown.

    `status` (n, m) are `Status`, with a `reason` in words where it is not OK. A status NONE is no glint at all: rows
    with fewer than m glints are padded, and a light that does not light the eye has none. In a sequence, `time_s` says
    when the row of each is exposed.
    """

    LEADING = 2

    status: Statuses
    light: Ints = column()
    reason: Objects = column()
    in_image: Bools = column()
    xy_px: Floats = column(2)
    covariance: Floats = column(2, 2)
    time_s: Floats = column()

    @property
    def ok(self) -> Bools:
        """Whether a glint was found, (n, m)."""
        return np.asarray(self.status == Status.OK)

    def of_light(self, light: int | Ints) -> tuple[Floats, Bools]:
        """Return the position (n, 2) px of a light's glint, and whether it was found (n,); `light` may be (n,)."""
        n, m = self.light.shape
        if m == 0:
            return np.full((n, 2), np.nan), np.zeros(n, dtype=bool)
        here = (self.light == np.reshape(light, (-1, 1))) & self.ok
        found = here.any(axis=1)
        xy = self.xy_px[np.arange(n), here.argmax(axis=1)]
        return np.where(found[:, None], xy, np.nan), found


SURFACES = ("front", "back")
"""Surfaces of a lens that mirror lamps."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LensGlintFeatures(GlintFeatures):
    """Reflections of lamps in the lenses worn, as glints with `surface` (0 front, 1 back) and `index` of the image."""

    surface: Ints = column()
    index: Ints = column()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PurkinjeFeatures(GlintFeatures):
    """Purkinje images of lamps, as glints with `order`: 1 (the glint) to 4 (the lens' back)."""

    order: Ints = column()


WHITE = math.sqrt(2.0)
"""RMS-S2S over SD of white noise."""


def correlated(white: Floats, s2s_over_sd: float) -> Floats:
    """Make a series of noise with a ratio of RMS-S2S over SD from white noise (n, ...), along the first axis."""
    from scipy.signal import lfilter  # which takes a fifth of a second to import

    kept = 1.0 - s2s_over_sd**2 / 2.0
    if not kept:
        return white
    steps = np.concatenate([white[:1], np.sqrt(1.0 - kept**2) * white[1:]])
    return np.asarray(lfilter([1.0], [1.0, -kept], steps, axis=0))


class PixelNoise(Protocol):
    """Noise of features, such as `er.design.FeatureNoise`."""

    @property
    def outline_px(self) -> Floats:
        """Deviation of one px of outline, (cameras,) px."""

    @property
    def glint_px(self) -> Floats:
        """Deviation of each glint, (cameras, lights) px."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Observations(ArrayValue):
    """A batch of observations, in frame order and with the right eye first within a frame.

    >>> seen = er.trace(er.load_scene("headset"))
    >>> len(seen), next(seen.records())["pupil"]["status"]
    (9, 'ok')
    """

    index: Index
    pose: PoseTruth
    pupil: PupilFeatures
    glints: GlintFeatures
    lens_glints: LensGlintFeatures | None = None
    ghost_glints: GlintFeatures | None = None
    purkinje: PurkinjeFeatures | None = None

    def __len__(self) -> int:
        return len(self.index)

    def take(self, rows: Any) -> Observations:
        """Select rows (indices, a slice or a mask)."""
        parts: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(self)}
        parts = {name: part if part is None else part.take(rows) for name, part in parts.items()}
        return Observations(**parts)

    def with_targets(self, target_mm: ArrayLike) -> Observations:
        """Replace the targets by points (n, 3) or (3,) mm in the world, NaN where there is none."""
        targets = np.broadcast_to(np.asarray(target_mm, dtype=float), (len(self), 3))
        return replace(self, index=replace(self.index, target_mm=frozen(targets)))

    def in_rig(self, mount: tuple[ArrayLike, ArrayLike] | None = None) -> Observations:
        """Return targets and places of eyes as the rig of a sequence has them, which moves in the world.

        Estimators know the rig where its mount puts it. Gaze on a headset's display, which moves along with the
        cameras, is therefore judged in its frame.

        Args:
            mount: R (3, 3) and t (3,) mm of the rig's mount, x' = R x + t, as of `Mount.motion`; default: none.
        """
        from scipy.spatial.transform import Rotation

        at = self.index
        R, offset = (np.eye(3), np.zeros(3)) if mount is None else map(np.asarray, mount)
        moved: Bools = np.asarray(np.isfinite(at.rig_rotation_rad).all(axis=1))
        turn = Rotation.from_rotvec(np.where(moved[:, None], at.rig_rotation_rad, 0.0))

        def inside(points: Floats) -> Floats:
            own = turn.inv().apply(points - np.where(moved[:, None], at.rig_translation_mm, 0.0)) @ R.T + offset
            return np.asarray(np.where(moved[:, None], own, points))

        place = inside(at.eye_position_mm + at.head_mm)
        changed = replace(at, target_mm=inside(at.target_mm), eye_position_mm=place, head_mm=np.zeros(place.shape))
        return replace(self, index=changed)

    def with_noise(
        self, noise: PixelNoise | float, seed: int | np.random.Generator = 0, *, s2s_over_sd: float = WHITE
    ) -> Observations:
        """Displace pupils and glints by Gaussian noise; outlines move with their pupils.

        The rows of each eye and camera are a series in time, with an autoregressive noise of first order: successive
        displacements correlate by 1 - r^2 / 2, so that the rms of their differences is r times their deviation
        (Niehorster et al. 2020, Behav. Res. Methods 52, 2515-2534, measure trackers by this ratio). Covariances, where
        there are any, grow by the noise.

        >>> seen = er.trace(er.load_scene("headset"))
        >>> moved = seen.with_noise(0.05, seed=1).pupil.centre_px - seen.pupil.centre_px
        >>> bool(0 < np.abs(moved).max() < 0.3)
        True

        Args:
            noise: standard deviation in px along each axis, or the noise of `er.sensor_noise`: a circle of radius r
                whose outline has the noise s per px has the noise s / sqrt(pi r) of its centre. Glints that cannot be
                located stay.
            seed: selects the noise; or a generator that makes it.
            s2s_over_sd: the type of noise: RMS-S2S over SD, sqrt(2) for white noise, less for filtered.

        Raises:
            InputError: the noise is negative, or the ratio is not between 0 and 2.
        """
        if not 0.0 < s2s_over_sd < 2.0:
            raise InputError(f"must be > 0 and < 2, not {s2s_over_sd}", path="s2s_over_sd")
        pupil, glints, size = self.pupil, self.glints, self._noise_px(noise)
        series = np.unique(np.stack([self.index.eye, self.index.camera]), axis=1, return_inverse=True)[1].reshape(-1)
        rng = np.random.default_rng(seed)
        unit = np.concatenate([rng.standard_normal((len(self), k, 2)) for k in (1, glints.light.shape[1])], axis=1)
        for one in np.unique(series):
            rows = np.flatnonzero(series == one)
            unit[rows] = correlated(unit[rows], s2s_over_sd)
        moves = size[..., None] * unit
        wider = (size**2)[..., None, None] * np.eye(2)
        covariance = np.array(pupil.covariance)
        covariance[:, :2, :2] += wider[:, 0]
        return replace(
            self,
            pupil=replace(
                pupil,
                centre_px=pupil.centre_px + moves[:, 0],
                points_px=pupil.points_px + moves[:, :1],
                covariance=covariance,
            ),
            glints=replace(glints, xy_px=glints.xy_px + moves[:, 1:], covariance=glints.covariance + wider[:, 1:]),
        )

    def _noise_px(self, noise: PixelNoise | float) -> Floats:
        """Return the standard deviations (n, 1 + m) px of the pupil's centre and of each glint."""
        if isinstance(noise, int | float):
            if not 0.0 <= noise < np.inf:
                raise InputError(f"must be >= 0, not {noise}", path="noise")
            return np.full((len(self), 1 + self.glints.light.shape[1]), float(noise))
        camera = np.maximum(self.index.camera, 0)
        radius = np.sqrt(np.prod(self.pupil.semi_axes_px, axis=1))
        centre = noise.outline_px[camera] / np.sqrt(np.pi * radius)
        glints = noise.glint_px[camera[:, None], np.maximum(self.glints.light, 0)]
        return np.concatenate([centre[:, None], np.where(np.isfinite(glints), glints, 0.0)], axis=1)

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield one record (docs/formats.md) per observation; every key is present, null where it does not apply."""
        for i in range(len(self)):
            yield self._record(i)

    def _record(self, i: int) -> dict[str, Any]:
        at, pose, pupil, lens_glints = self.index, self.pose, self.pupil, self.lens_glints
        # A plain integer: comparing a NumPy integer with a Status takes 20 times as long.
        status = Status(int(pupil.status[i]))
        return {
            "schema": RECORD_SCHEMA,
            "frame": int(at.frame[i]),
            "fixation": _count(at.fixation[i]),
            "camera": _count(at.camera[i]),
            "eye": EYES[int(at.eye[i])] if at.eye[i] >= 0 else None,
            "eye_model": at.eye_model[i],
            "subject": _count(at.subject[i]),
            "instant": _count(at.instant[i]),
            "time_s": _numbers(at.time_s[i]),
            "target_mm": _numbers(at.target_mm[i]),
            "head_mm": _numbers(at.head_mm[i]),
            "eye_position_mm": _numbers(at.eye_position_mm[i]),
            "pose": {
                "azimuth_deg": _numbers(np.degrees(pose.azimuth_rad[i])),
                "elevation_deg": _numbers(np.degrees(pose.elevation_rad[i])),
                "torsion_deg": _numbers(np.degrees(pose.torsion_rad[i])),
                "residual_mm": _numbers(pose.residual_mm[i]),
            },
            "rig_pose": _rig_pose(at, i),
            "events": None if at.events[i] is None else [word for word in at.events[i].split("+") if word],
            "blink_phase": at.blink_phase[i],
            "pupil": {
                "status": status.label,
                "reason": pupil.reason[i] or None,
                "in_image": bool(pupil.in_image[i]) if status in (Status.OK, Status.PARTIAL) else None,
                "centre_px": _numbers(pupil.centre_px[i]),
                "semi_axes_px": _numbers(pupil.semi_axes_px[i]),
                "angle_rad": _numbers(pupil.angle_rad[i]),
                "anatomical_centre_px": _numbers(pupil.anatomical_centre_px[i]),
                "points_px": _points(pupil.points_px[i]),
                "covariance": _numbers(pupil.covariance[i]),
                "arcs_deg": _points(pupil.arcs_deg[i]),
                "arc_ellipse": _arc_ellipse(pupil.arc_ellipse[i]),
                "time_s": _numbers(pupil.time_s[i]),
            },
            "glints": _glint_records(self.glints, i),
            "lens_glints": None if lens_glints is None else _glint_records(lens_glints, i) or None,
            "ghost_glints": None if self.ghost_glints is None else _glint_records(self.ghost_glints, i) or None,
            "purkinje": None if self.purkinje is None else _glint_records(self.purkinje, i) or None,
            # Only extractors have one; records of ray optics do not have the key.
            **({} if np.isnan(pupil.confidence[i]) else {"confidence": float(pupil.confidence[i])}),
        }

    @classmethod
    def from_records(
        cls, records: Sequence[dict[str, Any]], *, source: str = "", complete: bool = False
    ) -> Observations:
        """Read records.

        A key that is left out counts as null. A feature with a place and without a status is 'ok'. Without a `frame`
        in any record, every record is a frame of its own.

        Args:
            records: the records.
            source: name of their file in messages.
            complete: whether every key must be there, as this package writes them.

        Raises:
            InputError: naming the records and the keys.
        """
        rows = list(records)
        reader = _Reader(rows, source, complete)
        eye = reader.texts("eye")
        for k, name in enumerate(eye):
            if name is not None and name not in EYES:
                reader.refuse(k, "eye", "must be 'right' or 'left'")
                eye[k] = None
        head, pupil = reader.array("head_mm", (3,)), reader.pupils()
        found = cls(
            index=Index(
                frame=reader.frames(),
                instant=reader.counts("instant"),
                subject=reader.counts("subject"),
                time_s=reader.array("time_s", ()),
                fixation=reader.counts("fixation"),
                camera=reader.counts("camera"),
                head=count_heads(head),
                eye=np.array([EYES.index(e) if e else -1 for e in eye], np.int64),
                eye_model=reader.texts("eye_model"),
                target_mm=reader.array("target_mm", (3,)),
                head_mm=head,
                eye_position_mm=reader.array("eye_position_mm", (3,)),
                events=reader.events(),
                blink_phase=reader.texts("blink_phase"),
                **reader.rig_poses(),
            ),
            pose=PoseTruth(
                azimuth_rad=np.radians(reader.array("pose.azimuth_deg", ())),
                elevation_rad=np.radians(reader.array("pose.elevation_deg", ())),
                torsion_rad=np.radians(reader.array("pose.torsion_deg", ())),
                residual_mm=reader.array("pose.residual_mm", ()),
            ),
            pupil=pupil,
            glints=GlintFeatures(**reader.glints("glints", reader.rows("glints"))),
            lens_glints=reader.lens_glints(),
            ghost_glints=reader.ghost_glints(),
            purkinje=reader.purkinje(),
        )
        reader.problems.check()
        return found


class _Reader:
    """Read columns from records, and collect the record number and key of everything that is wrong.

    Raises:
        InputError: an entry is not a record at all.
    """

    def __init__(self, records: list[dict[str, Any]], source: str, complete: bool) -> None:
        self.records = records
        self.complete = complete
        self.problems = Problems(source)
        for k, record in enumerate(records):
            if not isinstance(record, dict):
                self.problems.add("must be a record", f"records.{k}")
            elif "schema" not in record:
                self.refuse(k, "schema", f"missing; write {RECORD_SCHEMA!r}")
            elif record["schema"] != RECORD_SCHEMA:
                self.refuse(k, "schema", f"is {shown(record['schema'])}; this version reads {RECORD_SCHEMA!r}")
            else:
                for part in ("pose", "pupil"):
                    if not isinstance(record.get(part, {}), dict):
                        self.refuse(k, part, "must be an object")
        self.problems.check()

    def values(self, path: str, *, optional: bool = False) -> list[Any]:
        """Return the value at a path of each record; None where it is missing."""
        return [self._value(k, path, optional) for k in range(len(self.records))]

    def _value(self, k: int, path: str, optional: bool) -> Any:
        value: Any = self.records[k]
        for key in path.split("."):
            if key not in value:
                if self.complete and not optional:
                    self.refuse(k, path, "missing")
                return None
            value = value[key]
        return value

    def refuse(self, k: int, path: str, reason: str) -> None:
        self.problems.add(reason, f"records.{k}.{path}")

    def texts(self, path: str) -> Objects:
        out = np.empty(len(self.records), dtype=object)
        for k, value in enumerate(self.values(path)):
            if value is None or (isinstance(value, str) and len(value) <= _MAX_TEXT):
                out[k] = value
            else:
                self.refuse(k, path, f"must be null or a text of at most {_MAX_TEXT} characters")
        return out

    def statuses(self, path: str, reasons: Objects, placed: Bools) -> Statuses:
        """Read statuses; where a record has none, use `placed` (n,), which says whether there is a feature."""
        labels = self.texts(path)
        for k, label in enumerate(labels):
            if label is None and not self.complete:
                labels[k] = "ok" if placed[k] else "missing"
            elif not label:
                self.refuse(k, path, "must be 'ok' or 'missing'")
            elif label not in ("ok", "partial", "missing"):
                self.refuse(k, path, "must be 'ok', 'partial' or 'missing'")
        return frozen([int(Status.of_record(*said)) for said in zip(labels, reasons, strict=True)], np.int8)

    def flags(self, path: str) -> Bools:
        values = self.values(path)
        for k, value in enumerate(values):
            if not (value is None or isinstance(value, bool)):
                self.refuse(k, path, "must be true, false or null")
        return frozen([value is True for value in values], bool)

    def counts(self, path: str) -> Ints:
        out = np.full(len(self.records), -1, np.int64)
        for k, value in enumerate(self.values(path)):
            if value is None or _is_count(value):
                out[k] = -1 if value is None else value
            else:
                self.refuse(k, path, "must be a whole number or null")
        return frozen(out, np.int64)

    def frames(self) -> Ints:
        """Read the frame numbers; if no record has one, number the records."""
        given = [record.get("frame") is not None for record in self.records]
        if not self.complete and not any(given):
            return frozen(np.arange(len(given)), np.int64)
        for k in np.flatnonzero(~np.array(given)) if not self.complete else ():
            self.refuse(int(k), "frame", "missing; number the frames of all records or of none")
        return self.counts("frame")

    def array(self, path: str, shape: tuple[int, ...], *, optional: bool = False) -> Floats:
        out = np.full((len(self.records), *shape), np.nan)
        for k, value in enumerate(self.values(path, optional=optional)):
            if value is not None:
                found = _array(value)
                if found is None or found.shape != shape:
                    self.refuse(k, path, f"must be null or {'x'.join(map(str, shape)) or 'one'} number(s)")
                else:
                    out[k] = found
        return frozen(out)

    def points(self, path: str, what: str = "points") -> Floats:
        """Read lists of points as (n, longest, 2), padded with NaN."""
        values = self.values(path)
        for k, value in enumerate(values):
            if not (value is None or (isinstance(value, list) and len(value) <= MAX_BOUNDARY_POINTS)):
                self.refuse(k, path, f"must be null or a list of at most {MAX_BOUNDARY_POINTS} {what}")
                values[k] = None
        width = max((len(value) for value in values if value), default=0)
        _check_width(len(values), width, MAX_POINTS, "boundary points", self.problems.source)
        out = np.full((len(values), width, 2), np.nan)
        for k, value in enumerate(values):
            if value:
                found = _array(value)
                if found is None or found.shape != (len(value), 2):
                    self.refuse(k, path, f"must be null or a list of {what}")
                else:
                    out[k, : len(value)] = found
        return frozen(out)

    def arc_ellipses(self) -> Floats:
        out = np.full((len(self.records), 5), np.nan)
        for k, value in enumerate(self.values("pupil.arc_ellipse")):
            if value is None:
                continue
            parts = [value.get(key) for key in _ELLIPSE_KEYS] if isinstance(value, dict) else []
            arrays = [_array(part) for part in parts]
            shapes = [None if a is None else a.shape for a in arrays]
            if shapes == [(2,), (2,), ()]:
                out[k] = np.concatenate([np.ravel(a) for a in arrays])  # type: ignore[arg-type]
            else:
                self.refuse(k, "pupil.arc_ellipse", f"must be null or an object of {', '.join(_ELLIPSE_KEYS)}")
        return frozen(out)

    def pupils(self) -> PupilFeatures:
        """Read the pupils; one that is 'ok' needs a centre and semi-axes."""
        reason = self.texts("pupil.reason")
        centre, semi_axes = self.array("pupil.centre_px", (2,)), self.array("pupil.semi_axes_px", (2,))
        placed = np.asarray(np.isfinite(centre).all(axis=1))
        status = self.statuses("pupil.status", reason, placed)
        for row in np.flatnonzero(status == Status.OK).tolist():
            centre_given, axes_given = (
                self.records[row].get("pupil", {}).get(key) is not None for key in ("centre_px", "semi_axes_px")
            )
            if not centre_given or (semi_axes[row] <= 0).any() or (self.complete and not axes_given):
                self.refuse(row, "pupil", "is 'ok', but has no centre or semi-axes")
        return PupilFeatures(
            status=status,
            reason=reason,
            in_image=self.flags("pupil.in_image"),
            centre_px=centre,
            semi_axes_px=semi_axes,
            angle_rad=self.array("pupil.angle_rad", ()),
            anatomical_centre_px=self.array("pupil.anatomical_centre_px", (2,)),
            points_px=self.points("pupil.points_px"),
            covariance=self.array("pupil.covariance", (5, 5)),
            arcs_deg=self.points("pupil.arcs_deg", "arcs [from, to]"),
            arc_ellipse=self.arc_ellipses(),
            confidence=self.array("confidence", (), optional=True),
            time_s=self.array("pupil.time_s", ()),
        )

    def events(self) -> Objects:
        """Read lists of events as words joined by +."""
        out = np.full(len(self.records), None, dtype=object)
        for k, value in enumerate(self.values("events")):
            if isinstance(value, list) and set(map(str, value)) <= set(EVENTS) and len(value) <= len(EVENTS):
                out[k] = "+".join(value)
            elif value is not None:
                self.refuse(k, "events", f"must be null or a list of {', '.join(EVENTS)}")
        return out

    def rig_poses(self) -> dict[str, Floats]:
        """Read the poses of the rig, NaN where there is none."""
        out = {name: np.full((len(self.records), 3), np.nan) for name in ("rotation_rad", "translation_mm")}
        for k, value in enumerate(self.values("rig_pose")):
            for name, column_ in out.items() if value is not None else ():
                found = _array(value.get(name)) if isinstance(value, dict) else None
                if found is None or found.shape != (3,):
                    self.refuse(k, "rig_pose", "must be null or have rotation_rad and translation_mm, 3 numbers each")
                    break
                column_[k] = found
        return {f"rig_{name}": values for name, values in out.items()}

    def ghost_glints(self) -> GlintFeatures | None:
        if all(entries is None for entries in self.values("ghost_glints")):
            return None
        return GlintFeatures(**self.glints("ghost_glints", self.rows("ghost_glints")))

    def purkinje(self) -> PurkinjeFeatures | None:
        """Read the Purkinje images, which have no covariance."""
        if all(entries is None for entries in self.values("purkinje")):
            return None
        rows = self.rows("purkinje")
        found = self.glints("purkinje", rows, without="covariance")
        order = np.full(found["light"].shape, -1, np.int64)
        for k, entries in enumerate(rows):
            for j, one in enumerate(entries):
                number = one.get("order") if isinstance(one, dict) else None
                if number not in (1, 2, 3, 4):
                    self.refuse(k, f"purkinje.{j}", "needs order, 1 to 4")
                else:
                    order[k, j] = number
        return PurkinjeFeatures(**found, order=order)

    def lens_glints(self) -> LensGlintFeatures | None:
        if all(entries is None for entries in self.values("lens_glints")):
            return None
        rows = self.rows("lens_glints")
        found = self.glints("lens_glints", rows)
        surface, index = (np.full(found["light"].shape, -1, np.int64) for _ in range(2))
        for k, entries in enumerate(rows):
            for j, one in enumerate(entries):
                name, number = (one.get("surface"), one.get("index")) if isinstance(one, dict) else (None, None)
                if name not in SURFACES or not _is_count(number):
                    self.refuse(k, f"lens_glints.{j}", "needs surface, front or back, and index, a whole number")
                else:
                    surface[k, j], index[k, j] = SURFACES.index(name), number
        return LensGlintFeatures(**found, surface=surface, index=index)

    def rows(self, key: str) -> list[list[Any]]:
        """Return the list of each record, empty for null; what is no list, or too long, is refused, and empty too."""
        absent = not self.complete or key != "glints"
        rows = [[] if entries is None and absent else entries for entries in self.values(key)]
        for k, entries in enumerate(rows):
            if not isinstance(entries, list) or len(entries) > _MAX_ENTRIES:
                self.refuse(k, key, f"must be a list of at most {_MAX_ENTRIES}")
                rows[k] = []
        return rows

    def glints(self, key: str, rows: list[list[Any]], without: str = "") -> dict[str, Any]:
        """Read the glints of rows; entries lack the key `without`."""
        n, m = len(rows), max(map(len, rows), default=0)
        _check_width(n, m, MAX_GLINTS, "glints", self.problems.source)
        light, status = np.full((n, m), -1, np.int64), np.full((n, m), Status.NONE, np.int8)
        reason = np.full((n, m), None, object)
        inside, xy, covariance = np.zeros((n, m), bool), np.full((n, m, 2), np.nan), np.full((n, m, 2, 2), np.nan)
        time_s = np.full((n, m), np.nan)
        for k, entries in enumerate(rows):
            for j, g in enumerate(entries):
                if without and isinstance(g, dict):
                    g = {**g, without: None}
                if not self.complete and isinstance(g, dict):
                    g = {**_NO_GLINT, **g}
                    if g["status"] is None:
                        g["status"] = "missing" if g["xy_px"] is None else "ok"
                why = _glint_problem(g)
                if why is not None:
                    self.refuse(k, f"{key}.{j}", f"is no glint record: {why}")
                    continue
                light[k, j] = -1 if g["light"] is None else g["light"]
                status[k, j] = int(Status.of_record(g["status"], g["reason"]))
                reason[k, j], inside[k, j] = g["reason"], bool(g["in_image"])
                for name, numbers in (("xy_px", xy), ("covariance", covariance), ("time_s", time_s)):
                    numbers[k, j] = np.nan if g[name] is None else g[name]
        return {
            "light": light, "status": status, "reason": reason,
            "in_image": inside, "xy_px": xy, "covariance": covariance, "time_s": time_s,
        }  # fmt: skip


def _glint_records(glints: GlintFeatures, i: int) -> list[dict[str, Any]]:
    """Write the glints of row i, with surface and index in a lens, or with the order of Purkinje images."""
    # Plain integers: comparing a NumPy integer with a Status takes 20 times as long.
    status = list(map(Status, glints.status[i].tolist()))
    lens = glints if isinstance(glints, LensGlintFeatures) else None
    images = glints if isinstance(glints, PurkinjeFeatures) else None
    return [
        {
            **({} if images is None else {"order": int(images.order[i, j])}),
            "light": _count(glints.light[i, j]),
            **({} if lens is None else {"surface": SURFACES[lens.surface[i, j]], "index": int(lens.index[i, j])}),
            "status": status[j].label,
            "reason": glints.reason[i, j] or None,
            "in_image": bool(glints.in_image[i, j]) if status[j] == Status.OK else None,
            "xy_px": _numbers(glints.xy_px[i, j]),
            **({"covariance": _numbers(glints.covariance[i, j])} if images is None else {}),
            "time_s": _numbers(glints.time_s[i, j]),
        }
        for j in range(len(status))
        if status[j] != Status.NONE
    ]


def _rig_pose(at: Index, i: int) -> dict[str, Any] | None:
    turn, shift = _numbers(at.rig_rotation_rad[i]), _numbers(at.rig_translation_mm[i])
    return None if turn is None or shift is None else {"rotation_rad": turn, "translation_mm": shift}


def _arc_ellipse(values: Floats) -> dict[str, Any] | None:
    """Write an ellipse (5,) of `PupilFeatures.arc_ellipse`; None where it is NaN."""
    numbers = _numbers(values)
    return None if numbers is None else dict(zip(_ELLIPSE_KEYS, (numbers[:2], numbers[2:4], numbers[4]), strict=True))


_ELLIPSE_KEYS = ("centre_px", "semi_axes_px", "angle_rad")
_NO_GLINT = dict.fromkeys(("light", "status", "reason", "in_image", "xy_px", "covariance", "time_s"))


def _glint_problem(g: Any) -> str | None:
    """Describe what is wrong with one glint of a record; None if nothing is."""
    if not isinstance(g, dict):
        return "must be an object"
    for key in _NO_GLINT:
        if key not in g:
            return f"{key} is missing"
    light, status, reason, in_image = g["light"], g["status"], g["reason"], g["in_image"]
    for fits, message in (
        (light is None or _is_count(light), "light must be a whole number or null"),
        (isinstance(status, str) and 0 < len(status) <= _MAX_TEXT, "status must be 'ok' or 'missing'"),
        (reason is None or (isinstance(reason, str) and len(reason) <= _MAX_TEXT), "reason must be null or a text"),
        (in_image is None or isinstance(in_image, bool), "in_image must be true, false or null"),
    ):
        if not fits:
            return message
    for key, shape in (("xy_px", (2,)), ("covariance", (2, 2)), ("time_s", ())):
        if g[key] is not None and ((found := _array(g[key])) is None or found.shape != shape):
            return f"{key} must be null or {'x'.join(map(str, shape)) or 'one'} number(s)"
    if g["status"] == "ok" and g["xy_px"] is None:
        return "it is 'ok', but has no xy_px"
    return None


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31


def _array(value: Any) -> Floats | None:
    """Convert numbers to an array if they are small enough to be squared; None for anything else."""
    try:
        found = np.asarray(value)
    except (ValueError, OverflowError):  # rows of unequal length
        return None
    if found.dtype.kind not in "iuf" or not (np.abs(found) <= _LARGEST).all():
        return None
    return found


def _check_width(rows: int, width: int, limit: int, what: str, source: str = "") -> None:
    """Limit the width to which rows are padded, so that one wide record cannot exhaust the memory."""
    if rows * width > limit:
        raise InputError(f"{rows} records of up to {width} {what} are more than {limit} {what}", source=source)


def count_heads(head_mm: Floats) -> Ints:
    """Number head positions (n, 3) from 0: equal positions have one number, in order of appearance.

    Records store the positions only, not these numbers.
    """
    heads: dict[bytes, int] = {}
    return frozen([heads.setdefault((np.round(h, 9) + 0.0).tobytes(), len(heads)) for h in head_mm], np.int64)


def concatenate(parts: Iterable[Observations]) -> Observations:
    """Concatenate batches in order; pad glints and boundary points to the widest."""
    batches = list(parts)
    if len(batches) == 1:
        return batches[0]

    def joined(name: str) -> Any:
        groups = [getattr(b, name) for b in batches]
        columns = {}
        for f in fields(groups[0]):
            arrays = [getattr(g, f.name) for g in groups]
            width = max((a.shape[1] for a in arrays if a.ndim > 1), default=0)
            limit, what = (MAX_GLINTS, "glints") if name == "glints" else (MAX_POINTS, "boundary points")
            if f.name in ("points_px", "light"):
                _check_width(sum(map(len, arrays)), width, limit, what)
            columns[f.name] = np.concatenate([_widened(a, width) for a in arrays])
        return replace(groups[0], **columns)

    joint: dict[str, Any] = {name: joined(name) for name in ("index", "pose", "pupil", "glints")}
    further: tuple[tuple[str, type[GlintFeatures]], ...]
    further = ("lens_glints", LensGlintFeatures), ("ghost_glints", GlintFeatures), ("purkinje", PurkinjeFeatures)
    for name, kind in further:
        if any(getattr(b, name) is not None for b in batches):
            own = [getattr(b, name) or kind(status=np.zeros((len(b), 0), np.int8)) for b in batches]
            changes: list[dict[str, Any]] = [{name: one} for one in own]
            batches = [replace(b, **change) for b, change in zip(batches, changes, strict=True)]
            joint[name] = joined(name)
    return Observations(**joint)


def _widened(a: Any, width: int) -> Any:
    if a.ndim < 2 or a.shape[1] == width:
        return a
    fill = {"f": np.nan, "i": -1, "b": False, "O": None}[a.dtype.kind]  # -1 is Status.NONE as well
    return np.concatenate([a, np.full((len(a), width - a.shape[1], *a.shape[2:]), fill, dtype=a.dtype)], axis=1)


def _numbers(values: Any) -> Any:
    a = np.asarray(values, dtype=float)
    return None if not np.all(np.isfinite(a)) else a.tolist()


def _points(values: Floats) -> Any:
    good = values[np.isfinite(values).all(axis=-1)]
    return good.tolist() if len(good) else None


def _count(value: Any) -> int | None:
    return int(value) if value >= 0 else None
