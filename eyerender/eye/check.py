"""Geometric checks of an eye file: whether it describes a possible eye."""

from __future__ import annotations

from itertools import pairwise
from typing import NoReturn

import numpy as np

from ..base.arrays import Bools, Floats
from ..base.errors import InputError, Refuse
from ..optics.corneas import WINDOW, misfit_mm
from ..optics.graphs import graphs_of
from ..optics.surfaces import Surface, components
from ..optics.surfaces_measured import Measured
from .model import Stop
from .parts import (
    BiconicSpec,
    ConicSpec,
    EyeParts,
    GradientLensSpec,
    GridSpec,
    MediumSpec,
    PlacedSpec,
    QuadricSpec,
    SphereSpec,
    SurfaceLensSpec,
    ZernikeSpec,
)
from .surfaces import gradient_geometry, stop_of, surface_of

_TOUCH_MM = 1e-6
_BULGE_MM = 0.5
_FAR_MM = 60.0
_SMALLEST_RADIUS_MM, _SMALLEST_HALF_MM = 2.0, 1.0
# Corneas with severe keratoconus come within a tenth of this limit.
_MISFIT_MM = 0.5


def check_eye(spec: EyeParts, *, source: str = "") -> None:
    """Raise InputError with the path of the first wrong key if the geometry of an eye file is impossible."""

    def refuse(path: str, reason: str) -> NoReturn:
        raise InputError(reason, source=source, path=path)

    for path, placed in _placed(spec):
        reason = _shape_problem(placed)
        if reason is not None:
            refuse(f"{path}.{reason[0]}", reason[1])
    for path, medium in _media(spec):
        if (medium.index is None) == (medium.cauchy is None):
            refuse(path, "give either 'index' or 'cauchy'")
    stop = stop_of(spec, spec.stop.diameter_mm)
    if not (stop.relative_radius(np.linspace(0.0, 2.0 * np.pi, 720)) > 0.0).all():
        refuse("stop.contour", "the margin's radius must be > 0 all around")
    radius = stop.reach_mm
    _check_widths(spec, refuse, radius)
    if any(abs(angle) >= 60.0 for angle in spec.fovea.field_deg):
        refuse("fovea.field_deg", "must be within 60 degrees of the optic axis")
    _check_cornea(spec, refuse, stop)
    _check_inside(spec, refuse, stop, radius)
    if isinstance(spec.lens, GradientLensSpec):
        try:
            gradient_geometry(spec.lens)
        except InputError as error:
            refuse(error.path, error.reason)


def _check_widths(spec: EyeParts, refuse: Refuse, pupil_radius_mm: float) -> None:
    """Check that the pupil lies within the iris, the iris within the cornea, and the cornea within the sclera."""
    if pupil_radius_mm >= spec.limbus_radius_mm:
        refuse("stop.diameter_mm", f"the pupil is wider than the cornea ({2 * spec.limbus_radius_mm:g} mm)")
    if pupil_radius_mm >= spec.iris.root_radius_mm:
        refuse("stop.diameter_mm", f"the pupil is wider than the iris ({2 * spec.iris.root_radius_mm:g} mm)")
    if spec.iris.root_radius_mm > spec.limbus_radius_mm:
        refuse("iris.root_radius_mm", f"the iris is wider than the cornea ({spec.limbus_radius_mm:g} mm)")
    if spec.sclera.radius_mm <= spec.limbus_radius_mm:
        refuse("sclera.radius_mm", f"must be > limbus_radius_mm ({spec.limbus_radius_mm:g})")


def _check_cornea(spec: EyeParts, refuse: Refuse, stop: Stop) -> None:
    """Check that the cornea's surfaces reach the limbus and follow each other, before the plane of the iris."""
    cornea = [(f"cornea.{k}", surface_of(s)) for k, s in enumerate(spec.cornea)]
    wide = _disc(spec.limbus_radius_mm, np.zeros(2))
    depth_wide = _stop_depth(stop.centre_mm, stop.normal, wide)
    front = _depth(cornea[0][1], wide)
    if not np.isfinite(front).all():
        reach = np.min(np.linalg.norm(wide[~np.isfinite(front)], axis=1))
        refuse("limbus_radius_mm", f"the front cornea ends {reach:.3g} mm from the axis")
    for (path_before, before), (path, surface) in pairwise(cornea):
        ahead, depth = _depth(before, wide), _depth(surface, wide)
        # The inner cornea ends at the plane of the iris.
        counts = np.isfinite(ahead) & np.isfinite(depth) & (ahead > depth_wide)
        crossing = counts & (depth > ahead - _TOUCH_MM)
        if crossing.any():
            refuse(f"{path}.position_mm", f"crosses {path_before} {_where(wide, crossing)}")


def _check_inside(spec: EyeParts, refuse: Refuse, stop: Stop, pupil_radius_mm: float) -> None:
    """Check that inner cornea, stop, lens and retina follow each other within the pupil."""
    narrow = _disc(pupil_radius_mm, stop.centre_mm[1:])
    depth = _depth(surface_of(spec.cornea[-1]), narrow)
    if not (depth > _stop_depth(stop.centre_mm, stop.normal, narrow)).all():
        refuse("stop.position_mm", f"the stop is not behind cornea.{len(spec.cornea) - 1} within the pupil")
    behind: list[tuple[str, Surface]] = []
    if isinstance(spec.lens, SurfaceLensSpec):
        behind = [(f"lens.surfaces.{k}", surface_of(s)) for k, s in enumerate(spec.lens.surfaces)]
    elif spec.lens is not None:
        behind = [("lens.front", surface_of(spec.lens.front)), ("lens.back", surface_of(spec.lens.back))]
    behind.append(("retina", surface_of(spec.retina)))
    path_before, ahead = "stop", _stop_depth(stop.centre_mm, stop.normal, narrow)
    for path, surface in behind:
        depth = _depth(surface, narrow)
        if not np.isfinite(depth).all():
            refuse(f"{path}.shape", "does not reach as far as the pupil")
        # A lens may touch the stop, and a decentred one may bulge slightly through its plane.
        slack = _BULGE_MM if path_before == "stop" else -_TOUCH_MM
        crossing = depth > ahead + slack
        if crossing.any():
            refuse(f"{path}.position_mm", f"crosses the {path_before} {_where(narrow, crossing)}")
        path_before, ahead = path, depth


def _depth(surface: Surface, grid: Floats) -> Floats:
    """Depth x (mm, eye frame) of the surface over points (y, z), (m, 2) -> (m,); NaN where the line misses it."""
    graphs = graphs_of(surface)
    if graphs is not None and graphs.plain:
        return np.asarray(graphs.jets(*grid.T)[0].x)
    start = np.column_stack([np.full(len(grid), _FAR_MM), grid])
    hit = surface.hit(components(start), components(np.broadcast_to([-1.0, 0.0, 0.0], start.shape)), inward=True)
    return np.where(hit.ok, _FAR_MM - hit.distance, np.nan)


def _stop_depth(centre: Floats, normal: Floats, grid: Floats) -> Floats:
    offset = grid - centre[1:]
    return np.asarray(centre[0] - (offset @ normal[1:]) / normal[0])


def _disc(radius_mm: float, centre: Floats) -> Floats:
    """Return points (y, z) that fill a disc."""
    radius, angle = np.meshgrid(np.linspace(0.0, radius_mm, 25), np.linspace(0.0, 2 * np.pi, 32, endpoint=False))
    return centre + np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])


def _where(grid: Floats, mask: Bools) -> str:
    return f"{np.min(np.linalg.norm(grid[mask], axis=1)):.3g} mm from the axis"


def _placed(spec: EyeParts) -> list[tuple[str, PlacedSpec]]:
    found: list[tuple[str, PlacedSpec]] = [(f"cornea.{k}", s) for k, s in enumerate(spec.cornea)]
    if isinstance(spec.lens, SurfaceLensSpec):
        found += [(f"lens.surfaces.{k}", s) for k, s in enumerate(spec.lens.surfaces)]
    elif spec.lens is not None:
        found += [("lens.front", spec.lens.front), ("lens.back", spec.lens.back)]
    return [*found, ("retina", spec.retina)]


def _media(spec: EyeParts) -> list[tuple[str, MediumSpec]]:
    found = [(f"cornea.{k}.medium", s.medium) for k, s in enumerate(spec.cornea)]
    if isinstance(spec.lens, SurfaceLensSpec):
        found += [(f"lens.surfaces.{k}.medium", s.medium) for k, s in enumerate(spec.lens.surfaces)]
    elif spec.lens is not None:
        found += [("lens.edge", spec.lens.edge), ("lens.core", spec.lens.core), ("lens.vitreous", spec.lens.vitreous)]
    return found


def _shape_problem(placed: PlacedSpec) -> tuple[str, str] | None:
    shape = placed.shape
    if isinstance(shape, SphereSpec | ConicSpec) and shape.radius_mm == 0.0:
        return "shape.radius_mm", "must not be 0"
    if isinstance(shape, BiconicSpec):
        first, second = shape.radii_mm
        if first * second <= 0.0:
            return "shape.radii_mm", "must both be > 0 or both be < 0"
    if isinstance(shape, ZernikeSpec):
        if shape.base_radius_mm is not None and abs(shape.base_radius_mm) < _SMALLEST_RADIUS_MM:
            return "shape.base_radius_mm", f"must not lie within {_SMALLEST_RADIUS_MM:g} of 0"
        return _continued(placed)
    if isinstance(shape, GridSpec):
        return _grid_problem(shape) or _continued(placed)
    if isinstance(shape, QuadricSpec) and not any(shape.coefficients[:9]):
        return "shape.coefficients", "must not all be 0"
    return None


def _continued(placed: PlacedSpec) -> tuple[str, str] | None:
    """Describe the problem of a measured surface that its outer biconic fails to continue; None if there is none."""
    surface = surface_of(placed)
    away = misfit_mm(surface) if isinstance(surface, Measured) else 0.0
    if away < _MISFIT_MM:
        return None
    return "shape", f"is no surface of an eye: at the end of its zone it is {away:.3g} mm from any biconic"


def _grid_problem(shape: GridSpec) -> tuple[str, str] | None:
    if shape.file is not None:
        return "shape.file", "is read with an eye file only; name the eye file here"
    if shape.heights_mm is None or shape.spacing_mm is None:
        return "shape", "give 'heights_mm' and 'spacing_mm', or 'file'"
    count = len(shape.heights_mm)
    if count % 2 == 0:
        return "shape.heights_mm", f"must have an odd number of rows, not {count}"
    wrong = [k for k, row in enumerate(shape.heights_mm) if len(row) != count]
    if wrong:
        return f"shape.heights_mm.{wrong[0]}", f"must have {count} values, as there are rows"
    half = 0.5 * (count - 1) * shape.spacing_mm
    if half < _SMALLEST_HALF_MM:
        return "shape.spacing_mm", f"the grid must reach at least {_SMALLEST_HALF_MM:g} mm from the axis"
    if shape.zone_radius_mm is not None and WINDOW[1] * shape.zone_radius_mm > half * (1.0 + 1e-9):
        return "shape.zone_radius_mm", f"must be <= {half / WINDOW[1]:.6g}, so that the grid covers the transition"
    return None
