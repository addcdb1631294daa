"""Surfaces of measured corneas (Zernike terms, grids of heights), continued by the biconic that fits them best."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..base.arrays import Floats
from .surfaces_measured import GridSurface, Measured, ZernikeSurface, order_of, terms
from .topography import outer_biconic, outer_height, spline_coefficients

WINDOW = (0.75, 1.15)
"""Shares of the zone's radius between which the biconic takes over.

Over this width the bends of a healthy cornea stay as they are inside (of the trials 0.6 to 0.85 and 1.0 to 1.15); a
polynomial is hardly worse 15 % beyond its disc.
"""
_FITTED = (0.75, 1.0)
_FAR = np.array([1e6, 2e6])
_ANY = np.array([8.0, 8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@lru_cache(maxsize=4096)
def zernike_surface(
    coefficients_mm: tuple[float, ...],  # c_0, c_1, ... in the order of OSA/ANSI, depths.
    radius_mm: float,  # radius of the disc on which the terms are orthonormal
    *,
    base_radius_mm: float | None = None,  # radius of curvature of the conic below the terms; None: a plane
    base_conic_constant: float = 0.0,  # Q of that conic
    zone_radius_mm: float | None = None,  # radius of the measured zone; None: that of the disc
) -> ZernikeSurface:
    """Build the surface of Zernike terms with its apex at the origin; the biconic is fitted once per shape."""
    coefficients = np.zeros(terms(max(order_of(len(coefficients_mm)), 1)))
    coefficients[: len(coefficients_mm)] = coefficients_mm
    base = np.array([0.0 if base_radius_mm is None else 1.0 / base_radius_mm, base_conic_constant])
    radius = np.array(radius_mm)
    zone = radius_mm if zone_radius_mm is None else zone_radius_mm
    alone = ZernikeSurface(np.zeros(3), np.eye(3), base, radius, coefficients, _ANY, _FAR)
    outer = outer_biconic(lambda y, z: alone.measured(y, z), _ring(zone))
    return ZernikeSurface(np.zeros(3), np.eye(3), base, radius, coefficients, outer, _window(zone))


@lru_cache(maxsize=256)
def grid_surface(
    heights_mm: tuple[tuple[float, ...], ...], spacing_mm: float, *, zone_radius_mm: float | None = None
) -> GridSurface:
    """Build the bicubic surface of a grid of heights with its apex at the origin; it is fitted once per shape.

    Args:
        heights_mm: depths, row by row from low z to high z.
        spacing_mm: spacing of the grid.
        zone_radius_mm: radius of the measured zone; None: so that the transition ends at the rim of the grid.
    """
    heights, spacing = np.array(heights_mm).T, np.array(spacing_mm)
    half = 0.5 * (len(heights) - 1) * float(spacing)
    zone = half / WINDOW[1] if zone_radius_mm is None else zone_radius_mm
    origin, middle = np.zeros(3), np.zeros(2)

    def on_biconic(outer: Floats, rest: Floats) -> GridSurface:
        coefficients = spline_coefficients(rest)[None]
        return GridSurface(
            origin_mm=origin,
            rotation=np.eye(3),
            outer=outer,
            window_mm=_window(zone),
            centre_mm=middle,
            spacing_mm=spacing,
            row=np.array(0),
            table=coefficients,
        )

    # First on a plane (a biconic without curvature), only to fit the biconic.
    flat = np.array([np.inf, np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    raw = on_biconic(flat, heights)
    outer = outer_biconic(lambda y, z: raw.measured(y, z), _ring(zone))
    place = np.linspace(-half, half, len(heights))
    y, z = np.meshgrid(place, place, indexing="ij")
    # Beyond the reach of the biconic there is no residual; those nodes lie far outside the measured zone.
    reached = np.isfinite(raw.with_outer(outer).measured(y, z))
    surface = on_biconic(outer, np.where(reached, heights - outer_height(outer, y, z), 0.0))
    apex = surface.measured(np.zeros(1), np.zeros(1))[0]
    return surface.with_outer(outer - apex * np.eye(8)[5])


def misfit_mm(surface: Measured) -> float:
    """Compute the rms deviation from the outer biconic (mm), on a circle in the middle of the transition."""
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    radius = float(np.mean(surface.window_mm))
    y, z = radius * np.cos(angle), radius * np.sin(angle)
    away = surface.measured(y, z) - outer_height(surface.outer, y, z)
    return float(np.sqrt(np.mean(away**2)))


def _window(zone_mm: float) -> Floats:
    return zone_mm * np.array(WINDOW)


def _ring(zone_mm: float) -> tuple[float, float]:
    return zone_mm * _FITTED[0], zone_mm * _FITTED[1]
