"""Surfaces that are graphs x = h(y, z) in their own frame; ray hits by safeguarded Newton steps."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from .biconic_kernels import HALVINGS, SAMPLES, SEARCHED_MM, SETTLED_MM, STEPS, Jet, Slopes
from .surfaces import Hit, Surface, SymmetricMatrix, Xyz, fit, shift, turn, turn_back

_TOGETHER = 5  # Newton steps of all rays; almost all that meet the surface have settled by then


class GraphSurface(Surface):
    """A surface x = h(y, z) of the local frame.

    F = 2 (x - h(y, z)), so that the half gradient is (1, -dh/dy, -dh/dz), whose local x component is 1 everywhere: the
    sheet is the whole graph.
    """

    __slots__ = ()

    _untilted: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_untilted", bool(np.all(self.rotation == np.eye(3))))

    @property
    def untilted(self) -> bool:
        """Whether the local axes are those of the eye."""
        return self._untilted

    @abstractmethod
    def slopes(self, y: Floats, z: Floats) -> Slopes:
        """Compute height and slopes over the local (y, z)."""

    @abstractmethod
    def jet(self, y: Floats, z: Floats) -> Jet:
        """Compute height, slopes and second derivatives over the local (y, z)."""

    @abstractmethod
    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature and 1 + Q, (...,), of the approximating conic at which the search starts."""

    def hit(self, origin: Xyz, direction: Xyz, inward: bool) -> Hit:
        """Solve x - h(y, z) = 0 along the ray by Newton's method, starting at the hit on the approximating conic.

        Rays for which the steps do not converge are searched by bisection around that hit. The residual of every hit is
        checked.
        """
        start = self.local_point(origin)
        way = self.local_vector(direction)
        shape = np.broadcast_shapes(*(a.shape for a in (*start, *way)))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            guess, possible = self._conic_hit(start, way, len(shape), inward)
            t, error = self._newton(start, way, guess, possible)
            lost = possible & ~(np.abs(error) < SETTLED_MM)
            if lost.any():
                t, error = self._searched(start, way, guess, t, error, lost, inward)
            sag = self.slopes(start[1] + t * way[1], start[2] + t * way[2])
            crossing = way[0] - sag.y * way[1] - sag.z * way[2]
            ok = possible & (np.abs(error) < SETTLED_MM) & sag.inside & np.isfinite(t)
            ok &= crossing < 0.0 if inward else crossing > 0.0
        point = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
        return Hit(t, point, self.eye_vector((np.ones_like(sag.y), -sag.y, -sag.z)), ok)

    def _conic_hit(self, start: Xyz, way: Xyz, ndim: int, inward: bool) -> tuple[Floats, Bools]:
        """Intersect the conic of `likeness`, times its curvature: c (y^2 + z^2) + 2 x + c p x^2 = 0."""
        (ox, oy, oz), (dx, dy, dz) = start, way
        curvature, shape = (fit(value, ndim) for value in self.likeness())
        gx = 1.0 + curvature * shape * ox
        a = curvature * (1.0 + (shape - 1.0) * (dx * dx))
        b = gx * dx + curvature * (oy * dy + oz * dz)
        value = (gx + 1.0) * ox + curvature * (oy * oy + oz * oz)
        square = b * b - a * value
        root = np.sqrt(np.maximum(square, 0.0))
        t = value / (root - b) if inward else value / (-root - b)
        possible = np.asarray((square >= 0.0) & np.isfinite(t))
        return np.where(possible, t, 0.0), possible

    def _newton(self, start: Xyz, way: Xyz, guess: Floats, wanted: Bools, steps: int = STEPS) -> tuple[Floats, Floats]:
        """Take Newton steps from `guess`; return the distance and the error before the last step.

        After some steps, only the rays that have not settled take further ones: those that miss the surface never do.
        """
        (ox, oy, oz), (dx, dy, dz) = start, way
        t, error = guess, np.full_like(guess, np.inf)
        for step in range(1, steps + 1):
            sag = self.slopes(oy + t * dy, oz + t * dz)
            error = ox + t * dx - sag.x
            t = t - error / (dx - sag.y * dy - sag.z * dz)
            late = wanted & np.isfinite(error) & (np.abs(error) > SETTLED_MM)
            if not late.any():
                break
            if step == _TOGETHER and late.ndim:
                rows = np.nonzero(late)
                few, own, ways = self._rays(rows, late.shape, start, way)
                t[rows], error[rows] = few._newton(own, ways, t[rows], late[rows], steps - step)
                break
        return t, error

    def _rays(self, rows: tuple[Ints, ...], shape: tuple[int, ...], start: Xyz, way: Xyz) -> tuple[Self, Xyz, Xyz]:
        """Take rays with their surfaces: rows of arrays of a shape."""
        own, ways = ([np.broadcast_to(a, shape)[rows] for a in vector] for vector in (start, way))
        return self.take(rows[0]), (own[0], own[1], own[2]), (ways[0], ways[1], ways[2])

    def _searched(
        self, start: Xyz, way: Xyz, guess: Floats, t: Floats, error: Floats, lost: Bools, inward: bool
    ) -> tuple[Floats, Floats]:
        """Search `lost` rays: bisect the first change of sign near the guess, then apply Newton's method."""
        shape = lost.shape or (1,)
        t, error = (np.array(np.broadcast_to(a, shape)) for a in (t, error))
        rows = np.nonzero(lost.reshape(shape))
        few, own, ways = self._rays(rows, shape, start, way)
        low, high = few._bracketed(own, ways, np.broadcast_to(guess, shape)[rows], inward)
        t[rows] = np.nan
        crosses = ~np.isnan(low)
        if crosses.any():
            rows, low, high = tuple(row[crosses] for row in rows), low[crosses], high[crosses]
            few, own, ways = self._rays(rows, shape, start, way)
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                behind = few._side(own, ways, middle, inward) <= 0.0
                low, high = np.where(behind, low, middle), np.where(behind, middle, high)
            t[rows], error[rows] = few._newton(own, ways, 0.5 * (low + high), ~np.isnan(low))
        return t.reshape(lost.shape), error.reshape(lost.shape)

    def _bracketed(self, start: Xyz, way: Xyz, near: Floats, inward: bool) -> tuple[Floats, Floats]:
        """Find distances before and behind the first crossing within `SEARCHED_MM` of a guess, else NaN."""
        low, high = np.full(near.shape, np.nan), np.full(near.shape, np.nan)
        before, value = near - SEARCHED_MM, self._side(start, way, near - SEARCHED_MM, inward)
        for k in range(1, SAMPLES):
            after = near - SEARCHED_MM + 2.0 * SEARCHED_MM * k / (SAMPLES - 1)
            there = self._side(start, way, after, inward)
            found = np.isnan(low) & (value > 0.0) & (there <= 0.0)
            low, high = np.where(found, before, low), np.where(found, after, high)
            before, value = after, there
        return low, high

    def _side(self, start: Xyz, way: Xyz, t: Floats, inward: bool) -> Floats:
        """Return a positive number at distances before the crossing, a negative one behind it, else NaN."""
        (ox, oy, oz), (dx, dy, dz) = start, way
        value = ox + t * dx - self.local_sag(oy + t * dy, oz + t * dz)
        return value if inward else -value

    def value_at(self, point: Xyz) -> Floats:
        """Evaluate the implicit function F = 2 (x - h(y, z))."""
        x, y, z = self.local_point(point)
        return 2.0 * (x - self.slopes(y, z).x)

    def gradient_at(self, point: Xyz) -> Xyz:
        """Compute the half gradient (1, -dh/dy, -dh/dz) of the local frame, rotated to the eye frame."""
        _, y, z = self.local_point(point)
        sag = self.slopes(y, z)
        return self.eye_vector((np.ones_like(sag.y), -sag.y, -sag.z))

    def hessian_at(self, point: Xyz) -> SymmetricMatrix:
        """Compute the derivative of the half gradient, H with dg = H dp."""
        _, y, z = self.local_point(point)
        sag = self.jet(y, z)
        if self.untilted:
            return SymmetricMatrix(0.0, -sag.yy, -sag.zz, 0.0, 0.0, -sag.yz)
        r = [[fit(self.rotation[..., i, j], y.ndim) for j in range(3)] for i in range(3)]

        def entry(i: int, j: int) -> Floats:
            cross = r[i][1] * r[j][2] + r[i][2] * r[j][1]
            return np.asarray(-(r[i][1] * r[j][1] * sag.yy + r[i][2] * r[j][2] * sag.zz + cross * sag.yz))

        return SymmetricMatrix(entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2))

    def local_sag(self, y: Floats, z: Floats) -> Floats:
        """Compute the height x of the sheet over the local (y, z); NaN where the sheet does not reach."""
        sag = self.slopes(y, z)
        return np.asarray(np.where(sag.inside, sag.x, np.nan))

    def local_point(self, point: Xyz) -> Xyz:
        """Transform points of the eye frame to the local frame."""
        return self.local_vector(shift(point, self.origin_mm, -1.0))

    def local_vector(self, vector: Xyz) -> Xyz:
        """Rotate directions of the eye frame to the local frame."""
        return vector if self.untilted else turn_back(self.rotation, vector)

    def eye_vector(self, vector: Xyz) -> Xyz:
        """Rotate directions of the local frame to the eye frame."""
        return vector if self.untilted else turn(self.rotation, vector)
