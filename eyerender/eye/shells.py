"""A gradient lens as shells of constant index."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..geometry.surfaces import Surface
from ..geometry.transforms import Array
from ..optics.interface import Number
from .model import Eye

SHELLS = 21
"""Shells a half where a lens has to be made of bodies: in meshes and drawings."""


class Shells(NamedTuple):
    """Surfaces outside in, front shells and then back shells; the index behind each; their rims."""

    surfaces: tuple[Surface, ...]
    indices: tuple[Number, ...]
    rims_mm: tuple[Number, ...]


def lens_shells(
    front: Surface,
    back: Surface,
    centre_mm: Array,
    indices: tuple[float, float, float],
    rim_mm: float,
    count: int = SHELLS,
    index_rate: int = 1,
) -> Shells:
    """The shells of the lens between two single surfaces; indices: of its edge, of its core, behind it.

    `count` and `index_rate` as in `GradientLensSpec`.
    """
    edge, core, behind = indices
    steps = np.arange(count)
    size = np.sqrt(1.0 - steps / (index_rate * count))
    inside = edge + (core - edge) * (steps + (0.5 if index_rate == 1 else 1.0)) / count
    if index_rate != 1:
        # That software has the first shell stand on the lens' own surface, with nothing of the edge between.
        size, inside = np.insert(size, 0, 1.0), np.insert(inside, 0, edge)
    fronts = tuple(front.scaled(centre_mm, float(p)) for p in size)
    backs = tuple(back.scaled(centre_mm, float(p)) for p in size[::-1])
    media = [*inside, *inside[-2::-1], behind]
    return Shells(
        fronts + backs, tuple(float(n) for n in media), tuple(float(rim_mm * p) for p in (*size, *size[::-1]))
    )


def shelled(eye: Eye, count: int = SHELLS) -> Eye:
    """A single eye with its gradient lens made of shells; any other eye as it is."""
    gradient = eye.lens_gradient
    if gradient is None:
        return eye
    edge, core = float(gradient.core - gradient.fall), float(gradient.core)
    shells = lens_shells(
        eye.back[0],
        eye.back[1],
        gradient.centre_mm,
        (edge, core, float(eye.back_indices[-1])),
        float(eye.back_rims_mm[0]),
        count,
    )
    return replace(
        eye,
        back=shells.surfaces,
        back_indices=shells.indices,
        back_rims_mm=shells.rims_mm,
        back_passing=passing_shells(len(shells.surfaces)),
        lens_gradient=None,
    )


def passing_shells(count: int) -> tuple[bool, ...]:
    """Rays may pass by all surfaces of a lens of shells but the outermost."""
    return tuple(k not in (0, count - 1) for k in range(count))
