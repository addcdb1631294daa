"""Build the surfaces, media and stop of an eye file."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np

from ..base.arrays import FloatLike, Floats, frozen
from ..base.errors import InputError
from ..optics.corneas import grid_surface, zernike_surface
from ..optics.gradient import GradientMedium
from ..optics.media import CauchyMedium, ConstantMedium, Medium
from ..optics.shells import SHELLS, Layers, equator_radius_mm, even_layers, lens_shells
from ..optics.surfaces import Surface
from ..optics.surfaces_graph import Biconic
from ..optics.surfaces_quadric import Quadric
from ..optics.transforms import rotation_x, tilt_rotation
from .model import Sphere, Stop
from .parts import (
    LARGEST_INDEX,
    BiconicSpec,
    ConicSpec,
    EllipsoidSpec,
    EyeParts,
    GradientLensSpec,
    GridSpec,
    MediumSpec,
    PlacedSpec,
    PlaneSpec,
    SphereSpec,
    ZernikeSpec,
)


@lru_cache(maxsize=64)
def surface_of(placed: PlacedSpec) -> Surface:
    """Build a shape as a surface in the eye frame; equal shapes give the same object."""
    shape = placed.shape
    rotation = tilt_rotation(np.radians(placed.tilt_deg))
    position = np.array(placed.position_mm)
    if isinstance(shape, PlaneSpec):
        return Quadric.plane(position, rotation)
    if isinstance(shape, SphereSpec | ConicSpec):
        conic_constant = shape.conic_constant if isinstance(shape, ConicSpec) else 0.0
        return Quadric.conic(shape.radius_mm, conic_constant, position, rotation)
    if isinstance(shape, BiconicSpec):
        return Biconic(
            origin_mm=position,
            rotation=rotation,
            radii_mm=np.array(shape.radii_mm),
            conic_constants=np.array(shape.conic_constants),
        )
    if isinstance(shape, ZernikeSpec):
        zernike = zernike_surface(
            shape.coefficients_mm,
            shape.radius_mm,
            base_radius_mm=shape.base_radius_mm,
            base_conic_constant=shape.base_conic_constant,
            zone_radius_mm=shape.zone_radius_mm,
        )
        return zernike.placed(position, rotation)
    if isinstance(shape, GridSpec):
        assert shape.heights_mm is not None
        assert shape.spacing_mm is not None
        grid = grid_surface(shape.heights_mm, shape.spacing_mm, zone_radius_mm=shape.zone_radius_mm)
        return grid.placed(position, rotation)
    front = shape.side == "front"
    if isinstance(shape, EllipsoidSpec):
        lead = shape.semi_axes_mm[0] * (-1.0 if front else 1.0)
        return Quadric.ellipsoid(shape.semi_axes_mm, position + rotation[:, 0] * lead, rotation, front)
    return Quadric.general(shape.coefficients, front, position, rotation)


def medium_of(spec: MediumSpec) -> Medium:
    """Build the medium of a spec."""
    if spec.cauchy is not None:
        return CauchyMedium(*spec.cauchy)
    return ConstantMedium(1.0 if spec.index is None else spec.index)


def index_at(spec: MediumSpec, wavelength_nm: float, path: str) -> float:
    """Compute the refractive index at a wavelength (nm); InputError if it is below 1."""
    index = medium_of(spec).index(wavelength_nm)
    if not 1.0 <= index <= LARGEST_INDEX:
        raise InputError(
            f"the index at {wavelength_nm:g} nm is {index:.6g}; must be >= 1 and <= {LARGEST_INDEX:g}", path=path
        )
    return index


def sclera_of(spec: EyeParts, cornea: Surface) -> Sphere:
    """Build the sclera: the sphere through the limbus circle, centred on the cornea's axis unless given otherwise."""
    radius = spec.sclera.radius_mm
    if spec.sclera.centre_mm is not None:
        return Sphere(frozen(spec.sclera.centre_mm), radius)
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    rim = spec.limbus_radius_mm
    depth = float(np.mean(cornea.sag(rim * np.cos(angle), rim * np.sin(angle))))
    local = np.array([depth - np.sqrt(max(radius**2 - rim**2, 0.0)), 0.0, 0.0])
    return Sphere(frozen(cornea.to_eye(local)), radius)


def gradient_geometry(lens: GradientLensSpec) -> tuple[Surface, Surface, Floats]:
    """Return the surfaces and centre (3,) of a gradient lens; InputError if they cannot be those of one."""
    for name, shape in (("front", lens.front.shape), ("back", lens.back.shape)):
        if not isinstance(shape, SphereSpec | ConicSpec | BiconicSpec):
            raise InputError("a gradient lens must be made of spheres, conics or biconics", path=f"lens.{name}.shape")
        if lens.shells is None and lens.layers is None and isinstance(shape, BiconicSpec):
            raise InputError("give a number: a gradient lens of biconics is traced as shells", path="lens.shells")
    if lens.shells is not None and lens.layers is not None:
        raise InputError("give either 'shells' or 'layers'", path="lens.layers")
    for k, (outer, inner) in enumerate(pairwise(lens.layers or ()), start=1):
        if inner.size > outer.size:
            raise InputError("must be <= the size of the layer around it", path=f"lens.layers.{k}.size")
    front, back = surface_of(lens.front), surface_of(lens.back)
    if lens.centre_mm is None:
        centre = front.origin_mm + lens.centre_fraction * (back.origin_mm - front.origin_mm)
    else:
        centre = np.array(lens.centre_mm)
        if not (front.implicit(centre) < 0.0 < back.implicit(centre)):
            raise InputError("must lie between the lens' front and its back", path="lens.centre_mm")
    return front, back, centre


def gradient_lens(
    lens: GradientLensSpec, wavelength_nm: float
) -> tuple[tuple[Surface, ...], tuple[FloatLike, ...], tuple[FloatLike, ...], GradientMedium | None]:
    """Build a gradient lens: surfaces outside in, index behind each, their rims, and the medium (None for shells)."""
    front, back, centre = gradient_geometry(lens)
    edge, core, vitreous = (
        index_at(medium, wavelength_nm, f"lens.{name}")
        for name, medium in (("edge", lens.edge), ("core", lens.core), ("vitreous", lens.vitreous))
    )
    rim = equator_radius_mm(front, back)
    if isinstance(front, Quadric) and isinstance(back, Quadric) and lens.shells is None and lens.layers is None:
        medium = GradientMedium.between(front, back, centre, edge, core)
        return (front, back), (edge, vitreous), (rim, rim), medium
    if lens.layers is None:
        layers = even_layers(lens.shells or SHELLS)
    else:
        layers = Layers(*np.array([(layer.size, layer.index_share) for layer in lens.layers]).T)
    return *lens_shells(front, back, centre, (edge, core, vitreous), rim, layers), None


def stop_of(spec: EyeParts, diameter_mm: float) -> Stop:
    """Build the stop of the right eye at a diameter (mm)."""
    stop = spec.stop
    change = diameter_mm - stop.diameter_mm
    rotation = tilt_rotation(np.radians(stop.tilt_deg)) @ rotation_x(np.radians(stop.axis_deg))
    # The pupil moves within the plane of the iris, which is fixed. Otherwise it would sink into a lens that is tilted
    # with it.
    depth = -float(rotation[1:, 0] @ stop.shift_mm_per_mm) / float(rotation[0, 0])
    centre = np.array(stop.position_mm) + np.array([depth, *stop.shift_mm_per_mm]) * change
    ratio = np.sqrt(1.0 - stop.ellipticity)
    semi_axes = 0.5 * diameter_mm * np.array([1.0 / ratio, ratio])
    if stop.contour is None:
        return Stop(centre, rotation, semi_axes, np.array(1.0))
    rows = (stop.contour.cosines, stop.contour.sines)
    contour = np.zeros((2, max(map(len, rows))))
    for row, values in zip(contour, rows, strict=True):
        row[: len(values)] = values
    return Stop(centre, rotation, semi_axes, np.array(1.0), contour)
