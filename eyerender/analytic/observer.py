"""The analytic observer: observe frames by ray optics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from ..base.arrays import Bools, Floats, Indices
from ..base.errors import InputError
from ..base.status import Status
from ..eye.legs import LensImage, lens_images
from ..eye.model import EyeModel, Stop
from ..eye.pose import Poses
from ..optics.ellipse import fit_ellipse_direct
from ..rig.imaging import Opening
from ..rig.rig import RigGeometry, RigLike
from ..rig.timing import FrameTimes
from ..scene.observation import (
    SURFACES,
    GlintFeatures,
    Index,
    LensGlintFeatures,
    Observations,
    PoseTruth,
    PupilFeatures,
    PurkinjeFeatures,
)
from .exposed import at_own_times
from .features import Features, RigidMotions, features
from .ghosts import ghost_glint_features
from .occluders import Occluders

ARC_POINTS = 6
ARC_GAP_DEG = 120.0
"""Requirements for an ellipse of a partial pupil: number of visible points, and longest hidden stretch (degrees)."""


class TraceableScene(Protocol):
    """Inputs of ray optics: the numeric rig and eyes of a scene."""

    @property
    def rig(self) -> RigGeometry:
        """The numeric rig."""
        ...

    @property
    def eye_name(self) -> str:
        """Name of the eye file, for messages."""
        ...

    @property
    def further_purkinje(self) -> tuple[int, ...]:
        """Orders of the mirror images of the lamps that pictures show besides the glints."""
        ...

    @property
    def openings(self) -> tuple[Opening, ...]:
        """Openings through which the cameras look."""
        ...

    @property
    def timings(self) -> tuple[FrameTimes, ...]:
        """When each camera takes its frames."""
        ...

    def eyes_of(self, index: Index) -> tuple[list[EyeModel], Indices]:
        """Build the numeric eyes of an index, and return which of them each row uses."""
        ...

    def stops_of(self, index: Index) -> Stop | None:
        """Return the stop of each row where a sequence changes it; None if it does not."""
        ...

    def rig_motions(self, index: Index) -> RigidMotions | None:
        """Return how a sequence moves the rig in each row; None if it does not."""
        ...

    def rig_at(self, index: Index, row: int) -> RigGeometry:
        """Return the rig in the world as it stands in one row."""
        ...


@runtime_checkable
class Traceable(Protocol):
    """Part of `Frames` that ray optics reads: which camera sees which eye, and its pose."""

    @property
    def scene(self) -> TraceableScene:
        """The scene with the rig and the eyes."""
        ...

    @property
    def index(self) -> Index:
        """Eye, camera and place of each row."""
        ...

    @property
    def pose(self) -> PoseTruth:
        """Pose of the eye of each row."""
        ...

    def seen_by(self, rig: RigLike | None) -> Self:
        """Observe the same eyes with another rig."""
        ...

    def at(self, rows: Any, time_s: Floats) -> Traceable:
        """Select rows of a sequence and return their eyes at other times, s."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """A scene, which poses its eyes in all of its frames."""

    def frames(self) -> Traceable:
        """Compute the pose of every (frame, eye)."""
        ...


@dataclass(frozen=True, slots=True)
class AnalyticObserver:
    """Observer by ray optics: exact apparent pupil and glints.

    >>> int(er.AnalyticObserver().observe(er.load_scene("headset").frames()).pupil.ok.sum())
    9

    Args:
        boundary_points: number of traced points of each pupil boundary.
        occluded: whether obstacles of the rig and openings of the lens hide features. Labels of pictures state where
            these are even so.
    """

    boundary_points: int = 30
    occluded: bool = True

    def observe(self, frames: Traceable, rig: RigLike | None = None) -> Observations:
        """Observe every (frame, eye); `rig` replaces that of the frames."""
        return self.observe_in_detail(frames, rig)[0]

    def observe_in_detail(
        self, frames: Traceable, rig: RigLike | None = None, *, purkinje: Sequence[int] = ()
    ) -> tuple[Observations, Features]:
        """Observe with residuals, the pupil's deviation from an ellipse, and Purkinje images.

        Args:
            frames: n frames.
            rig: replaces the rig of the frames.
            purkinje: orders of the Purkinje images to report, from 1 (the glint) to 4, besides those of the scene's
                pictures.

        Returns:
            The observations, and the detailed features, which records do not contain.

        Raises:
            InputError: the eye has no surface for one of the Purkinje images.
        """
        frames = frames.seen_by(rig)
        scene, index, pose = frames.scene, frames.index, frames.pose
        eyes, which = scene.eyes_of(index)
        has = (1,) if eyes[0].worn else eyes[0].purkinje_orders
        if eyes[0].worn and not set(purkinje) <= {1}:
            raise InputError("must be 1 behind spectacles, through which images 2 to 4 are not traced", path="purkinje")
        if not set(purkinje) <= set(has):
            raise InputError(
                f"must be among {', '.join(map(str, has))}: {scene.eye_name} has no other Purkinje images",
                path="purkinje",
            )
        shown = sorted({*purkinje} | ({*scene.further_purkinje} & {*has}))
        orders = (1, *(order for order in shown if order > 1))
        seen = self._traced(frames, orders)
        pupil_s = np.full(len(index), np.nan)
        glint_s = np.full(seen.glint_status.shape[:2], np.nan)
        if len(index) and np.isfinite(index.start_s).all():
            seen, pupil_s, glint_s = at_own_times(
                seen, index, scene.rig, scene.timings, lambda rows, at: self._traced(frames.at(rows, at), orders)
            )
        observed = Observations(
            index=index,
            pose=pose,
            pupil=replace(pupil_features(seen), time_s=pupil_s),
            glints=replace(glint_features(seen), time_s=glint_s),
            lens_glints=lens_glint_features(scene, eyes, which, index),
            ghost_glints=ghost_glint_features(scene.rig, eyes, which, index, pose, scene.rig_motions(index)),
            purkinje=purkinje_features(seen, glint_s, orders, shown) if shown else None,
        )
        return observed, seen

    def at_instants(self, frames: Traceable) -> Features:
        """Compute pupils and glints at the times of frames, whatever the shutters of their cameras."""
        return self._traced(frames, (1,))

    def _traced(self, frames: Traceable, purkinje: Sequence[int]) -> Features:
        """Compute the features of rows at the times of their frames."""
        scene, index, pose = frames.scene, frames.index, frames.pose
        eyes, which = scene.eyes_of(index)
        return features(
            eyes,
            which,
            Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad),
            index.eye_position_mm + index.head_mm,
            scene.rig.cameras,
            index.camera,
            np.array([light.position_mm for light in scene.rig.lights]),
            lit=scene.rig.lit(index.eye),
            boundary_points=self.boundary_points,
            purkinje=purkinje,
            occluders=Occluders.of(scene.rig, scene.openings) if self.occluded else None,
            stops=scene.stops_of(index),
            rig_motion=scene.rig_motions(index),
        )


def trace(
    frames: Traceable | FrameSource, rig: RigLike | None = None, *, boundary_points: int = 30, occluded: bool = True
) -> Observations:
    """Compute the apparent pupils and glints of frames, or of all frames of a scene, by ray optics.

    >>> er.trace(er.load_scene("headset")).pupil.centre_px.round(1)[0].tolist()
    [364.5, 209.1]

    Args:
        frames: frames, or a scene for all of its frames.
        rig: replaces the rig of the frames.
        boundary_points: number of traced points of each pupil boundary.
        occluded: whether obstacles of the rig and openings of the lens hide features.

    Raises:
        InputError: no pose of an eye fixates a target of the scene; the message names it and the reason.
        TypeError: the argument is neither.
    """
    posed = frames.frames() if isinstance(frames, FrameSource) else frames
    if not isinstance(posed, Traceable):
        raise TypeError(f"give frames or a scene, not {type(frames).__name__}")
    return AnalyticObserver(boundary_points, occluded).observe(posed, rig)


def purkinje_features(seen: Features, glint_s: Floats, orders: Sequence[int], shown: Sequence[int]) -> PurkinjeFeatures:
    """Compute the Purkinje images of the orders `shown`, lamp by lamp, from features of `orders`.

    The times are those of the lamps' glints, `glint_s` (n, lights): all images of a lamp are a few rows apart.
    """
    n, m, _ = seen.glint_status.shape
    slots = [orders.index(order) for order in shown]

    def each(values: Any) -> Any:
        return values[:, :, slots].reshape(n, m * len(slots), *values.shape[3:])

    status = each(seen.glint_status)
    reasons = np.full(status.shape, None, dtype=object)
    for i, j in np.argwhere((status != Status.OK) & (status != Status.NONE)):
        reasons[i, j] = Status(status[i, j]).reason
    return PurkinjeFeatures(
        status=status,
        light=np.where(status == Status.NONE, -1, np.repeat(np.arange(m), len(slots))),
        reason=reasons,
        in_image=each(seen.glint_in_image) & (status == Status.OK),
        xy_px=each(seen.glints_px),
        time_s=np.where(status == Status.OK, np.repeat(glint_s, len(slots), axis=1), np.nan),
        order=np.broadcast_to(np.tile(shown, m), status.shape),
    )


def pupil_features(seen: Features) -> PupilFeatures:
    """Compute the apparent pupils of a batch.

    A pupil is missing if no boundary point has a ray or no ellipse fits. It is partial if only some points have a ray.

    The arcs of a partial pupil run from the first to the last point of each run of visible points. The true arcs extend
    beyond these by less than one spacing of the points. An ellipse is fitted where there are at least `ARC_POINTS`
    points and no stretch of more than `ARC_GAP_DEG` is hidden.
    """
    status, found = seen.pupil_status, seen.point_status == Status.OK
    whole = status == Status.OK
    ok = whole & np.isfinite(seen.ellipse_residual_px)
    partial = ~whole & found.any(axis=1)
    count = found.shape[1]
    reasons = np.full(len(seen), None, dtype=object)
    for k in np.flatnonzero(~ok):
        reasons[k] = (
            Status.NO_ELLIPSE.reason
            if whole[k]
            else f"{Status(status[k]).reason} ({np.count_nonzero(~found[k])} of {count} boundary points)"
        )
    runs = {row: seen_arcs_deg(found[row]) for row in np.flatnonzero(partial).tolist()}
    arcs = np.full((len(seen), max((len(arc) for arc in runs.values()), default=1), 2), np.nan)
    arcs[ok, 0] = (0.0, 360.0)
    ellipses = np.full((len(seen), 5), np.nan)
    for row, arc in runs.items():
        arcs[row, : len(arc)] = arc
        ellipses[row] = _arc_ellipse(seen.points_px[row][found[row]], arc)
    inside = np.where(partial, seen.seen_in_image, seen.pupil_in_image & ok)
    return PupilFeatures(
        status=np.select([ok, partial, whole], [Status.OK, Status.PARTIAL, Status.NO_ELLIPSE], status),
        reason=reasons,
        in_image=inside,
        centre_px=np.where(ok[:, None], seen.centre_px, np.nan),
        semi_axes_px=np.where(ok[:, None], seen.semi_axes_px, np.nan),
        angle_rad=np.where(ok, seen.angle_rad, np.nan),
        anatomical_centre_px=seen.anatomical_centre_px,
        points_px=seen.points_px,
        arcs_deg=arcs,
        arc_ellipse=ellipses,
    )


def seen_arcs_deg(found: Bools) -> list[tuple[float, float]]:
    """Return runs of visible points (k,), evenly spaced around the margin: (from, to) in degrees of its parameter.

    `from` lies in [0, 360) and `to` is not below it; an arc over the first point ends beyond 360.
    """
    count = len(found)
    if found.all():
        return [(0.0, 360.0)]
    starts = np.flatnonzero(found & ~np.roll(found, 1))
    ends = np.flatnonzero(found & ~np.roll(found, -1))
    # The end of an arc is the next end around the margin.
    after = [int(ends[ends >= start][0]) if (ends >= start).any() else int(ends[0]) + count for start in starts]
    step = 360.0 / count
    return [(float(start * step), float(end * step)) for start, end in zip(starts, after, strict=True)]


def _arc_ellipse(points_px: Floats, arcs: Sequence[tuple[float, float]]) -> Floats:
    """Fit the ellipse (cx, cy, a, b, angle) to the visible points; NaN if they do not determine it."""
    gaps = [following[0] - arc[1] for arc, following in pairwise([*arcs, (arcs[0][0] + 360.0, 0.0)])]
    if len(points_px) < ARC_POINTS or max(gaps) > ARC_GAP_DEG + 1e-9:
        return np.full(5, np.nan)
    fit = fit_ellipse_direct(points_px)
    if not fit.ok:
        return np.full(5, np.nan)
    return np.concatenate([fit.centre_px, fit.semi_axes_px, [fit.angle_rad]])


def glint_features(seen: Features) -> GlintFeatures:
    """Compute the glints (first Purkinje images) of a batch."""
    status = seen.glint_status[:, :, 0]
    reasons = np.full(status.shape, None, dtype=object)
    for i, j in np.argwhere((status != Status.OK) & (status != Status.NONE)):
        reasons[i, j] = Status(status[i, j]).reason
    return GlintFeatures(
        status=status,
        light=np.where(status == Status.NONE, -1, np.arange(status.shape[1])),
        reason=reasons,
        in_image=seen.glint_in_image[:, :, 0] & (status == Status.OK),
        xy_px=seen.glints_px[:, :, 0],
    )


def lens_glint_features(
    scene: TraceableScene, eyes: Sequence[EyeModel], which: Indices, index: Index
) -> LensGlintFeatures | None:
    """Compute the reflections of lamps in the lenses worn; None if nobody wears any.

    Lenses do not turn with the eye, so rows that differ in the fixation only share one search.
    """
    if not any(eye.worn for eye in eyes):
        return None
    places = index.eye_position_mm + index.head_mm
    moved = np.nan_to_num(np.concatenate([index.rig_rotation_rad, index.rig_translation_mm], axis=1))
    keys: dict[bytes, int] = {}
    table = np.column_stack([index.camera, which, places, moved])
    back = np.array([keys.setdefault(key.tobytes(), len(keys)) for key in table], dtype=np.intp)
    rows = np.unique(back, return_index=True)[1]
    rigs = [scene.rig_at(index, int(row)) for row in rows]
    found = [
        _images_of(rig, eyes[which[row]], int(index.eye[row]), int(index.camera[row]), places[row])
        for rig, row in zip(rigs, rows, strict=True)
    ]
    shape = len(keys), max(map(len, found))
    status, light = np.full(shape, Status.NONE, np.int8), np.full(shape, -1)
    surface, number = np.full(shape, -1), np.full(shape, -1)
    xy, inside = np.full((*shape, 2), np.nan), np.zeros(shape, dtype=bool)
    reason = np.full(shape, None, dtype=object)
    for k, (row, images) in enumerate(zip(rows, found, strict=True)):
        camera = rigs[k].cameras[index.camera[row]]
        for j, one in enumerate(images):
            xy[k, j], front = camera.project(one.seen_mm + places[row])
            at = Status.BEHIND_CAMERA if one.status == Status.OK and not front else one.status
            status[k, j], reason[k, j], inside[k, j] = at, at.reason, bool(camera.in_image(xy[k, j]))
            light[k, j], surface[k, j], number[k, j] = one.lamp, SURFACES.index(one.surface), one.index
    whole = LensGlintFeatures(
        status=status, light=light, reason=reason, in_image=inside, xy_px=xy, surface=surface, index=number
    )
    return whole.take(back)


def _images_of(rig: RigGeometry, eye: EyeModel, side: int, camera: int, place_mm: Floats) -> list[LensImage]:
    """Compute the reflections in the lenses of one eye; lamps keep their numbers in the rig."""
    lights, seen = rig.lights_of(side), rig.cameras[camera].nodal_point_mm - place_mm
    if not eye.worn or not len(lights):
        return []
    lamps = np.array([rig.lights[k].position_mm for k in lights]) - place_mm
    return [replace(one, lamp=int(lights[one.lamp])) for one in lens_images(eye.worn, lamps, seen)]
