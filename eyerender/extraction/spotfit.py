"""Censored fits of Gaussian spots on a known background, all spots of an image at once.

Model of a spot in pixel (x, y): B(x, y) + b0 + bx (x - xc) + by (y - yc) + A Gx(x) Gy(y), with Gx the mean over the
pixel of exp(-(x - x0)^2 / (2 sx^2)). B is the image expected without spots (pupil, iris, the blurred edge between
them). A pixel at the clip level only says that the intensity is at least its own; it counts only where the model is
below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from .fittedspots import SpotFit, joined, no_spots, profile
from .preprocess import Image

Array = NDArray[np.float64]

PARAMETERS = 8  # x, y, ln A, ln sx, ln sy, b0, bx, by
MAX_TURNS = 25
LOST_PX = 12.0  # no glint's fit is as wide as that, or as far from where it began
PATIENCE, WANDERING_PX = 4, 0.3  # turns after which a spot that still moves by more is given up


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    x: Array  # (n, 1, k) pixel coordinates
    y: Array  # (n, k, 1)
    data: Array  # (n, k, k)
    known: Array  # (n, k, k) B
    weight: Array  # (n, k, k) 1 inside the image, else 0
    clip: NDArray[np.bool_]  # (n, k, k)
    centre: Array  # (n, 2)

    def taken(self, index: NDArray[np.intp]) -> _Windows:
        """The chosen spots'."""
        return _Windows(*(getattr(self, one.name)[index] for one in fields(self)))


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
    """Fit all spots. linear: image (DN). known: B at pixels (x, y).

    start_px (n, 2), width_px (n,), height_dn (n,): from detection.
    slope_dn: how steep the background may be beyond `known`, DN per px (standard deviation of its prior).

    Spots that reach into each other's windows are fitted in turn, each on the image less the others, until they settle.
    """
    if start_px.shape[0] == 0:
        return no_spots()
    parts, order = [], []
    for members in _groups(start_px, width_px):
        half = int(np.clip(math.ceil(3.2 * float(np.max(width_px[members])) + 1.0), 4, 20))
        start, width = start_px[members], width_px[members]
        windows = _cut(linear, known, start, np.minimum(window_radius(width), half), half, clip_dn)
        theta = _start(windows, start, width, height_dn[members])
        others = np.zeros_like(windows.data)
        if _touching(start, width).any():
            theta, settled, others = _fit_in_turn(windows, theta, noise_dn, slope_dn)
        else:
            theta, settled = _fit(windows, theta, others, noise_dn, slope_dn)
        parts.append(_report(windows, theta, settled, others, noise_dn, slope_dn))
        order.append(members)
    back = np.argsort(np.concatenate(order), kind="stable")
    return joined(parts).taken(back)


def window_radius(width: Array) -> Array:
    """Radius, px, of the pixels that a spot of that sigma is fitted to."""
    return 2.7 * width + 1.2


def _touching(start: Array, width: Array) -> NDArray[np.bool_]:
    """(n, n) whether one spot's light reaches into another's window."""
    radius = window_radius(width)
    distance = np.hypot(*np.moveaxis(start[:, None] - start[None], -1, 0))
    return np.asarray((distance < 1.35 * (radius[:, None] + radius[None])) & ~np.eye(width.size, dtype=bool))


def _groups(start: Array, width: Array) -> list[NDArray[np.intp]]:
    """Spots that touch each other, group by group; lone ones together, the narrow and the wide apart."""
    count, label = connected_components(_touching(start, width), directed=False)
    alone = np.bincount(label, minlength=count)[label] == 1
    groups = [np.nonzero(label == k)[0] for k in np.unique(label[~alone])]
    narrow = width < 2.5
    return [group for group in (np.nonzero(alone & narrow)[0], np.nonzero(alone & ~narrow)[0], *groups) if group.size]


def _fit_in_turn(
    windows: _Windows, theta: Array, noise_dn: float, slope_dn: float
) -> tuple[Array, NDArray[np.bool_], Array]:
    """(theta, settled, the others' light) of spots that share pixels.

    A spot that has grown or moved beyond what a glint's could, or wanders on when others have settled, is given up:
    its light is nobody's background.
    """
    theta, start = theta.copy(), theta[:, :2]
    settled, lost = np.zeros(theta.shape[0], dtype=bool), np.zeros(theta.shape[0], dtype=bool)
    others = _others(windows, theta, lost)
    for turn in range(10):
        index = np.nonzero(~lost)[0]
        found, done = _fit(windows.taken(index), theta[index], others[index], noise_dn, slope_dn, turns=4)
        moved = np.abs(found[:, :2] - theta[index, :2]).max(axis=1)
        theta[index] = found
        settled[index] = done | (moved < 0.02)
        if turn + 1 >= PATIENCE:
            lost[index[moved > WANDERING_PX]] = True
        lost |= _lost(theta, start)
        others = _others(windows, theta, lost)
        if lost.all() or moved.max() < 3e-4:
            break
    return theta, settled & ~lost, others


def _lost(theta: Array, start: Array) -> NDArray[np.bool_]:
    """(n,) which spots have grown or moved beyond what a glint's fit could."""
    wide = theta[:, 3:5].max(axis=1) > math.log(LOST_PX)
    return np.asarray(wide | (np.hypot(*(theta[:, :2] - start).T) > LOST_PX))


def _cut(
    linear: Image, known: Callable[[Array, Array], Array], start: Array, radius: Array, half: int, clip_dn: float
) -> _Windows:
    centre = np.rint(start).astype(np.intp)
    step = np.arange(-half, half + 1)
    x, y = centre[:, :1] + step, centre[:, 1:] + step
    height, width = linear.shape
    inside = ((x >= 0) & (x < width))[:, None, :] & ((y >= 0) & (y < height))[:, :, None]
    row, column = np.clip(y, 0, height - 1)[:, :, None], np.clip(x, 0, width - 1)[:, None, :]
    # Round windows, each as wide as its spot needs: the less of the limbus and of other edges is in them.
    away = np.hypot(x[:, None, :] - start[:, 0, None, None], y[:, :, None] - start[:, 1, None, None])
    inside &= away <= radius[:, None, None]
    data = linear[row, column].astype(np.float64)
    return _Windows(
        x[:, None, :].astype(np.float64),
        y[:, :, None].astype(np.float64),
        data,
        known(*(part.astype(np.float64) for part in np.broadcast_arrays(x[:, None, :], y[:, :, None]))),
        inside.astype(np.float64),
        data >= clip_dn,
        centre.astype(np.float64),
    )


def _start(windows: _Windows, start: Array, width: Array, height: Array) -> Array:
    n = start.shape[0]
    theta = np.zeros((n, PARAMETERS))
    theta[:, :2] = start
    clipped = windows.clip.sum(axis=(1, 2))
    for i in np.nonzero(clipped > 2)[0]:  # a flat top's centre is its mean, its pixel of first maximum is anywhere
        distance = np.hypot(windows.x[i] - start[i, 0], windows.y[i] - start[i, 1])
        weight = windows.clip[i] & (distance < 3.0 + 2.5 * width[i])
        theta[i, 0] = (windows.x[i] * weight).sum() / max(weight.sum(), 1)
        theta[i, 1] = (windows.y[i] * weight).sum() / max(weight.sum(), 1)
    amplitude = np.maximum(height, 1.0) * np.where(clipped > 2, 2.0, 1.3)
    theta[:, 2] = np.log(amplitude)
    theta[:, 3:5] = np.log(width * np.where(clipped > 2, 0.8, 1.0))[:, None]
    excess = windows.data - windows.known
    border = np.concatenate([excess[:, 0], excess[:, -1], excess[:, :, 0], excess[:, :, -1]], axis=1)
    theta[:, 5] = np.median(border, axis=1)
    return theta


def _model(windows: _Windows, theta: Array) -> tuple[Array, Array]:
    """Spot plus fitted background plane (n, k, k), and its Jacobian (n, k, k, PARAMETERS)."""
    p = theta[:, :, None, None]
    gx, gx_c, gx_s = profile(windows.x, p[:, 0], np.exp(p[:, 3]))
    gy, gy_c, gy_s = profile(windows.y, p[:, 1], np.exp(p[:, 4]))
    amplitude = np.exp(p[:, 2])
    spot = amplitude * gx * gy
    jacobian = np.empty((*spot.shape, PARAMETERS))
    jacobian[..., 0] = amplitude * gx_c * gy
    jacobian[..., 1] = amplitude * gx * gy_c
    jacobian[..., 2] = spot
    jacobian[..., 3] = amplitude * gx_s * gy
    jacobian[..., 4] = amplitude * gx * gy_s
    jacobian[..., 5] = 1.0
    jacobian[..., 6] = windows.x - windows.centre[:, 0, None, None]
    jacobian[..., 7] = windows.y - windows.centre[:, 1, None, None]
    value = spot + p[:, 5] + p[:, 6] * jacobian[..., 6] + p[:, 7] * jacobian[..., 7]
    return value, jacobian


def _normal(
    windows: _Windows, theta: Array, others: Array, noise: float, slope: float
) -> tuple[Array, Array, Array, Array]:
    """(cost, gradient, normal matrix, squared residual of the data alone) in units of the noise."""
    value, jacobian = _model(windows, theta)
    total = value + windows.known + others
    weight = windows.weight * ~(windows.clip & (total >= windows.data)) / noise
    residual = (windows.data - total) * weight
    n = theta.shape[0]
    flat = (jacobian * weight[..., None]).reshape(n, -1, PARAMETERS)
    r = residual.reshape(n, -1)
    gradient = np.einsum("nkp,nk->np", flat, r)
    matrix = flat.transpose(0, 2, 1) @ flat
    data_cost = (r * r).sum(axis=1)
    # Priors: nearly round (10 % each way per ... 0.3 in ln), and a background that is flat to within `slope`.
    round_weight, slope_weight = 1.0 / 0.3**2, 1.0 / slope**2
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
    cost = data_cost + round_weight * gap**2 + slope_weight * (theta[:, 6:] ** 2).sum(axis=1)
    return cost, gradient, matrix, data_cost


def _fit(
    windows: _Windows, theta: Array, others: Array, noise: float, slope: float, turns: int = MAX_TURNS
) -> tuple[Array, NDArray[np.bool_]]:
    """Levenberg-Marquardt on every spot side by side."""
    n = theta.shape[0]
    damping = np.full(n, 1e-2)
    settled, start = np.zeros(n, dtype=bool), theta[:, :2]
    cost, gradient, matrix, _ = _normal(windows, theta, others, noise, slope)
    diagonal = np.arange(PARAMETERS)
    for _ in range(turns):
        damped = matrix.copy()
        damped[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        damped[:, diagonal, diagonal] += 1e-9
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -1.5, 1.5)
        step[:, 2:5] = np.clip(step[:, 2:5], -0.7, 0.7)
        trial = theta + step
        trial[:, 3:5] = np.clip(trial[:, 3:5], math.log(0.2), math.log(30.0))
        trial[:, 2] = np.clip(trial[:, 2], -5.0, 15.0)
        new_cost, new_gradient, new_matrix, _ = _normal(windows, trial, others, noise, slope)
        better = new_cost <= cost * (1.0 + 1e-12)
        small = np.abs(step[:, :2]).max(axis=1) < 2e-4
        settled |= better & small & (np.abs(step[:, 2:5]).max(axis=1) < 2e-3)
        theta = np.where(better[:, None], trial, theta)
        gradient = np.where(better[:, None], new_gradient, gradient)
        matrix = np.where(better[:, None, None], new_matrix, matrix)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 8.0 * damping), 1e-7, 1e7)
        settled |= (damping > 1e5) | _lost(theta, start)
        if settled.all():
            break
    return theta, settled


def _others(windows: _Windows, theta: Array, lost: NDArray[np.bool_]) -> Array:
    """(n, k, k): in every spot's window, the light of the other spots."""
    out = np.zeros_like(windows.data)
    for i in np.nonzero(~lost)[0]:
        gx = profile(windows.x, theta[i, 0], math.exp(theta[i, 3]))[0]
        gy = profile(windows.y, theta[i, 1], math.exp(theta[i, 4]))[0]
        spot = math.exp(theta[i, 2]) * gx * gy
        spot[i] = 0.0
        out += spot
    return out


def _report(
    windows: _Windows, theta: Array, settled: NDArray[np.bool_], others: Array, noise: float, slope: float
) -> SpotFit:
    _, _, matrix, data_cost = _normal(windows, theta, others, noise, slope)
    value, _ = _model(windows, theta)
    used = windows.weight * ~(windows.clip & (value + windows.known + others >= windows.data))
    pixels = used.sum(axis=(1, 2))
    free = np.maximum(pixels - PARAMETERS, 1.0)
    diagonal = np.arange(PARAMETERS)
    matrix[:, diagonal, diagonal] += 1e-9
    inverse = np.linalg.inv(matrix)
    scale = np.maximum(data_cost / free, 1.0)  # what the noise does not explain counts as noise
    covariance = inverse[:, :2, :2] * scale[:, None, None]
    at = theta[:, :2] - windows.centre
    background = theta[:, 5] + (theta[:, 6:] * at).sum(axis=1)
    middle = windows.known.shape[1] // 2
    return SpotFit(
        theta[:, :2].copy(),
        covariance,
        np.exp(theta[:, 2]),
        np.exp(theta[:, 3:5]),
        background + windows.known[:, middle, middle],
        np.sqrt(data_cost / np.maximum(pixels, 1.0)) * noise,
        windows.clip.sum(axis=(1, 2)),
        settled & np.isfinite(theta).all(axis=1) & (pixels >= 12),
    )
