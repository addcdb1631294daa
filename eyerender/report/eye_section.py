"""Draw an eye's section: surfaces, stop, fovea, axes and centres of rotation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..eye.model import EyeModel
from ..optics.surfaces import Surface
from .style import ANALYTIC, IMAGE, TARGET, figure

_SCLERA, _CORNEA, _LENS, _RETINA, _IRIS = "#9a9a9a", ANALYTIC, "#009E73", IMAGE, "#8c564b"
_GRID, _LENS_GRID = 900, 300
# Adult lenses are 9 to 10 mm wide, but their optical surfaces meet farther out.
_LENS_MM = 4.8


def eye_section(eye: EyeModel, title: str = "") -> Any:
    """Draw the horizontal section (from above) and the vertical one (from the temporal side) as a matplotlib figure."""
    with figure(13.0, 5.4, 2) as (fig, axes):
        _draw(axes[0], eye, 1)
        _draw(axes[1], eye, 2)
        name = title or f"{eye.name}, {eye.side} eye, {eye.wavelength_nm:g} nm"
        axes[0].set(title=f"{name}: horizontal section, from above", ylabel="y, nasal (mm)")
        if eye.side == "left":
            axes[0].set(ylabel="y, temporal (mm)")
        axes[1].set(title="vertical section", ylabel="z, up (mm)")
        handles, labels = axes[0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside right center", frameon=False)
        return fig


def _draw(ax: Any, eye: EyeModel, across: int) -> None:
    """Draw one section: the plane of x and the coordinate `across` (1: y, 2: z)."""
    centre, radius = np.asarray(eye.sclera.centre_mm), eye.sclera.radius_mm
    low = float(min(centre[0] - radius, eye.fovea_mm[0])) - 1.2
    x, s = np.meshgrid(np.linspace(low, 1.0, _GRID), np.linspace(-radius - 0.8, radius + 0.8, _GRID))
    for k, surface in enumerate(eye.front):
        rim = _axis_distance(surface, x, s, across) <= eye.limbus_radius_mm
        if k:  # the back of the cornea ends at the iris
            normal, stop = eye.stop.normal, eye.stop.centre_mm
            rim &= x >= stop[0] - (s - stop[across]) * normal[across] / normal[0]
        _curve(ax, surface, x, s, across, rim, _CORNEA, 1.8, "cornea" if k == 0 else None)
    shells = eye.shelled()
    # A gradient lens has dozens of shells, so they get a grid that is no larger than they are.
    back = float(eye.stop.centre_mm[0]) - 6.0
    lx, ls = np.meshgrid(np.linspace(back, back + 7.0, _LENS_GRID), np.linspace(-6.5, 6.5, _LENS_GRID))
    for k, (surface, rim_mm) in enumerate(zip(shells.back, shells.back_rims_mm, strict=True)):
        outer = k in (0, len(shells.back) - 1) or len(shells.back) <= 2
        inside = _axis_distance(surface, lx, ls, across) <= min(float(np.asarray(rim_mm)), _LENS_MM)
        name = "lens" if k == 0 else None
        _curve(ax, surface, lx, ls, across, inside, _LENS, 1.6 if outer else 0.35, name)
    _curve(ax, eye.retina, x, s, across, x < -8.0, _RETINA, 1.6, "retina (optical)")
    outside = np.hypot(x - centre[0], s - centre[across]) - radius
    beside = (_axis_distance(eye.front[0], x, s, across) >= eye.limbus_radius_mm) | (x < -8.0)
    sclera = np.where(beside, outside, np.nan)
    ax.contour(x, s, sclera, levels=[0.0], colors=[_SCLERA], linewidths=2.4)
    ax.plot([], [], color=_SCLERA, lw=2.4, label="sclera")
    _iris(ax, eye, across)
    ax.axhline(0, color="#444444", lw=0.9, ls=(0, (6, 4)), label="optic axis")
    fovea, los = eye.fovea_mm, eye.chief_ray
    path = np.stack([fovea, eye.stop.centre_mm, los.point_mm, los.point_mm + 5.0 * np.asarray(los.direction)])
    ax.plot(path[:, 0], path[:, across], color="#CC79A7", lw=1.3, label="line of sight")
    ax.plot(fovea[0], fovea[across], "s", color=_RETINA, ms=7, label="fovea")
    azimuth, elevation = eye.rotation.azimuth_centre_mm, eye.rotation.elevation_centre_mm
    ax.plot(azimuth[0], azimuth[across], "*", color=TARGET, ms=11, label="azimuth centre")
    ax.plot(elevation[0], elevation[across], "o", color=TARGET, mfc="none", ms=9, label="elevation centre")
    ax.set(aspect="equal", xlabel="x, along the optic axis (mm)", xlim=(low, 3.0))


def _curve(
    ax: Any, surface: Surface, x: Floats, s: Floats, across: int, keep: Any, colour: str, width: float, name: str | None
) -> None:
    points = _points(x, s, across)
    facing = surface.gradient(points) @ np.asarray(surface.rotation)[:, 0] > 0
    values = np.where(facing & keep, surface.implicit(points), np.nan)
    if np.nanmin(values, initial=np.inf) <= 0 <= np.nanmax(values, initial=-np.inf):
        ax.contour(x, s, values, levels=[0.0], colors=[colour], linewidths=width)
    if name:
        ax.plot([], [], color=colour, lw=width, label=name)


def _points(x: Floats, s: Floats, across: int) -> Floats:
    zero = np.zeros_like(x)
    return np.stack([x, s, zero] if across == 1 else [x, zero, s], axis=-1)


def _axis_distance(surface: Surface, x: Floats, s: Floats, across: int) -> Floats:
    local = surface.to_local(_points(x, s, across))
    return np.hypot(local[..., 1], local[..., 2])


def _iris(ax: Any, eye: EyeModel, across: int) -> None:
    """Draw the iris and the gap of the pupil in the section's plane, through the pupil's centre."""
    stop = eye.stop
    margin = stop.boundary(720) - stop.centre_mm
    axis = np.cross(np.eye(3)[3 - across], stop.normal)
    axis /= np.linalg.norm(axis)
    for sign in (-1, 1):
        edge = margin[np.argmax(margin @ (sign * axis) / np.linalg.norm(margin, axis=1))]
        line = np.stack([stop.centre_mm + sign * r * axis for r in (np.linalg.norm(edge), eye.iris_root_radius_mm)])
        ax.plot(
            line[:, 0], line[:, across], color=_IRIS, lw=3, solid_capstyle="butt", label="iris" if sign > 0 else None
        )
