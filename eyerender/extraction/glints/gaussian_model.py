"""The Gaussian model of a bright spot, fitted to many spots at once by Levenberg-Marquardt.

The level in pixel (x, y) is B(x, y) + b0 + bx (x - xc) + by (y - yc) + A Gx(x) Gy(y). Gx is the mean over the pixel of
exp(-(x - x0)^2 / (2 sx^2)), and Gy likewise. B is the image expected without spots: pupil, iris and the blurred edge
between them. A spot beside an edge of its own (limbus, lid) adds h Phi(((x - xc) cos p + (y - yc) sin p - o) / blur).
A clipped pixel only shows that its intensity is at least the clip level, so it counts only where the model is below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from ...arrays import Bools, Floats, Indices
from ..compiled import twin
from .windows import Grid, Others, SpotPixels, Windows

PARAMETERS, WITH_EDGE = 8, 11  # x, y, ln A, ln sx, ln sy, b0, bx, by; with an edge also h, p, o
LOST_PX = 12.0  # a spot that becomes wider or moves farther is not a glint
ROUND_SD = 0.3  # prior standard deviation of ln sx - ln sy: glints are nearly round
STEPS = 8  # of Levenberg-Marquardt in one descent
# A descent ends when a step gains less, in squared standard deviations of the noise. That is also the squared length of
# the step in standard deviations of the parameters. The second number is for spots that overlap others.
SMALL_GAIN = (5e-2, 5e-3)
# A fit is promising if its misfit is below ROUGH noise standard deviations or this share of the spot's height.
ROUGH, ROUGH_SHARE = 3.0, 0.05
STALLED = 0.97  # a step that leaves more of the squared misfit is the last one of an unpromising spot
SAME_LIGHT = 0.01  # smaller changes of the other spots' light, in noise standard deviations, need no further step

_FREE = np.inf
_LEAST = np.array([-_FREE, -_FREE, -5.0, math.log(0.2), math.log(0.2), *[-_FREE] * 6])
_MOST = np.array([_FREE, _FREE, 15.0, math.log(30.0), math.log(30.0), *[_FREE] * 6])
_STRIDE = np.array([1.5, 1.5, 0.7, 0.7, 0.7, _FREE, _FREE, _FREE, _FREE, 0.5, 1.5])  # largest step of each parameter
_BOUNDS = {edge: np.stack([_LEAST, _MOST, _STRIDE])[:, : WITH_EDGE if edge else PARAMETERS] for edge in (False, True)}
_ALONE = np.zeros((0, 2), dtype=np.intp)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Properties of the image that limit a fit of spots.

    Attributes:
        noise_dn: standard deviation of a pixel's noise.
        clip_dn: level at which the sensor clips.
        slope_dn: prior standard deviation of the background's slope beyond B, DN per px.
    """

    noise_dn: float
    clip_dn: float
    slope_dn: float


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Result of a descent.

    Attributes:
        theta: (n, K) parameters.
        gram: (n, K + 1, K + 1) products of slopes and residual, priors included (see `_gram`).
        used: (n,) number of pixels that count.
        settled: (n,) whether the last step gained little.
        moved: (n,) px moved during the second half of the steps.
        falling: (n,) whether the squared misfit halved during the second half of the steps.
    """

    theta: Floats
    gram: Floats
    used: Floats
    settled: Bools
    moved: Floats
    falling: Bools


def lost(theta: Floats, start: Floats) -> Bools:
    """Whether spots (n,) have grown or moved more than a glint can."""
    wide = theta[:, 3:5].max(axis=1) > math.log(LOST_PX)
    away = theta[:, :2] - start
    return np.asarray(wide | ((away * away).sum(axis=1) > LOST_PX**2))


def promising(theta: Floats, gram: Floats, used: Floats, noise: float) -> Bools:
    """Whether the fit roughly explains spots (n,) (see ROUGH and ROUGH_SHARE)."""
    misfit = noise * np.sqrt(gram[:, -1, -1] / np.maximum(used, 1.0))
    return np.asarray(misfit < np.maximum(ROUGH * noise, ROUGH_SHARE * np.exp(theta[:, 2])))


def slopes(pixels: SpotPixels, theta: Floats, rest: Floats, blur_px: float | None = None) -> Floats:
    """Derivatives (K + 1, P) of the model at every pixel and, in the last row, the residual.

    Args:
        pixels: P pixels of n spots.
        theta: (n, K) parameters.
        rest: (P,) image minus everything that is not fitted.
        blur_px: blur of the edges, if the spots have edges of their own.
    """
    about = (pixels.first, pixels.plane, pixels.centre, pixels.radius)
    return _spot_rows(*about, theta, rest, 1.0 if blur_px is None else blur_px)


@twin
def _spot_rows(
    first: Indices, plane: Floats, centre: Floats, radius: Floats, theta: Floats, rest: Floats, blur_px: float
) -> Floats:
    """Compute `slopes` from the parts of `SpotPixels`."""
    spot = np.arange(radius.size).repeat(np.diff(first))
    _, dx, dy = plane
    across, along = Grid.of(radius, spot, dx, dy).profiles(
        theta[:, :2] - centre, np.exp(theta[:, 3:5]), np.exp(theta[:, 2])
    )
    out = np.empty((theta.shape[1] + 1, rest.size))
    np.multiply(across[0], along[1], out=out[0])
    np.multiply(across[1:], along[1], out=out[2:4])
    np.multiply(across[1], along[::2], out=out[1:5:3])
    out[5:8] = plane
    own = theta[:, 5:].T.take(spot, axis=1)
    np.subtract(rest, out[2], out=out[-1])
    out[-1] -= np.einsum("kp,kp->p", own[:3], plane)
    if theta.shape[1] == WITH_EDGE:
        cos, sin = np.cos(own[4]), np.sin(own[4])
        t = (dx * cos + dy * sin - own[5]) / blur_px
        bell = own[3] * (_DENSITY / blur_px) * np.exp(-0.5 * t * t)
        out[8] = ndtr(t)
        np.multiply(bell, dy * cos - dx * sin, out=out[9])
        np.negative(bell, out=out[10])
        out[-1] -= own[3] * out[8]
    return out


def _products(first: Indices, rows: Floats) -> Floats:
    """Products (n, K + 1, K + 1) of rows (K + 1, P), summed over the pixels first[i] to first[i + 1] of each spot."""
    out = np.empty((first.size - 1, rows.shape[0], rows.shape[0]))
    for k, (begin, end) in enumerate(pairwise(first.tolist())):
        np.matmul(rows[:, begin:end], rows[:, begin:end].T, out=out[k])
    return out


def _solved(gram: Floats, damping: Floats) -> Floats:
    """Damped steps (n, K) of the normal equations gram (n, K + 1, K + 1), whose last column is the right side."""
    k = gram.shape[1] - 1
    matrix = gram[:, :k, :k].copy()
    diagonal = matrix.reshape(-1, k * k)[:, :: k + 1]
    diagonal *= 1.0 + damping[:, None]
    diagonal += 1e-9
    return np.asarray(np.linalg.solve(matrix, gram[:, :k, k:])[..., 0])


def prior(limits: Limits, edge: bool) -> Floats:
    """Normal matrix (K, K) of the priors, all with mean 0.

    They favour a nearly round spot, a background that is flat to within its slope, and an edge of at most full scale
    within reach.
    """
    out = np.zeros((WITH_EDGE, WITH_EDGE))
    out[3, 3] = out[4, 4] = 1.0 / ROUND_SD**2
    out[3, 4] = out[4, 3] = -1.0 / ROUND_SD**2
    out[6, 6] = out[7, 7] = 1.0 / limits.slope_dn**2
    out[8, 8], out[10, 10] = 1e-5, 1e-2
    return out if edge else out[:PARAMETERS, :PARAMETERS]


def _gram(
    first: Indices, clip: Bools, rows: Floats, theta: Floats, noise: float, penalty: Floats
) -> tuple[Floats, Floats]:
    """Products of the `slopes`, summed over each spot's pixels, with the priors, in units of the noise.

    Returns:
        (n, K + 1, K + 1) products, and (n,) number of pixels that count. A clipped pixel does not count where the model
        is brighter than the clip level.
    """
    used = np.diff(first).astype(np.float64)
    if clip.size:
        idle = clip & (rows[-1] <= 0.0)
        rows *= ~idle
        used -= np.diff(np.concatenate([[0], np.cumsum(idle)])[first])
    k = theta.shape[1]
    out = _products(first, rows)
    out *= 1.0 / noise**2
    pull = theta @ penalty
    out[:, :k, :k] += penalty
    out[:, :k, k] -= pull
    pull *= theta
    out[:, k, k] += pull.sum(axis=1)
    return out, used


def _dimmed(first: Indices, rows: Floats, gram: Floats, light: Floats, noise: float) -> None:
    """Subtract more light (P,) of other spots from the residual; changes the products in place."""
    k = gram.shape[1] - 1
    for product, (begin, end) in zip(gram, pairwise(first.tolist()), strict=True):
        row = rows[:, begin:end]
        part = light[begin:end] * row[5]  # 0 in pixels that do not count
        taken = row @ part
        product[:, k] -= taken * (1.0 / noise**2)
        product[k, k] += (part @ part - taken[k]) * (1.0 / noise**2)


def descend(
    pixels: SpotPixels,
    theta: Floats,
    rest: Floats,
    others: Others | None,
    limits: Limits,
    blur_px: float | None = None,
    steps: int = STEPS,
) -> Descent:
    """Take at most `steps` Levenberg-Marquardt steps on every spot.

    The light of other spots in a spot's window is updated as they change.

    Args:
        pixels: P pixels of n spots.
        theta: (n, K) start.
        rest: (P,) image minus B and minus the other spots' light at the start.
        others: which of these spots shine into each other's windows; None if none do.
        limits: noise, clip level and the prior of the slope.
        blur_px: blur of the edges, if the spots have edges of their own.
        steps: how many at most.
    """
    edge = blur_px is not None
    pairs = _ALONE if others is None else others.pairs
    clip = pixels.clip if pixels.clipped else pixels.clip[:0]
    windows = (pixels.first, pixels.plane, pixels.centre, pixels.radius)
    about = (limits.noise_dn, prior(limits, edge), 1.0 if blur_px is None else blur_px, steps, _BOUNDS[edge])
    return Descent(*_descended(windows, theta, rest, clip, pairs, *about))


@twin
def _descended(
    windows: Windows, theta: Floats, rest: Floats, clip: Bools, pairs: Indices,
    noise: float, penalty: Floats, blur_px: float, steps: int, bounds: Floats,
) -> tuple[Floats, Floats, Floats, Bools, Floats, Bools]:  # fmt: skip
    """Take the steps of `descend`.

    Args:
        windows: first, plane, centre and radius of `SpotPixels`.
        theta: (n, K) start.
        rest: (P,) image minus what is not fitted.
        clip: (P,) clipped pixels; none if no pixel is.
        pairs: (m, 2) the spots of a window, and those that shine into it.
        noise: standard deviation of a pixel's noise, DN.
        penalty: (K, K) normal matrix of the priors.
        blur_px: blur of the edges.
        steps: how many at most.
        bounds: (3, K) least and most of the parameters, and their largest steps.

    Returns:
        The parts of `Descent`.
    """
    first, own = windows[0], np.arange(theta.shape[0]).repeat(np.diff(windows[0]))
    others, k = Others.shining(windows, pairs) if pairs.size else None, theta.shape[1]
    theta, start, middle, cost = theta.copy(), theta[:, :2], theta[:, :2], np.full(theta.shape[0], np.inf)
    rows = _spot_rows(*windows, theta, rest, blur_px)
    gram, used = _gram(first, clip, rows, theta, noise, penalty)
    damping, over = np.full(theta.shape[0], 1e-2), np.zeros(theta.shape[0], dtype=bool)
    held = np.zeros(0) if others is None else others.light(theta, rest.size)
    stalled = over.copy()
    enough = SMALL_GAIN[0] if others is None else SMALL_GAIN[1]
    least, most, stride = bounds
    for turn in range(steps):
        step = _solved(gram, damping)
        gain = (step * gram[:, :k, k]).sum(axis=1)
        step = np.minimum(np.maximum(step, -stride), stride)
        trial = np.minimum(np.maximum(theta + step, least), most)
        over = gain < enough * np.maximum(gram[:, k, k] / np.maximum(used, 1.0), 1.0)
        if turn >= STEPS // 2:
            over |= (damping > 1e5) | lost(theta, start)
            stalled &= ~promising(theta, gram, used, noise)
        if (over | stalled if turn >= STEPS // 2 else over).all():
            theta = np.where((np.abs(step) < 1.0).all(axis=1)[:, None], trial, theta)
            break
        rows = _spot_rows(*windows, trial, rest, blur_px)
        new, new_used = _gram(first, clip, rows, trial, noise, penalty)
        better = new[:, k, k] <= gram[:, k, k] * (1.0 + 1e-12)
        stalled = better & (new[:, k, k] > STALLED * gram[:, k, k])
        if better.all():
            theta, gram, used = trial, new, new_used
            damping = np.maximum(0.1 * damping, 1e-7)
        else:
            np.copyto(theta, trial, where=better[:, None])
            np.copyto(gram, new, where=better[:, None, None])
            np.copyto(used, new_used, where=better)
            damping = np.where(better, np.maximum(0.1 * damping, 1e-7), 8.0 * damping)
        if others is not None and turn % 2 == 1:
            change = others.light(theta, rest.size) - held
            if not better.all():
                change *= better[own]
            held, rest = held + change, rest - change
            _dimmed(first, rows, gram, change, noise)
        if turn + 1 == steps // 2:
            middle, cost = theta[:, :2].copy(), gram[:, k, k].copy()
    moved = np.abs(theta[:, :2] - middle).max(axis=1)
    return theta, gram, used, over, moved, gram[:, k, k] < 0.5 * cost
