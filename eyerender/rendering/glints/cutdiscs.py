"""Quadrature over lamps: whole discs, and discs partly hidden by an edge of any shape.

Points are those of the unit disc, which `disc_points` spreads over a lamp's disc or ring with equal areas. A disc is
cut into circles. Where an edge crosses a circle, a search finds the angles at which the visibility changes, and
Gauss-Legendre nodes fill each visible arc. The lengths of the arcs vary like a square root where a circle just touches
the edge. A search finds these radii too, and the panels between them are integrated over s with

    u = r^2 = u0 + (u1 - u0) (3 s^2 - 2 s^3),

under which a square root at an end of the panel becomes smooth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...base.arrays import Bools, Floats

Visible = Callable[[Floats], Bools]

_CIRCLES, _ANGLES = 12, 48
_PARTS, _STEPS = 8, 4  # each step finds the eighth of an interval with the edge: to 2e-5 of the radius, 3e-5 rad


@dataclass(frozen=True, slots=True)
class Nodes:
    """A quadrature over the unit disc: points (k, 2) and weights (k,), which sum to 1 for the whole disc."""

    point: Floats
    weight: Floats

    def join(self, other: Nodes) -> Nodes:
        """Join the points of both quadratures."""
        return Nodes(np.concatenate([self.point, other.point]), np.concatenate([self.weight, other.weight]))


@lru_cache(maxsize=256)
def _gauss(count: int) -> tuple[Floats, Floats]:
    """Return points in [-1, 1] and weights of the Gauss-Legendre quadrature."""
    return np.polynomial.legendre.leggauss(count)


POINT = Nodes(np.zeros((1, 2)), np.ones(1))


@lru_cache(maxsize=64)
def quadrature(radial: int, angular: int) -> Nodes:
    """Compute nodes over the disc: Gauss-Legendre in r^2, equal steps in angle."""
    x, weight = _gauss(radial)
    angle = 2 * np.pi * (np.arange(angular) + 0.5) / angular
    r = np.sqrt(0.5 * (x + 1))
    return Nodes(_polar(*np.broadcast_arrays(r[:, None], angle)), np.repeat(0.5 * weight, angular) / angular)


@lru_cache(maxsize=4)
def rim(count: int) -> Nodes:
    """Return points of the unit circle, without weight, which show whether an edge cuts the disc."""
    return Nodes(_polar(np.ones(count), 2 * np.pi * np.arange(count) / count), np.zeros(count))


def cut_nodes(visible: Visible, radial: int, angular: int) -> Nodes:
    """Compute a quadrature over the visible part of a disc.

    `visible`: returns whether points (n, 2) of the unit disc are visible; `radial`: number of circles for the whole
    disc; `angular`: number of points for a whole circle.
    """
    s, gauss = _gauss(max(8, radial))
    s, gauss = 0.5 * (s + 1), 0.5 * gauss
    edges = _edges(visible) ** 2
    start, size = edges[:-1, None], np.diff(edges)[:, None]
    r = np.sqrt(start + size * (3 - 2 * s) * s * s).ravel()
    weight = (size * 6 * s * (1 - s) * gauss).ravel()
    which, begin, end = _arcs(visible, r)
    length = end - begin
    out = []
    for k in range(len(which)):
        x, share = _gauss(max(4, math.ceil(angular * length[k] / (2 * np.pi))))
        angle = begin[k] + 0.5 * length[k] * (x + 1)
        point = _polar(np.full(len(x), r[which[k]]), angle)
        out.append(Nodes(point, weight[which[k]] * length[k] / (2 * np.pi) * 0.5 * share))
    if not out:
        return Nodes(np.zeros((0, 2)), np.zeros(0))
    return Nodes(np.concatenate([n.point for n in out]), np.concatenate([n.weight for n in out]))


def _edges(visible: Visible) -> Floats:
    """Return radii from 0 to 1 between which all circles are alike: hidden, partly visible, or visible."""

    def kind(r: Floats) -> Floats:
        seen = _seen(visible, r, _ANGLES)
        return np.asarray(seen.any(axis=1).astype(float) + seen.all(axis=1))

    # The innermost circle is next to the centre, the outermost is the rim.
    low = np.append((np.arange(_CIRCLES) + 1e-3) / _CIRCLES, 1.0)
    kinds = kind(low)
    changes = np.flatnonzero(np.diff(kinds))
    low, high, inner = low[changes], low[changes + 1], kinds[changes]
    found = _first_changes(low, high, lambda r: kind(r.ravel()).reshape(r.shape) == inner[:, None])
    return np.concatenate([[0.0], found, [1.0]])


def _arcs(visible: Visible, r: Floats) -> tuple[Floats, Floats, Floats]:
    """Return visible arcs of circles of radii r (n,): index of the circle, and the angles of the arc's ends."""
    seen = _seen(visible, r, _ANGLES)
    steps = np.linspace(0, 2 * np.pi, _ANGLES + 1)
    whole = np.flatnonzero(seen.all(axis=1))
    # An arc begins after a hidden point, and ends after a visible one.
    rises = np.roll(seen, -1, axis=1) & ~seen
    falls = np.roll(~seen, -1, axis=1) & seen
    (which, first), (falling, last) = np.nonzero(rises), np.nonzero(falls)
    circle, k = np.append(which, falling), np.append(first, last)
    before = np.repeat([False, True], [len(which), len(falling)])

    def same(angle: Floats) -> Bools:
        points = _polar(np.broadcast_to(r[circle, None], angle.shape), angle)
        return np.asarray(visible(points).reshape(angle.shape) == before[:, None])

    begin, end = np.split(_first_changes(steps[k], steps[k + 1], same), [len(which)])
    # On each circle beginnings and ends alternate; an arc that contains angle 0 ends before it begins.
    for c in np.unique(which):
        here = which == c
        if end[here][0] < begin[here][0]:
            end[here] = np.append(end[here][1:], end[here][0] + 2 * np.pi)
    return (
        np.concatenate([whole, which]),
        np.concatenate([np.zeros(len(whole)), begin]),
        np.concatenate([np.full(len(whole), 2 * np.pi), end]),
    )


def _first_changes(low: Floats, high: Floats, same: Callable[[Floats], Bools]) -> Floats:
    """Find where something first changes between `low` and `high` (n,); `same` tells where it is still that of `low`.

    Few calls with many points each, because every call launches rays on the device.
    """
    share = np.arange(1, _PARTS) / _PARTS
    for _ in range(_STEPS if len(low) else 0):
        part = (high - low) / _PARTS
        before = np.cumprod(same(low[:, None] + (high - low)[:, None] * share), axis=1).sum(axis=1)
        low, high = low + before * part, low + (before + 1) * part
    return np.asarray(0.5 * (low + high))


def _seen(visible: Visible, r: Floats, angles: int) -> Bools:
    """Return which evenly spaced points of circles (n,) are visible, (n, angles)."""
    angle = 2 * np.pi * np.arange(angles) / angles
    return visible(_polar(*np.broadcast_arrays(r[:, None], angle))).reshape(len(r), angles)


def _polar(r: Floats, angle: Floats) -> Floats:
    return np.stack([(r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()], axis=1)
