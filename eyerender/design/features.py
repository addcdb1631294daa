"""Residuals between observed and modelled features: distances along the outline's normals, and glint shifts, whitened.

An observed outline is a set of points: those of the record, or points of its ellipse. Their distances d from the
modelled outline along its normal have the covariance of the noise (s^2 / l for l px of outline), or that of the
record's ellipse. For a covariance C of the ellipse's parameters e, d = H de to first order, and the whitened distances
are C^(-1/2) H^+ d.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, Floats, Ints
from ..base.status import Status
from ..scene.observation import Observations
from .noise import FeatureNoise
from .unknowns import COUNT
from .varied import FeatureSlopes, ModelFeatures

Complexes = npt.NDArray[np.complex128]
ELLIPSE_POINTS, MOST_POINTS = 24, 40
MODEL_PX = 0.02
"""Deviation that is added to the covariances of an extractor (chosen): they hold the sensor's noise alone, often less
than .01 px, but features are displaced by more than that. A good outline would count as wrong without it."""
_OF_ELLIPSE, _OF_POINT = MODEL_PX**2 * np.diag([1.0, 1.0, 1.0, 1.0, 0.0]), MODEL_PX**2 * np.eye(2)
_ANY_AXES_PX = np.array([20.0, 20.0])
"""Semi-axes of the circle about a pupil that is given by its centre alone."""
_NEWTON = 4
_LEAST_RATIO = 1e-6


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredFeatures(ArrayValue):
    """Observed features of n views."""

    outline_px: Floats  # (n, k, 2) points of the outline; 0 if missing
    outline_white: Floats  # (n, k, k) whitening of their distances; 0 without an outline
    outline_size: Ints  # (n,) number of independent distances
    glints_px: Floats  # (n, m, 2) glint of each light; 0 if missing
    glint_white: Floats  # (n, m, 2, 2) whitening of their shifts; 0 without a glint

    def take(self, rows: Ints) -> MeasuredFeatures:
        """Select views."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.__slots__})

    @property
    def has_glint(self) -> Bools:
        """Whether each glint was observed, (n, m)."""
        return np.asarray(self.glint_white.any(axis=(2, 3)))

    @property
    def count(self) -> int:
        """Number of independent values."""
        return int(self.outline_size.sum() + 2 * self.has_glint.sum())


def measured(observations: Observations, noise: FeatureNoise, lights: int) -> MeasuredFeatures:
    """Convert observations to whitened features.

    Covariances are those of the observations plus that of `MODEL_PX`, or, where these are missing, those of `noise`.
    """
    camera = np.maximum(observations.index.camera, 0)
    points, white, size = _outlines(observations, noise.outline_px[camera])
    glints, weights = np.zeros((len(camera), lights, 2)), np.zeros((len(camera), lights, 2, 2))
    for light in range(lights):
        place, found = observations.glints.of_light(light)
        deviation = noise.glint_px[camera, light]
        covariance = np.where(found, deviation, 1.0)[:, None, None] ** 2 * np.eye(2)
        given = _covariance_of(observations, light) + _OF_POINT
        own = found & np.isfinite(given).all(axis=(1, 2))
        covariance[own] = given[own]
        usable = found & np.isfinite(covariance).all(axis=(1, 2))
        weights[usable, light] = _whitening(covariance[usable])
        glints[usable, light] = place[usable]
    return MeasuredFeatures(
        outline_px=points, outline_white=white, outline_size=size, glints_px=glints, glint_white=weights
    )


def _covariance_of(observations: Observations, light: int) -> Floats:
    """Return the covariance (n, 2, 2) px^2 of one light's glint; NaN if there is none."""
    glints = observations.glints
    out = np.full((len(observations), 2, 2), np.nan)
    if glints.light.shape[1]:
        here = (glints.light == light) & glints.ok
        rows = np.flatnonzero(here.any(axis=1))
        out[rows] = glints.covariance[rows, here[rows].argmax(axis=1)]
    return out


def _whitening(covariance: Floats) -> Floats:
    """Compute inverse square roots (n, q, q) of covariances, W^T W = C^-1, without directions of zero weight."""
    values, vectors = np.linalg.eigh(covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.where(values > 0, 1.0 / np.sqrt(values), 0.0)
    return np.asarray(root[..., None] * np.swapaxes(vectors, -1, -2))


def sized(observations: Observations) -> Bools:
    """Return which pupils (n,) have an outline: six points, or an ellipse; others have a centre at most."""
    pupil = observations.pupil
    ellipse = np.isfinite(pupil.semi_axes_px).all(axis=1) & np.isfinite(pupil.angle_rad)
    return np.asarray(ellipse | (np.isfinite(pupil.points_px).all(axis=2).sum(axis=1) >= 6))


def _outlines(observations: Observations, deviation: Floats) -> tuple[Floats, Floats, Ints]:
    """Compute points of the outlines, the whitening of their distances, and the number of independent distances."""
    pupil = observations.pupil
    given = pupil.points_px[:, :: max(1, -(-pupil.points_px.shape[1] // MOST_POINTS))]
    traced = np.sum(np.isfinite(given).all(axis=2), axis=1) >= 6
    of_ellipse = ~traced & (pupil.status == Status.OK) & np.isfinite(pupil.centre_px).all(axis=1)
    width = max(given.shape[1] if traced.any() else 0, ELLIPSE_POINTS if of_ellipse.any() else 0)
    n = len(observations)
    points, white, size = np.zeros((n, width, 2)), np.zeros((n, width, width)), np.zeros(n, dtype=np.int64)
    for row in np.flatnonzero(traced):
        good = np.flatnonzero(np.isfinite(given[row]).all(axis=1))
        points[row, good] = given[row, good]
        gaps = np.linalg.norm(np.diff(given[row, good], axis=0, append=given[row, good[:1]]), axis=1)
        length = (gaps + np.roll(gaps, 1)) / 2.0
        white[row, good, good] = np.sqrt(length) / deviation[row]
        size[row] = len(good)
    covered: Bools = np.asarray(np.isfinite(pupil.covariance).all(axis=(1, 2)))
    whole = sized(observations)
    for row in np.flatnonzero(of_ellipse):
        axes, angle = (pupil.semi_axes_px[row], float(pupil.angle_rad[row])) if whole[row] else (_ANY_AXES_PX, 0.0)
        at, basis, speed = _of_ellipse(pupil.centre_px[row], axes, angle)
        points[row, :ELLIPSE_POINTS] = at
        if not whole[row]:
            # Only the centre counts: it is in the odd harmonics of the distances, size and shape are in the even ones.
            part = np.linalg.pinv(basis, rcond=_LEAST_RATIO)[:2] / deviation[row]
        elif covered[row]:
            part = _whitening(pupil.covariance[row] + _OF_ELLIPSE) @ np.linalg.pinv(basis, rcond=_LEAST_RATIO)
        else:
            part = np.diag(np.sqrt(speed * 2.0 * np.pi / ELLIPSE_POINTS) / deviation[row])
        white[row, : len(part), :ELLIPSE_POINTS] = part
        size[row] = len(part)
    return points, white, size


def _of_ellipse(centre: Floats, axes: Floats, angle: float) -> tuple[Floats, Floats, Floats]:
    """Compute an ellipse's points, their normal shifts by (cx, cy, a, b, angle) (k, 5), and |dp / df|, f parameter."""
    f = 2.0 * np.pi * np.arange(ELLIPSE_POINTS) / ELLIPSE_POINTS
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    circle = np.stack([np.cos(f), np.sin(f)], axis=-1)
    about = (circle * axes) @ turn.T
    along = (np.stack([-np.sin(f), np.cos(f)], axis=-1) * axes) @ turn.T
    speed = np.linalg.norm(along, axis=1)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=-1) / speed[:, None]
    by_a, by_b = circle[:, :1] * turn[:, 0], circle[:, 1:] * turn[:, 1]
    by_angle = np.stack([-about[:, 1], about[:, 0]], axis=-1)
    shifts = [normal[:, 0], normal[:, 1], *(np.sum(normal * by, axis=1) for by in (by_a, by_b, by_angle))]
    return centre + about, np.stack(shifts, axis=-1), speed


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Residuals:
    """Whitened residuals of n views, and their derivatives with respect to the unknowns."""

    outline: Floats  # (n, k) residuals of outlines
    glints: Floats  # (n, m, 2) residuals of glints
    outline_slopes: Floats  # (n, k, 35) derivatives; empty if not requested
    glint_slopes: Floats  # (n, m, 2, 35) derivatives
    outline_size: Ints  # (n,) number of independent distances that the model has too
    glint_ok: Bools  # (n, m) whether a glint is both observed and modelled


def residuals(seen: MeasuredFeatures, model: ModelFeatures | FeatureSlopes) -> Residuals:
    """Compute the residuals of observed features from a model; features that the model lacks have residuals 0."""
    images = model.images if isinstance(model, FeatureSlopes) else model
    whole = np.isfinite(images.outline_px).all(axis=(1, 2)) & (seen.outline_size > 0)
    k, m = seen.outline_px.shape[1], seen.glints_px.shape[1]
    outline, by_outline = np.zeros((len(whole), k)), np.zeros((len(whole), k, COUNT))
    rows = np.flatnonzero(whole)
    if len(rows):
        slopes = model.outline[rows] if isinstance(model, FeatureSlopes) else None
        distance, by = outline_distances(images.outline_px[rows], slopes, seen.outline_px[rows])
        outline[rows] = np.einsum("nij,nj->ni", seen.outline_white[rows], distance)
        if by is not None:
            by_outline[rows] = seen.outline_white[rows] @ by
    ok = seen.has_glint & np.isfinite(images.glints_px).all(axis=2)
    gap = np.where(ok[..., None], seen.glints_px - images.glints_px, 0.0)
    glints = np.einsum("nmij,nmj->nmi", seen.glint_white, gap)
    by_glints = np.zeros((len(whole), m, 2, COUNT))
    if isinstance(model, FeatureSlopes):
        by_glints = np.where(ok[..., None, None], -seen.glint_white @ model.glints, 0.0)
    return Residuals(
        outline=outline,
        glints=glints,
        outline_slopes=by_outline,
        glint_slopes=by_glints,
        outline_size=np.where(whole, seen.outline_size, 0),
        glint_ok=ok,
    )


def outline_distances(model_px: Floats, slopes: Floats | None, observed_px: Floats) -> tuple[Floats, Floats | None]:
    """Compute signed distances (n, k) px of points from modelled outlines along their normals, and derivatives.

    The outline through the modelled points is their trigonometric interpolation p(f). The foot of a point o satisfies
    (p(f) - o) . p'(f) = 0 (Newton's steps from the nearest point), and its distance is n . (o - p). `model_px`: (n, j,
    2) points, evenly spaced in the parameter; `slopes`: (n, j, 2, 35) their derivatives, or None; `observed_px`: (n, k,
    2).
    """
    count = model_px.shape[1]
    waves = np.arange((count - 1) // 2 + 1)

    def harmonics(values: Floats) -> Complexes:
        found = np.fft.rfft(values, axis=1)[:, : len(waves)] / count
        found[:, 1:] *= 2.0
        return np.asarray(found)

    def turns(f: Floats) -> Complexes:
        """Compute exp(i w f) for all waves w, (n, k, waves)."""
        out = np.ones((*f.shape, len(waves)), dtype=np.complex128)
        out[..., 1:] = np.exp(1j * f)[..., None]
        return np.asarray(np.cumprod(out, axis=-1))

    parts = harmonics(model_px)
    gap_x, gap_y = (observed_px[:, :, None, i] - model_px[:, None, :, i] for i in (0, 1))
    f = 2.0 * np.pi / count * np.argmin(gap_x**2 + gap_y**2, axis=2)
    derivatives = np.concatenate([parts, 1j * waves[:, None] * parts, -(waves[:, None] ** 2) * parts], axis=2)
    for _ in range(_NEWTON):
        point, along, bend = np.split((turns(f) @ derivatives).real, 3, axis=2)
        gap = point - observed_px
        square = np.sum(along**2, axis=-1)
        slope = square + np.sum(gap * bend, axis=-1)
        step = np.sum(gap * along, axis=-1) / np.where(slope > 0.2 * square, slope, square)
        f = f - np.clip(step, -0.3, 0.3)
    wave = turns(f)
    point, along, _ = np.split((wave @ derivatives).real, 3, axis=2)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1)[..., None]
    distance = np.sum(normal * (observed_px - point), axis=-1)
    if slopes is None:
        return distance, None
    by = harmonics(slopes.reshape(*model_px.shape[:2], -1))
    real = np.concatenate([wave.real, -wave.imag], axis=2) @ np.concatenate([by.real, by.imag], axis=1)
    return distance, -np.einsum("nkx,nkxa->nka", normal, real.reshape(*f.shape, 2, -1))
