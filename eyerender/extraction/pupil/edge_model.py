"""The pixel model of a pupil's boundary: two levels and the blurred convex edge between them.

    I = inner(u) (1 - E) + outer(u) E + slope (d Phi(d / s) + s phi(d / s))
    E(d) = Phi(z) + (kappa s / 2) phi(z) - (g / 24) (z^3 - 3 z) phi(z),   z = d / s

d is the signed distance to the ellipse (positive outside) and kappa the curvature of the boundary at the nearest point.
s is the standard deviation of the blur and includes the pixel (s^2 = optics^2 + 1/12). Phi and phi are the normal
distribution and its density. The second term of E is the first order in s kappa of a blurred disc. The third term gives
the blur heavier tails than a normal distribution; g is its excess kurtosis (Edgeworth series).

outer is a Fourier series in u = t + angle: the ellipse's parameter t counted from the image's x axis. It therefore does
not turn when the axes of a nearly round ellipse do. inner is a series of first order, for iris light that is scattered
into the pupil. The slope multiplies a blurred ramp: the iris may grow brighter or darker outwards, as it does when the
lamps stand beside the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from ...arrays import Bools, Floats, Indices
from ...geometry.ellipse import Ellipse
from ..compiled import twin

SECTORS = 48  # equal steps of the ellipse's parameter u
NEAR = 2  # steps to the nearest point; the band is within a few tenths of b, the boundary's own pixels closer
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


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
        displaced: (SECTORS,) how far the boundary's sectors lie inside the ellipse, px.
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
        """The parameters (11 + 1 + 2 K,) without the displacements.

        They are the centre, the semi-axes and the angle, sigma, inner level, slope, kurtosis, lean (two) and `outer`.
        """
        ellipse = self.ellipse
        head = ellipse.numbers()
        rest = (self.sigma_px, self.inner_dn, self.slope, self.kurtosis, *self.lean)
        return np.array([*head, *rest, *self.outer.tolist()])

    @staticmethod
    def of(numbers: Floats) -> EdgeModel:
        """Make the model of the parameters that `numbers` gives."""
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
        """Expected grey level at pixels (x, y) of any shape."""
        displaced = _EXACT if self.displaced is None else self.displaced
        return _levels(self.numbers(), displaced, x.ravel(), y.ravel()).reshape(x.shape)

    def level_and_slope(self, place: Place) -> tuple[Floats, Floats]:
        """Expected grey level (n,) near the boundary of an exact ellipse, and its derivative by distance, DN per px."""
        profile = Profile.of(place.distance, place.curvature, self.sigma_px, self.kurtosis)
        inner = self.inner(place)
        step = self.outer @ harmonics(place.cos_u, place.sin_u, (self.outer.size - 1) // 2) - inner
        level = inner + step * profile.edge + self.slope * profile.ramp
        return level, step * profile.edge_by_distance + self.slope * profile.ramp_by_distance

    def inner(self, place: Place) -> Floats:
        """Inner level (n,) at places about the boundary."""
        return self.inner_dn + self.lean[0] * place.cos_u + self.lean[1] * place.sin_u


_EXACT = np.zeros(0)


@twin
def _levels(numbers: Floats, displaced: Floats, x: Floats, y: Floats) -> Floats:
    """Levels (n,) of the model of these numbers; `displaced` is empty for an exact ellipse."""
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y)
    if displaced.size:
        place = replace(place, distance=place.distance + _between(displaced, place))
    return model.level_and_slope(place)[0]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where points (n,) lie relative to an ellipse.

    It holds the signed distance, the nearest point's parameter (cos t, sin t), the outward normal there in the
    ellipse's own axes (nx, ny), the curvature, and the parameter counted from the image's x axis (cos u, sin u).
    """

    distance: Floats
    cos_t: Floats
    sin_t: Floats
    nx: Floats
    ny: Floats
    curvature: Floats
    cos_u: Floats
    sin_u: Floats

    def taken(self, which: Bools | Indices) -> Place:
        """Places of the chosen points."""
        parts = (self.distance, self.cos_t, self.sin_t, self.nx, self.ny, self.curvature, self.cos_u, self.sin_u)
        return Place(*(part[which] for part in parts))

    @staticmethod
    def middles(ellipse: Ellipse, count: int = SECTORS) -> Place:
        """Places on the ellipse, in the middle of each of `count` sectors."""
        t = 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5) - ellipse.angle_rad
        return Place.on(ellipse, np.cos(t), np.sin(t))

    @staticmethod
    def on(ellipse: Ellipse, cos_t: Floats, sin_t: Floats) -> Place:
        """Places on the ellipse itself."""
        a, b = ellipse.semi_axes_px.tolist()
        nx, ny = b * cos_t, a * sin_t
        height = np.sqrt(nx * nx + ny * ny)
        turned = _turned(cos_t, sin_t, ellipse.angle_rad)
        return Place(np.zeros_like(height), cos_t, sin_t, nx / height, ny / height, a * b / height**3, *turned)

    @staticmethod
    def of(ellipse: Ellipse, x: Floats, y: Floats, steps: int = 3) -> Place:
        """Find places by Newton's iteration on the nearest point's parameter, from the point's own direction.

        f(t) = (a^2 - b^2) cos t sin t - a p sin t + b q cos t = 0. Three steps reach 1e-6 px up to b / 2 away.
        """
        a, b = (float(value) for value in ellipse.semi_axes_px)
        cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
        dx, dy = x - ellipse.centre_px[0], y - ellipse.centre_px[1]
        p, q = dx * cos + dy * sin, dy * cos - dx * sin
        c, s = p / a, q / b
        length = np.sqrt(c * c + s * s)
        length[length == 0.0] = 1.0
        c, s = c / length, s / length
        eccentric = a * a - b * b
        if eccentric > 1e-9 * a * a:
            ap, bq = a * p, b * q
            for _ in range(steps):
                value = eccentric * c * s - ap * s + bq * c
                slope = eccentric * (c * c - s * s) - ap * c - bq * s
                # Far inside (beyond the evolute) the slope changes sign, but no pixel is used there.
                turn = np.minimum(np.maximum(value / np.minimum(slope, -1e-9), -0.3), 0.3)
                c, s = c + turn * s, s - turn * c
                length = np.sqrt(c * c + s * s)
                c, s = c / length, s / length
        nx, ny = b * c, a * s
        height = np.sqrt(nx * nx + ny * ny)
        nx, ny = nx / height, ny / height
        distance = (p - a * c) * nx + (q - b * s) * ny
        turned = _turned(c, s, ellipse.angle_rad)
        return Place(distance, c, s, nx, ny, a * b / height**3, *turned)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Profile:
    """The blurred step and ramp across the boundary, all (n,).

    `edge` E goes from 0 inside to 1 outside; `ramp` is max(d, 0) blurred. Both have their derivatives by the distance d
    (px), by sigma (px) and by the kurtosis.
    """

    edge: Floats
    edge_by_distance: Floats
    edge_by_sigma: Floats
    edge_by_kurtosis: Floats
    ramp: Floats
    ramp_by_distance: Floats
    ramp_by_sigma: Floats

    @staticmethod
    def of(distance: Floats, curvature: Floats, sigma: float, kurtosis: float = 0.0) -> Profile:
        """Compute the profile.

        Args:
            distance: (n,) px from the boundary.
            curvature: (n,) 1/px of the nearest point of the boundary.
            sigma: standard deviation of the blur, px.
            kurtosis: its excess kurtosis.
        """
        z = distance / sigma
        z2 = z * z
        density = _DENSITY * np.exp(-0.5 * z2)
        step = ndtr(z)
        half = 0.5 * curvature
        tails = z * (3.0 - z2) * density / 24.0
        # The derivative of -(z^3 - 3 z) phi is He_4 phi.
        bend = density * (1.0 + (kurtosis / 24.0) * (z2 * (z2 - 6.0) + 3.0))
        return Profile(
            edge=step + half * sigma * density + kurtosis * tails,
            edge_by_distance=bend / sigma - half * z * density,
            edge_by_sigma=half * (1.0 + z2) * density - z * bend / sigma,
            edge_by_kurtosis=tails,
            ramp=distance * step + sigma * density,
            ramp_by_distance=step,
            ramp_by_sigma=density,
        )


@twin
def sectors_at(ellipse: tuple[float, ...], x: Floats, y: Floats, steps: int) -> Indices:
    """Sector (n,) of each pixel (x, y) near an ellipse (cx, cy, a, b, angle)."""
    about = Ellipse.of(ellipse)
    return sector_of(Place.of(about, x, y, steps))


def sector_of(place: Place) -> Indices:
    """Sector (n,) of each point: which of the SECTORS equal steps of the ellipse's parameter u."""
    share = np.arctan2(place.sin_u, place.cos_u) / (2.0 * np.pi) + 0.5
    return (share * SECTORS).astype(np.intp) % SECTORS


def _turned(cos_t: Floats, sin_t: Floats, angle: float) -> tuple[Floats, Floats]:
    """Cosine and sine of t + angle."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos_t * cos - sin_t * sin, sin_t * cos + cos_t * sin


def _between(values: Floats, place: Place) -> Floats:
    """Values (n,) at places, interpolated linearly between the middles of the SECTORS."""
    share = np.arctan2(place.sin_u, place.cos_u) / (2.0 * np.pi) + 0.5
    at = share * SECTORS - 0.5
    low = np.floor(at).astype(np.intp)
    first, second = values[low % SECTORS], values[(low + 1) % SECTORS]
    return np.asarray(first + (at - low) * (second - first))


def harmonics(cos_u: Floats, sin_u: Floats, order: int) -> Floats:
    """Harmonics (1 + 2 K, n): 1, cos u, sin u, ..., cos K u, sin K u."""
    out = np.empty((1 + 2 * order, cos_u.size))
    out[0] = 1.0
    if order:
        out[1], out[2] = cos_u, sin_u
    for k in range(3, 1 + 2 * order, 2):
        np.subtract(out[k - 2] * cos_u, out[k - 1] * sin_u, out=out[k])
        np.add(out[k - 1] * cos_u, out[k - 2] * sin_u, out=out[k + 1])
    return out


def longest_gap(held: Bools) -> float:
    """Share of the outline in the longest run of sectors that are not held; 1 if none is."""
    at = np.flatnonzero(held)
    if at.size == 0:
        return 1.0
    return float(np.diff(np.append(at, at[0] + held.size)).max() - 1) / held.size
