"""Observations: an observer's report of every (frame, eye), as structs of arrays; and their record.

Both observers report this type, and gaze estimators take nothing else. A frame is one exposure of one camera and may
contain both eyes; an observation belongs to (frame, eye). Where a status is not OK the numbers beside it are NaN in
memory and null in the record, and there is a reason. A pupil of which only arcs are visible has a status of its own,
PARTIAL. In a record a status is a word: "ok", "partial", or "missing" for all others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from .arrays import ArrayValue, Bools, Columns, Floats, Ints, Objects, Statuses, column, frozen
from .errors import InputError
from .files import shown
from .status import Status

RECORD = 2
"""The record's version that is written unless another one is asked for; `SCHEMAS` are those that are read."""
SCHEMAS = {1: "eyerender/record/1", 2: "eyerender/record/2"}
EYES = ("right", "left")

# Largest numbers of boundary points of one pupil (ten per degree) and of all pupils of a batch, which take 25 bytes
# each.
MAX_BOUNDARY_POINTS, MAX_POINTS = 3600, 50_000_000
# Largest number of glints of all observations of a batch, which have a status and a reason each.
MAX_GLINTS = 5_000_000
# Limits in a record: glints (as many as lights of a rig), characters of a text, and the size of a number.
_MAX_ENTRIES, _MAX_TEXT, _LARGEST = 1000, 500, 1e30


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Index(Columns):
    """Identity of each observation; all arrays (n,) or (n, 3).

    Attributes:
        frame: number of the frame.
        fixation: counted from 0 in the scene's order, as are the next two; -1 where unknown.
        camera: index of the camera.
        head: index of the head position.
        eye: 0 for the right and 1 for the left eye, -1 where unknown.
        eye_model: name of the eye model.
        target_mm: (n, 3) NaN where there is no target.
        head_mm: (n, 3) head position.
        eye_position_mm: (n, 3) apex of the unrotated eye in the world, without `head_mm`.
    """

    frame: Ints
    fixation: Ints = column()
    camera: Ints = column()
    head: Ints = column()
    eye: Ints = column()
    eye_model: Objects = column()
    target_mm: Floats = column(3)
    head_mm: Floats = column(3)
    eye_position_mm: Floats = column(3)

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PoseTruth(Columns):
    """Pose of the eye, arrays (n,) in radians, NaN where unknown; `residual_mm` of the fixation at the fovea."""

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
        in_image: (n,) whether the pupil is on the sensor.
        centre_px: (n, 2) centre of the direct least-squares ellipse of the boundary.
        semi_axes_px: (n, 2) a >= b of that ellipse.
        angle_rad: (n,) angle of a, in [0, pi).
        anatomical_centre_px: (n, 2) image of the stop's centre.
        points_px: (n, k, 2) the boundary itself.
        covariance: (n, 5, 5) over (cx, cy, a, b, angle).
        arcs_deg: (n, m, 2) visible arcs of the true boundary, from and to in degrees of the stop's parameter; NaN where
            there are fewer than m.
        arc_ellipse: (n, 5) (cx, cy, a, b px, angle rad); NaN where the visible points do not determine it.
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

    @property
    def ok(self) -> Bools:
        """Whether the whole pupil was found, (n,)."""
        return np.asarray(self.status == Status.OK)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GlintFeatures(Columns):
    """Glints in full-sensor pixels, arrays with leading axes (n, m); `light` is -1 where it is unknown.

    `status` (n, m) are `Status`, with a `reason` in words where it is not OK. Rows with fewer than m glints are padded
    with status NONE.
    """

    LEADING = 2

    status: Statuses
    light: Ints = column()
    reason: Objects = column()
    in_image: Bools = column()
    xy_px: Floats = column(2)
    covariance: Floats = column(2, 2)

    @property
    def ok(self) -> Bools:
        """Whether a glint was found, (n, m)."""
        return np.asarray(self.status == Status.OK)

    def of_light(self, light: int) -> tuple[Floats, Bools]:
        """Place (n, 2) of one light's glint, and whether it was found (n,)."""
        n, m = self.light.shape
        if m == 0:
            return np.full((n, 2), np.nan), np.zeros(n, dtype=bool)
        here = (self.light == light) & self.ok
        found = here.any(axis=1)
        xy = self.xy_px[np.arange(n), here.argmax(axis=1)]
        return np.where(found[:, None], xy, np.nan), found


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Observations(ArrayValue):
    """A batch of observations, in frame order and with the right eye first within a frame."""

    index: Index
    pose: PoseTruth
    pupil: PupilFeatures
    glints: GlintFeatures

    def __len__(self) -> int:
        return len(self.index)

    def take(self, rows: Any) -> Observations:
        """Select rows (indices, a slice or a mask)."""
        return Observations(
            index=self.index.take(rows),
            pose=self.pose.take(rows),
            pupil=self.pupil.take(rows),
            glints=self.glints.take(rows),
        )

    def with_targets(self, target_mm: ArrayLike) -> Observations:
        """Replace the targets by (n, 3) or (3,) mm in the world, NaN where there is none."""
        targets = np.broadcast_to(np.asarray(target_mm, dtype=float), (len(self), 3))
        return replace(self, index=replace(self.index, target_mm=frozen(targets)))

    def records(self, version: int = RECORD) -> Iterator[dict[str, Any]]:
        """Yield one record (docs/formats.md) per observation; every key is present, null where it does not apply.

        Args:
            version: version of the record; in version 1 a partial pupil is a missing one.
        """
        for i in range(len(self)):
            yield self._record(i, version)

    def _record(self, i: int, version: int) -> dict[str, Any]:
        at, pose, pupil, glints = self.index, self.pose, self.pupil, self.glints
        # Plain integers: a comparison of NumPy's with a Status takes 20 times as long.
        status, glint_status = Status(int(pupil.status[i])), list(map(Status, glints.status[i].tolist()))
        if version == 1 and status == Status.PARTIAL:
            status = Status.NOT_FOUND
        return {
            "schema": SCHEMAS[version],
            "frame": int(at.frame[i]),
            "fixation": _count(at.fixation[i]),
            "camera": _count(at.camera[i]),
            "eye": EYES[int(at.eye[i])] if at.eye[i] >= 0 else None,
            "eye_model": at.eye_model[i],
            "target_mm": _numbers(at.target_mm[i]),
            "head_mm": _numbers(at.head_mm[i]),
            "eye_position_mm": _numbers(at.eye_position_mm[i]),
            "pose": {
                "azimuth_deg": _numbers(np.degrees(pose.azimuth_rad[i])),
                "elevation_deg": _numbers(np.degrees(pose.elevation_rad[i])),
                "torsion_deg": _numbers(np.degrees(pose.torsion_rad[i])),
                "residual_mm": _numbers(pose.residual_mm[i]),
            },
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
                **(_arcs_of(pupil, i) if version > 1 else {}),
            },
            "glints": [
                {
                    "light": _count(glints.light[i, j]),
                    "status": glint_status[j].label,
                    "reason": glints.reason[i, j] or None,
                    "in_image": bool(glints.in_image[i, j]) if glint_status[j] == Status.OK else None,
                    "xy_px": _numbers(glints.xy_px[i, j]),
                    "covariance": _numbers(glints.covariance[i, j]),
                }
                for j in range(len(glint_status))
                if glint_status[j] != Status.NONE
            ],
        }

    @classmethod
    def from_records(cls, records: Sequence[dict[str, Any]], *, source: str = "") -> Observations:
        """Read records of any version.

        Raises:
            InputError: naming the record and the key.
        """
        rows = list(records)
        for k, record in enumerate(rows):
            if not isinstance(record, dict):
                raise InputError("must be a record", source=source, path=f"records.{k}")
            if record.get("schema") not in SCHEMAS.values():
                raise InputError(
                    f"is {shown(record.get('schema'))}; this version reads {' and '.join(map(repr, SCHEMAS.values()))}",
                    source=source,
                    path=f"records.{k}.schema",
                )
        reader = _Reader(rows, source)
        eye = reader.texts("eye")
        for k, name in enumerate(eye):
            if name is not None and name not in EYES:
                raise InputError("must be 'right' or 'left'", source=source, path=f"records.{k}.eye")
        head = reader.array("head_mm", (3,))
        reason = reader.texts("pupil.reason")
        status, centre = reader.statuses("pupil.status", reason), reader.array("pupil.centre_px", (2,))
        semi_axes = reader.array("pupil.semi_axes_px", (2,))
        for row in np.flatnonzero(
            (status == Status.OK) & ~(np.isfinite(centre).all(axis=1) & (semi_axes > 0).all(axis=1))
        ):
            reader.refuse(row, "pupil", "is 'ok', but has no centre or semi-axes")
        return cls(
            index=Index(
                frame=reader.counts("frame"),
                fixation=reader.counts("fixation"),
                camera=reader.counts("camera"),
                head=count_heads(head),
                eye=np.array([EYES.index(e) if e else -1 for e in eye], np.int64),
                eye_model=reader.texts("eye_model"),
                target_mm=reader.array("target_mm", (3,)),
                head_mm=head,
                eye_position_mm=reader.array("eye_position_mm", (3,)),
            ),
            pose=PoseTruth(
                azimuth_rad=np.radians(reader.array("pose.azimuth_deg", ())),
                elevation_rad=np.radians(reader.array("pose.elevation_deg", ())),
                torsion_rad=np.radians(reader.array("pose.torsion_deg", ())),
                residual_mm=reader.array("pose.residual_mm", ()),
            ),
            pupil=PupilFeatures(
                status=status,
                reason=reason,
                in_image=reader.flags("pupil.in_image"),
                centre_px=centre,
                semi_axes_px=semi_axes,
                angle_rad=reader.array("pupil.angle_rad", ()),
                anatomical_centre_px=reader.array("pupil.anatomical_centre_px", (2,)),
                points_px=reader.points("pupil.points_px"),
                covariance=reader.array("pupil.covariance", (5, 5)),
                arcs_deg=reader.arcs(),
                arc_ellipse=reader.arc_ellipses(),
            ),
            glints=reader.glints(),
        )


class _Reader:
    """Reads columns from records, and names the record and key where one is wrong."""

    def __init__(self, records: list[dict[str, Any]], source: str) -> None:
        self.records = records
        self.source = source

    def values(self, path: str) -> list[Any]:
        out = []
        for k, record in enumerate(self.records):
            value: Any = record
            for key in path.split("."):
                if not isinstance(value, dict) or key not in value:
                    raise InputError("missing", source=self.source, path=f"records.{k}.{path}")
                value = value[key]
            out.append(value)
        return out

    def refuse(self, k: Any, path: str, reason: str) -> NoReturn:
        raise InputError(reason, source=self.source, path=f"records.{k}.{path}")

    def texts(self, path: str) -> Objects:
        out = np.empty(len(self.records), dtype=object)
        for k, value in enumerate(self.values(path)):
            if not (value is None or (isinstance(value, str) and len(value) <= _MAX_TEXT)):
                self.refuse(k, path, f"must be null or a text of at most {_MAX_TEXT} characters")
            out[k] = value
        return frozen(out, object)

    def statuses(self, path: str, reasons: Objects) -> Statuses:
        labels = self.texts(path)
        for k, (label, record) in enumerate(zip(labels, self.records, strict=True)):
            if not label:
                self.refuse(k, path, "must be 'ok' or 'missing'")
            if record["schema"] != SCHEMAS[1] and label not in ("ok", "partial", "missing"):
                self.refuse(k, path, "must be 'ok', 'partial' or 'missing'")
        return frozen([int(Status.of_record(*said)) for said in zip(labels, reasons, strict=True)], np.int8)

    def flags(self, path: str) -> Bools:
        values = self.values(path)
        for k, value in enumerate(values):
            if not (value is None or isinstance(value, bool)):
                self.refuse(k, path, "must be true, false or null")
        return frozen([bool(v) for v in values], bool)

    def counts(self, path: str) -> Ints:
        values = self.values(path)
        for k, value in enumerate(values):
            if not (value is None or _is_count(value)):
                self.refuse(k, path, "must be a whole number or null")
        return frozen([-1 if v is None else v for v in values], np.int64)

    def array(self, path: str, shape: tuple[int, ...]) -> Floats:
        out = np.full((len(self.records), *shape), np.nan)
        for k, value in enumerate(self.values(path)):
            if value is not None:
                found = _array(value)
                if found is None or found.shape != shape:
                    self.refuse(k, path, f"must be null or {'x'.join(map(str, shape)) or 'one'} number(s)")
                out[k] = found
        return frozen(out)

    def points(self, path: str) -> Floats:
        values = self.values(path)
        for k, value in enumerate(values):
            if not (value is None or (isinstance(value, list) and len(value) <= MAX_BOUNDARY_POINTS)):
                self.refuse(k, path, f"must be null or a list of at most {MAX_BOUNDARY_POINTS} points")
        width = max((len(value) for value in values if value), default=0)
        _check_width(len(values), width, MAX_POINTS, "boundary points", self.source)
        out = np.full((len(values), width, 2), np.nan)
        for k, value in enumerate(values):
            if value:
                found = _array(value)
                if found is None or found.shape != (len(value), 2):
                    self.refuse(k, path, "must be null or a list of points")
                out[k, : len(value)] = found
        return frozen(out)

    def second(self, path: str) -> list[Any]:
        """Values of a key that records have from version 2 on; None in those of version 1."""
        newer = [k for k, record in enumerate(self.records) if record["schema"] != SCHEMAS[1]]
        out: list[Any] = [None] * len(self.records)
        for k in newer:
            value: Any = self.records[k]
            for key in path.split("."):
                if not isinstance(value, dict) or key not in value:
                    self.refuse(k, path, "missing")
                value = value[key]
            out[k] = value
        return out

    def arcs(self) -> Floats:
        values = self.second("pupil.arcs_deg")
        for k, value in enumerate(values):
            if not (value is None or (isinstance(value, list) and len(value) <= MAX_BOUNDARY_POINTS)):
                self.refuse(k, "pupil.arcs_deg", f"must be null or a list of at most {MAX_BOUNDARY_POINTS} arcs")
        width = max((len(value) for value in values if value), default=0)
        _check_width(len(values), width, MAX_POINTS, "arcs", self.source)
        out = np.full((len(values), width, 2), np.nan)
        for k, value in enumerate(values):
            if value:
                found = _array(value)
                if found is None or found.shape != (len(value), 2):
                    self.refuse(k, "pupil.arcs_deg", "must be null or a list of arcs [from, to]")
                out[k, : len(value)] = found
        return frozen(out)

    def arc_ellipses(self) -> Floats:
        out = np.full((len(self.records), 5), np.nan)
        for k, value in enumerate(self.second("pupil.arc_ellipse")):
            if value is None:
                continue
            parts = [value.get(key) for key in _ELLIPSE_KEYS] if isinstance(value, dict) else []
            arrays = [_array(part) for part in parts]
            shapes = [None if a is None else a.shape for a in arrays]
            if shapes != [(2,), (2,), ()]:
                self.refuse(k, "pupil.arc_ellipse", f"must be null or an object of {', '.join(_ELLIPSE_KEYS)}")
            out[k] = np.concatenate([np.ravel(a) for a in arrays])  # type: ignore[arg-type]
        return frozen(out)

    def glints(self) -> GlintFeatures:
        rows = self.values("glints")
        for k, entries in enumerate(rows):
            if not isinstance(entries, list) or len(entries) > _MAX_ENTRIES:
                self.refuse(k, "glints", f"must be a list of at most {_MAX_ENTRIES}")
        n, m = len(rows), max(map(len, rows), default=0)
        _check_width(n, m, MAX_GLINTS, "glints", self.source)
        light, status = np.full((n, m), -1, np.int64), np.full((n, m), Status.NONE, np.int8)
        reason = np.full((n, m), None, object)
        inside, xy, covariance = np.zeros((n, m), bool), np.full((n, m, 2), np.nan), np.full((n, m, 2, 2), np.nan)
        for k, entries in enumerate(rows):
            for j, g in enumerate(entries):
                why = _glint_problem(g)
                if why is not None:
                    self.refuse(k, f"glints.{j}", f"is no glint record: {why}")
                light[k, j] = -1 if g["light"] is None else g["light"]
                status[k, j] = int(Status.of_record(g["status"], g["reason"]))
                reason[k, j], inside[k, j] = g["reason"], bool(g["in_image"])
                if g["xy_px"] is not None:
                    xy[k, j] = g["xy_px"]
                if g["covariance"] is not None:
                    covariance[k, j] = g["covariance"]
        return GlintFeatures(
            light=light, status=status, reason=reason, in_image=inside, xy_px=xy, covariance=covariance
        )


def _arcs_of(pupil: PupilFeatures, i: int) -> dict[str, Any]:
    """Additional keys of version 2 of the record."""
    ellipse = _numbers(pupil.arc_ellipse[i])
    parts = None if ellipse is None else (ellipse[:2], ellipse[2:4], ellipse[4])
    return {
        "arcs_deg": _points(pupil.arcs_deg[i]),
        "arc_ellipse": None if parts is None else dict(zip(_ELLIPSE_KEYS, parts, strict=True)),
    }


_ELLIPSE_KEYS = ("centre_px", "semi_axes_px", "angle_rad")


def _glint_problem(g: Any) -> str | None:
    """Describe what is wrong with an entry of a record's glints; None where nothing is."""
    if not isinstance(g, dict):
        return "must be an object"
    for key in ("light", "status", "reason", "in_image", "xy_px", "covariance"):
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
    for key, shape in (("xy_px", (2,)), ("covariance", (2, 2))):
        if g[key] is not None and ((found := _array(g[key])) is None or found.shape != shape):
            return f"{key} must be null or {'x'.join(map(str, shape))} numbers"
    if g["status"] == "ok" and g["xy_px"] is None:
        return "it is 'ok', but has no xy_px"
    return None


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31


def _array(value: Any) -> Floats | None:
    """Convert plain numbers, of a size that can be squared, to an array; None for anything else."""
    try:
        found = np.asarray(value)
    except (ValueError, OverflowError):  # rows of unequal length
        return None
    if found.dtype.kind not in "iuf" or not (np.abs(found) <= _LARGEST).all():
        return None
    return found


def _check_width(rows: int, width: int, limit: int, what: str, source: str = "") -> None:
    """Limit the width to which rows are padded: one wide record among many must not take all the memory."""
    if rows * width > limit:
        raise InputError(f"{rows} records of up to {width} {what} are more than {limit} {what}", source=source)


def count_heads(head_mm: Floats) -> Ints:
    """Number head positions (n, 3) from 0: equal positions have one number, in order of appearance.

    Records do not contain this number.
    """
    heads: dict[bytes, int] = {}
    return frozen([heads.setdefault((np.round(h, 9) + 0.0).tobytes(), len(heads)) for h in head_mm], np.int64)


def version_of(record: dict[str, Any]) -> int:
    """Version of a record; raises `KeyError` or `ValueError` where it is not a record."""
    return {schema: version for version, schema in SCHEMAS.items()}[str(record["schema"])]


def concatenate(parts: Iterable[Observations]) -> Observations:
    """Join batches, in order; glints and boundary points are padded to the widest."""
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

    return Observations(index=joined("index"), pose=joined("pose"), pupil=joined("pupil"), glints=joined("glints"))


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
