"""Censored fits of Gaussian spots on a known background, all spots of an image at once.

Model of a spot in pixel (x, y): B(x, y) + b0 + bx (x - xc) + by (y - yc) + A Gx(x) Gy(y), with Gx the mean over the
pixel of exp(-(x - x0)^2 / (2 sx^2)). B is the image expected without spots (pupil, iris, the blurred edge between
them). A pixel at the clip level only says that the intensity is at least its own; it counts only where the model is
below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .fittedspots import SpotFit, no_spots
from .preprocess import Image
from .spotpixels import Grid, SpotPixels, cut, light_between, profile, window_radius

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PARAMETERS = 8  # x, y, ln A, ln sx, ln sy, b0, bx, by
LOST_PX = 12.0  # no glint's fit is as wide as that, or as far from where it began
# Turns of STEPS steps each, with the light of others in a spot's window as the turn before left it; after PATIENCE
# turns a spot that still moves by WANDERING_PX is given up. The second numbers are for twins, which overlap, and so
# must push each other apart, and for spots that the fit explains to within ROUGH noises.
TURNS, STEPS, PATIENCE, WANDERING_PX = (4, 10), 4, (2, 4), 0.3
ROUGH = 3.0
STILL_PX, SAME_LIGHT = 3e-4, 0.01  # no further turn: movement, and change of the others' light in noises
ROUND_SD = 0.3  # standard deviation of ln sx - ln sy: glints are nearly round


def fit_spots(
    linear: Image,
    known: Callable[[Array, Array], Array],
    start_px: Array,
    width_px: Array,
    height_dn: Array,
    noise_dn: float,
    clip_dn: float,
    slope_dn: float,
) -> SpotFit:
    """Fit all spots. linear: image (DN). known: B at pixels (x, y), each (k,).

    start_px (n, 2), width_px (n,), height_dn (n,): from detection.
    slope_dn: how steep the background may be beyond `known`, DN per px (standard deviation of its prior).

    Spots that reach into each other's windows are fitted in turn, each on the image less the others, until they settle.
    A spot that has grown or moved beyond what a glint's could, or wanders on when others have settled, is given up:
    its light is nobody's background.
    """
    if start_px.shape[0] == 0:
        return no_spots()
    pixels = cut(linear, known, start_px, width_px, clip_dn)
    theta = _start(pixels, start_px, width_px, height_dn)
    begun, touching, twin = theta[:, :2].copy(), _touching(start_px, width_px), _twin(start_px, width_px)
    paired: Mask = np.asarray(touching.any(axis=1))
    hopeful = np.ones(paired.size, dtype=bool)
    settled, lost = np.zeros(paired.size, dtype=bool), np.zeros(paired.size, dtype=bool)
    others = light_between(pixels, theta, touching, noise_dn)
    live = np.arange(paired.size)
    for turn in range(TURNS[1]):
        found, done, misfit = _fit(pixels.taken(live), theta[live], others[pixels.rows(live)], noise_dn, slope_dn)
        moved, restless = np.zeros(paired.size), np.zeros(paired.size, dtype=bool)
        moved[live] = np.abs(found[:, :2] - theta[live, :2]).max(axis=1)
        theta[live] = found
        settled[live] = done | (paired[live] & (moved[live] < 0.02))
        hopeful[live] = twin[live] | (misfit < ROUGH)
        patience, turns = (np.where(hopeful, part[1], part[0]) for part in (PATIENCE, TURNS))
        restless[live] = ~done & (moved[live] > STILL_PX)
        lost |= paired & (_lost(theta, begun) | ((moved > WANDERING_PX) & (turn + 1 >= patience)))
        before, others = others, light_between(pixels, theta, touching & ~lost, noise_dn)
        brighter = pixels.total(np.abs(others - before) > SAME_LIGHT * noise_dn) > 0
        live = np.nonzero(~lost & (restless | brighter) & (turn + 1 < turns))[0]
        if live.size == 0:
            break
    return _report(pixels, theta, settled & ~lost, others, noise_dn, slope_dn)


def _touching(start: Array, width: Array) -> Mask:
    """(n, n) whether one spot's light reaches into another's window."""
    radius = window_radius(width)
    return np.asarray(_distance(start) < 1.35 * (radius[:, None] + radius[None]))


def _twin(start: Array, width: Array) -> Mask:
    """(n,) whether a spot overlaps another."""
    return np.asarray((_distance(start) < 1.6 * (width[:, None] + width[None])).any(axis=1))


def _distance(start: Array) -> Array:
    """(n, n) between spots; infinite from one to itself."""
    out: Array = np.hypot(*np.moveaxis(start[:, None] - start[None], -1, 0))
    np.fill_diagonal(out, np.inf)
    return out


def _lost(theta: Array, start: Array) -> Mask:
    """(n,) which spots have grown or moved beyond what a glint's fit could."""
    wide = theta[:, 3:5].max(axis=1) > math.log(LOST_PX)
    return np.asarray(wide | (np.hypot(*(theta[:, :2] - start).T) > LOST_PX))


def _start(pixels: SpotPixels, start: Array, width: Array, height: Array) -> Array:
    n, spot = width.size, pixels.spot
    theta = np.zeros((n, PARAMETERS))
    theta[:, :2] = start
    away = np.hypot(*((pixels.centre - start)[spot] + np.stack([pixels.dx, pixels.dy], axis=-1)).T)
    flat = pixels.total(pixels.clip) > 2
    if flat.any():  # a flat top's centre is its mean, its pixel of first maximum is anywhere
        top = pixels.clip & (away < 3.0 + 2.5 * width[spot])
        share = top / np.maximum(pixels.total(top), 1.0)[spot]
        mean = pixels.centre + np.stack([pixels.total(share * pixels.dx), pixels.total(share * pixels.dy)], axis=-1)
        theta[flat, :2] = mean[flat]
    theta[:, 2] = np.log(np.maximum(height, 1.0) * np.where(flat, 2.0, 1.3))
    theta[:, 3:5] = np.log(width * np.where(flat, 0.8, 1.0))[:, None]
    # The background: the median along the window's rim.
    ring = np.nonzero(away > pixels.radius[spot] - 1.0)[0]
    excess = (pixels.data - pixels.known)[ring]
    ordered = excess[np.lexsort((excess, spot[ring]))]
    size = np.bincount(spot[ring], minlength=n)
    some = size > 0
    theta[some, 5] = ordered[(np.cumsum(size) - size + size // 2)[some]]
    return theta


def _slopes(pixels: SpotPixels, grid: Grid, theta: Array, rest: Array) -> Array:
    """(PARAMETERS + 1, P): the model's derivatives at every pixel and, last, the residual.

    rest (P,): image less all that is not fitted."""
    owner = grid.owner
    at = (theta[:, :2] - pixels.centre)[owner]
    sigma = np.exp(theta[:, 3:5])[owner]
    gx, gx_c, gx_s = profile(grid.edges, at[:, 0], sigma[:, 0])
    gy, gy_c, gy_s = profile(grid.edges, at[:, 1], sigma[:, 1])
    amplitude = np.exp(theta[:, 2])[owner[:-1]]
    across, along = (amplitude * gx)[grid.column], gy[grid.row]
    out = np.empty((PARAMETERS + 1, pixels.dx.size))
    np.multiply((amplitude * gx_c)[grid.column], along, out=out[0])
    np.multiply(across, gy_c[grid.row], out=out[1])
    np.multiply(across, along, out=out[2])
    np.multiply((amplitude * gx_s)[grid.column], along, out=out[3])
    np.multiply(across, gy_s[grid.row], out=out[4])
    out[5], out[6], out[7] = 1.0, pixels.dx, pixels.dy
    plane = theta[:, 5:][pixels.spot]
    out[8] = rest - out[2] - plane[:, 0] - plane[:, 1] * pixels.dx - plane[:, 2] * pixels.dy
    return out


def _gram(pixels: SpotPixels, grid: Grid, theta: Array, rest: Array, noise: float) -> tuple[Array, Mask]:
    """(n, PARAMETERS + 1, PARAMETERS + 1): products of `_slopes`, summed over every spot's pixels, in units of the
    noise; and which pixels count: not the clipped ones where the model is brighter."""
    rows = _slopes(pixels, grid, theta, rest)
    counts = ~(pixels.clip & (rows[-1] <= 0.0))
    if not counts.all():
        rows *= counts
    out = np.empty((theta.shape[0], PARAMETERS + 1, PARAMETERS + 1))
    for product, (begin, end) in zip(out, pairwise(pixels.first.tolist()), strict=True):
        np.matmul(rows[:, begin:end], rows[:, begin:end].T, out=product)
    out *= 1.0 / noise**2
    return out, counts


def _normal(gram: Array, theta: Array, slope: float) -> tuple[Array, Array, Array]:
    """(cost, gradient, normal matrix) in units of the noise, priors included: a nearly round spot, and a background
    that is flat to within `slope`."""
    gradient, matrix = gram[:, :-1, -1].copy(), gram[:, :-1, :-1].copy()
    round_weight, slope_weight = 1.0 / ROUND_SD**2, 1.0 / slope**2
    gap = theta[:, 3] - theta[:, 4]
    gradient[:, 3] -= round_weight * gap
    gradient[:, 4] += round_weight * gap
    matrix[:, 3, 3] += round_weight
    matrix[:, 4, 4] += round_weight
    matrix[:, 3, 4] -= round_weight
    matrix[:, 4, 3] -= round_weight
    gradient[:, 6:] -= slope_weight * theta[:, 6:]
    matrix[:, 6, 6] += slope_weight
    matrix[:, 7, 7] += slope_weight
    cost = gram[:, -1, -1] + round_weight * gap**2 + slope_weight * (theta[:, 6:] ** 2).sum(axis=1)
    return cost, gradient, matrix


_LEAST = np.array([-np.inf, -np.inf, -5.0, math.log(0.2), math.log(0.2), -np.inf, -np.inf, -np.inf])
_MOST = np.array([np.inf, np.inf, 15.0, math.log(30.0), math.log(30.0), np.inf, np.inf, np.inf])
_STRIDE = np.array([1.5, 1.5, 0.7, 0.7, 0.7, np.inf, np.inf, np.inf])  # largest step


def _fit(pixels: SpotPixels, theta: Array, others: Array, noise: float, slope: float) -> tuple[Array, Mask, Array]:
    """(theta, settled, root mean square misfit in noises) by at most STEPS steps of Levenberg-Marquardt on every spot
    side by side."""
    out, start = theta.copy(), theta[:, :2].copy()
    settled = np.zeros(theta.shape[0], dtype=bool)
    live = np.arange(theta.shape[0])  # the spots that are not settled; what follows holds these alone
    damping, size, misfit = np.full(live.size, 1e-2), pixels.count, np.zeros(live.size)
    rest, grid = pixels.data - pixels.known - others, Grid.of(pixels)
    cost, gradient, matrix = _normal(_gram(pixels, grid, theta, rest, noise)[0], theta, slope)
    diagonal = np.arange(PARAMETERS)
    for _ in range(STEPS):
        damped = matrix.copy()
        damped[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        damped[:, diagonal, diagonal] += 1e-9
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        step = np.minimum(np.maximum(step, -_STRIDE), _STRIDE)
        trial = np.minimum(np.maximum(theta + step, _LEAST), _MOST)
        new_cost, new_gradient, new_matrix = _normal(_gram(pixels, grid, trial, rest, noise)[0], trial, slope)
        better = new_cost <= cost * (1.0 + 1e-12)
        stride = np.abs(step)
        small = (stride[:, :2].max(axis=1) < 2e-4) & (stride[:, 2:5].max(axis=1) < 2e-3)
        theta = np.where(better[:, None], trial, theta)
        gradient = np.where(better[:, None], new_gradient, gradient)
        matrix = np.where(better[:, None, None], new_matrix, matrix)
        cost = np.where(better, new_cost, cost)
        damping = np.minimum(np.maximum(np.where(better, 0.1 * damping, 8.0 * damping), 1e-7), 1e7)
        out[live], misfit[live] = theta, cost
        done = (better & small) | (damping > 1e5) | _lost(theta, start[live])
        settled[live[done]] = True
        if done.all():
            break
        if done.any():
            keep = np.nonzero(~done)[0]
            rest = rest[pixels.rows(keep)]
            pixels = pixels.taken(keep)
            grid = Grid.of(pixels)
            live, theta, cost, damping = live[keep], theta[keep], cost[keep], damping[keep]
            gradient, matrix = gradient[keep], matrix[keep]
    return out, settled, np.sqrt(misfit / np.maximum(size, 1))


def _report(pixels: SpotPixels, theta: Array, settled: Mask, others: Array, noise: float, slope: float) -> SpotFit:
    gram, counts = _gram(pixels, Grid.of(pixels), theta, pixels.data - pixels.known - others, noise)
    _, _, matrix = _normal(gram, theta, slope)
    data_cost, used = gram[:, -1, -1], pixels.total(counts)
    diagonal = np.arange(PARAMETERS)
    matrix[:, diagonal, diagonal] += 1e-9
    inverse = np.linalg.inv(matrix)
    # What the noise does not explain counts as noise.
    scale = np.maximum(data_cost / np.maximum(used - PARAMETERS, 1.0), 1.0)
    at = theta[:, :2] - pixels.centre
    return SpotFit(
        theta[:, :2].copy(),
        np.asarray(inverse[:, :2, :2] * scale[:, None, None], dtype=np.float64),
        np.exp(theta[:, 2]),
        np.exp(theta[:, 3:5]),
        theta[:, 5] + (theta[:, 6:] * at).sum(axis=1) + pixels.middle_dn,
        np.sqrt(data_cost / np.maximum(used, 1.0)) * noise,
        pixels.total(pixels.clip).astype(np.intp),
        settled & np.isfinite(theta).all(axis=1) & (used >= 12),
    )
