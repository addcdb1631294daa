"""Trace rays through a medium whose index decreases from a core to its edge, as in the lens of the eye.

The medium lies between a front and a back surface. Each of them, scaled by p about the centre, is a surface of constant
index (p = 1: the surface itself):

    n(p) = n_core - (n_core - n_edge) p^2

With q the point relative to the centre, a quadric scaled by p is p^2 = 2 p b.q + q.A q, so that

    p = b.q + s,  s = sqrt((b.q)^2 + q.A q),    grad p = (p b + A q) / s,
    grad grad p = (A + b (grad p)^T + (grad p) b^T - (grad p)(grad p)^T) / s.

A point belongs to the front half where the front's p is the larger one, else to the back half. The halves meet at a
ridge. The index is continuous there; its gradient is not.

The ray equation d^2 r / dt^2 = grad(n^2 / 2), dt = ds / n, is solved by a Runge-Kutta-Nystrom scheme of fourth order
(Sharma, Kumar and Ghatak 1982, "Tracing rays through graded-index media: a new method", Appl. Opt. 21, 984-987). It
takes STEPS equal steps to the ridge and STEPS from there to the surface where the ray leaves. Each half ends with short
steps that reach the ridge and the surface to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Floats, Indices
from .surfaces import Hit, Surface, Xyz, fit
from .surfaces_quadric import Quadric
from .transforms import MIRROR, flip_y, read_only

STEPS = 32
"""Steps in each half. Twice as many change the direction behind a human lens by less than 1e-5 deg for any ray through
its pupil, and by some 1e-7 deg for most."""

_LANDINGS = 3
_AIMS = 4
_OUTSIDE = 1e-9


class Passage(NamedTuple):
    """Rays (m,) that have crossed the medium, where they meet the far surface."""

    hit: Hit  # the intersection; its `distance` is 0
    way: Xyz  # unit direction on arrival
    optical_path_mm: Floats  # the integral of n ds
    moves: list[Xyz]  # differentials of the point on the surface, one for each given one
    turns: list[Xyz]  # differentials of the direction, one for each given one


@dataclass(frozen=True, slots=True, eq=False)
class GradientMedium(ArrayValue):
    """The medium between two quadrics; one, or a batch of n with a leading axis."""

    centre_mm: Floats  # (..., 3) centre
    matrices: Floats  # (..., 2, 3, 3) A of the front and the back
    vectors: Floats  # (..., 2, 3) b of the front and the back
    core: Floats  # (...,) n_core
    fall: Floats  # (...,) n_core - n_edge

    def __post_init__(self) -> None:
        for name in ("centre_mm", "matrices", "vectors", "core", "fall"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @classmethod
    def between(cls, front: Quadric, back: Quadric, centre_mm: Floats, edge: float, core: float) -> GradientMedium:
        """Create the medium between two single surfaces on either side of `centre_mm` (3,)."""
        matrices, vectors = [], []
        for surface in (front, back):
            xx, yy, zz, xy, xz, yz, bx, by, bz, c = (float(v) for v in surface.coefficients)
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            vector = np.array([bx, by, bz])
            value = centre_mm @ matrix @ centre_mm + 2.0 * vector @ centre_mm + c
            matrices.append(-matrix / value)
            vectors.append(-(matrix @ centre_mm + vector) / value)
        return cls(centre_mm, np.stack(matrices), np.stack(vectors), np.array(core), np.array(core - edge))

    def index_at(self, points_mm: npt.ArrayLike) -> Floats:
        """Compute the refractive index n at points (..., 3) of the lens; (n, ..., 3) for a batch of n media."""
        points = np.moveaxis(np.asarray(points_mm, dtype=np.float64), -1, 0)
        front, back = self._halves(points.ndim - 1)
        seen = points - _first(self.centre_mm, points.ndim - 1)
        size = np.maximum(front.at(seen).size, back.at(seen).size)
        return np.asarray(front.core - front.fall * size * size)

    def cross(
        self,
        surface: Surface,  # the surface through which the rays leave
        inward: bool,  # whether the rays go from the front to the back
        point: Xyz,  # start points of the rays
        way: Xyz,  # directions of the rays behind the first surface
        moves: Sequence[Xyz] = (),  # differentials of `point` (along the surface) to propagate
        turns: Sequence[Xyz] = (),  # differentials of `way` to propagate
        steps: int | None = None,  # steps in each half; None: STEPS
    ) -> Passage:
        """Trace rays between the surfaces of the medium; `hit.ok` is False for one that leaves where it entered."""
        steps = STEPS if steps is None else steps
        place, speed = _stacked(point, way)
        ndim = place.ndim - 1
        halves = self._halves(ndim)
        first, last = halves if inward else halves[::-1]
        edge, centre = first.core - first.fall, _first(self.centre_mm, ndim)
        carried = [_stacked(move, turn) for move, turn in zip(moves, turns, strict=True)]
        rays = _Rays(
            place - centre,
            edge * speed,
            np.zeros(place.shape[1:]),
            [(np.broadcast_to(move, place.shape), edge * turn) for move, turn in carried],
        )
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            rays = _to_ridge(rays, first, last, steps)
            ok = np.asarray(last.at(rays.place).size <= 1.0 + _OUTSIDE)
            pace = np.sqrt(_dot(rays.speed, rays.speed))
            chord = surface.hit(_xyz(rays.place + centre), _xyz(rays.speed / pace), inward)
            ok &= chord.ok & (chord.distance > -_OUTSIDE)
            rays = _march(rays, last, np.where(ok, chord.distance, 0.0) / pace, steps)
            for _ in range(_LANDINGS):
                here = last.at(rays.place)
                rays = _step(rays, last, (1.0 - here.size) / _dot(here.slope, rays.speed))
            here = last.at(rays.place)
            ok &= np.abs(here.size - 1.0) < _OUTSIDE
            # These differentials are for a common time. On the surface they are for the point where each ray meets it.
            rate, pull = _dot(here.slope, rays.speed), last.pull(here)
            pace = np.sqrt(_dot(rays.speed, rays.speed))
            end = rays.speed / pace
            out_moves, out_turns = [], []
            for move, turn in rays.differentials:
                late = -_dot(here.slope, move) / rate
                turned = (turn + late * pull) / pace
                out_moves.append(_xyz(move + late * rays.speed))
                out_turns.append(_xyz(turned - _dot(end, turned) * end))
        place = rays.place + centre
        ok &= np.isfinite(place).all(axis=0)
        arrived = _xyz(place)
        hit = Hit(np.zeros(ok.shape), arrived, surface.gradient_at(arrived), ok)
        return Passage(hit, _xyz(end), rays.optical_path_mm, out_moves, out_turns)

    def _halves(self, ndim: int) -> tuple[_Half, _Half]:
        """Return front and back with parameters that broadcast with components (3, ...) of `ndim` further axes."""
        core, fall = (np.asarray(fit(value, ndim)) for value in (self.core, self.fall))
        front, back = (
            _Half(
                tuple(_first(self.matrices[..., k, :, j], ndim) for j in range(3)),
                _first(self.vectors[..., k, :], ndim),
                core,
                fall,
            )
            for k in (0, 1)
        )
        return front, back

    def take(self, index: Indices) -> GradientMedium:
        """Select media of the batch by `index`; a single medium is returned unchanged."""
        return self if self.core.ndim == 0 else GradientMedium(*(part[index] for part in self._parts()))

    def mirrored(self) -> GradientMedium:
        """Mirror the medium, for the other eye."""
        return GradientMedium(
            flip_y(self.centre_mm), MIRROR @ self.matrices @ MIRROR, flip_y(self.vectors), self.core, self.fall
        )

    @classmethod
    def stack(cls, media: Sequence[GradientMedium]) -> GradientMedium:
        """Combine single media into a batch."""
        return cls(*(np.stack(parts) for parts in zip(*(m._parts() for m in media), strict=True)))

    def _parts(self) -> tuple[Floats, ...]:
        return self.centre_mm, self.matrices, self.vectors, self.core, self.fall


class _Size(NamedTuple):
    """Scale p, the root s and grad p at some points."""

    size: Floats
    s: Floats
    slope: Floats


class _Half(NamedTuple):
    """One half of the medium; vectors have their components first: (3, ...)."""

    columns: tuple[Floats, ...]
    vector: Floats
    core: Floats
    fall: Floats

    def at(self, q: Floats) -> _Size:
        turned = self._turned(q)
        lead = _dot(self.vector, q)
        s = np.sqrt(lead * lead + _dot(q, turned))
        s = np.maximum(s, 1e-300)  # at the centre, every product with p vanishes
        size = lead + s
        return _Size(size, s, (turned + size * self.vector) / s)

    def index_of(self, here: _Size) -> Floats:
        return np.asarray(self.core - self.fall * (here.size * here.size))

    def pull(self, here: _Size) -> Floats:
        """Compute the acceleration grad(n^2 / 2) = -2 n (n_core - n_edge) p grad p."""
        return np.asarray(-2.0 * self.fall * self.index_of(here) * here.size * here.slope)

    def bend(self, here: _Size, move: Floats) -> Floats:
        """Compute the derivative of the pull along `move`."""
        index, slope = self.index_of(here), here.slope
        rise = _dot(slope, move)
        # s times (grad grad p) move
        curve = self._turned(move) + rise * self.vector + (_dot(self.vector, move) - rise) * slope
        by_size = 4.0 * self.fall * self.fall * here.size * here.size - 2.0 * self.fall * index
        return np.asarray(by_size * rise * slope - 2.0 * self.fall * index * here.size / here.s * curve)

    def _turned(self, q: Floats) -> Floats:
        x, y, z = self.columns
        return np.asarray(x * q[0] + y * q[1] + z * q[2])


class _Rays(NamedTuple):
    """Points relative to the centre, dr/dt, the optical path so far, and differentials of point and dr/dt."""

    place: Floats
    speed: Floats
    optical_path_mm: Floats
    differentials: list[tuple[Floats, Floats]]


def _to_ridge(rays: _Rays, first: _Half, last: _Half, steps: int) -> _Rays:
    """Trace rays through the first half of the lens to the ridge, where the parameters p of both halves are equal."""
    # The straight line gives the time to its point closest to the centre.
    time = -_dot(rays.place, rays.speed) / _dot(rays.speed, rays.speed)
    for _ in range(_AIMS):
        time = time + _to_go(rays.place + time * rays.speed, rays.speed, first, last)
    rays = _march(rays, first, np.where(np.isfinite(time), np.maximum(time, 0.0), 0.0), steps)
    for _ in range(_LANDINGS):
        rays = _step(rays, first, _to_go(rays.place, rays.speed, first, last))
    if not rays.differentials:
        return rays
    # Neighbouring rays meet the ridge earlier or later, and the acceleration behind it differs.
    before, after = first.at(rays.place), last.at(rays.place)
    slope, jump = before.slope - after.slope, first.pull(before) - last.pull(after)
    late = -_per_time(slope, rays.speed)
    met = [(move, turn + _dot(slope, move) * late * jump) for move, turn in rays.differentials]
    return rays._replace(differentials=met)


def _to_go(place: Floats, speed: Floats, first: _Half, last: _Half) -> Floats:
    """Compute Newton's step in time to the ridge."""
    a, b = first.at(place), last.at(place)
    return np.asarray((b.size - a.size) * _per_time(a.slope - b.slope, speed))


def _per_time(slope: Floats, speed: Floats) -> Floats:
    """Invert the rate slope . speed; 0 where both halves are the same sphere and any point may be the ridge."""
    rate = _dot(slope, speed)
    return np.where(np.abs(rate) > 1e-9, 1.0 / rate, 0.0)


def _march(rays: _Rays, half: _Half, time: Floats, steps: int) -> _Rays:
    h = time / steps
    for _ in range(steps):
        rays = _step(rays, half, h)
    return rays


def _step(rays: _Rays, half: _Half, h: Floats) -> _Rays:
    """Take one step of the scheme.

    A, B and C of the source are h times the pulls. The optical path uses Simpson's rule.
    """
    place, speed = rays.place, rays.speed
    one = half.at(place)
    a = h * half.pull(one)
    two = half.at(place + h * (0.5 * speed + 0.125 * a))
    b = h * half.pull(two)
    three = half.at(place + h * (speed + 0.5 * b))
    c = h * half.pull(three)
    differentials = []
    for move, turn in rays.differentials:
        da = h * half.bend(one, move)
        db = h * half.bend(two, move + h * (0.5 * turn + 0.125 * da))
        dc = h * half.bend(three, move + h * (turn + 0.5 * db))
        differentials.append((move + h * (turn + (da + 2.0 * db) / 6.0), turn + (da + 4.0 * db + dc) / 6.0))
    path = half.index_of(one) ** 2 + 4.0 * half.index_of(two) ** 2 + half.index_of(three) ** 2
    return _Rays(
        place + h * (speed + (a + 2.0 * b) / 6.0),
        speed + (a + 4.0 * b + c) / 6.0,
        rays.optical_path_mm + h / 6.0 * path,
        differentials,
    )


def _first(values: Floats, ndim: int) -> Floats:
    """Reshape components (3,) or (n, 3) to (3, 1, ...) or (3, n, 1, ...)."""
    moved = np.moveaxis(values, -1, 0)
    return moved.reshape(moved.shape + (1,) * (ndim + 1 - moved.ndim))


def _stacked(first: Xyz, second: Xyz) -> tuple[Floats, Floats]:
    shape = np.broadcast_shapes(*(part.shape for part in (*first, *second)))
    one, two = (np.stack([np.broadcast_to(part, shape) for part in parts]) for parts in (first, second))
    return one, two


def _xyz(vector: Floats) -> Xyz:
    return vector[0], vector[1], vector[2]


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray((a * b).sum(axis=0))
