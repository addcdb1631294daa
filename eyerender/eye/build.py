"""Build the numeric eye from an eye file."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from ..arrays import FloatLike, Floats
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..geometry.surfaces_biconic import Biconic
from ..geometry.surfaces_quadric import Quadric
from ..geometry.transforms import flip_y, mirror_rotation, read_only, rotation_x, tilt_rotation
from ..optics.gradient import GradientMedium
from ..optics.media import CauchyMedium, ConstantMedium, Medium
from .corneas import grid_surface, zernike_surface
from .landmarks import chief_ray_in_air, fovea_by_nodal_ray, incident_node
from .model import EyeModel, LineOfSight, RotationCentres, Sphere, Stop
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
    QuadricSpec,
    Side,
    SphereSpec,
    SurfaceLensSpec,
    ZernikeSpec,
)
from .shells import SHELLS, Layers, even_layers, lens_shells, passing_shells


def build_eye(spec: EyeParts, side: Side, wavelength_nm: float, pupil_diameter_mm: float | None) -> EyeModel:
    """Build the numeric eye.

    Args:
        spec: the eye file.
        side: right or left.
        wavelength_nm: wavelength in vacuum.
        pupil_diameter_mm: diameter of the pupil; None: the file's own.

    Raises:
        InputError: the pupil does not fit, or an index is below 1 at this wavelength.
    """
    if not (np.isfinite(wavelength_nm) and wavelength_nm > 0.0):
        raise InputError("must be a positive number", path="wavelength_nm")
    diameter = spec.stop.diameter_mm if pupil_diameter_mm is None else float(pupil_diameter_mm)
    widest = 2.0 * min(spec.limbus_radius_mm, spec.iris.root_radius_mm)
    path = "stop.diameter_mm" if pupil_diameter_mm is None else "pupil_diameter_mm"
    if not (np.isfinite(diameter) and diameter > 0.0):
        raise InputError("must be > 0", path=path)
    stop = stop_of(spec, diameter)
    if 2.0 * stop_reach_mm(stop) >= widest:
        raise InputError(f"the pupil is wider than the iris or the cornea ({widest:g} mm)", path=path)
    # The implicit function is negative behind a surface.
    if not (surface_of(spec.cornea[-1]).implicit(stop.boundary(32)) < 0.0).all():
        raise InputError("the pupil reaches beyond the cornea", path=path)
    x, y, z = (float(v) for v in stop.centre_mm)
    eye = replace(_compiled(_Key(spec), float(wavelength_nm), (x, y, z)), stop=stop)
    return eye if side == "right" else mirrored_eye(eye)


def bare_eye(spec: EyeParts, wavelength_nm: float, stop: Stop) -> EyeModel:
    """The right eye without its landmarks (fovea, node and chief ray are zeros), which is enough for tracing."""
    front = tuple(surface_of(s) for s in spec.cornea)
    front_indices = tuple(index_at(s.medium, wavelength_nm, f"cornea.{k}.medium") for k, s in enumerate(spec.cornea))
    back: tuple[Surface, ...] = ()
    back_indices: tuple[FloatLike, ...] = ()
    rims: tuple[FloatLike, ...] = ()
    passing: tuple[bool, ...] = ()
    gradient: GradientMedium | None = None
    if isinstance(spec.lens, SurfaceLensSpec):
        back = tuple(surface_of(s) for s in spec.lens.surfaces)
        back_indices = tuple(
            index_at(s.medium, wavelength_nm, f"lens.surfaces.{k}.medium") for k, s in enumerate(spec.lens.surfaces)
        )
        rims, passing = (np.inf,) * len(back), (False,) * len(back)
    elif isinstance(spec.lens, GradientLensSpec):
        back, back_indices, rims, gradient = gradient_lens(spec.lens, wavelength_nm)
        passing = passing_shells(len(back))
    zero = read_only(np.zeros(3))
    return EyeModel(
        name=spec.name,
        side="right",
        wavelength_nm=float(wavelength_nm),
        front=front,
        front_indices=front_indices,
        back=back,
        back_indices=back_indices,
        back_rims_mm=rims,
        back_passing=passing,
        retina=surface_of(spec.retina),
        stop=stop,
        limbus_radius_mm=spec.limbus_radius_mm,
        iris_root_radius_mm=spec.iris.root_radius_mm,
        sclera=sclera_of(spec, front[0]),
        rotation=RotationCentres(
            read_only(spec.rotation.azimuth_centre_mm),
            read_only(spec.rotation.elevation_centre_mm),
            read_only(spec.rotation.torsion_centre_mm),
        ),
        fovea_mm=zero,
        incident_node_mm=zero,
        chief_ray=LineOfSight(zero, zero),
        lens_gradient=gradient,
    )


def surface_of(placed: PlacedSpec) -> Surface:
    """Build a placed shape as a surface of the eye frame."""
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
        return zernike_surface(shape).placed(position, rotation)
    if isinstance(shape, GridSpec):
        return grid_surface(shape).placed(position, rotation)
    if isinstance(shape, EllipsoidSpec):
        front = shape.side == "front"
        lead = shape.semi_axes_mm[0] * (-1.0 if front else 1.0)
        return Quadric.ellipsoid(shape.semi_axes_mm, position + rotation[:, 0] * lead, rotation, front)
    return _general_quadric(shape, position, rotation)


def _general_quadric(shape: QuadricSpec, position: Floats, rotation: Floats) -> Quadric:
    a, b, c, d, e, f, g, h, i, k = shape.coefficients
    # The scale makes the size of rounding depend on distances, not on the unit of the coefficients.
    scale = max(abs(v) for v in (a, b, c, d, e, f)) or max(abs(v) for v in (g, h, i))
    if b == c and d == e == f == 0.0 and b != 0.0:
        scale = abs(b)
    matrix = np.array([[a, d, e], [d, b, f], [e, f, c]]) / scale
    sign = 1.0 if shape.side == "front" else -1.0
    return Quadric.oriented(matrix, np.array([g, h, i]) / scale, np.array(k / scale), sign, position, rotation)


def medium_of(spec: MediumSpec) -> Medium:
    """Build the medium that a spec describes."""
    if spec.cauchy is not None:
        return CauchyMedium(*spec.cauchy)
    return ConstantMedium(1.0 if spec.index is None else spec.index)


def index_at(spec: MediumSpec, wavelength_nm: float, path: str) -> float:
    """Index at a wavelength.

    Raises:
        InputError: the index is below 1.
    """
    index = medium_of(spec).index(wavelength_nm)
    if not 1.0 <= index <= LARGEST_INDEX:
        raise InputError(
            f"the index at {wavelength_nm:g} nm is {index:.6g}; must be >= 1 and <= {LARGEST_INDEX:g}", path=path
        )
    return index


def stop_of(spec: EyeParts, diameter_mm: float) -> Stop:
    """Stop of the right eye at a diameter."""
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


def stop_reach_mm(stop: Stop) -> float:
    """Largest distance of the margin from the stop's centre, within 0.1 %."""
    return float(np.max(np.linalg.norm(stop.boundary(360) - stop.centre_mm, axis=-1)))


def sclera_of(spec: EyeParts, cornea: Surface) -> Sphere:
    """Sclera: the sphere through the limbus circle, centred on the cornea's axis unless the file gives the centre."""
    radius = spec.sclera.radius_mm
    if spec.sclera.centre_mm is not None:
        return Sphere(read_only(spec.sclera.centre_mm), radius)
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    rim = spec.limbus_radius_mm
    depth = float(np.mean(cornea.sag(rim * np.cos(angle), rim * np.sin(angle))))
    local = np.array([depth - np.sqrt(max(radius**2 - rim**2, 0.0)), 0.0, 0.0])
    return Sphere(read_only(cornea.to_eye(local)), radius)


def gradient_geometry(lens: GradientLensSpec) -> tuple[Surface, Surface, Floats]:
    """Geometry of a gradient lens: (front, back, centre (3,)).

    Raises:
        InputError: the surfaces cannot be those of a gradient lens.
    """
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
    """Surfaces of a gradient lens outside in, the index behind each, their rims, and the medium (None for shells)."""
    front, back, centre = gradient_geometry(lens)
    edge, core, vitreous = (
        index_at(medium, wavelength_nm, f"lens.{name}")
        for name, medium in (("edge", lens.edge), ("core", lens.core), ("vitreous", lens.vitreous))
    )
    rim = _equator_radius(front, back)
    if isinstance(front, Quadric) and isinstance(back, Quadric) and lens.shells is None and lens.layers is None:
        medium = GradientMedium.between(front, back, centre, edge, core)
        return (front, back), (edge, vitreous), (rim, rim), medium
    if lens.layers is None:
        layers = even_layers(lens.shells or SHELLS)
    else:
        layers = Layers(*np.array([(layer.size, layer.index_share) for layer in lens.layers]).T)
    return *lens_shells(front, back, centre, (edge, core, vitreous), rim, layers), None


def _equator_radius(front: Surface, back: Surface) -> float:
    """Distance from the axis (mm) where the outer front and back surfaces meet; infinite if they do not."""
    thickness = float(np.linalg.norm(front.origin_mm - back.origin_mm))

    def gap(r: float) -> float:
        height, zero = np.array(r), np.array(0.0)
        return float(thickness + front.sag(height, zero) - back.sag(height, zero))

    reach = 0.1
    while reach < 20.0 and gap(reach) > 0.0:
        reach += 0.1
    return float(brentq(gap, reach - 0.1, reach)) if gap(reach) <= 0.0 else np.inf


def mirrored_eye(eye: EyeModel) -> EyeModel:
    """Mirror an eye to the other side: every point (x, y, z) -> (x, -y, z)."""
    side: Literal["right", "left"] = "left" if eye.side == "right" else "right"
    stop, centres, ray = eye.stop, eye.rotation, eye.chief_ray

    def flipped(points: Floats) -> Floats:
        return read_only(flip_y(points))

    return replace(
        eye,
        side=side,
        front=tuple(s.mirrored() for s in eye.front),
        back=tuple(s.mirrored() for s in eye.back),
        retina=eye.retina.mirrored(),
        stop=replace(
            stop, centre_mm=flip_y(stop.centre_mm), rotation=mirror_rotation(stop.rotation), handed=-stop.handed
        ),
        sclera=replace(eye.sclera, centre_mm=flipped(eye.sclera.centre_mm)),
        rotation=RotationCentres(
            flipped(centres.azimuth_centre_mm),
            flipped(centres.elevation_centre_mm),
            flipped(centres.torsion_centre_mm),
        ),
        fovea_mm=flipped(eye.fovea_mm),
        incident_node_mm=flipped(eye.incident_node_mm),
        chief_ray=LineOfSight(flipped(ray.point_mm), flipped(ray.direction)),
        lens_gradient=None if eye.lens_gradient is None else eye.lens_gradient.mirrored(),
    )


class _Key:
    """A spec that hashes by its digest, so that landmarks are computed once per eye."""

    __slots__ = ("digest", "spec")

    def __init__(self, spec: EyeParts) -> None:
        self.spec, self.digest = spec, spec.digest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.digest == self.digest


@lru_cache(maxsize=256)
def _compiled(key: _Key, wavelength_nm: float, stop_centre_mm: tuple[float, float, float]) -> EyeModel:
    """The right eye with its landmarks, which depend on the stop only through its centre."""
    spec = key.spec
    nominal = stop_of(spec, spec.stop.diameter_mm)
    bare = bare_eye(spec, wavelength_nm, replace(nominal, centre_mm=np.array(stop_centre_mm)))
    node = incident_node(bare)
    if spec.fovea.position_mm is not None:
        fovea = np.array(spec.fovea.position_mm)
    else:
        fovea = fovea_by_nodal_ray(bare, node, np.radians(spec.fovea.field_deg), spec.fovea.distance_mm)
    return replace(
        bare,
        incident_node_mm=read_only(node),
        fovea_mm=read_only(fovea),
        chief_ray=chief_ray_in_air(bare, fovea),
    )
