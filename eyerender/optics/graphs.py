"""Express the surfaces of an eye as graphs x = h(y, z) over one plane, for compiled code."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.arrays import Floats, remembered
from ..base.jit import RAYS, ensure_compiled
from .graph_kernels import SMOOTH, Sheets
from .sheets import Graphs, placed_sheets
from .surfaces import Surface
from .surfaces_graph import GraphSurface
from .surfaces_quadric import Quadric

_AXES = 1e-15


@remembered
def graphs_of(*surfaces: Surface) -> Graphs | None:
    """Express surfaces as graphs over one plane; cached for the same objects.

    Graph surfaces must have parallel x axes. If these are the eye's x axis, the working frame is that of the eye, else
    that of the first graph surface. Returns the graphs; None if the surfaces have no common plane.
    """
    ensure_compiled(RAYS)
    frame = next((surface for surface in surfaces if isinstance(surface, GraphSurface)), None)
    first = surfaces[0]
    origin, rotation = np.zeros_like(first.origin_mm), np.broadcast_to(np.eye(3), first.rotation.shape)
    plain = frame is None or _turned_about_x(frame.rotation)
    if frame is not None and not plain:
        origin, rotation = frame.origin_mm, frame.rotation
    columns: list[Sheets] = []
    kinds: list[int] = []
    table = [np.zeros(1)]
    back = np.swapaxes(rotation, -1, -2)
    for k, surface in enumerate(surfaces):
        same = next((j for j in range(k) if surfaces[j] is surface), None)  # rays may pass a lens twice
        if same is not None:
            columns.append(columns[same])
            kinds.append(kinds[same])
            continue
        turn, place = surface.rotation, surface.origin_mm
        if not plain:
            turn, place = back @ turn, (back @ (place - origin)[..., None])[..., 0]
        sheets = placed_sheets(place, turn)
        if isinstance(surface, Quadric):
            if not np.all(turn[..., 0, 0] > 0.5):
                return None
            # Measured from a point beside its origin, so that no digits cancel.
            if plain:
                coefficients = surface.about(place * (1.0, 0.0, 0.0))
            else:
                beside = origin + rotation[..., :, 0] * place[..., :1]
                coefficients = surface.seen_from(beside, rotation).coefficients
            _write_quadric(sheets, coefficients)
            apex = place + turn[..., :, 0] * surface.sag(0.0, 0.0)[..., None]
            sheets["apex"] = apex[..., 1:]
            kinds.append(SMOOTH)
        elif isinstance(surface, GraphSurface) and _turned_about_x(turn):
            kinds.append(surface.write(sheets, table))
        else:
            return None
        columns.append(sheets)
    whole = np.stack(np.broadcast_arrays(*columns), axis=-1)
    return Graphs(kinds=np.array(kinds), sheets=whole, table=np.concatenate(table), origin_mm=origin, rotation=rotation)


def _turned_about_x(rotation: Floats) -> bool:
    """Return whether rotations (..., 3, 3) leave the x axis where it is."""
    return bool(np.all(np.abs(rotation[..., 1:, 0]) <= _AXES)) and bool(np.all(rotation[..., 0, 0] > 0.0))


def _write_quadric(sheets: Sheets, coefficients: Sequence[Floats | float]) -> None:
    """Write a quadric, A_xx x^2 + 2 h x + N = 0 with R = h^2 - A_xx N, into records (n,)."""
    xx, yy, zz, xy, xz, yz, bx, by, bz, c = coefficients
    numerator = np.broadcast_arrays(c, 2.0 * by, 2.0 * bz, yy, 2.0 * yz, zz)
    square = (bx * bx, 2.0 * bx * xy, 2.0 * bx * xz, xy * xy, 2.0 * xy * xz, xz * xz)
    for k, (n, h) in enumerate(zip(numerator, square, strict=True)):
        sheets["numerator"][:, k], sheets["square"][:, k] = n, h - xx * n
    for k, h in enumerate((bx, xy, xz)):
        sheets["linear"][:, k] = h
