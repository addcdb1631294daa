"""Fisher information of a rig's observations, and the resulting covariance of gaze and of every parameter.

    I = sum_j (l_j / s^2) (n_j . dp_j) (n_j . dp_j)^T + sum_g dg^T dg / s_g^2 + sum_t dm^T dm / f^2 + P^-1      (3)

with points p_j of the pupil's outline, their normals n_j and lengths l_j of outline, the noise s of one px of outline,
glints g with noise s_g, the angles m between line of sight and target with the noise of fixation f for frames of a
calibration, and the covariance P of priors. All derivatives are with respect to the unknowns (`unknowns.py`). The
inverse of I is the Cramer-Rao bound: no unbiased estimator on these features has less variance. The bound includes
noise only; an estimator's wrong assumptions about the eye add to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints, finite_or_none
from ..base.errors import InputError
from ..rig.rig import RigLike
from ..scene import Frames
from ..scene.observation import EYES
from .noise import FeatureNoise, sensor_noise
from .unknowns import ANGLES, AZIMUTH, COUNT, ELEVATION, LOCAL, NAMES, PERSON, PUPIL, Unknowns
from .varied import (
    FeatureSlopes,
    Views,
    diameters_mm,
    gaze_slopes,
    lines_of_sight,
    slopes_of,
    stacked_eyes,
    target_slopes,
)

UNSEEN = 1e-11
"""Eigenvalues of the information, scaled to a unit diagonal, below which a direction is undetermined."""
_VIRTUAL_MM = 1000.0
_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Case:
    """Views and their instants, the input of all analyses of a rig."""

    views: Views  # n views
    instant: Ints  # (n,) the instant of each view, 0 to i - 1
    instants: Views  # one view for each of i instants, for values that do not depend on the camera
    theta: Floats  # (i, 35) the true unknowns
    target_mm: Floats  # (i, 3) fixation targets; NaN without one


def case_of(frames: Frames, rig: RigLike | None = None) -> tuple[Case, Ints]:
    """Create a case from frames; also return the first row of each instant.

    Raises:
        InputError: the rig has another number of cameras, or a cornea has no radius.
    """
    frames = frames.seen_by(rig)
    scene, index, pose = frames.scene, frames.index, frames.pose
    scene.refuse_spectacles("information is computed")
    built, which = scene.eyes_of(index)
    eyes = stacked_eyes(built)
    keys = np.stack([index.head, index.fixation, index.eye], axis=-1)
    _, rows, instant = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    views = Views(
        eyes=eyes,
        person=np.asarray(which),
        position_mm=index.eye_position_mm + index.head_mm,
        camera=np.asarray(index.camera),
        rig=scene.rig,
    )
    theta = np.zeros((len(rows), COUNT))
    theta[:, AZIMUTH], theta[:, ELEVATION] = pose.azimuth_rad[rows], pose.elevation_rad[rows]
    instants = views.take(rows)
    theta[:, PUPIL] = diameters_mm(eyes)[instants.person]
    target = np.array(index.target_mm[rows])
    case = Case(views=views, instant=instant.reshape(-1), instants=instants, theta=theta, target_mm=target)
    return case, rows


def outline_normals(points_px: Floats, ok: Bools) -> tuple[Floats, Floats]:
    """Compute unit normals (n, k, 2) and lengths (n, k) px of outline at points (n, k, 2) evenly spaced along it.

    The points are evenly spaced in the outline's parameter. The derivative by the parameter is (p_(j+1) - p_(j-1)) / (2
    sin h) for a spacing h, which is exact for an ellipse. Points without both neighbours have length 0.
    """
    spacing = 2.0 * np.pi / points_px.shape[1]
    after, before = np.roll(points_px, -1, axis=1), np.roll(points_px, 1, axis=1)
    along = (after - before) / (2.0 * np.sin(spacing))
    usable = ok & np.roll(ok, 1, axis=1) & np.roll(ok, -1, axis=1)
    speed = np.linalg.norm(along, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / speed[..., None]
    return np.where(usable[..., None], normal, 0.0), np.where(usable, speed * spacing, 0.0)


def whitened_slopes(slopes: FeatureSlopes, noise: FeatureNoise, camera: Ints) -> tuple[Floats, Floats]:
    """Compute derivatives over noise in n views: (n, k, 35) across the outline and (n, m, 2, 35) of glints."""
    normal, length = outline_normals(slopes.images.outline_px, slopes.outline_ok)
    size = np.sqrt(length) / noise.outline_px[camera][:, None]
    across = np.einsum("nkx,nkxa->nka", normal, slopes.outline) * size[..., None]
    weight = np.where(slopes.glint_ok, 1.0 / noise.glint_px[camera], 0.0)
    return across, slopes.glints * weight[..., None, None]


def whitened_rows(slopes: FeatureSlopes, noise: FeatureNoise, camera: Ints) -> Floats:
    """Compute derivatives over noise of all features in n views, (n, features, columns of the derivatives)."""
    across, glints = whitened_slopes(slopes, noise, camera)
    return np.concatenate([across, glints.reshape(len(camera), -1, across.shape[2])], axis=1)


def information_of_views(slopes: FeatureSlopes, noise: FeatureNoise, camera: Ints) -> Floats:
    """Compute the information (n, 35, 35) of outline and glints in each view, the first two sums of equation (3)."""
    rows = whitened_rows(slopes, noise, camera)
    return np.asarray(np.swapaxes(rows, 1, 2) @ rows)


def information_of_instants(case: Case, noise: FeatureNoise, boundary_points: int, free: Bools | None = None) -> Floats:
    """Compute the information (i, 35, 35) of all views of each instant."""
    out = np.zeros((len(case.theta), COUNT, COUNT))
    for first in range(0, len(case.views), _ROWS):
        rows = np.arange(first, min(first + _ROWS, len(case.views)))
        views = case.views.take(rows)
        slopes = slopes_of(views, case.theta[case.instant[rows]], boundary_points, free)
        np.add.at(out, case.instant[rows], information_of_views(slopes, noise, views.camera))
    return out


def target_information(case: Case, noise: FeatureNoise, rows: Ints) -> Floats:
    """Compute the information (r, 35, 35) of known targets, the third sum of equation (3).

    An instant without a target is assumed to fixate a point one metre away.
    """
    views, theta = case.instants.take(rows), case.theta[rows]
    point, way = lines_of_sight(views, theta)
    given = case.target_mm[rows]
    target = np.where(np.isfinite(given), given, point + _VIRTUAL_MM * way)
    slopes = target_slopes(views, theta, target) / np.radians(noise.fixation_deg)
    return np.asarray(np.swapaxes(slopes, 1, 2) @ slopes)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EyeInformation(ArrayValue):
    """Information of a rig about one eye in i instants."""

    eye: str  # right or left
    fixation: Ints  # (i,) fixation of each instant
    head: Ints  # (i,) head position
    # (i, 2, 2) covariance of the line of sight, to the subject's left and up; inf if undetermined
    gaze_covariance_deg2: Floats
    axis_covariance_deg2: Floats  # (i, 2, 2) covariance of the optic axis' azimuth and elevation
    # (i, 6) standard deviations of each frame's unknowns (`unknowns.FRAME`), rad and mm; 0 if known, inf if
    # undetermined
    frame_deviation: Floats
    person_deviation: Floats  # (29,) standard deviations of the person's unknowns (`unknowns.PERSON`), rad and mm
    person_covariance: Floats  # (29, 29) covariance of these; inf on the diagonal if undetermined
    matrices: Floats  # (i, 35, 35) information of each instant on its unknowns and the person's, without priors
    unseen: tuple[str, ...]  # combinations of unknowns that the rig does not determine, in words

    @property
    def gaze_deg(self) -> Floats:
        """Standard deviation (i,) of the line of sight in degrees: the square root of the sum of both variances."""
        return np.asarray(np.sqrt(np.trace(self.gaze_covariance_deg2, axis1=1, axis2=2)))

    @property
    def axis_deg(self) -> Floats:
        """Standard deviation (i,) of the optic axis in degrees."""
        return np.asarray(np.sqrt(np.trace(self.axis_covariance_deg2, axis1=1, axis2=2)))


@dataclass(frozen=True, slots=True, eq=False)
class Information(ArrayValue):
    """Information of a rig about each eye, from noise only: `information["right"].gaze_deg`."""

    eyes: tuple[EyeInformation, ...]
    note: str = field(default="noise only: what an estimator assumes wrongly comes on top")

    def __getitem__(self, eye: str) -> EyeInformation:
        for one in self.eyes:
            if one.eye == eye:
                return one
        raise InputError(f"there is no {eye} eye", path="eye")

    def to_mapping(self) -> dict[str, Any]:
        """Convert to JSON values: standard deviations in degrees and mm, null if undetermined."""
        return {"schema": "eyerender/information/1", "note": self.note, "eyes": [_mapping(one) for one in self.eyes]}


def information(
    frames: Frames,
    rig: RigLike | None = None,
    *,
    unknowns: Unknowns | None = None,
    noise: FeatureNoise | None = None,
    calibration: Sequence[int] = (),
    boundary_points: int = 30,
) -> Information:
    """Compute the Fisher information of a rig about gaze and eye, and its inverse, equation (3).

    >>> er.information(er.load_scene("guestrin2006").frames())["right"].gaze_deg.shape
    (45,)

    Args:
        frames: the frames; all cameras at one fixation and head position are one instant.
        rig: replaces the rig of the frames.
        unknowns: what is known beforehand; default: `Unknowns()`, everything except gaze and pupil.
        noise: noise of the features; default: that of the scene's sensor.
        calibration: fixations with known targets, up to the noise of fixation; the other frames profit from them.
        boundary_points: points of each outline.

    Raises:
        InputError: there is no such fixation, or a cornea has no radius to vary.
    """
    unknowns = Unknowns() if unknowns is None else unknowns
    case, first = case_of(frames, rig)
    index = frames.index.take(first)
    unknown = sorted(set(calibration) - set(index.fixation.tolist()))
    if unknown:
        raise InputError(f"there is no fixation {unknown[0]}", path="calibration")
    scene = frames.scene if rig is None else frames.seen_by(rig).scene
    noise = sensor_noise(scene) if noise is None else noise
    matrices = information_of_instants(case, noise, boundary_points, unknowns.free())
    calibrated = np.flatnonzero(np.isin(index.fixation, list(calibration)))
    matrices[calibrated] += target_information(case, noise, calibrated)
    slopes = gaze_slopes(case.instants, case.theta)
    found = []
    for person in np.unique(case.instants.person):
        rows = np.flatnonzero(case.instants.person == person)
        at = index.take(rows)
        found.append(
            eye_information(EYES[int(at.eye[0])], (at.fixation, at.head), matrices[rows], slopes[rows], unknowns)
        )
    return Information(tuple(found))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Inverse:
    """Covariance of each instant's and the person's unknowns, without combinations that are not determined."""

    covariance: Floats  # (i, q, q) covariance of the q free unknowns
    unseen: tuple[Floats, ...]  # for each instant an orthonormal basis (q, u) of its undetermined combinations

    def variance_of(self, slopes: Floats) -> Floats:
        """Compute the covariance (i, f, f) of f linear functions (i, f, q); inf on the diagonal if undetermined."""
        out: Floats = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        size = np.maximum(np.linalg.norm(slopes, axis=2), 1e-300)
        for k, basis in enumerate(self.unseen):
            lost = np.linalg.norm(slopes[k] @ basis, axis=1) / size[k] > 1e-4
            out[k][np.diag_indices(len(lost))] = np.where(lost, np.inf, np.diag(out[k]))
        return out


def arrow_inverse(matrices: Floats, unknowns: Unknowns) -> Inverse:
    """Invert the information on the unknowns of i instants and of their person, in time proportional to i.

    Instants are coupled through the person alone. With the blocks A_i of an instant and its prior, B_i to the person
    and C of the person and its prior, the person's covariance is P = (C - sum B_i^T A_i^-1 B_i)^-1, and that of an
    instant is A_i^-1 + K_i P K_i^T with K_i = A_i^-1 B_i (block inversion). Blocks are scaled to a unit diagonal;
    directions with an eigenvalue below `UNSEEN` are split off. `matrices`: (i, 35, 35) information of each instant,
    without priors; `unknowns`: provides the priors, and which unknowns are free.
    """
    prior, free = unknowns.precision(), unknowns.free()
    local, person = np.flatnonzero(free[:LOCAL]), LOCAL + np.flatnonzero(free[LOCAL:])
    a = matrices[:, local[:, None], local] + np.diag(prior[local])
    c = matrices[:, person[:, None], person].sum(axis=0) + np.diag(prior[person])
    own, common = _scales(np.einsum("iaa->ia", a)), _scales(np.diag(c))
    b = matrices[:, local[:, None], person] * own[:, :, None] * common
    values, vectors = np.linalg.eigh(a * own[:, :, None] * own[:, None])
    seen = values > UNSEEN
    half = vectors * np.where(seen, 1.0 / np.sqrt(np.where(seen, values, 1.0)), 0.0)[:, None]
    inner = half @ np.swapaxes(half, 1, 2)
    lift = inner @ b
    weights, modes = np.linalg.eigh(c * common[:, None] * common - np.einsum("ilp,ilq->pq", b, lift))
    good = weights > UNSEEN * (1.0 + np.sum((lift @ modes) ** 2, axis=(0, 1)))
    scale = np.concatenate([own, np.broadcast_to(common, (len(own), len(common)))], axis=1)

    def whole(columns: Floats) -> Floats:
        """Complete columns (p, u) of the person by what they move in each instant, (i, q, u)."""
        each = np.broadcast_to(columns, (len(lift), *columns.shape))
        return np.asarray(np.concatenate([-(lift @ columns), each], axis=1) * scale[:, :, None])

    root = whole(modes[:, good] / np.sqrt(weights[good]))
    covariance = root @ np.swapaxes(root, 1, 2)
    covariance[:, : len(local), : len(local)] += inner * own[:, :, None] * own[:, None]
    lost, unseen = whole(modes[:, ~good]), []
    for k, missing in enumerate(~seen):
        alone = np.zeros((scale.shape[1], int(missing.sum())))
        alone[: len(local)] = vectors[k][:, missing] * own[k][:, None]
        unseen.append(np.linalg.qr(np.concatenate([alone, lost[k]], axis=1))[0])
    return Inverse(covariance=covariance, unseen=tuple(unseen))


def roots_of(matrices: Floats) -> Floats:
    """Compute roots V (i, q, q) of inverse matrices, V V^T = A^-1; columns of undetermined directions are 0."""
    scale = _scales(np.einsum("iaa->ia", matrices))
    values, vectors = np.linalg.eigh(matrices * scale[:, :, None] * scale[:, None])
    seen = values > UNSEEN
    return np.asarray(
        scale[..., None] * vectors * np.where(seen, 1.0 / np.sqrt(np.where(seen, values, 1.0)), 0.0)[:, None]
    )


def _scales(diagonal: Floats) -> Floats:
    """Return 1 / sqrt(diagonal), 1 where it is 0."""
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


def eye_information(
    eye: str, at: tuple[Ints, Ints], matrices: Floats, gaze: Floats, unknowns: Unknowns
) -> EyeInformation:
    """Compute the covariances of one eye from the information of its instants."""
    free = unknowns.free()
    found = arrow_inverse(matrices, unknowns)
    count, each = len(matrices), np.flatnonzero(free)
    every = np.zeros((count, COUNT, COUNT))
    every[:, each[:, None], each] = found.variance_of(np.tile(np.eye(len(each)), (count, 1, 1)))
    deviation = np.sqrt(np.einsum("iaa->ia", every))
    axes = np.tile(np.eye(2, COUNT)[:, each], (count, 1, 1))
    square = np.degrees(1.0) ** 2
    return EyeInformation(
        eye=eye,
        fixation=at[0],
        head=at[1],
        gaze_covariance_deg2=found.variance_of(gaze[:, :, each]) * square,
        axis_covariance_deg2=found.variance_of(axes) * square,
        frame_deviation=deviation[:, :LOCAL],
        person_deviation=deviation[0, LOCAL:],
        person_covariance=every[0, LOCAL:, LOCAL:],
        matrices=matrices,
        unseen=described(found.unseen, [NAMES[k] for k in each]),
    )


def described(unseen: Sequence[Floats], names: Sequence[str]) -> tuple[str, ...]:
    """Name the unknowns that take part in undetermined combinations, the largest share first."""
    share = np.sum([np.sum(basis**2, axis=1) for basis in unseen], axis=0)
    return tuple(names[k] for k in np.argsort(-share, kind="stable") if share[k] > 1e-6)


def _mapping(one: EyeInformation) -> dict[str, Any]:
    degrees = np.where(ANGLES, np.degrees(1.0), 1.0)

    person = one.person_deviation * degrees[LOCAL:]
    frame = one.frame_deviation * degrees[:LOCAL]
    return {
        "eye": one.eye,
        "fixation": one.fixation.tolist(),
        "head": one.head.tolist(),
        "gaze_deg": [finite_or_none(v) for v in one.gaze_deg],
        "axis_deg": [finite_or_none(v) for v in one.axis_deg],
        "frame": {name: [finite_or_none(v) for v in frame[:, k]] for k, name in enumerate(NAMES[:LOCAL])},
        "person": {name: finite_or_none(v) for name, v in zip(PERSON, person, strict=True)},
        "unseen": list(one.unseen),
    }
