"""The Gaussian model of a bright spot, fitted to many spots at once by Levenberg-Marquardt.

The level in pixel (x, y) is B(x, y) + b0 + bx (x - xc) + by (y - yc) + A Gx(x) Gy(y). Gx is the mean over the pixel of
exp(-(x - x0)^2 / (2 sx^2)), and Gy likewise. B is the image expected without spots: pupil, iris and the blurred edge
between them. A spot beside an additional edge (limbus, lid) adds h Phi(((x - xc) cos p + (y - yc) sin p - o) / blur). A
clipped pixel only gives a lower bound, so it counts only where the model is below the clip level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ..products import add_products, copy, largest_size, solve
from .windows import WINDOWS, SpotPixels, Windows, light_of_others, profile

PARAMETERS, WITH_EDGE = 8, 11  # x, y, ln A, ln sx, ln sy, b0, bx, by; with an edge also h, p, o
LOST_PX = 12.0  # a spot that becomes wider or moves farther is not a glint
ROUND_SD = 0.3  # prior standard deviation of ln sx - ln sy: glints are nearly round
STEPS = 8  # Levenberg-Marquardt steps in one descent
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
_BOUNDS = np.stack([_LEAST, _MOST, _STRIDE])
ALONE = np.zeros((0, 2), dtype=np.intp)  # no pairs of spots


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Image properties that limit a fit of spots.

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


@compiled("f8[:,::1], f8[:,::1]")
def lost(theta: Floats, start: Floats) -> Bools:
    """Return which spots (n,) have grown or moved more than a glint can."""
    out = np.empty(theta.shape[0], dtype=np.bool_)
    for s in range(out.size):
        wide = max(theta[s, 3], theta[s, 4]) > math.log(LOST_PX)
        out[s] = wide or (theta[s, 0] - start[s, 0]) ** 2 + (theta[s, 1] - start[s, 1]) ** 2 > LOST_PX**2
    return out


@compiled("f8[:,::1], f8[:,:,::1], f8[::1], f8")
def promising(theta: Floats, gram: Floats, used: Floats, noise: float) -> Bools:
    """Return for which spots (n,) the fit roughly explains the pixels (see ROUGH and ROUGH_SHARE)."""
    out, k = np.empty(theta.shape[0], dtype=np.bool_), theta.shape[1]
    for s in range(out.size):
        misfit = noise * math.sqrt(gram[s, k, k] / max(used[s], 1.0))
        out[s] = misfit < max(ROUGH * noise, ROUGH_SHARE * math.exp(theta[s, 2]))
    return out


@compiled(f"{WINDOWS}, f8[:,::1], f8[::1], f8")
def slopes(windows: Windows, theta: Floats, rest: Floats, blur_px: float) -> Floats:
    """Compute derivatives (K + 1, P) of the model at every pixel and, in the last row, the residual.

    Args:
        windows: first, plane, centre and radius of `SpotPixels`.
        theta: (n, K) parameters.
        rest: (P,) image minus everything that is not fitted.
        blur_px: blur of the edges, if the model includes edges beside the spots.
    """
    first, plane, centre, radius = windows
    n, size = theta.shape
    out = np.empty((size + 1, rest.size))
    for k in range(n):
        half = math.ceil(radius[k] + 0.5)
        across, along = np.empty((2 * half + 1, 3)), np.empty((2 * half + 1, 3))
        x, y, height = theta[k, 0] - centre[k, 0], theta[k, 1] - centre[k, 1], math.exp(theta[k, 2])
        wide, high = math.exp(theta[k, 3]), math.exp(theta[k, 4])
        for j in range(2 * half + 1):
            across[j, 0], across[j, 1], across[j, 2] = profile(j - half - 0.5 - x, wide)
            along[j, 0], along[j, 1], along[j, 2] = profile(j - half - 0.5 - y, high)
        for i in range(first[k], first[k + 1]):
            dx, dy = plane[1, i], plane[2, i]
            p, q = across[int(dx) + half], along[int(dy) + half]
            out[0, i], out[1, i], out[2, i] = height * p[0] * q[1], height * p[1] * q[0], height * p[1] * q[1]
            out[3, i], out[4, i] = height * p[2] * q[1], height * p[1] * q[2]
            out[5, i], out[6, i], out[7, i] = 1.0, dx, dy
            out[size, i] = rest[i] - out[2, i] - theta[k, 5] - theta[k, 6] * dx - theta[k, 7] * dy
        if size == WITH_EDGE:
            _add_edge(first[k], first[k + 1], plane, theta[k], blur_px, out)
    return out


@inlined
def _add_edge(begin: int, end: int, plane: Floats, theta: Floats, blur_px: float, out: Floats) -> None:
    """Write the derivatives by the parameters of a spot's edge, and subtract the edge from the residual."""
    height, cos, sin, offset = theta[8], math.cos(theta[9]), math.sin(theta[9]), theta[10]
    for i in range(begin, end):
        dx, dy = plane[1, i], plane[2, i]
        t = (dx * cos + dy * sin - offset) / blur_px
        bell = height * math.exp(-0.5 * t * t) / (math.sqrt(2.0 * math.pi) * blur_px)
        out[8, i] = 0.5 * math.erfc(-t * math.sqrt(0.5))
        out[9, i], out[10, i] = bell * (dy * cos - dx * sin), -bell
        out[11, i] -= height * out[8, i]


def prior(limits: Limits, size: int) -> Floats:
    """Compute the normal matrix (K, K) of the priors of K = `size` parameters, all with mean 0.

    They favour a nearly round spot, a background that is flat to within its slope, and an edge of at most full scale
    within reach.
    """
    out = np.zeros((WITH_EDGE, WITH_EDGE))
    out[3, 3] = out[4, 4] = 1.0 / ROUND_SD**2
    out[3, 4] = out[4, 3] = -1.0 / ROUND_SD**2
    out[6, 6] = out[7, 7] = 1.0 / limits.slope_dn**2
    out[8, 8], out[10, 10] = 1e-5, 1e-2
    return out[:size, :size].copy()


@inlined
def _gram(
    first: Indices, clip: Bools, rows: Floats, theta: Floats, noise: float, penalty: Floats
) -> tuple[Floats, Floats]:
    """Compute products of the `slopes`, summed over each spot's pixels and with the priors, in units of the noise.

    Returns:
        (n, K + 1, K + 1) products, and (n,) number of pixels that count. A clipped pixel does not count where the model
        is brighter than the clip level.
    """
    n, k = theta.shape
    gram, used = np.zeros((n, k + 1, k + 1)), np.empty(n)
    for i in range(clip.size):
        if clip[i] and rows[k, i] <= 0.0:
            for j in range(k + 1):
                rows[j, i] = 0.0
    for s in range(n):
        used[s] = first[s + 1] - first[s]
        for i in range(first[s], min(first[s + 1], clip.size)):
            used[s] -= clip[i] and rows[5, i] == 0.0
        add_products(rows, first[s], first[s + 1], gram[s])
        for j in range(k + 1):
            for m in range(j + 1):
                gram[s, j, m] /= noise * noise
                gram[s, m, j] = gram[s, j, m]
        for j in range(k):
            pull = 0.0
            for m in range(k):
                gram[s, j, m] += penalty[j, m]
                pull += theta[s, m] * penalty[m, j]
            gram[s, j, k] -= pull
            gram[s, k, k] += pull * theta[s, j]
    return gram, used


@inlined
def _step(gram: Floats, damping: float, theta: Floats, bounds: Floats, step: Floats, trial: Floats) -> float:
    """Write a spot's damped step (K,) and its end point (K,), both limited; return the predicted gain."""
    k, gain = theta.size, 0.0
    matrix = np.empty((k, k))
    for j in range(k):
        for m in range(k):
            matrix[j, m] = gram[j, m]
        matrix[j, j] = matrix[j, j] * (1.0 + damping) + 1e-9
        step[j] = gram[j, k]
    solve(matrix, step)
    for j in range(k):
        gain += step[j] * gram[j, k]
        step[j] = min(max(step[j], -bounds[2, j]), bounds[2, j])
        trial[j] = min(max(theta[j] + step[j], bounds[0, j]), bounds[1, j])
    return gain


@inlined
def _finish(step: Floats, trial: Floats, theta: Floats) -> None:
    """Apply the last steps (n, K) of spots, unless they are large."""
    for s in range(theta.shape[0]):
        if largest_size(step[s]) < 1.0:
            copy(trial[s], theta[s])


@inlined
def _progress(theta: Floats, middle: Floats, gram: Floats, cost: Floats) -> tuple[Floats, Bools]:
    """Compute how far each spot (n,) moved since the middle of the steps, and whether its squared misfit halved."""
    n, k = theta.shape
    moved, falling = np.empty(n), np.empty(n, np.bool_)
    for s in range(n):
        moved[s] = max(abs(theta[s, 0] - middle[s, 0]), abs(theta[s, 1] - middle[s, 1]))
        falling[s] = gram[s, k, k] < 0.5 * cost[s]
    return moved, falling


@inlined
def _dim(
    first: Indices, rows: Floats, gram: Floats, light: Floats, held: Floats, rest: Floats, better: Bools, noise: float
) -> None:
    """Update the fit of each spot, in place, for the light (P,) of the other spots.

    For a spot whose fit is `better`, the other spots' light stays subtracted from now on; for the rest, nothing is
    subtracted.
    """
    n, k = gram.shape[0], gram.shape[1] - 1
    for s in range(n):
        square = taken = 0.0
        for i in range(first[s], first[s + 1]):
            light[i] = (light[i] - held[i]) * better[s]
            held[i] += light[i]
            rest[i] -= light[i]
            square += (light[i] * rows[5, i]) ** 2  # 0 in pixels that do not count
        for j in range(k + 1):
            taken = 0.0
            for i in range(first[s], first[s + 1]):
                taken += rows[j, i] * light[i] * rows[5, i]
            gram[s, j, k] -= taken / noise**2
        gram[s, k, k] += (square - taken) / noise**2


def descend(
    pixels: SpotPixels,
    theta: Floats,
    rest: Floats,
    pairs: Indices,
    limits: Limits,
    blur_px: float = 1.0,
    steps: int = STEPS,
) -> Descent:
    """Take at most `steps` Levenberg-Marquardt steps on every spot.

    The light of other spots in a spot's window is updated as they change.

    Args:
        pixels: P pixels of n spots.
        theta: (n, K) start.
        rest: (P,) image minus B and minus the other spots' light at the start.
        pairs: (m, 2) the spots of a window, and those that shine into it.
        limits: noise, clip level and the prior of the slope.
        blur_px: blur of the edges, if the model includes edges beside the spots.
        steps: largest number of steps.
    """
    size = theta.shape[1]
    clip = pixels.clip if pixels.clip.any() else pixels.clip[:0]
    about = ((limits.noise_dn, blur_px), (prior(limits, size), _BOUNDS[:, :size].copy()), steps)
    return Descent(*_descended(pixels.windows, np.ascontiguousarray(theta), rest, clip, pairs, *about))


@compiled(f"{WINDOWS}, f8[:,::1], f8[::1], b1[::1], i8[:,::1], UniTuple(f8, 2), UniTuple(f8[:,::1], 2), i8")
def _descended(
    windows: Windows, theta: Floats, rest: Floats, clip: Bools, pairs: Indices,
    optics: tuple[float, float], limits: tuple[Floats, Floats], steps: int,
) -> tuple[Floats, Floats, Floats, Bools, Floats, Bools]:  # fmt: skip
    """Take the steps of `descend`, in compiled code.

    Args:
        windows: first, plane, centre and radius of `SpotPixels`.
        theta: (n, K) start.
        rest: (P,) image minus what is not fitted.
        clip: (P,) clipped pixels; none if no pixel is.
        pairs: (m, 2) the spots of a window, and those that shine into it.
        optics: standard deviation of a pixel's noise, DN, and blur of the edges, px.
        limits: normal matrix (K, K) of the priors; (3, K) least and most of the parameters, and their largest steps.
        steps: largest number of steps.

    Returns:
        The parts of `Descent`.
    """
    first, (n, k), (noise, blur_px), (penalty, bounds) = windows[0], theta.shape, optics, limits
    rest, start, theta = rest.copy(), theta, theta.copy()
    middle, cost = theta.copy(), np.empty(n)
    rows = slopes(windows, theta, rest, blur_px)
    gram, used = _gram(first, clip, rows, theta, noise, penalty)
    damping, step, trial = np.empty(n), np.empty((n, k)), np.empty((n, k))
    for s in range(n):
        cost[s], damping[s] = math.inf, 1e-2
    over, stalled, better = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    held, shared = light_of_others(windows, theta, pairs, rest.size), pairs.shape[0] > 0
    enough = SMALL_GAIN[1] if shared else SMALL_GAIN[0]
    for turn in range(steps):
        late, ended = turn >= STEPS // 2, True
        away, likely = lost(theta, start), promising(theta, gram, used, noise)
        for s in range(n):
            gain = _step(gram[s], damping[s], theta[s], bounds, step[s], trial[s])
            over[s] = gain < enough * max(gram[s, k, k] / max(used[s], 1.0), 1.0)
            over[s] = over[s] or (late and (damping[s] > 1e5 or away[s]))
            stalled[s] = stalled[s] and not (late and likely[s])
            ended = ended and (over[s] or (late and stalled[s]))
        if ended:
            _finish(step, trial, theta)
            break
        rows = slopes(windows, trial, rest, blur_px)
        new, new_used = _gram(first, clip, rows, trial, noise, penalty)
        for s in range(n):
            better[s] = new[s, k, k] <= gram[s, k, k] * (1.0 + 1e-12)
            stalled[s] = better[s] and new[s, k, k] > STALLED * gram[s, k, k]
            damping[s] = max(0.1 * damping[s], 1e-7) if better[s] else 8.0 * damping[s]
            if better[s]:
                used[s] = new_used[s]
                copy(trial[s], theta[s])
                copy(new[s].ravel(), gram[s].ravel())
        if shared and turn % 2 == 1:
            change = light_of_others(windows, theta, pairs, rest.size)
            _dim(first, rows, gram, change, held, rest, better, noise)
        if turn + 1 == steps // 2:
            for s in range(n):
                middle[s, 0], middle[s, 1], cost[s] = theta[s, 0], theta[s, 1], gram[s, k, k]
    moved, falling = _progress(theta, middle, gram, cost)
    return theta, gram, used, over, moved, falling
