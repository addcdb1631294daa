"""Batches of eyes: one eye model whose numbers have a leading axis."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from operator import is_
from typing import TypeVar

import numpy as np

from ..arrays import FloatLike, Floats, Indices
from ..geometry.surfaces import Surface
from ..geometry.transforms import read_only, stacked
from ..optics.gradient import GradientMedium
from .model import EyeModel, LineOfSight, RotationCentres, Sphere, Stop

Structure = tuple[tuple[str, ...], tuple[str, ...], tuple[bool, ...], bool, str]
S = TypeVar("S", bound=Surface)

CHUNK_POINTS = 12000
"""Points refracted at once: fewer leave the time to the interpreter, more leave the cache (measured: 8,000 to
20,000).
"""
FEW_EYES = 4
"""Up to so many different eyes are traced one after the other with plain numbers; more are stacked."""


def structure_of(eye: EyeModel) -> Structure:
    """Structure that eyes must share to be stacked: kinds and numbers of surfaces."""
    front, back = (tuple(s.kind for s in surfaces) for surfaces in (eye.front, eye.back))
    return front, back, eye.back_passing, eye.lens_gradient is not None, eye.retina.kind


def stack_eyes(eyes: Sequence[EyeModel]) -> EyeModel:
    """Stack n eyes of one structure into a batch; name and side are those of the first."""
    first = eyes[0]
    structure = structure_of(first)
    if any(structure_of(eye) != structure for eye in eyes):
        raise ValueError("eyes of different structure cannot be stacked")

    def numbers(values: Sequence[FloatLike]) -> Floats:
        return read_only([float(v) for v in values])

    def points(values: Sequence[Floats]) -> Floats:
        return read_only(stacked(values))

    gradients = [e.lens_gradient for e in eyes if e.lens_gradient is not None]
    waves = max(e.stop.contour.shape[-1] for e in eyes)
    return EyeModel(
        name=first.name,
        side=first.side,
        wavelength_nm=first.wavelength_nm,
        front=tuple(_stack(surfaces) for surfaces in zip(*(e.front for e in eyes), strict=True)),
        front_indices=tuple(numbers(n) for n in zip(*(e.front_indices for e in eyes), strict=True)),
        back=tuple(_stack(surfaces) for surfaces in zip(*(e.back for e in eyes), strict=True)),
        back_indices=tuple(numbers(n) for n in zip(*(e.back_indices for e in eyes), strict=True)),
        back_rims_mm=tuple(numbers(n) for n in zip(*(e.back_rims_mm for e in eyes), strict=True)),
        back_passing=first.back_passing,
        retina=_stack(tuple(e.retina for e in eyes)),
        stop=Stop(*(points(v) for v in zip(*(_stop_parts(e.stop, waves) for e in eyes), strict=True))),
        limbus_radius_mm=numbers([e.limbus_radius_mm for e in eyes]),
        iris_root_radius_mm=numbers([e.iris_root_radius_mm for e in eyes]),
        sclera=Sphere(points([e.sclera.centre_mm for e in eyes]), numbers([e.sclera.radius_mm for e in eyes])),
        rotation=RotationCentres(
            points([e.rotation.azimuth_centre_mm for e in eyes]),
            points([e.rotation.elevation_centre_mm for e in eyes]),
            points([e.rotation.torsion_centre_mm for e in eyes]),
        ),
        fovea_mm=points([e.fovea_mm for e in eyes]),
        incident_node_mm=points([e.incident_node_mm for e in eyes]),
        chief_ray=LineOfSight(
            points([e.chief_ray.point_mm for e in eyes]), points([e.chief_ray.direction for e in eyes])
        ),
        lens_gradient=GradientMedium.stack(gradients) if gradients else None,
    )


def take_eyes(eye: EyeModel, index: Indices) -> EyeModel:
    """Eyes of a batch at `index`; a single eye is returned as it is."""
    if eye.fovea_mm.ndim == 1:
        return eye

    def numbers(values: Sequence[FloatLike]) -> tuple[FloatLike, ...]:
        return tuple(np.asarray(v)[index] for v in values)

    rotation, ray = eye.rotation, eye.chief_ray
    return EyeModel(
        name=eye.name,
        side=eye.side,
        wavelength_nm=eye.wavelength_nm,
        front=tuple(s.take(index) for s in eye.front),
        front_indices=numbers(eye.front_indices),
        back=tuple(s.take(index) for s in eye.back),
        back_indices=numbers(eye.back_indices),
        back_rims_mm=numbers(eye.back_rims_mm),
        back_passing=eye.back_passing,
        retina=eye.retina.take(index),
        stop=Stop(*(part[index] for part in _stop_parts(eye.stop, eye.stop.contour.shape[-1]))),
        limbus_radius_mm=np.asarray(eye.limbus_radius_mm)[index],
        iris_root_radius_mm=np.asarray(eye.iris_root_radius_mm)[index],
        sclera=Sphere(eye.sclera.centre_mm[index], np.asarray(eye.sclera.radius_mm)[index]),
        rotation=RotationCentres(
            rotation.azimuth_centre_mm[index], rotation.elevation_centre_mm[index], rotation.torsion_centre_mm[index]
        ),
        fovea_mm=eye.fovea_mm[index],
        incident_node_mm=eye.incident_node_mm[index],
        chief_ray=LineOfSight(ray.point_mm[index], ray.direction[index]),
        lens_gradient=None if eye.lens_gradient is None else eye.lens_gradient.take(index),
    )


def groups(eyes: Sequence[EyeModel], which: Indices) -> list[tuple[tuple[EyeModel, Indices | None], Indices]]:
    """Rows whose eyes can be traced together: ((eye or stacked eyes, row -> eye of the stack), rows)."""
    kinds: dict[object, list[int]] = {}
    for k in np.unique(which):
        kinds.setdefault(structure_of(eyes[k]), []).append(int(k))
    out: list[tuple[tuple[EyeModel, Indices | None], Indices]] = []
    for members in kinds.values():
        if len(members) <= FEW_EYES:
            out += [((eyes[k], None), np.flatnonzero(which == k)) for k in members]
        else:
            place = np.full(len(eyes), -1, dtype=np.intp)
            place[members] = np.arange(len(members))
            rows = np.flatnonzero(place[which] >= 0)
            out.append(((_stacked_once(tuple(eyes[k] for k in members)), place[which]), rows))
    return out


class _Last:
    """The eyes that were stacked last, and their stack."""

    held: tuple[tuple[EyeModel, ...], EyeModel] | None = None


def _stacked_once(eyes: tuple[EyeModel, ...]) -> EyeModel:
    """Stack of eyes; fixation and features of the same eyes share one, because stacking takes a third of either."""
    held = _Last.held
    if held is None or len(held[0]) != len(eyes) or not all(map(is_, held[0], eyes)):
        held = _Last.held = eyes, stack_eyes(eyes)
    return held[1]


def chunks(group: tuple[EyeModel, Indices | None], rows: Indices, size: int) -> list[tuple[Indices, EyeModel]]:
    """Cut the rows of a group into (rows, their eyes) of at most `size` rows each."""
    eye, place = group
    parts = [rows[part] for part in slices(len(rows), size)]
    return [(part, eye if place is None else take_eyes(eye, place[part])) for part in parts]


def slices(count: int, size: int) -> list[slice]:
    """Divide into equal pieces of at most `size`.

    A short last piece would cost the interpreter as much as a full one.
    """
    pieces = max(1, -(-count // size))
    edges = [count * k // pieces for k in range(pieces + 1)]
    return [slice(low, high) for low, high in pairwise(edges)]


def _stack(surfaces: tuple[S, ...]) -> S:
    return type(surfaces[0]).stack(surfaces)


def _stop_parts(stop: Stop, waves: int) -> tuple[Floats, ...]:
    """Numbers of the stop, with its contour padded by zeros to `waves`."""
    contour = np.zeros((*stop.contour.shape[:-1], waves))
    contour[..., : stop.contour.shape[-1]] = stop.contour
    return stop.centre_mm, stop.rotation, stop.semi_axes_mm, stop.handed, contour
