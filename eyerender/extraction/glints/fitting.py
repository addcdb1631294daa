"""Censored fits of Gaussian spots on a known background, for all spots of an image.

The level in pixel (x, y) is B(x, y) + b0 + bx (x - xc) + by (y - yc) + A Gx(x) Gy(y). Gx is the mean over the pixel of
exp(-(x - x0)^2 / (2 sx^2)), and Gy likewise. B is the image expected without spots: pupil, iris and the blurred edge
between them. A clipped pixel only gives a lower bound, so it counts only where the model is below the clip level.

The spots are fitted in turn, each to the pixels of a round window minus the light of the others, until neither they nor
that light change. A spot that is no bell, or that grows or moves more than a glint can, is abandoned, and its light is
no longer subtracted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ..preprocessing import DN, Image
from ..products import add_products, copy, largest_size, solve
from .detection import SMOOTH_PX


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SpotFit:
    """A batch of fitted spots."""

    xy_px: Floats  # (n, 2) centres
    covariance: Floats  # (n, 2, 2) of the centres, px^2
    amplitude_dn: Floats  # (n,) peak above the background
    sigma_px: Floats  # (n, 2) standard deviations along x and y
    background_dn: Floats  # (n,) level of the background at the centre
    residual_dn: Floats  # (n,) root mean square over the window
    # (n, 2, 2) second moments of the bright patch: those of the Gaussian if it explains the pixels, else those of the
    # part above a third of the height, without background and other spots
    moments_px2: Floats
    clipped: Indices  # (n,) number of clipped pixels
    converged: Bools  # (n,) whether the fit converged

    def taken(self, index: Indices) -> SpotFit:
        """Select the spots with these indices."""
        return SpotFit(**{one.name: getattr(self, one.name)[index] for one in fields(self)})

    def replaced(self, index: Indices, other: SpotFit) -> SpotFit:
        """Copy, with the spots at these indices replaced by those of `other`."""
        order = np.arange(self.converged.size)
        order[index] = order.size + np.arange(index.size)
        return joined([self, other]).taken(order)


def joined(parts: list[SpotFit]) -> SpotFit:
    """Concatenate several batches."""
    return SpotFit(**{one.name: np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(SpotFit)})


PARAMETERS = 8  # x, y, ln A, ln sx, ln sy, b0, bx, by
LARGEST_PX = 20.0  # radius of a window at most
LOST_PX = 12.0  # a spot that becomes wider or moves farther is not a glint
ROUND_SD = 0.3  # prior standard deviation of ln sx - ln sy: glints are nearly round
ROUNDS, STEPS = 12, 8  # Levenberg-Marquardt steps of a spot in each round
# A descent ends when a step gains less, in squared standard deviations of the noise. That is also the squared length of
# the step in standard deviations of the parameters.
SMALL_GAIN = 5e-3
SAME_LIGHT = 0.01  # smaller changes of the other spots' light, in noise standard deviations, need no further step
LEAST_LIGHT = 1e-3  # light that counts, in noise standard deviations
# Largest misfit of a spot as a share of its visible height, at the end and from the step SOON on.
MISFIT, MISFIT_SOON, SOON = 0.1, 0.23, 3
MOST_CLIPPED = 60  # pixels of a flat top that say more about a glint's place than its flanks do
UNEXPLAINED = 2.0  # misfit in noise standard deviations below which the Gaussian explains the pixels
FEW_CLIPPED = 2  # a spot with more clipped pixels has a flat top
LEAST_PIXELS = 12
_LEAST, _MOST = math.log(0.2), math.log(30.0)  # limits of the logarithms of the widths
_STRIDE = np.array([1.5, 1.5, 0.7, 0.7, 0.7, np.inf, np.inf, np.inf])  # largest step of each parameter
_ROOT_HALF, _ROOT_HALF_PI = math.sqrt(0.5), math.sqrt(0.5 * math.pi)
# First pixel of each spot (n + 1,), offsets from the middle of its window (2, P), middles (n, 2) and radii (n,).
Windows = tuple[Indices, Indices, Floats, Floats]
WINDOWS = "Tuple((i8[::1], i8[:,::1], f8[:,::1], f8[::1]))"  # type for `compiled`


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Image properties that limit a fit of spots: a pixel's noise (standard deviation) and the level of clipping, DN.

    `slope_dn` is the prior standard deviation of the background's slope beyond B, DN per px.
    """

    noise_dn: float
    clip_dn: float
    slope_dn: float


def window_radius(width: Floats) -> Floats:
    """Compute the radius, px, of the pixels to which a spot of that sigma is fitted."""
    return np.minimum(2.7 * width + 1.2, LARGEST_PX)


def fit_spots(
    linear: Image,
    known: Callable[[Floats, Floats], Floats],
    start_px: Floats,
    width_px: Floats,
    height_dn: Floats,
    limits: Limits,
) -> SpotFit:
    """Fit all spots of an image (DN), given their peaks (n, 2), estimated standard deviations (n,) and heights (n,).

    `known` returns the background B at pixels x and y, (k,) each.
    """
    middle, radius = np.rint(start_px), window_radius(width_px)
    first, offset, data = cut_windows(linear, start_px, middle, radius)
    at = np.concatenate([middle.repeat(np.diff(first), axis=0) + offset.T, middle])
    level = known(at[:, 0].copy(), at[:, 1].copy())
    clip, rest, windows = data >= limits.clip_dn, data - level[: data.size], (first, offset, middle, radius)
    theta = _starts(windows, clip, start_px, width_px, height_dn)
    prior, noise = _prior(limits.slope_dn), limits.noise_dn
    gram, used, settled = _descend_all(windows, rest, clip, theta, noise, prior)
    covariance, background, misfit, moments = _report(windows, rest, theta, gram, used, noise, prior)
    height = np.exp(theta[:, 2])
    bell = misfit <= np.maximum(UNEXPLAINED * noise, MISFIT * np.minimum(height, DN))
    flat = np.array([np.count_nonzero(clip[i:k]) for i, k in pairwise(first.tolist())], dtype=np.intp)
    good = settled & bell & np.isfinite(theta).all(axis=1) & (used >= LEAST_PIXELS) & (flat <= MOST_CLIPPED)
    return SpotFit(
        xy_px=np.where(settled[:, None], theta[:, :2], start_px),
        covariance=covariance,
        amplitude_dn=height,
        sigma_px=np.exp(theta[:, 3:5]),
        background_dn=background + level[data.size :],
        residual_dn=misfit,
        moments_px2=moments,
        clipped=flat,
        converged=good,
    )


def _prior(slope_dn: float) -> Floats:
    """Compute the normal matrix of the priors: a nearly round spot, and a background that is flat to within a slope."""
    out = np.zeros((PARAMETERS, PARAMETERS))
    out[3, 3] = out[4, 4] = 1.0 / ROUND_SD**2
    out[3, 4] = out[4, 3] = -1.0 / ROUND_SD**2
    out[6, 6] = out[7, 7] = 1.0 / slope_dn**2
    return out


@compiled("f4[:,::1], f8[:,::1], f8[:,::1], f8[::1]")
def cut_windows(linear: Image, start: Floats, middle: Floats, radius: Floats) -> tuple[Indices, Indices, Floats]:
    """Collect the pixels within `radius` (n,) of `start` (n, 2).

    Returns:
        First pixel of each spot (n + 1,), offsets from its middle pixel `middle` (n, 2) as (2, P), and levels (P,).
    """
    size = 0
    for k in range(radius.size):
        size += (2 * math.ceil(radius[k] + 0.5) + 1) ** 2
    first, offset, data, count = np.zeros(radius.size + 1, np.int64), np.empty((2, size), np.int64), np.empty(size), 0
    for k in range(radius.size):
        half = math.ceil(radius[k] + 0.5)
        for dy in range(-half, half + 1):
            for dx in range(-half, half + 1):
                x, y = int(middle[k, 0]) + dx, int(middle[k, 1]) + dy
                if (x - start[k, 0]) ** 2 + (y - start[k, 1]) ** 2 > radius[k] ** 2:
                    continue
                if 0 <= x < linear.shape[1] and 0 <= y < linear.shape[0]:
                    offset[0, count], offset[1, count], data[count] = dx, dy, linear[y, x]
                    count += 1
        first[k + 1] = count
    return first, offset[:, :count].copy(), data[:count].copy()


@compiled(f"{WINDOWS}, b1[::1], f8[:,::1], f8[::1], f8[::1]")
def _starts(windows: Windows, clip: Bools, start: Floats, width: Floats, height: Floats) -> Floats:
    """Compute the start of the fit (n, PARAMETERS), without the background's level.

    The centre of a flat top is its mean, because its first brightest pixel may be anywhere. A Gaussian exceeds a level
    on an area of 2 pi sigma^2 ln(A / level). The areas above the clip level and above half of it, from which the width
    was estimated, give the amplitude.
    """
    first, offset, middle, _ = windows
    theta = np.zeros((width.size, PARAMETERS))
    for k in range(width.size):
        area = x = y = 0.0
        for i in range(first[k], first[k + 1]):
            px, py = middle[k, 0] + offset[0, i], middle[k, 1] + offset[1, i]
            away2 = (px - start[k, 0]) ** 2 + (py - start[k, 1]) ** 2
            own = clip[i] and away2 < (3.0 + 2.5 * width[k]) ** 2
            for m in range(width.size):  # omit pixels nearer to another spot
                own = own and (px - start[m, 0]) ** 2 + (py - start[m, 1]) ** 2 >= away2
            if own:
                area, x, y = area + 1.0, x + px, y + py
        theta[k, 0], theta[k, 1], theta[k, 3] = start[k, 0], start[k, 1], math.log(width[k])
        theta[k, 2] = math.log(1.3 * max(height[k], 1.0))
        if area > FEW_CLIPPED:
            full = 2.0 * math.pi * math.log(2.0) * (width[k] ** 2 + SMOOTH_PX**2) + math.pi * SMOOTH_PX**2
            ratio = min(area / full, 0.8)
            beyond = math.log(2.0) * ratio / (1.0 - ratio)
            theta[k, 0], theta[k, 1], theta[k, 2] = x / area, y / area, math.log(max(height[k], 1.0)) + beyond
            theta[k, 3] = 0.5 * math.log(area / (2.0 * math.pi * beyond))
        theta[k, 4] = theta[k, 3]
    return theta


@inlined
def profiles(low: float, sigma: float, count: int) -> Floats:
    """Integrate exp(-x^2 / (2 s^2)) over each of `count` pixels from `low` on, relative to the centre.

    Returns:
        The derivative by the centre, the value, and the derivative by ln s (count, 3).
    """
    out, at = np.empty((count, 3)), low / sigma
    tail, part = math.exp(-0.5 * at * at), math.erf(at * _ROOT_HALF)
    for j in range(count):
        first, tail_first, part_first = at, tail, part
        at = (low + j + 1.0) / sigma
        tail, part = math.exp(-0.5 * at * at), math.erf(at * _ROOT_HALF)
        value = sigma * _ROOT_HALF_PI * (part - part_first)
        out[j, 0], out[j, 1], out[j, 2] = tail_first - tail, value, value + sigma * (first * tail_first - at * tail)
    return out


@inlined
def _profiles(theta: Floats, x: float, y: float, half: int) -> tuple[Floats, Floats]:
    """Compute the profiles (2 half + 1, 3) of a spot across the columns and along the rows about a pixel (x, y)."""
    low, count = -half - 0.5, 2 * half + 1
    return (
        profiles(x + low - theta[0], math.exp(theta[3]), count),
        profiles(y + low - theta[1], math.exp(theta[4]), count),
    )


@inlined
def _light_of_others(windows: Windows, s: int, theta: Floats, gone: Bools, noise: float, light: Floats) -> float:
    """Write the light of the other spots in a spot's pixels to (P,); return its largest change."""
    first, offset, middle, radius = windows
    half, total, change = math.ceil(radius[s] + 0.5), np.zeros(first[s + 1] - first[s]), 0.0
    for k in range(theta.shape[0]):
        gap = math.hypot(middle[s, 0] - theta[k, 0], middle[s, 1] - theta[k, 1]) - radius[s] - 2.0
        wide2 = 1.5 * math.exp(2.0 * max(theta[k, 3], theta[k, 4])) + 0.1
        if k == s or gone[k] or theta[k, 2] - 0.5 * max(gap, 0.0) ** 2 / wide2 < math.log(LEAST_LIGHT * noise):
            continue
        across, along = _profiles(theta[k], middle[s, 0], middle[s, 1], half)
        for i in range(total.size):
            p, q = across[offset[0, first[s] + i] + half], along[offset[1, first[s] + i] + half]
            total[i] += math.exp(theta[k, 2]) * p[1] * q[1]
    for i in range(total.size):
        change = max(change, abs(total[i] - light[first[s] + i]))
        light[first[s] + i] = total[i]
    return change


@inlined
def spot_slopes(windows: Windows, s: int, theta: Floats, rest: Floats) -> Floats:
    """Compute derivatives (PARAMETERS + 1, k) of the model in the k pixels of spot s; the last row is the residual.

    `theta` (PARAMETERS,) are its parameters; `rest` (k,) is the image minus B and the light of other spots.
    """
    first, offset, middle, radius = windows
    half, height, out = math.ceil(radius[s] + 0.5), math.exp(theta[2]), np.empty((PARAMETERS + 1, rest.size))
    across, along = _profiles(theta, middle[s, 0], middle[s, 1], half)
    for i in range(rest.size):
        dx, dy = offset[0, first[s] + i], offset[1, first[s] + i]
        p, q = across[dx + half], along[dy + half]
        out[0, i], out[1, i], out[2, i] = height * p[0] * q[1], height * p[1] * q[0], height * p[1] * q[1]
        out[3, i], out[4, i], out[5, i] = height * p[2] * q[1], height * p[1] * q[2], 1.0
        out[6, i], out[7, i] = dx, dy
        out[8, i] = rest[i] - out[2, i] - theta[5] - theta[6] * dx - theta[7] * dy
    return out


@inlined
def _normal(rows: Floats, clip: Bools, theta: Floats, noise: float, prior: Floats, gram: Floats) -> float:
    """Write the products of `spot_slopes` with the priors, in units of the noise; return the pixels that count.

    A clipped pixel does not count where the model is brighter than the clip level.
    """
    used = float(clip.size)
    for i in range(clip.size):
        if clip[i] and rows[PARAMETERS, i] <= 0.0:
            used -= 1.0
            for j in range(PARAMETERS + 1):
                rows[j, i] = 0.0
    for j in range(PARAMETERS + 1):
        for m in range(j + 1):
            gram[j, m] = 0.0
    add_products(rows, 0, clip.size, gram)
    for j in range(PARAMETERS + 1):
        for m in range(j + 1):
            gram[j, m] /= noise * noise
            gram[m, j] = gram[j, m]
    for j in range(PARAMETERS):
        pull = 0.0
        for m in range(PARAMETERS):
            gram[j, m] += prior[j, m]
            pull += theta[m] * prior[m, j]
        gram[j, PARAMETERS] -= pull
        gram[PARAMETERS, PARAMETERS] += pull * theta[j]
    return used


@inlined
def _step(gram: Floats, damping: float, theta: Floats, step: Floats, trial: Floats) -> float:
    """Write a spot's damped step and its end point (PARAMETERS,), both limited; return the predicted gain."""
    gain, matrix = 0.0, np.empty((PARAMETERS, PARAMETERS))
    for j in range(PARAMETERS):
        for m in range(PARAMETERS):
            matrix[j, m] = gram[j, m]
        matrix[j, j] = matrix[j, j] * (1.0 + damping) + 1e-9
        step[j] = gram[j, PARAMETERS]
    solve(matrix, step)
    for j in range(PARAMETERS):
        gain += step[j] * gram[j, PARAMETERS]
        step[j] = min(max(step[j], -_STRIDE[j]), _STRIDE[j])
        trial[j] = theta[j] + step[j]
    trial[2] = min(max(trial[2], -5.0), 15.0)
    trial[3], trial[4] = min(max(trial[3], _LEAST), _MOST), min(max(trial[4], _LEAST), _MOST)
    return gain


@inlined
def _descend(
    windows: Windows, s: int, rest: Floats, clip: Bools, theta: Floats, noise: float, prior: Floats, gram: Floats
) -> tuple[float, bool, bool]:
    """Take up to STEPS Levenberg-Marquardt steps of spot s in place; return the used pixels, and if settled or gone."""
    begun, damping, k = theta.copy(), 1e-2, PARAMETERS
    step, trial, new = np.empty(k), np.empty(k), np.empty((k + 1, k + 1))
    used = _normal(spot_slopes(windows, s, theta, rest), clip, theta, noise, prior, gram)
    for turn in range(STEPS):
        variance = gram[k, k] / max(used, 1.0)
        if turn >= SOON:
            tall = MISFIT_SOON * min(math.exp(theta[2]), DN)
            lost = math.hypot(theta[0] - begun[0], theta[1] - begun[1]) > LOST_PX
            lost = lost or max(theta[3], theta[4]) > math.log(LOST_PX)
            if lost or noise * math.sqrt(variance) > max(UNEXPLAINED * noise, tall):
                return used, False, True
        if _step(gram, damping, theta, step, trial) < SMALL_GAIN * max(variance, 1.0):
            if largest_size(step) < 1.0:
                copy(trial, theta)
            return used, True, False
        now = _normal(spot_slopes(windows, s, trial, rest), clip, trial, noise, prior, new)
        if new[k, k] <= gram[k, k] * (1.0 + 1e-12):
            used, damping = now, max(0.1 * damping, 1e-7)
            copy(trial, theta)
            copy(new.ravel(), gram.ravel())
        else:
            damping *= 8.0
    return used, False, False


@compiled(f"{WINDOWS}, f8[::1], b1[::1], f8[:,::1], f8, f8[:,::1]")
def _descend_all(
    windows: Windows, rest: Floats, clip: Bools, theta: Floats, noise: float, prior: Floats
) -> tuple[Floats, Floats, Bools]:
    """Fit all spots in place, in rounds; `rest` (P,), the image minus B, loses the light of other spots.

    A spot that has not settled goes on while a round halves its squared misfit. Returns (n, 9, 9) products of slopes
    and residual with the priors, (n,) pixels that count, (n,) whether it settled.
    """
    first, n = windows[0], theta.shape[0]
    gram, used = np.zeros((n, PARAMETERS + 1, PARAMETERS + 1)), np.zeros(n)
    gone, settled, light = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.zeros(rest.size)
    for turn in range(ROUNDS):
        changed = False
        for s in range(n):
            if gone[s]:
                continue
            begin, end = first[s], first[s + 1]
            moved = _light_of_others(windows, s, theta, gone, noise, light)
            if turn > 0 and settled[s] and moved <= SAME_LIGHT * noise:
                continue
            own = rest[begin:end] - light[begin:end]
            if turn == 0:
                theta[s, 5] = _ring_level(windows, s, own)
            before, changed = gram[s, PARAMETERS, PARAMETERS], True
            used[s], settled[s], gone[s] = _descend(windows, s, own, clip[begin:end], theta[s], noise, prior, gram[s])
            gone[s] = gone[s] or (turn > 0 and not settled[s] and gram[s, PARAMETERS, PARAMETERS] > 0.5 * before)
        if not changed:
            break
    for i in range(rest.size):
        rest[i] -= light[i]
    return gram, used, settled


@inlined
def _ring_level(windows: Windows, s: int, rest: Floats) -> float:
    """Compute the mean level along the edge of a spot's window."""
    first, offset, _, radius = windows
    total = count = 0.0
    for i in range(rest.size):
        if offset[0, first[s] + i] ** 2 + offset[1, first[s] + i] ** 2 > (radius[s] - 1.0) ** 2:
            total, count = total + rest[i], count + 1.0
    return total / max(count, 1.0)


@inlined
def _bright_moments(offset: Indices, begin: int, end: int, rest: Floats, level: float, out: Floats) -> None:
    """Write the second moments (2, 2) of the part of a spot's pixels above a third of their height over `level`."""
    top = 0.0
    for i in range(begin, end):
        top = max(top, rest[i] - level)
    total = x = y = xx = xy = yy = 0.0
    for i in range(begin, end):
        weight, dx, dy = max(rest[i] - level - 0.35 * top, 0.0), offset[0, i], offset[1, i]
        total, x, y = total + weight, x + weight * dx, y + weight * dy
        xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
    total = max(total, 1e-12)
    x, y = x / total, y / total
    out[0, 0], out[1, 1] = xx / total - x * x, yy / total - y * y
    out[0, 1] = out[1, 0] = xy / total - x * y


@compiled(f"{WINDOWS}, f8[::1], f8[:,::1], f8[:,:,::1], f8[::1], f8, f8[:,::1]")
def _report(
    windows: Windows, rest: Floats, theta: Floats, gram: Floats, used: Floats, noise: float, prior: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute covariance (n, 2, 2), level at the centre beyond B (n,), misfit (n,) and moments (n, 2, 2) of fits."""
    first, offset, middle, _ = windows
    n, k = theta.shape
    covariance, moments, level, misfit = np.empty((n, 2, 2)), np.zeros((n, 2, 2)), np.empty(n), np.empty(n)
    for s in range(n):
        own, pull, matrix = theta[s], 0.0, np.empty((k, k))
        for j in range(k):
            for m in range(k):
                matrix[j, m] = gram[s, j, m]
                pull += own[j] * prior[j, m] * own[m]
            matrix[j, j] += 1e-9
        cost = max(gram[s, k, k] - pull, 0.0)
        # A misfit beyond the noise counts as more noise.
        scale = max(cost / max(used[s] - k, 1.0), 1.0)
        for j in range(2):
            unit = np.zeros(k)
            unit[j] = scale
            solve(matrix.copy(), unit)
            covariance[s, j, 0], covariance[s, j, 1] = unit[0], unit[1]
        level[s] = own[5] + own[6] * (own[0] - middle[s, 0]) + own[7] * (own[1] - middle[s, 1])
        misfit[s] = math.sqrt(cost / max(used[s], 1.0)) * noise
        moments[s, 0, 0], moments[s, 1, 1] = math.exp(2.0 * own[3]), math.exp(2.0 * own[4])
        if misfit[s] > UNEXPLAINED * noise:
            _bright_moments(offset, first[s], first[s + 1], rest, level[s], moments[s])
    return covariance, level, misfit, moments
