"""Outlines in full-sensor pixels: closed curves through a few boundary points, and the pixels inside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats
from ...optics.ellipse import points_on_ellipse
from ...rig.camera import Window

# A mask is traced in single precision, which moves an outline by at most .004 px (measured on the shipped eyes, seen at
# up to 35 deg). The polygon of `_POINTS` chords is within r pi^2 / (2 n^2) of the curve, 0.02 px at r = 500 px.
EXACT_PX = 0.05
# Tolerances where only the best-fitting ellipse is known. The limbus deviates from it by .06 px at most, in E5.
# Irregular pupils and pupils seen from the side deviate by up to 1.05 px.
LIMBUS_PX, PUPIL_PX = 0.25, 1.5
# Moments of a moving picture are at most half a pixel apart, and each row of a mask is that of the nearest one.
MOMENT_PX = 0.3
_POINTS = 360


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """A closed polygon `curve` (n, 2) px, and the tolerance for a pixel's centre on either side."""

    curve: Floats
    tolerance_px: float

    @classmethod
    def through(cls, points_px: Floats) -> Outline:
        """Interpolate a closed curve through boundary points (k, 2) px at equal parameter steps, k >= 6.

        The interpolation is trigonometric, which is exact for a curve with fewer than k / 2 harmonics. The outline of a
        stop has few, so the size of the harmonics above k / 4 estimates the interpolation error.
        """
        k = len(points_px)
        harmonics = np.fft.fft(points_px[:, 0] + 1j * points_px[:, 1]) / k
        order = np.fft.fftfreq(k, 1 / k)
        error = float(np.abs(harmonics[np.abs(order) > k / 4]).sum())
        t = np.arange(_POINTS) / _POINTS
        # For an even number of points the highest harmonic has both signs.
        waves = np.exp(2j * np.pi * np.outer(t, order))
        if k % 2 == 0:
            waves[:, k // 2] = np.cos(np.pi * k * t)
        curve = waves @ harmonics
        return cls(np.stack([curve.real, curve.imag], axis=1), EXACT_PX + error)

    @classmethod
    def ellipse(cls, centre_px: Floats, semi_axes_px: Floats, angle_rad: float, tolerance_px: float) -> Outline:
        """Create the outline from an ellipse, if only the best-fitting ellipse is known."""
        return cls(points_on_ellipse(centre_px, semi_axes_px, angle_rad, _POINTS), tolerance_px)

    def inside(self, window: Window) -> Bools:
        """Return whether each pixel's centre in a window (x0, y0, width, height) lies inside, (height, width)."""
        from skimage.draw import polygon2mask

        x0, y0, width, height = window
        corners = (self.curve - np.array([x0, y0]))[:, ::-1]  # (row, column)
        return np.asarray(polygon2mask((height, width), corners))  # type: ignore[no-untyped-call]

    def beyond(self, pixels: Bools, window: Window) -> Floats:
        """Return the distances (px) from the outline of those pixels of a window that exceed the tolerance."""
        v, u = np.nonzero(pixels)
        at = np.stack([u + window[0], v + window[1]], axis=1).astype(float)
        p, way = self.curve, np.roll(self.curve, -1, axis=0) - self.curve
        length2 = np.maximum(np.sum(way * way, axis=1), 1e-300)
        out = []
        for part in np.array_split(at, max(1, len(at) // 1024)):
            away = part[:, None, :] - p
            t = np.clip(np.sum(away * way, axis=2) / length2, 0, 1)
            gap = away - t[..., None] * way
            out.append(np.sqrt(np.sum(gap * gap, axis=2)).min(axis=1, initial=np.inf))
        distance = np.concatenate(out)
        return np.asarray(distance[distance > self.tolerance_px])
