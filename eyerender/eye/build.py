"""Build the model from an eye file: surfaces and fovea, then the stop, then the chief ray through it.

Surfaces and fovea are computed once for all pupil sizes of an eye, and the chief ray once for each centre of the stop.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from ..base.arrays import FloatLike, frozen
from ..base.errors import InputError
from ..base.spec import Side
from ..optics.gradient import GradientMedium
from ..optics.shells import passing_shells
from ..optics.surfaces import Surface
from .landmarks import chief_ray_in_air, fovea_by_nodal_ray, incident_node
from .model import EyeModel, LineOfSight, RotationCentres, Stop
from .parts import EyeParts, GradientLensSpec, SurfaceLensSpec
from .surfaces import gradient_lens, index_at, sclera_of, stop_of, surface_of


def build_eye(spec: EyeParts, side: Side, wavelength_nm: float, pupil_diameter_mm: float | None) -> EyeModel:
    """Build the numeric eye of an eye file, at a wavelength in vacuum; pupil diameter None: that of the file.

    Raises:
        InputError: the pupil does not fit, or an index is below 1 at this wavelength.
    """
    if not (np.isfinite(wavelength_nm) and wavelength_nm > 0.0):
        raise InputError("must be a positive number", path="wavelength_nm")
    stop = fitting_stop(spec, pupil_diameter_mm)
    text = json.dumps(spec.model_dump(mode="json", exclude={"name", "stop"}), sort_keys=True)
    optics = _Optics(text, spec), float(wavelength_nm)
    chief_ray = _chief_ray(*optics, tuple(np.asarray(stop.centre_mm).tolist()))
    eye = replace(_without_pupil(*optics), name=spec.name, stop=stop, chief_ray=chief_ray)
    return eye if side == "right" else eye.mirrored()


def fitting_stop(spec: EyeParts, pupil_diameter_mm: float | None) -> Stop:
    """Return the stop of the right eye at a diameter (None: the file's); InputError if it does not fit."""
    diameter = spec.stop.diameter_mm if pupil_diameter_mm is None else float(pupil_diameter_mm)
    widest = 2.0 * min(spec.limbus_radius_mm, spec.iris.root_radius_mm)
    path = "stop.diameter_mm" if pupil_diameter_mm is None else "pupil_diameter_mm"
    if not (np.isfinite(diameter) and diameter > 0.0):
        raise InputError("must be > 0", path=path)
    stop = stop_of(spec, diameter)
    if 2.0 * stop.reach_mm >= widest:
        raise InputError(f"the pupil is wider than the iris or the cornea ({widest:g} mm)", path=path)
    # The implicit function is negative behind a surface.
    if not (surface_of(spec.cornea[-1]).implicit(stop.boundary(32)) < 0.0).all():
        raise InputError("the pupil reaches beyond the cornea", path=path)
    return stop


def bare_eye(spec: EyeParts, wavelength_nm: float, stop: Stop) -> EyeModel:
    """Build the right eye without its landmarks (fovea and chief ray are zeros), which is enough for tracing."""
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
    zero = frozen(np.zeros(3))
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
            frozen(spec.rotation.azimuth_centre_mm),
            frozen(spec.rotation.elevation_centre_mm),
            frozen(spec.rotation.torsion_centre_mm),
        ),
        fovea_mm=zero,
        chief_ray=LineOfSight(zero, zero),
        lens_gradient=gradient,
    )


@dataclass(frozen=True, slots=True)
class _Optics:
    """Key of the cache: eye files are equal if all but name and stop is equal (`text`, as JSON)."""

    text: str
    spec: EyeParts = field(compare=False)


@lru_cache(maxsize=64)
def _without_pupil(optics: _Optics, wavelength_nm: float) -> EyeModel:
    """Build the right eye with its fovea, which does not depend on the stop; its stop is that of the file."""
    spec = optics.spec
    bare = bare_eye(spec, wavelength_nm, stop_of(spec, spec.stop.diameter_mm))
    if spec.fovea.position_mm is not None:
        return replace(bare, fovea_mm=frozen(spec.fovea.position_mm))
    field_rad = np.radians(spec.fovea.field_deg)
    return replace(
        bare, fovea_mm=frozen(fovea_by_nodal_ray(bare, incident_node(bare), field_rad, spec.fovea.distance_mm))
    )


@lru_cache(maxsize=256)
def _chief_ray(optics: _Optics, wavelength_nm: float, stop_centre_mm: tuple[float, ...]) -> LineOfSight:
    """Trace the chief ray, which depends on the centre of the stop alone; it takes 80 ms with a gradient lens."""
    eye = _without_pupil(optics, wavelength_nm)
    return chief_ray_in_air(replace(eye, stop=replace(eye.stop, centre_mm=frozen(stop_centre_mm))), eye.fovea_mm)
