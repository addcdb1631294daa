"""Approximation of a gradient lens by shells of constant index."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ..base.arrays import FloatLike, Floats
from .surfaces import Surface

SHELLS = 21
"""Shells per half where a lens has to be made of bodies: in meshes and drawings."""


class Layers(NamedTuple):
    """Layers (k,) of a lens from outside in: the scale of each shell, and its index as a share from edge to core."""

    sizes: Floats
    index_shares: Floats


class Shells(NamedTuple):
    """Surfaces outside in (front shells, then back shells), the index behind each, and their rims."""

    surfaces: tuple[Surface, ...]
    indices: tuple[FloatLike, ...]
    rims_mm: tuple[FloatLike, ...]


def lens_shells(
    front: Surface, back: Surface, centre_mm: Floats, indices: tuple[float, float, float], rim_mm: float, layers: Layers
) -> Shells:
    """Compute the shells of the lens between two surfaces, scaled about `centre_mm` (3,).

    `indices` are those of the edge, of the core, and behind the lens; the outermost shell has the rim radius `rim_mm`.
    """
    edge, core, behind = indices
    size, inside = layers.sizes, edge + (core - edge) * layers.index_shares
    fronts = tuple(front.scaled(centre_mm, float(p)) for p in size)
    backs = tuple(back.scaled(centre_mm, float(p)) for p in size[::-1])
    media = [*inside, *inside[-2::-1], behind]
    return Shells(
        fronts + backs, tuple(float(n) for n in media), tuple(float(rim_mm * p) for p in (*size, *size[::-1]))
    )


def even_layers(count: int) -> Layers:
    """Return layers with equal index steps, each with the index at its middle; `count` as in `GradientLensSpec`."""
    steps = np.arange(count)
    return Layers(np.sqrt(1.0 - steps / count), (steps + 0.5) / count)


def passing_shells(count: int) -> tuple[bool, ...]:
    """Return whether a ray may miss each surface of a lens of shells: true for all but the outermost."""
    return tuple(k not in (0, count - 1) for k in range(count))


def equator_radius_mm(front: Surface, back: Surface) -> float:
    """Compute the distance from the axis (mm) where the outer front and back surfaces meet; infinite if they do not."""
    thickness = float(np.linalg.norm(front.origin_mm - back.origin_mm))

    def gap(r: float) -> float:
        height, zero = np.array(r), np.array(0.0)
        return float(thickness + front.sag(height, zero) - back.sag(height, zero))

    reach = 0.1
    while reach < 20.0 and gap(reach) > 0.0:
        reach += 0.1
    return float(brentq(gap, reach - 0.1, reach)) if gap(reach) <= 0.0 else np.inf
