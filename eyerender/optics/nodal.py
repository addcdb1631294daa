"""Rays that leave a path of surfaces parallel to their direction before it (nodal rays)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..base.arrays import Floats
from ..base.status import Status
from .trace import Crossing, Traced, trace
from .transforms import inverse_2x2, normalize

_STEP = 1e-5
_PARALLEL = 1e-13


def parallel_rays(path: Sequence[Crossing], objects_mm: Floats, guess_mm: Floats) -> tuple[Floats, Floats] | None:
    """Compute rays from objects (m, 3) in air that arrive at the last surface parallel to their direction at the start.

    They are first aimed at `guess_mm`. Returns directions (m, 3) at the start and points (m, 3) on the last surface;
    None if an object has no such ray.
    """
    direction, error, last = _solved(path, objects_mm, normalize(guess_mm - objects_mm))
    for k in np.flatnonzero(~(error < _PARALLEL)):
        row = slice(k, k + 1)
        # The ray meets the edge of a shell, where the index jumps. Solve it with the shells that it meets next to the
        # edge.
        met = crossed(path, trace(path, 1.0, objects_mm[row], direction[row]))
        direction[row], error[row], last[row] = _solved(met, objects_mm[row], direction[row])
    return (direction, last) if (error < _PARALLEL).all() else None


def _solved(path: Sequence[Crossing], objects_mm: Floats, direction: Floats) -> tuple[Floats, Floats, Floats]:
    """Solve by Newton's method: directions, |change of direction|, and points on the last surface."""
    for _ in range(30):
        first, second = _tangents(direction)
        bundle = np.stack([direction, direction + _STEP * first, direction + _STEP * second])
        traced = trace(path, 1.0, np.broadcast_to(objects_mm, bundle.shape), normalize(bundle))
        turn = traced.directions[-1] - traced.directions[0]
        error = np.stack([np.sum(turn * first, -1), np.sum(turn * second, -1)], axis=-1)
        ok = (traced.status == Status.OK).all(axis=0)
        size = np.where(ok, np.linalg.norm(error[0], axis=-1), np.inf)
        last = traced.points_mm[-1, 0]
        slope = np.stack([(error[1] - error[0]) / _STEP, (error[2] - error[0]) / _STEP], axis=-1)
        singular = ~ok | ~(np.abs(np.linalg.det(slope)) > 1e-12)
        slope = np.where(singular[:, None, None], np.eye(2), slope)
        step = np.einsum("nij,nj->ni", inverse_2x2(slope), np.where(singular[:, None], 0.0, error[0]))
        if np.max(np.abs(step)) < 1e-16:
            break
        direction = normalize(direction - step[..., :1] * first - step[..., 1:] * second)
    return direction, size, last


def crossed(path: Sequence[Crossing], traced: Traced) -> tuple[Crossing, ...]:
    """Return the surfaces that one traced ray (leading shape (1,)) met, without their rims."""
    moved = np.linalg.norm(np.diff(traced.points_mm[:, 0], axis=0), axis=-1) > 0.0
    return tuple(replace(c, rim_mm=np.inf, beyond_rim=Status.MISSED) for c, met in zip(path, moved, strict=True) if met)


def _tangents(direction: Floats) -> tuple[Floats, Floats]:
    first = normalize(np.cross(direction, np.array([0.0, 0.0, 1.0])))
    return first, np.cross(direction, first)
