"""The pixel model of a pupil's boundary: two levels and the blurred convex edge between them.

    I = inner(u) (1 - E) + outer(u) E + inner'(u) (d - R) + outer'(u) R
    R(d) = d Phi(z) + s phi(z)
    E(d) = Phi(z) + (kappa s / 2) phi(z) - (g / 24) (z^3 - 3 z) phi(z),   z = d / s

d is the signed distance to the ellipse (positive outside) and kappa the curvature of the boundary at the nearest point.
s is the standard deviation of the blur and includes the pixel (s^2 = optics^2 + 1/12). Phi and phi are the normal
distribution and its density. The second term of E is the first order in s kappa of a blurred disc. The third term gives
the blur heavier tails than a normal distribution; g is its excess kurtosis (Edgeworth series).

outer is a Fourier series in u = t + angle: the ellipse's parameter t counted from the image's x axis, so it does not
turn with the axes of a nearly round ellipse. inner is a series of first order. R is a blurred ramp. Lamps beside the
camera shade pupil and iris like a plane, so the terms of first order continue across the boundary: inner' and outer',
the changes per px, are these terms over sqrt(a b). outer' also has a constant, the slope, because the iris may become
brighter or darker outwards on all sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from .places import BLOCK, COS_U, CURVATURE, SIN_U, places, sector_at

# Columns of a block of profiles, all by the distance d: the edge E (first), its derivatives by the distance, sigma and
# the kurtosis, the blurred ramp max(d, 0), and its derivatives by the distance and sigma.
BY_DISTANCE, BY_SIGMA, BY_KURTOSIS, RAMP, RAMP_BY_DISTANCE, RAMP_BY_SIGMA = (k * BLOCK for k in range(1, 7))

# Columns of a block of local levels; the inner level comes first.
STEP, WITHIN, BEND = (k * BLOCK for k in range(1, 4))

# Phi and phi at z = -LAST to LAST in steps of 1 / FINE; a Taylor series of fourth order leads to 1e-11 between them.
FINE, LAST = 32, 8
_STEPS = np.arange(-LAST * FINE, LAST * FINE + 1) / FINE
_PHI = np.array([0.5 * math.erfc(-z * math.sqrt(0.5)) for z in _STEPS.tolist()])
_BELL = np.exp(-0.5 * _STEPS**2) / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgeModel:
    """The pupil's edge as a blurred step across an ellipse.

    Attributes:
        ellipse: the pupil boundary.
        inner_dn: inner level, DN.
        outer: (1 + 2 K,) Fourier coefficients of the outer level (1, cos u, sin u, cos 2u, ...), DN.
        sigma_px: width of the blur.
        slope: slope of the outer level, DN per px.
        kurtosis: kurtosis of the blur beyond a Gaussian's 0.
        lean: (cos u, sin u) coefficients of the inner level, DN.
        displaced: (SECTORS,) displacement of the boundary's sectors into the ellipse, px.
    """

    ellipse: Ellipse
    inner_dn: float
    outer: Floats
    sigma_px: float
    slope: float = 0.0
    kurtosis: float = 0.0
    lean: tuple[float, float] = (0.0, 0.0)
    displaced: Floats | None = None

    def numbers(self) -> Floats:
        """Return the parameters (11 + 1 + 2 K,) without the displacements.

        In order: centre, semi-axes, angle, sigma, inner level, slope, kurtosis, lean (two) and `outer`.
        """
        ellipse = self.ellipse
        head = ellipse.numbers()
        rest = (self.sigma_px, self.inner_dn, self.slope, self.kurtosis, *self.lean)
        return np.array([*head, *rest, *self.outer.tolist()])

    @staticmethod
    def of(numbers: Floats) -> EdgeModel:
        """Create the model from parameters in the order of `numbers`."""
        sigma, inner, slope, kurtosis, lean_x, lean_y = numbers[5:11].tolist()
        return EdgeModel(
            ellipse=Ellipse.of(numbers),
            inner_dn=inner,
            outer=numbers[11:],
            sigma_px=sigma,
            slope=slope,
            kurtosis=kurtosis,
            lean=(lean_x, lean_y),
        )

    @property
    def step_dn(self) -> float:
        """Mean outer level minus the inner level."""
        return float(self.outer[0]) - self.inner_dn

    def level(self, x: Floats, y: Floats) -> Floats:
        """Compute the expected grey level at pixels (x, y) of any shape."""
        displaced = _EXACT if self.displaced is None else self.displaced
        return _levels(self.numbers(), displaced, x.ravel(), y.ravel()).reshape(x.shape)


_EXACT = np.zeros(0)


@inlined
def profiles(place: Floats, count: int, sigma: float, kurtosis: float, out: Floats) -> None:
    """Write the blurred step and ramp across the boundary at `count` positions, as columns of out (7 BLOCK,).

    E goes from 0 inside to 1 outside. The derivative of -(z^3 - 3 z) phi is He_4 phi.

    Args:
        place: (8 BLOCK,) of `places`.
        count: number of points.
        sigma: standard deviation of the blur, px.
        kurtosis: excess kurtosis of the blur.
        out: (7 BLOCK,) edge, its derivatives, ramp and its derivatives.
    """
    for i in range(count):
        z, half = min(max(place[i] / sigma, -float(LAST)), float(LAST)), 0.5 * place[CURVATURE + i]
        at = int(z * FINE + (LAST * FINE + 0.5))
        near = at * (1.0 / FINE) - LAST
        d, n2, bell, z2 = z - near, near * near, _BELL[at], z * z
        second, third, fourth = 0.5 * (n2 - 1.0), near * (3.0 - n2) / 6.0, (n2 * (n2 - 6.0) + 3.0) / 24.0
        density = bell * (1.0 + d * (-near + d * (second + d * (third + d * fourth))))
        series = 1.0 + d * (-0.5 * near + d * (second / 3.0 + d * (0.25 * third + d * 0.2 * fourth)))
        step, tails = _PHI[at] + bell * d * series, z * (3.0 - z2) * density / 24.0
        bend = density * (1.0 + (kurtosis / 24.0) * (z2 * (z2 - 6.0) + 3.0))
        out[i] = step + half * sigma * density + kurtosis * tails
        out[BY_DISTANCE + i] = bend / sigma - half * z * density
        out[BY_SIGMA + i] = half * (1.0 + z2) * density - z * bend / sigma
        out[BY_KURTOSIS + i], out[RAMP + i] = tails, place[i] * step + sigma * density
        out[RAMP_BY_DISTANCE + i], out[RAMP_BY_SIGMA + i] = step, density


@inlined
def turn_harmonics(place: Floats, count: int, basis: Floats) -> None:
    """Advance the harmonics (cos k u, then sin k u) in basis (2 BLOCK,) to the next order."""
    for i in range(count):
        c, s, cu, su = basis[i], basis[BLOCK + i], place[COS_U + i], place[SIN_U + i]
        basis[i], basis[BLOCK + i] = c * cu - s * su, s * cu + c * su


@inlined
def local_levels(place: Floats, count: int, numbers: Floats, basis: Floats, out: Floats) -> None:
    """Write the terms of the model's level at `count` positions, as columns of out (4 BLOCK,).

    The level is inner + step E + within d + bend R, where within is the slope inside and bend the change of the slope
    across the boundary.

    Args:
        place: (8 BLOCK,) of `places`.
        count: number of points.
        numbers: (p,) the model (see `EdgeModel.numbers`).
        basis: (2 BLOCK,) scratch memory.
        out: (4 BLOCK,) the result.
    """
    outer, plane = numbers[11:], 1.0 / math.sqrt(numbers[2] * numbers[3])
    for i in range(count):
        lean = numbers[9] * place[COS_U + i] + numbers[10] * place[SIN_U + i]
        out[i], out[STEP + i] = numbers[6] + lean, outer[0] - numbers[6] - lean
        out[WITHIN + i], out[BEND + i] = lean * plane, numbers[7] - lean * plane
        basis[i], basis[BLOCK + i] = 1.0, 0.0
    for j in range(1, outer.size, 2):
        turn_harmonics(place, count, basis)
        for i in range(count):
            part = outer[j] * basis[i] + outer[j + 1] * basis[BLOCK + i]
            out[STEP + i] += part
            if j == 1:
                out[BEND + i] += part * plane


@compiled("f8[::1], f8[::1], f8[::1]")
def boundary_terms(x: Floats, y: Floats, numbers: Floats) -> tuple[Indices, Floats]:
    """Compute what the level at pixels (n,) depends on, except the displacement of the boundary.

    Returns:
        Sectors (n,); distance, curvature, cos u, sin u and the four `local_levels` as rows (8, n).
    """
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    bins, out = np.empty(x.size, dtype=np.int64), np.empty((8, x.size))
    place, basis, local = np.empty(8 * BLOCK), np.empty(2 * BLOCK), np.empty(4 * BLOCK)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, place)
        local_levels(place, count, numbers, basis, local)
        for i in range(count):
            bins[start + i] = sector_at(place[COS_U + i], place[SIN_U + i])
            out[0, start + i], out[1, start + i] = place[i], place[CURVATURE + i]
            out[2, start + i], out[3, start + i] = place[COS_U + i], place[SIN_U + i]
            for k in range(4):
                out[4 + k, start + i] = local[k * BLOCK + i]
    return bins, out


@compiled("f8[:,::1], f8[::1], f8[::1]")
def levels_and_slopes(terms: Floats, displaced: Floats, numbers: Floats) -> tuple[Floats, Floats]:
    """Compute levels (n,) and their derivatives by the distance (n,), from the terms (8, n) of `boundary_terms`.

    The boundary at each pixel is `displaced` (n,) px into the ellipse.
    """
    n = displaced.size
    level, slope, place, edge = np.empty(n), np.empty(n), np.empty(8 * BLOCK), np.empty(7 * BLOCK)
    for start in range(0, n, BLOCK):
        count = min(BLOCK, n - start)
        for i in range(count):
            place[i], place[CURVATURE + i] = terms[0, start + i] + displaced[start + i], terms[1, start + i]
        profiles(place, count, numbers[5], numbers[8], edge)
        for i in range(count):
            k = start + i
            inner, step, within, bend = terms[4, k], terms[5, k], terms[6, k], terms[7, k]
            level[k] = inner + step * edge[i] + within * place[i] + bend * edge[RAMP + i]
            slope[k] = step * edge[BY_DISTANCE + i] + within + bend * edge[RAMP_BY_DISTANCE + i]
    return level, slope


def _levels(numbers: Floats, displaced: Floats, x: Floats, y: Floats) -> Floats:
    """Compute levels (n,) of the model with these parameters; `displaced` is empty for an exact ellipse."""
    terms, between = boundary_terms(x, y, numbers)[1], np.zeros(x.size)
    if displaced.size:
        at = (np.arctan2(terms[3], terms[2]) / (2.0 * np.pi) + 0.5) * displaced.size - 0.5
        low = np.floor(at).astype(np.intp)
        first, second = displaced[low % displaced.size], displaced[(low + 1) % displaced.size]
        between = first + (at - low) * (second - first)
    return levels_and_slopes(terms, between, numbers)[0]


def longest_gap(held: Bools) -> float:
    """Compute the share of the outline in the longest run of sectors that are not held; 1 if none is."""
    at = np.flatnonzero(held)
    if at.size == 0:
        return 1.0
    return float(np.diff(np.append(at, at[0] + held.size)).max() - 1) / held.size
