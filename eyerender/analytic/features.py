"""Features of eyes in cameras by ray optics: apparent pupil, glints, and Purkinje images.

A batch is n (frame, eye) pairs: eyes, their poses and positions, and the camera that sees each. Work is divided into
chunks whose arrays stay in the cache, so memory beyond the result is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, Floats, Indices, Statuses
from ..base.errors import InputError
from ..base.status import Status, mark
from ..eye.batch import CHUNK_POINTS, chunks, groups, slices, take_eyes, take_stops
from ..eye.model import EyeModel, Stop
from ..eye.pose import Poses, rigid_motion
from ..eye.worn import WornLens
from ..optics.ellipse import fit_ellipse_direct
from ..optics.surfaces import Xyz
from ..rig.camera import PinholeCamera
from ..rig.distortion import is_distorted
from ..scene.observation import MAX_BOUNDARY_POINTS, MAX_POINTS
from .occluders import Occluders
from .rays import glint_exits, lit_points, pupil_exits
from .view_kernels import project_all, see_all

RigidMotions = tuple[Floats, Floats]
"""Rotations (n, 3, 3) and translations (n, 3) mm."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Features(ArrayValue):
    """Features of n eyes in their cameras; pixels are full-sensor, NaN where the status is not OK."""

    points_px: Floats  # (n, k, 2) the pupil's boundary
    point_status: Statuses  # (n, k)
    point_residual_mm: Floats  # (n, k)
    centre_px: Floats  # (n, 2) centre of its direct least-squares ellipse
    semi_axes_px: Floats  # (n, 2)
    angle_rad: Floats  # (n,)
    ellipse_residual_px: Floats  # (n,) deviation (rms) of the boundary from the ellipse
    anatomical_centre_px: Floats  # (n, 2) image of the stop's centre
    point_in_image: Bools  # (n, k)
    glints_px: Floats  # (n, m, p, 2) the p requested Purkinje images of each of m lights; the first one is the glint
    glint_status: Statuses  # (n, m, p)
    glint_residual_mm: Floats  # (n, m, p)
    glint_in_image: Bools  # (n, m, p)

    @property
    def pupil_status(self) -> Statuses:
        """Status (n,) of the first boundary point that is not OK, else OK."""
        first = np.argmax(self.point_status != Status.OK, axis=1)
        return np.asarray(self.point_status[np.arange(len(first)), first])

    @property
    def seen_in_image(self) -> Bools:
        """Whether any boundary point is visible and all visible ones lie in the image, (n,)."""
        seen = self.point_status == Status.OK
        return np.asarray((self.point_in_image | ~seen).all(axis=1) & seen.any(axis=1))

    @property
    def pupil_in_image(self) -> Bools:
        """Whether all boundary points are visible and lie in the image, (n,)."""
        return np.asarray(self.point_in_image.all(axis=1))

    def __len__(self) -> int:
        return len(self.centre_px)


def features(
    eyes: Sequence[EyeModel],  # distinct eyes
    eye_index: npt.ArrayLike,  # (n,) the eye of each row
    poses: Poses,  # n poses
    position_mm: npt.ArrayLike,  # (n, 3) unrotated apex in the world, including the head's displacement
    cameras: Sequence[PinholeCamera],  # distinct cameras
    camera_index: npt.ArrayLike,  # (n,) the camera of each row
    lights_mm: npt.ArrayLike,  # (m, 3) in the world
    *,
    lit: npt.ArrayLike = True,  # (n, m) whether a light lights the eye; if not, its images have status NONE
    boundary_points: int = 30,  # number of boundary points, >= 6
    # orders of the requested images of each light; one that an eye lacks has status MISSED
    purkinje: Sequence[int] = (1,),
    # what hides features besides the eye itself. Light that enters the eye is followed from its lamp to the point where
    # it leaves.
    occluders: Occluders | None = None,
    stops: Stop | None = None,  # n stops in place of those of the eyes
    # n rotations and translations x' = R x + t that move cameras, lights and occluders in the world
    rig_motion: RigidMotions | None = None,
) -> Features:
    """Compute the features of n eyes."""
    _check_options(len(np.atleast_1d(eye_index)), boundary_points, purkinje)
    which = np.asarray(eye_index, dtype=np.intp)
    cams = np.asarray(camera_index, dtype=np.intp)
    position = np.broadcast_to(np.asarray(position_mm, dtype=np.float64), (len(which), 3))
    lights = np.asarray(lights_mm, dtype=np.float64).reshape(-1, 3)
    n, m, p = len(which), len(lights), len(purkinje)
    k = boundary_points
    points, anatomical, ellipse = np.empty((n, k, 2)), np.empty((n, 2)), np.empty((n, 6))
    point_status, point_residual = np.empty((n, k), dtype=np.int8), np.empty((n, k))
    in_image = np.empty((n, k), dtype=bool)
    lit = np.broadcast_to(np.asarray(lit, dtype=bool), (n, m))
    glints, glint_residual = np.full((n, m, p, 2), np.nan), np.full((n, m, p), np.nan)
    glint_status, glint_in_image = np.full((n, m, p), Status.NONE, np.int8), np.zeros((n, m, p), dtype=bool)
    for group, rows in groups(eyes, which):
        for number in np.unique(cams[rows]):
            camera = cameras[number]
            for block, turned in chunks(group, rows[cams[rows] == number], max(1, CHUNK_POINTS // max(m, 4))):
                pose = Poses(poses.azimuth_rad[block], poses.elevation_rad[block], poses.torsion_rad[block])
                view = View.of(turned, pose, position[block], camera, rows_of(rig_motion, block))
                turned = _stopped(turned, stops, block)
                some = np.flatnonzero(lit[block].any(axis=0))
                for j, order in enumerate(purkinje if len(some) else ()):
                    exits, residual, status = glint_exits(
                        turned, order, view.into_eye(lights[some]), view.camera_mm, view.lenses
                    )
                    pixels, status = view.project(exits, status)
                    if occluders is not None:
                        lit_mm = lit_points(turned, exits, view.into_eye(lights[some]), view.camera_mm, view.lenses)
                        points_mm = view.in_world(exits)
                        occluders.mark(status, pixels, points_mm, camera, lights[some], view.in_world(lit_mm))
                    at, lamp = np.ix_(block, some)
                    glints[at, lamp, j], glint_status[at, lamp, j] = pixels, status
                    glint_residual[at, lamp, j], glint_in_image[at, lamp, j] = residual, camera.in_image(pixels)
                for inner in slices(len(block), max(1, CHUNK_POINTS // boundary_points)):
                    part, eye, near = block[inner], take_eyes(turned, np.arange(len(block))[inner]), view.rows(inner)
                    eye = _stopped(eye, stops, part)
                    # The last point is the stop's centre.
                    exits, residual, status = pupil_exits(eye, boundary_points, near.camera_mm, near.lenses)
                    pixels, status = near.project(exits, status)
                    if occluders is not None:  # the centre is no feature that is seen
                        outline = near.in_world(exits)[:, :-1]
                        occluders.mark(status[:, :-1], pixels[:, :-1], outline, camera, None)
                    points[part], anatomical[part] = pixels[:, :-1], pixels[:, -1]
                    point_status[part], point_residual[part] = status[:, :-1], residual[:, :-1]
                    fit = fit_ellipse_direct(pixels[:, :-1])
                    ellipse[part, :2], ellipse[part, 2:4] = fit.centre_px, fit.semi_axes_px
                    ellipse[part, 4], ellipse[part, 5] = fit.angle_rad, fit.residual_px
                    in_image[part] = camera.in_image(pixels[:, :-1])
    if not lit.all():
        glints[~lit], glint_status[~lit], glint_in_image[~lit] = np.nan, Status.NONE, False
    results: list[npt.NDArray[Any]] = [points, point_status, point_residual, ellipse, anatomical, in_image]
    results += [glints, glint_status, glint_residual, glint_in_image]
    for array in results:
        array.setflags(write=False)
    return Features(
        points_px=points,
        point_status=point_status,
        point_residual_mm=point_residual,
        centre_px=ellipse[:, :2],
        semi_axes_px=ellipse[:, 2:4],
        angle_rad=ellipse[:, 4],
        ellipse_residual_px=ellipse[:, 5],
        anatomical_centre_px=anatomical,
        point_in_image=in_image,
        glints_px=glints,
        glint_status=glint_status,
        glint_residual_mm=glint_residual,
        glint_in_image=glint_in_image,
    )


def rows_of(motions: RigidMotions | None, rows: Indices) -> RigidMotions | None:
    """Select rows of motions, if there are any."""
    return None if motions is None else (motions[0][rows], motions[1][rows])


def _stopped(eye: EyeModel, stops: Stop | None, rows: Indices) -> EyeModel:
    """Replace the stop of eyes by those of rows, if there are any."""
    return eye if stops is None else replace(eye, stop=take_stops(stops, rows))


def _check_options(rows: int, boundary_points: int, purkinje: Sequence[int]) -> None:
    """Raise InputError if an option of `features` is out of range."""
    if boundary_points < 6:
        raise InputError("must be >= 6", path="boundary_points")
    if boundary_points > MAX_BOUNDARY_POINTS:
        raise InputError(f"must be <= {MAX_BOUNDARY_POINTS}", path="boundary_points")
    if rows * boundary_points > MAX_POINTS:
        raise InputError(
            f"{rows} observations with {boundary_points} points each are more than {MAX_POINTS} points; ask for fewer",
            path="boundary_points",
        )
    if not set(purkinje) <= {1, 2, 3, 4} or len(set(purkinje)) != len(purkinje):
        raise InputError("must be different numbers from 1 to 4", path="purkinje")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class View:
    """View of one camera on a batch of turned eyes: x_cam = R x_eye + t for each.

    The camera, and the lenses worn, are in the eyes' frames.
    """

    rotation: Floats
    translation: Floats
    camera_mm: Xyz
    motion: tuple[Floats, Floats]
    camera: PinholeCamera
    lenses: tuple[WornLens, ...]

    @classmethod
    def of(
        cls,
        eye: EyeModel,
        poses: Poses,
        position_mm: Floats,
        camera: PinholeCamera,
        rig_motion: RigidMotions | None = None,
    ) -> View:
        """Create the view of a camera on posed eyes whose unrotated apexes are at positions (n, 3) in the world.

        If the rig moves, everything is seen from it: what is called the world is then the frame of the rig.
        """
        own, shift = rigid_motion(poses, eye)
        turn, whole = own, shift + position_mm
        if rig_motion is not None:
            back, offset = rig_motion
            turn, whole = np.einsum("nji,njk->nik", back, own), np.einsum("nji,nj->ni", back, whole - offset)
        rotation, translation, at = np.empty(turn.shape), np.empty(shift.shape), np.empty(shift.shape[::-1])
        see_all(turn, whole, np.array(camera.R), np.array(camera.t), rotation, translation, at)
        return cls(
            rotation=rotation,
            translation=translation,
            camera_mm=(at[0], at[1], at[2]),
            motion=(turn, whole),
            camera=camera,
            lenses=tuple(lens.turned(own, shift) for lens in eye.worn),
        )

    def rows(self, part: slice) -> View:
        """Select some of the eyes."""
        x, y, z = self.camera_mm
        turn, shift = self.motion
        return View(
            rotation=self.rotation[part],
            translation=self.translation[part],
            camera_mm=(x[part], y[part], z[part]),
            motion=(turn[part], shift[part]),
            camera=self.camera,
            lenses=tuple(lens.take(np.arange(len(turn))[part]) for lens in self.lenses),
        )

    def into_eye(self, points_mm: Floats) -> Xyz:
        """Transform world points (m, 3) into each eye's frame: three arrays (n, m)."""
        turn, shift = self.motion
        inside = np.einsum("nmi,nij->jnm", points_mm - shift[:, None, :], turn)
        return inside[0], inside[1], inside[2]

    def in_world(self, points: Xyz) -> Floats:
        """Transform points (n, k) of each eye's frame to the world: (n, k, 3) mm."""
        turn, shift = self.motion
        return np.asarray(np.einsum("nij,jnk->nki", turn, np.stack(points)) + shift[:, None, :])

    def project(self, points: Xyz, status: Statuses) -> tuple[Floats, Statuses]:
        """Project points of the eye frame to pixels (n, k, 2); NaN where the status is not OK."""
        camera, found = self.camera, np.array(status, dtype=np.int8)
        if camera.is_fisheye:
            return self._in_mirror(*self._through_fisheye(points, found))
        plain = not is_distorted(camera.distortion)
        scale = (
            (camera.across * camera.K[0, 0], camera.K[0, 2], camera.K[1, 1], camera.K[1, 2])
            if plain
            else (1.0, 0.0, 1.0, 0.0)
        )
        seen = np.empty((*found.shape, 2))
        x, y, z = (np.ascontiguousarray(axis) for axis in points)
        ends = np.array(scale), int(Status.BEHIND_CAMERA)
        project_all(self.rotation, self.translation, x, y, z, found, *ends, seen)
        return self._in_mirror(seen if plain else camera.pixels_of(seen[..., 0], seen[..., 1]), found)

    def _in_mirror(self, pixels: Floats, status: Statuses) -> tuple[Floats, Statuses]:
        """Remove pixels outside the outline of the camera's mirror; `status` is changed."""
        if (beside := self.camera.beside_mirror(pixels)) is None:
            return pixels, status
        mark(status, beside, Status.BESIDE_MIRROR)
        return np.where((status == Status.OK)[..., None], pixels, np.nan), status

    def _through_fisheye(self, points: Xyz, status: Statuses) -> tuple[Floats, Statuses]:
        """Project points of the eye frame as `project` does; `status` is changed."""
        seen = np.einsum("nij,jnk->nki", self.rotation, np.stack(points)) + self.translation[:, None, :]
        x, y, front = self.camera.plane(seen)
        status[(status == Status.OK) & ~front] = Status.BEHIND_CAMERA
        return np.where((status == Status.OK)[..., None], self.camera.pixels_of(x, y), np.nan), status
