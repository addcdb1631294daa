"""Censored fits of Gaussian spots on a known background, for all spots of an image at once.

A spot that overlaps others is fitted to the image minus their light, which is updated as their fits change. A spot is
abandoned if it grows or moves more than a glint can, or if it still moves after the others have settled. The light of
an abandoned spot is not subtracted from the others' windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ..preprocessing import Image
from ..products import solve
from .detection import SMOOTH_PX
from .fits import SpotFit
from .gaussian_model import PARAMETERS, SAME_LIGHT, WITH_EDGE, Descent, Limits, descend, lost, prior, promising
from .windows import WINDOWS, SpotPixels, Windows, cut, light_of_others, shining_pairs, window_radius

# Rounds of several steps each. A spot that still moves by WANDERING_PX after PATIENCE rounds is abandoned. The second
# numbers are for spots whose fit is promising or whose misfit still falls.
TURNS, PATIENCE, WANDERING_PX = (1, 4), (1, 2), 0.3
FEW_CLIPPED = 2  # a spot with more clipped pixels has a flat top
UNEXPLAINED = 2.0  # misfit in noise standard deviations below which the Gaussian explains the pixels
NEARLY_STILL_PX = 0.02  # a spot that moves less has settled, even if its neighbour still answers its moves


@dataclass(frozen=True, slots=True, eq=False)
class FittedSpots:
    """A fit with the pixels it was fitted to.

    Attributes:
        fit: the fit.
        pixels: P pixels of the windows.
        theta: (n, PARAMETERS) parameters.
        rest: (P,) the image minus B and the other spots' light.
    """

    fit: SpotFit
    pixels: SpotPixels
    theta: Floats
    rest: Floats

    def taken(self, spots: Indices) -> FittedSpots:
        """Select spots, which are in ascending order."""
        rows = self.pixels.rows(spots)
        return FittedSpots(self.fit.taken(spots), self.pixels.taken(spots), self.theta[spots], self.rest[rows])


def fit_spots(
    linear: Image,
    known: Callable[[Floats, Floats], Floats],
    start_px: Floats,
    width_px: Floats,
    height_dn: Floats,
    limits: Limits,
) -> FittedSpots:
    """Fit all spots of an image.

    Args:
        linear: the image, DN.
        known: returns the background B at pixels x and y, (k,) each.
        start_px: (n, 2) detected peaks.
        width_px: (n,) their estimated standard deviations.
        height_dn: (n,) their heights.
        limits: noise, clip level and the prior of the slope.
    """
    noise = limits.noise_dn
    pixels = cut(linear, known, start_px, width_px, limits.clip_dn)
    apart, radius = np.hypot(*(start_px[:, None] - start_px).transpose(2, 0, 1)), window_radius(width_px)
    touching = (apart < 1.35 * (radius[:, None] + radius)) & ~np.eye(radius.size, dtype=bool)
    theta = _start(pixels, start_px, width_px, height_dn, touching)
    pairs = shining_pairs(pixels, theta, touching, noise)
    rest = pixels.data - pixels.known
    light = light_of_others(pixels.windows, theta, pairs, rest.size)
    theta[:, 5] = _ring_level(pixels, rest - light)
    found = descend(pixels, theta, rest - light, pairs, limits)
    if not pairs.size and bool(found.settled.all()):
        return FittedSpots(report(pixels, found, rest, limits), pixels, found.theta, rest)
    begun, n = theta[:, :2].copy(), width_px.size
    gone, settled = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    gram, used, live = found.gram.copy(), np.array(found.used), np.arange(n)
    for turn in range(TURNS[1]):
        if turn > 0:
            part, rows = pixels.taken(live), pixels.rows(live)
            among = shining_pairs(part, theta[live], touching[np.ix_(live, live)], noise)
            found = descend(part, theta[live], (rest - light)[rows], among, limits)
        theta[live], gram[live], used[live] = found.theta, found.gram, found.used
        moved, done, falling = np.zeros(n), np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
        moved[live], done[live], falling[live] = found.moved, found.settled, found.falling
        settled[live] = found.settled | (found.moved < NEARLY_STILL_PX)
        likely = falling | promising(theta, gram, used, noise)
        turns, patience = np.where(likely, TURNS[1], TURNS[0]), np.where(likely, PATIENCE[1], PATIENCE[0])
        gone |= lost(theta, begun) | (~done & (moved > WANDERING_PX) & (turn + 1 >= patience))
        if pairs.size:
            before, light = light, light_of_others(pixels.windows, theta, pairs[~gone[pairs[:, 1]]], rest.size)
            done &= pixels.most(np.abs(light - before)) <= SAME_LIGHT * noise
        live = np.flatnonzero(~gone & ~done & (turn + 1 < turns))
        if live.size == 0:
            break
    ended = Descent(theta=theta, gram=gram, used=used, settled=settled & ~gone, moved=moved, falling=falling)
    return FittedSpots(report(pixels, ended, rest - light, limits), pixels, theta, rest - light)


def _start(pixels: SpotPixels, start: Floats, width: Floats, height: Floats, touching: Bools) -> Floats:
    """Compute the start (n, PARAMETERS) of the fit, without the background's level."""
    theta = np.zeros((width.size, PARAMETERS))
    theta[:, :2] = start
    theta[:, 2] = np.log(1.3 * np.maximum(height, 1.0))
    theta[:, 3] = np.log(width)
    if pixels.clip.any():
        own = pixels.spot
        at = pixels.centre[own] + np.stack([pixels.dx, pixels.dy], axis=-1)
        away2 = ((at - start[own]) ** 2).sum(axis=1)
        top = pixels.clip & (away2 < (3.0 + 2.5 * width[own]) ** 2)
        width_sum = 4.0 + 2.5 * width[:, None] + 1.5 * width
        near = touching & (((start[:, None] - start) ** 2).sum(axis=-1) < width_sum**2)
        for i, k in zip(*np.nonzero(near), strict=True):  # omit pixels nearer to another spot
            part = slice(pixels.first[i], pixels.first[i + 1])
            top[part] &= ((at[part] - start[k]) ** 2).sum(axis=1) >= away2[part]
        area = pixels.total(top)
        # The centre of a flat top is its mean; its first brightest pixel may be anywhere.
        flat = area > FEW_CLIPPED
        share = top / np.maximum(area, 1.0)[own]
        mean = pixels.centre + np.stack([pixels.total(share * pixels.dx), pixels.total(share * pixels.dy)], axis=-1)
        theta[flat, :2] = mean[flat]
        # A Gaussian exceeds a level on an area of 2 pi sigma^2 ln(A / level). The areas above the clip level and above
        # half of it, from which the width was estimated, give the amplitude.
        full = 2.0 * np.pi * np.log(2.0) * (width**2 + SMOOTH_PX**2) + np.pi * SMOOTH_PX**2
        ratio = np.minimum(area / full, 0.8)[flat]
        beyond = np.log(2.0) * ratio / (1.0 - ratio)
        theta[flat, 2] += beyond - np.log(1.3)
        theta[flat, 3] = 0.5 * np.log(area[flat] / (2.0 * np.pi * beyond))
    theta[:, 4] = theta[:, 3]
    return theta


def _ring_level(pixels: SpotPixels, rest: Floats) -> Floats:
    """Compute the mean level (n,) along the edges of the windows."""
    ring = pixels.dx * pixels.dx + pixels.dy * pixels.dy > ((pixels.radius - 1.0) ** 2)[pixels.spot]
    return pixels.total(rest * ring) / np.maximum(pixels.total(ring), 1.0)


def report(pixels: SpotPixels, ended: Descent, rest: Floats, limits: Limits, blur_px: float = 1.0) -> SpotFit:
    """Convert the end of a descent to a fit; `rest` (P,) is the image minus B and the light of other spots."""
    theta, noise = ended.theta, limits.noise_dn
    penalty = prior(limits, theta.shape[1])
    ended_at = (np.ascontiguousarray(theta), ended.gram, ended.used)
    covariance, level, misfit, moments = _reported(pixels.windows, *ended_at, rest, noise, penalty, blur_px)
    return SpotFit(
        xy_px=theta[:, :2].copy(),
        covariance=covariance,
        amplitude_dn=np.exp(theta[:, 2]),
        sigma_px=np.exp(theta[:, 3:5]),
        background_dn=level + pixels.middle_dn,
        residual_dn=misfit,
        moments_px2=moments,
        clipped=pixels.total(pixels.clip).astype(np.intp),
        converged=ended.settled & np.isfinite(theta).all(axis=1) & (ended.used >= 12),
    )


@inlined
def _bright_moments(plane: Floats, begin: int, end: int, rest: Floats, level: float, out: Floats) -> None:
    """Write the second moments (2, 2) of the part of a spot's pixels above a third of their height over `level`."""
    top = 0.0
    for i in range(begin, end):
        top = max(top, rest[i] - level)
    total = x = y = xx = xy = yy = 0.0
    for i in range(begin, end):
        weight, dx, dy = max(rest[i] - level - 0.35 * top, 0.0), plane[1, i], plane[2, i]
        total, x, y = total + weight, x + weight * dx, y + weight * dy
        xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
    total = max(total, 1e-12)
    x, y = x / total, y / total
    out[0, 0], out[1, 1] = xx / total - x * x, yy / total - y * y
    out[0, 1] = out[1, 0] = xy / total - x * y


@compiled(f"{WINDOWS}, f8[:,::1], f8[:,:,::1], f8[::1], f8[::1], f8, f8[:,::1], f8")
def _reported(
    windows: Windows, theta: Floats, gram: Floats, used: Floats, rest: Floats,
    noise: float, penalty: Floats, blur_px: float,
) -> tuple[Floats, Floats, Floats, Floats]:  # fmt: skip
    """Compute covariance (n, 2, 2), level at the centre beyond B (n,), misfit (n,) and moments (n, 2, 2) of fits."""
    first, plane, centre, _ = windows
    n, k = theta.shape
    covariance, moments, level, misfit = np.empty((n, 2, 2)), np.zeros((n, 2, 2)), np.empty(n), np.empty(n)
    for s in range(n):
        own, pull, matrix = theta[s], 0.0, np.empty((k, k))
        for j in range(k):
            for m in range(k):
                matrix[j, m] = gram[s, j, m]
                pull += own[j] * penalty[j, m] * own[m]
            matrix[j, j] += 1e-9
        cost = max(gram[s, k, k] - pull, 0.0)
        # A misfit beyond the noise counts as more noise.
        scale = max(cost / max(used[s] - k, 1.0), 1.0)
        for j in range(2):
            unit = np.zeros(k)
            unit[j] = scale
            solve(matrix.copy(), unit)
            covariance[s, j, 0], covariance[s, j, 1] = unit[0], unit[1]
        x, y = own[0] - centre[s, 0], own[1] - centre[s, 1]
        level[s] = own[5] + own[6] * x + own[7] * y
        if k == WITH_EDGE:
            t = (x * math.cos(own[9]) + y * math.sin(own[9]) - own[10]) / blur_px
            level[s] += own[8] * 0.5 * math.erfc(-t * math.sqrt(0.5))
        misfit[s] = math.sqrt(cost / max(used[s], 1.0)) * noise
        moments[s, 0, 0], moments[s, 1, 1] = math.exp(2.0 * own[3]), math.exp(2.0 * own[4])
        if misfit[s] > UNEXPLAINED * noise:
            _bright_moments(plane, first[s], first[s + 1], rest, level[s], moments[s])
    return covariance, level, misfit, moments
