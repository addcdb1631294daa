"""Batches of eyes: an eye model whose numbers have a leading axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from operator import is_
from typing import Any

import numpy as np

from ..base.arrays import Indices, frozen
from ..optics.transforms import stacked
from .model import EyeModel, LineOfSight, RotationCentres, Sphere, Stop
from .worn import WornLens

Structure = tuple[tuple[str, ...], tuple[str, ...], tuple[bool, ...], bool, str, tuple[WornLens, ...], bool]
_SHARED = ("name", "side", "wavelength_nm", "back_passing", "worn", "has_contact_lens")
_NUMBERS = tuple(f.name for f in fields(EyeModel) if f.name not in _SHARED)
_RECORDS = (LineOfSight, RotationCentres, Sphere, Stop)

CHUNK_POINTS = 30000
"""Points refracted at once: with fewer the interpreter's overhead dominates, more do not fit the cache."""
FEW_EYES = 4
"""Largest number of different eyes that are traced one after the other; more are stacked."""


def structure_of(eye: EyeModel) -> Structure:
    """Return what eyes must share to be stacked: kinds and numbers of surfaces, and the lenses worn."""
    front, back = (tuple(s.kind for s in surfaces) for surfaces in (eye.front, eye.back))
    return front, back, eye.back_passing, eye.lens_gradient is not None, eye.retina.kind, eye.worn, eye.has_contact_lens


def stack_eyes(eyes: Sequence[EyeModel]) -> EyeModel:
    """Stack n eyes of one structure into a batch with the name and side of the first."""
    first = eyes[0]
    structure = structure_of(first)
    if any(structure_of(eye) != structure for eye in eyes):
        raise ValueError("eyes of different structure cannot be stacked")

    waves = max(e.stop.contour.shape[-1] for e in eyes)
    parts = {name: tuple(getattr(e, name) for e in eyes) for name in _NUMBERS}
    parts["stop"] = tuple(_with_waves(e.stop, waves) for e in eyes)
    return replace(first, **{name: _stacked(values) for name, values in parts.items()})


def take_eyes(eye: EyeModel, index: Indices) -> EyeModel:
    """Select eyes of a batch by `index`; a single eye is returned unchanged."""
    if eye.fovea_mm.ndim == 1:
        return eye
    return replace(eye, **{name: _taken(getattr(eye, name), index) for name in _NUMBERS})


def take_stops(stops: Stop, index: Indices) -> Stop:
    """Select stops of a batch by `index`."""
    found: Stop = _taken(stops, index)
    return found


def stack_stops(stops: Sequence[Stop]) -> Stop:
    """Stack n stops into a batch."""
    waves = max(stop.contour.shape[-1] for stop in stops)
    found: Stop = _stacked(tuple(_with_waves(stop, waves) for stop in stops))
    return found


def _stacked(values: tuple[Any, ...]) -> Any:
    """Stack one part of n eyes: arrays or numbers, tuples, records of arrays, surfaces or media."""
    first = values[0]
    if isinstance(first, np.ndarray):
        return frozen(stacked(values))
    if isinstance(first, tuple):
        return tuple(_stacked(parts) for parts in zip(*values, strict=True))
    if isinstance(first, _RECORDS):
        return type(first)(*(_stacked(tuple(getattr(v, f.name) for v in values)) for f in fields(first)))
    if hasattr(first, "stack"):
        return type(first).stack(values)
    return None if first is None else frozen(list(map(float, values)))


def _taken(value: Any, index: Indices) -> Any:
    """Select `index` from one part of a batch of eyes."""
    if isinstance(value, np.ndarray):
        return value[index]
    if isinstance(value, tuple):
        return tuple(_taken(part, index) for part in value)
    if isinstance(value, _RECORDS):
        return type(value)(*(_taken(getattr(value, f.name), index) for f in fields(value)))
    return None if value is None else value.take(index)


def groups(eyes: Sequence[EyeModel], which: Indices) -> list[tuple[tuple[EyeModel, Indices | None], Indices]]:
    """Group rows whose eyes can be traced together: ((one eye or a stack, row -> eye of the stack), rows)."""
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
    """The most recently stacked eyes and their stack."""

    held: tuple[tuple[EyeModel, ...], EyeModel] | None = None


def _stacked_once(eyes: tuple[EyeModel, ...]) -> EyeModel:
    """Return the stack of eyes, cached for the last eyes because stacking takes a third of a fixation or a trace."""
    held = _Last.held
    if held is None or len(held[0]) != len(eyes) or not all(map(is_, held[0], eyes)):
        held = _Last.held = eyes, stack_eyes(eyes)
    return held[1]


def chunks(group: tuple[EyeModel, Indices | None], rows: Indices, size: int) -> list[tuple[Indices, EyeModel]]:
    """Split the rows of a group into (rows, their eyes) of at most `size` rows each."""
    eye, place = group
    parts = [rows[part] for part in slices(len(rows), size)]
    return [(part, eye if place is None else take_eyes(eye, place[part])) for part in parts]


def slices(count: int, size: int) -> list[slice]:
    """Divide `count` into equal pieces of at most `size`.

    Equal pieces avoid a short last one, which would cost nearly as much as a full one.
    """
    pieces = max(1, -(-count // size))
    edges = [count * k // pieces for k in range(pieces + 1)]
    return [slice(low, high) for low, high in pairwise(edges)]


def _with_waves(stop: Stop, waves: int) -> Stop:
    """Return the stop with its contour padded by zeros to `waves`."""
    missing = waves - stop.contour.shape[-1]
    return replace(stop, contour=np.pad(stop.contour, ((0, 0), (0, missing)))) if missing else stop
