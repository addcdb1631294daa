"""Lamp light on the iris, on a grid in its plane that is filled once per frame (see `irradiancegrid`).

A cell lacks a lamp if anything blocks it at one of the surrounding nodes. With an eye region, the nodes must also be
far from all hairs and lids as seen from the lamp (`shadowmaps`), so that no occluder falls between them.

The rim of the cornea turns opaque within a millimetre. Where light passes the rim, a cell holds the irradiance behind a
clear rim and the radius at which the light enters; both vary slowly. Every sample then applies the transmittance of the
rim.

A small lamp is represented by its middle, a larger one by four points whose mean is exact to third order in its radius.
For large and near lamps there is no grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..materials.albedo import STEEPEST, opacity
from ..records.frame import BITS, Frame
from ..records.irradiancegrid import BENT, IrradianceGrid, unevenness
from ..records.recording import syntax
from .directlight import LampPath, behind

_SIDE = 68
_NODES = _SIDE * _SIDE
_SPARE_MM = 0.45  # margin beyond the root of the iris: two cells
_STEADY = 0.02  # like BENT, of the light that enters: without shadow edges, the error of cubics is a hundredth of it
_AHEAD_MM = 1.0  # distance in front of the back of the cornea, within which nodes continue the light behind it


@dataclass(kw_only=True)
class IrisIrradiance:
    """Irradiance of the lamps in the plane of the iris.

    Attributes:
        grid: irradiance of the lamps that the rim does not attenuate.
        behind_rim: bit mask per cell of lamps whose light passes the rim of the cornea.
        paths: for these lamps, the irradiance behind a clear rim at four nodes in a row, and the radii (mm) where the
            light enters.
    """

    grid: IrradianceGrid
    behind_rim: mi.UInt32
    paths: mi.Float

    @classmethod
    def build(cls, frame: Frame, lamps: int, points: mi.UInt32) -> IrisIrradiance:
        """Fill the grid over the plane of the iris.

        Args:
            frame: the frame.
            lamps: number of lamps; 0 if none may use a grid.
            points: number of points that represent a lamp.
        """
        if not lamps:
            none = dr.zeros(mi.UInt32, _NODES)
            dr.make_opaque(none)
            return cls(grid=IrradianceGrid.unknown(_SIDE), behind_rim=none, paths=dr.zeros(mi.Float, 8))
        index = dr.arange(mi.UInt32, _NODES * lamps)
        lamp = index // _NODES
        lit, *paths = _at_nodes(frame, points, lamp, index - lamp * _NODES)
        dr.eval(lit, paths)
        rows = _four_in_a_row(paths, min(lamps, BITS), frame.lights.count)

        def steady_behind_rim(k: mi.UInt32, cell: mi.UInt32, allowed: mi.Float) -> mi.Bool:
            four = [_rows(rows, k * _NODES + cell + n * _SIDE - _SIDE) for n in range(4)]
            whole, out = ([value for row in four for value in row[m]] for m in (0, 1))
            bent, least, most = unevenness(whole)
            steep = unevenness(out)[0] * most * STEEPEST * frame.limbus.gain
            return (least > 0) & (bent + steep <= _STEADY / BENT * allowed)

        grid, behind_rim = IrradianceGrid.build(_SIDE, lit, frame.lights.count, held=steady_behind_rim)
        return cls(grid=grid, behind_rim=behind_rim, paths=rows)

    @syntax
    def at(self, frame: Frame, x: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32]:
        """Interpolate the irradiance (mW/mm^2) at points of the iris plane (eye frame); also return missing lamps."""
        q = x - frame.stop.centre
        scale = 0.5 * (_SIDE - 1) / _half(frame)
        u, v = (dr.dot(q, axis) * scale + 0.5 * (_SIDE - 1) for axis in (frame.stop.u, frame.stop.v))
        place = self.grid.place(u, v, active)
        total, left = self.grid.at(place)
        lamps = dr.gather(mi.UInt32, self.behind_rim, place.cell, place.inside)
        while dr.hint(lamps != 0, label="behind the rim", exclude=[self, frame, place]):
            whole, out = mi.Float(0), mi.Float(0)
            first = dr.tzcnt(lamps) * _NODES + place.cell
            for k in range(4):
                a, b = _rows(self.paths, first + k * _SIDE - _SIDE)
                whole += place.down[k] * dr.dot(place.across, a)
                out += place.down[k] * dr.dot(place.across, b)
            lamps &= lamps - 1
            total += whole * (1 - opacity(frame, out))
        return total, left


def _half(frame: Frame) -> mi.Float:
    """Return half the width of the grid, mm."""
    return frame.iris.root_radius + _SPARE_MM


def _four_in_a_row(paths: list[mi.Float], lamps: int, count: mi.UInt32) -> mi.Float:
    """Arrange irradiances behind a clear rim, and radii of entry, for each node and the next three."""
    index = dr.arange(mi.UInt32, _NODES * lamps)
    rows = dr.zeros(mi.Float, 8 * _NODES * lamps)
    last = mi.Int32(dr.minimum(count, BITS) * _NODES) - 1
    for n, path in enumerate(paths):
        four = (dr.gather(mi.Float, path, mi.UInt32(dr.clip(mi.Int32(index) + k, 0, last))) for k in range(-1, 3))
        dr.scatter(rows, mi.Vector4f(*four), 2 * index + n)
    dr.eval(rows)
    return rows


def _rows(paths: mi.Float, node: mi.UInt32) -> tuple[mi.Vector4f, mi.Vector4f]:
    """Read irradiances behind a clear rim at nodes and the next three, and the radii of entry."""
    return dr.gather(mi.Vector4f, paths, 2 * node), dr.gather(mi.Vector4f, paths, 2 * node + 1)


@syntax
def _at_nodes(frame: Frame, points: mi.UInt32, i: mi.UInt32, node: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Compute the irradiance of lamps i at nodes, that behind a clear rim, and the radius (mm) of entry.

    Irradiances are negative where anything may hide the lamps, or a path was not found; behind a clear rim also for
    lamps with several points.
    """
    half, lamp = _half(frame), frame.lights[i]
    row = node // _SIDE
    column = node - row * _SIDE
    a, b = (half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (column, row))
    x = frame.stop.centre + a * frame.stop.u + b * frame.stop.v
    within = (a * a + b * b < dr.square(half)) & behind(frame.surfaces[-1], x, _AHEAD_MM)
    k, total, whole, out, hidden = mi.UInt32(0), mi.Float(0), mi.Float(-1), mi.Float(0), mi.Bool(False)
    while dr.hint(within & (k < points), label="grid of the iris", exclude=[frame, lamp]):
        path = LampPath.find(frame, lamp, lamp.node(k, points), x, within, ahead_mm=_AHEAD_MM)
        shadow, usable = _shadow(frame, i, path)
        total += dr.select(path.blocked, 0, path.gain)
        whole = dr.select(usable & (points == 1), path.whole, -1)
        out = mi.Float(path.out)
        hidden |= shadow
        k += 1
    hidden |= ~within
    return dr.select(hidden, -1, total / mi.Float(points)), dr.select(hidden, -1, whole), out


def _shadow(frame: Frame, lamp: mi.UInt32, path: LampPath) -> tuple[mi.Bool, mi.Bool]:
    """Return whether a path is in, near or possibly in a shadow, and whether a clear rim would let it pass."""
    if frame.caches.shadow_maps is None:
        return path.failed, ~path.blocked
    free = frame.caches.shadow_maps.at(lamp, frame.point_to_scene(path.entry), path.whole > 0)
    return path.failed | (path.enters & (path.blocked | ~free)), ~path.blocked & free
