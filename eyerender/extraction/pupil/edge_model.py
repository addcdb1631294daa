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
from typing import NamedTuple

import numpy as np

from ...base.arrays import Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from .places import BLOCK, PLACES, find_places, place_in, sector_at

# Phi and phi at z = -LAST to LAST in steps of 1 / FINE; a Taylor series of fourth order leads to 1e-11 between them.
FINE, LAST = 32, 8
_STEPS = np.arange(-LAST * FINE, LAST * FINE + 1) / FINE
_PHI = np.array([0.5 * math.erfc(-z * math.sqrt(0.5)) for z in _STEPS.tolist()])
_BELL = np.exp(-0.5 * _STEPS**2) / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgeModel:
    """The pupil's edge as a blurred step across an ellipse."""

    ellipse: Ellipse  # the pupil boundary
    inner_dn: float  # inner level, DN
    outer: Floats  # (1 + 2 K,) Fourier coefficients of the outer level (1, cos u, sin u, cos 2u, ...), DN
    sigma_px: float  # width of the blur
    slope: float = 0.0  # slope of the outer level, DN per px
    kurtosis: float = 0.0  # kurtosis of the blur beyond a Gaussian's 0
    lean: tuple[float, float] = (0.0, 0.0)  # (cos u, sin u) coefficients of the inner level, DN

    def numbers(self) -> Floats:
        """Return the parameters (11 + 1 + 2 K,).

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
        numbers = self.numbers()
        return levels_and_slopes(boundary_terms(x.ravel(), y.ravel(), numbers)[1], numbers)[0].reshape(x.shape)


class Profile(NamedTuple):
    """The blurred step and ramp across the boundary at one point.

    E, from 0 inside to 1 outside, with its derivatives by the distance, by the standard deviation of the blur and by
    its kurtosis; then R, the blurred max(d, 0), with the first two.
    """

    edge: float
    by_distance: float
    by_sigma: float
    by_kurtosis: float
    ramp: float
    ramp_by_distance: float
    ramp_by_sigma: float


PROFILES = 7 * BLOCK  # numbers in a block of profiles


@inlined
def profile_in(block: Floats, i: int) -> Profile:
    """Read profile i of a block (PROFILES,)."""
    return Profile(
        block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i],
        block[4 * BLOCK + i], block[5 * BLOCK + i], block[6 * BLOCK + i],
    )  # fmt: skip


@inlined
def put_profile(block: Floats, i: int, profile: Profile) -> None:
    """Write profile i of a block (PROFILES,)."""
    block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i] = profile[:4]
    block[4 * BLOCK + i], block[5 * BLOCK + i], block[6 * BLOCK + i] = profile[4:]


@inlined
def profile_at(distance: float, curvature: float, sigma: float, kurtosis: float) -> Profile:
    """Compute the profile at a distance from the boundary. The derivative of -(z^3 - 3 z) phi is He_4 phi."""
    z, half = min(max(distance / sigma, -float(LAST)), float(LAST)), 0.5 * curvature
    at = int(z * FINE + (LAST * FINE + 0.5))
    near = at * (1.0 / FINE) - LAST
    d, n2, bell, z2 = z - near, near * near, _BELL[at], z * z
    second, third, fourth = 0.5 * (n2 - 1.0), near * (3.0 - n2) / 6.0, (n2 * (n2 - 6.0) + 3.0) / 24.0
    density = bell * (1.0 + d * (-near + d * (second + d * (third + d * fourth))))
    series = 1.0 + d * (-0.5 * near + d * (second / 3.0 + d * (0.25 * third + d * 0.2 * fourth)))
    step, tails = _PHI[at] + bell * d * series, z * (3.0 - z2) * density / 24.0
    bend = density * (1.0 + (kurtosis / 24.0) * (z2 * (z2 - 6.0) + 3.0))
    return Profile(
        edge=step + half * sigma * density + kurtosis * tails,
        by_distance=bend / sigma - half * z * density,
        by_sigma=half * (1.0 + z2) * density - z * bend / sigma,
        by_kurtosis=tails,
        ramp=distance * step + sigma * density,
        ramp_by_distance=step,
        ramp_by_sigma=density,
    )


class Levels(NamedTuple):
    """Terms of the model's level at one point: inner + step E + within d + bend R.

    `within` is the slope inside, `bend` the change of the slope across the boundary.
    """

    inner: float
    step: float
    within: float
    bend: float


LEVELS = 4 * BLOCK  # numbers in a block of levels


@inlined
def levels_in(block: Floats, i: int) -> Levels:
    """Read levels i of a block (LEVELS,)."""
    return Levels(block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i])


@inlined
def put_levels(block: Floats, i: int, levels: Levels) -> None:
    """Write levels i of a block (LEVELS,)."""
    block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i] = levels


@inlined
def turn_harmonics(places: Floats, count: int, basis: Floats) -> None:
    """Advance the harmonics (cos k u, then sin k u) in basis (2 BLOCK,) to the next order."""
    for i in range(count):
        place, c, s = place_in(places, i), basis[i], basis[BLOCK + i]
        basis[i], basis[BLOCK + i] = c * place.cos_u - s * place.sin_u, s * place.cos_u + c * place.sin_u


@inlined
def local_levels(places: Floats, count: int, numbers: Floats, basis: Floats, out: Floats) -> None:
    """Write the levels of the model (see `EdgeModel.numbers`) at `count` of the places (PLACES,) to `out` (LEVELS,).

    `basis` (2 BLOCK,) is scratch memory.
    """
    outer, plane = numbers[11:], 1.0 / math.sqrt(numbers[2] * numbers[3])
    for i in range(count):
        place = place_in(places, i)
        lean = numbers[9] * place.cos_u + numbers[10] * place.sin_u
        step, within = outer[0] - numbers[6] - lean, lean * plane
        put_levels(out, i, Levels(numbers[6] + lean, step, within, numbers[7] - within))
        basis[i], basis[BLOCK + i] = 1.0, 0.0
    for j in range(1, outer.size, 2):
        turn_harmonics(places, count, basis)
        sloping = plane if j == 1 else 0.0
        for i in range(count):
            at, part = levels_in(out, i), outer[j] * basis[i] + outer[j + 1] * basis[BLOCK + i]
            put_levels(out, i, Levels(at.inner, at.step + part, at.within, at.bend + part * sloping))


@compiled("f8[::1], f8[::1], f8[::1]")
def boundary_terms(x: Floats, y: Floats, numbers: Floats) -> tuple[Indices, Floats]:
    """Compute what the level at pixels (n,) depends on.

    Returns:
        Sectors (n,); distance, curvature, cos u, sin u and the four `Levels` as rows (8, n).
    """
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    bins, out = np.empty(x.size, dtype=np.int64), np.empty((8, x.size))
    places, basis, levels = np.empty(PLACES), np.empty(2 * BLOCK), np.empty(LEVELS)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        find_places(ellipse, x, y, start, count, places)
        local_levels(places, count, numbers, basis, levels)
        for i in range(count):
            place, k = place_in(places, i), start + i
            bins[k] = sector_at(place.cos_u, place.sin_u)
            out[0, k], out[1, k], out[2, k], out[3, k] = place.distance, place.curvature, place.cos_u, place.sin_u
            out[4, k], out[5, k], out[6, k], out[7, k] = levels_in(levels, i)
    return bins, out


@compiled("f8[:,::1], f8[::1]")
def levels_and_slopes(terms: Floats, numbers: Floats) -> tuple[Floats, Floats]:
    """Compute levels (n,) and their derivatives by the distance (n,), from the terms (8, n) of `boundary_terms`."""
    level, slope = np.empty(terms.shape[1]), np.empty(terms.shape[1])
    for k in range(level.size):
        distance, at = terms[0, k], Levels(terms[4, k], terms[5, k], terms[6, k], terms[7, k])
        profile = profile_at(distance, terms[1, k], numbers[5], numbers[8])
        level[k] = at.inner + at.step * profile.edge + at.within * distance + at.bend * profile.ramp
        slope[k] = at.step * profile.by_distance + at.within + at.bend * profile.ramp_by_distance
    return level, slope
