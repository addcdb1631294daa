"""Build the model from an eye file, in four steps: surfaces, landmarks, stop, and the chief ray.

Surfaces and their landmarks are computed once for all pupil sizes of an eye.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..base.arrays import FloatLike
from ..base.errors import InputError
from ..optics.gradient import GradientMedium
from ..optics.surfaces import Surface
from ..optics.transforms import read_only
from .landmarks import chief_ray_in_air, fovea_by_nodal_ray, incident_node
from .model import EyeModel, LineOfSight, RotationCentres, Stop
from .parts import EyeParts, GradientLensSpec, Side, SurfaceLensSpec
from .shells import passing_shells
from .stop import stop_of, stop_reach_mm
from .surfaces import gradient_lens, index_at, sclera_of, surface_of


def build_eye(spec: EyeParts, side: Side, wavelength_nm: float, pupil_diameter_mm: float | None) -> EyeModel:
    """Build the numeric eye.

    Args:
        spec: the eye file.
        side: right or left.
        wavelength_nm: wavelength in vacuum.
        pupil_diameter_mm: diameter of the anatomical pupil; None: that of the file.

    Raises:
        InputError: the pupil does not fit, or an index is below 1 at this wavelength.
    """
    if not (np.isfinite(wavelength_nm) and wavelength_nm > 0.0):
        raise InputError("must be a positive number", path="wavelength_nm")
    stop = fitting_stop(spec, pupil_diameter_mm)
    x, y, z = (float(v) for v in stop.centre_mm)
    eye = replace(_with_landmarks(_Key(spec), float(wavelength_nm), (x, y, z)), stop=stop)
    return eye if side == "right" else eye.mirrored()


def fitting_stop(spec: EyeParts, pupil_diameter_mm: float | None) -> Stop:
    """Return the stop of the right eye at a diameter (that of the file if None), checked to fit the eye.

    Raises:
        InputError: the pupil does not fit.
    """
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
        chief_ray=LineOfSight(zero, zero),
        lens_gradient=gradient,
    )


class _Key:
    """Cache key: a spec that equals every other spec with the same surfaces and fovea."""

    __slots__ = ("spec", "text")

    def __init__(self, spec: EyeParts) -> None:
        self.spec = spec
        self.text = json.dumps(spec.model_dump(mode="json", exclude={"name", "stop"}), sort_keys=True)

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.text == self.text


@lru_cache(maxsize=64)
def _with_surfaces(spec: _Key, wavelength_nm: float) -> EyeModel:
    """Build the right eye with its fovea, which does not depend on the stop; its stop is that of the file."""
    parts = spec.spec
    bare = bare_eye(parts, wavelength_nm, stop_of(parts, parts.stop.diameter_mm))
    if parts.fovea.position_mm is not None:
        fovea = np.array(parts.fovea.position_mm)
    else:
        field = np.radians(parts.fovea.field_deg)
        fovea = fovea_by_nodal_ray(bare, incident_node(bare), field, parts.fovea.distance_mm)
    return replace(bare, fovea_mm=read_only(fovea))


@lru_cache(maxsize=256)
def _with_landmarks(spec: _Key, wavelength_nm: float, stop_centre_mm: tuple[float, float, float]) -> EyeModel:
    """Build the right eye with all landmarks; only the chief ray depends on the stop's centre."""
    eye = replace(_with_surfaces(spec, wavelength_nm), name=spec.spec.name)
    eye = replace(eye, stop=replace(eye.stop, centre_mm=np.array(stop_centre_mm)))
    return replace(eye, chief_ray=chief_ray_in_air(eye, eye.fovea_mm))
