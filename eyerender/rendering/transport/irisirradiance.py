"""Lamp light on the iris, on a grid in its plane that is filled once per frame (see `irradiancegrid`).

The light of a lamp is uneven in shadows, and behind the rim of the cornea, which turns opaque within a millimetre.
There a cell holds the path of the light instead: the irradiance if nothing blocked it, and where it enters the cornea.
Both vary slowly. Every sample applies the transmittance of the rim. Where something may hide the lamp from a
surrounding node, it also sends a shadow ray. With an eye region, this includes cells whose paths pass near hairs or
lids as seen from the lamp (`shadowmaps`), so that no occluder falls between nodes.

A small lamp is represented by its middle, a larger one by four points whose mean is exact to third order in its radius.
For large and near lamps there is no grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..materials.albedo import STEEPEST, limbal_radius, opacity
from ..records.frame import BITS, DeviceFrame, DeviceLamp
from ..records.irradiancegrid import BENT, GridPlace, IrradianceGrid, unevenness
from ..records.recording import syntax
from .directlight import LampPath, behind, image_of, lamp_blocked

_SIDE = 68
_NODES = _SIDE * _SIDE
_NUMBERS = 3  # that describe a path
_SPARE_MM = 0.45  # margin beyond the root of the iris: two cells
_STEADY = 0.06  # like BENT, of the light that enters: without shadow edges, the error of cubics is a hundredth of it
_SAME = 0.004  # largest difference between the light of several paths and that of their mean path, over the light
_AHEAD_MM = 1.0  # distance in front of the back of the cornea, within which nodes continue the light behind it


@dataclass(kw_only=True)
class IrisIrradiance:
    """Irradiance of the lamps in the plane of the iris."""

    grid: IrradianceGrid  # irradiance of the lamps that neither the rim nor anything else attenuates
    by_path: mi.UInt32  # bit mask per cell of the other lamps whose paths are known
    clear: mi.UInt32  # bit mask per cell of lamps that nothing hides
    paths: mi.Float  # the numbers of each lamp's path (see `_at_nodes`), each at four nodes in a row

    @classmethod
    def build(cls, frame: DeviceFrame, lamps: int, points: mi.UInt32) -> IrisIrradiance:
        """Fill the grid over the plane of the iris.

        Args:
            frame: the frame.
            lamps: number of lamps; 0 if none may use a grid.
            points: number of points that represent a lamp.
        """
        if not lamps:
            none, clear = dr.zeros(mi.UInt32, _NODES), dr.zeros(mi.UInt32, _NODES)
            dr.make_opaque(none, clear)
            unknown = IrradianceGrid.unknown(_SIDE)
            return cls(grid=unknown, by_path=none, clear=clear, paths=dr.zeros(mi.Float, 4 * _NUMBERS))
        index = dr.arange(mi.UInt32, _NODES * lamps)
        lamp = index // _NODES
        lit, *path = _at_nodes(frame, points, lamp, index - lamp * _NODES)
        dr.eval(lit, path)
        rows = _four_in_a_row(path, min(lamps, BITS), frame.lights.count)

        def steady(k: mi.UInt32, cell: mi.UInt32, allowed: mi.Float) -> mi.Bool:
            four = [_rows(rows, k * _NODES + cell + n * _SIDE - _SIDE) for n in range(4)]
            whole, *entry = ([value for row in four for value in row[m]] for m in range(_NUMBERS))
            bent, least, most = unevenness(whole)
            steep = sum(unevenness(values)[0] for values in entry) * most * STEEPEST * frame.limbus.gain
            return (least >= 0) & (bent + steep <= _STEADY * dr.maximum(most, allowed / BENT))

        grid, by_path, clear = IrradianceGrid.build(_SIDE, lit, frame.lights.count, held=steady)
        return cls(grid=grid, by_path=by_path, clear=clear, paths=rows)

    @syntax
    def at(
        self, frame: DeviceFrame, x: mi.Vector3f, spot: tuple[mi.Float, mi.Float, mi.Float], active: mi.Bool
    ) -> tuple[mi.Float, mi.UInt32]:
        """Interpolate the irradiance (mW/mm^2) at points of the iris plane (eye frame); also return missing lamps.

        `spot` is the position on each lamp's disc as for `Lamp.point`.
        """
        q = x - frame.stop.centre
        scale = 0.5 * (_SIDE - 1) / _half(frame)
        u, v = (dr.dot(q, axis) * scale + 0.5 * (_SIDE - 1) for axis in (frame.stop.u, frame.stop.v))
        place = self.grid.place(u, v, active)
        total, left = self.grid.at(place)
        lamps = dr.gather(mi.UInt32, self.by_path, place.cell, place.inside)
        clear = dr.gather(mi.UInt32, self.clear, place.cell, place.inside)
        while dr.hint(lamps != 0, label="by path", exclude=[self, frame, x, spot, place, clear]):
            number = dr.tzcnt(lamps)
            lit, entry = self._path(frame, number, place)
            shaded = ((clear >> number) & 1) == 0
            blocked = _blocked(frame, frame.lights[number], x, entry, spot, shaded & (lit > 0))
            total += dr.select(blocked, 0, lit)
            lamps &= lamps - 1
        return total, left

    def _path(self, frame: DeviceFrame, lamp: mi.UInt32, place: GridPlace) -> tuple[mi.Float, mi.Vector3f]:
        """Interpolate the irradiance of a lamp if nothing but the rim attenuates it, and where its light enters."""
        first, numbers = lamp * _NODES + place.cell, [mi.Float(0) for _ in range(_NUMBERS)]
        for k in range(4):
            rows = _rows(self.paths, first + k * _SIDE - _SIDE)
            numbers = [n + place.down[k] * dr.dot(place.across, row) for n, row in zip(numbers, rows, strict=True)]
        whole, y, z = numbers
        local, front = mi.Vector3f(0, y, z), frame.surfaces[0]
        lit = whole * (1 - opacity(frame, limbal_radius(frame, local)))
        return lit, front.on_surface(front.vector_out(local) + front.origin)[0]


@syntax
def _blocked(
    frame: DeviceFrame, lamp: DeviceLamp, x: mi.Vector3f, entry: mi.Vector3f, spot: tuple[mi.Float, mi.Float, mi.Float],
    asked: mi.Bool,
) -> mi.Bool:  # fmt: skip
    """Return whether anything blocks the path from a spot of a lamp to points x, where `asked`.

    The path from the lamp's middle enters the cornea at `entry`. Paths from other spots meet it at the image of x.
    """
    blocked = mi.Bool(False)
    if dr.hint(asked, exclude=[frame, lamp, x, entry, spot]):
        source = lamp.point(*spot)
        behind_entry, before = dr.norm(image_of(frame, x) - entry), dr.norm(lamp.position - entry)
        start = entry + (source - lamp.position) * (behind_entry / (behind_entry + before))
        blocked = lamp_blocked(frame, start, source, True, False, True)
    return blocked


def _half(frame: DeviceFrame) -> mi.Float:
    """Return half the width of the grid, mm."""
    return frame.iris.root_radius + _SPARE_MM


def _four_in_a_row(path: list[mi.Float], lamps: int, count: mi.UInt32) -> mi.Float:
    """Arrange the numbers of paths for each node and the next three."""
    index = dr.arange(mi.UInt32, _NODES * lamps)
    rows = dr.zeros(mi.Float, 4 * _NUMBERS * _NODES * lamps)
    last = mi.Int32(dr.minimum(count, BITS) * _NODES) - 1
    for n, number in enumerate(path):
        four = (dr.gather(mi.Float, number, mi.UInt32(dr.clip(mi.Int32(index) + k, 0, last))) for k in range(-1, 3))
        dr.scatter(rows, mi.Vector4f(*four), _NUMBERS * index + n)
    dr.eval(rows)
    return rows


def _rows(paths: mi.Float, node: mi.UInt32) -> list[mi.Vector4f]:
    """Read each number of the paths at nodes and the next three."""
    return [dr.gather(mi.Vector4f, paths, _NUMBERS * node + n) for n in range(_NUMBERS)]


@syntax
def _at_nodes(
    frame: DeviceFrame, points: mi.UInt32, i: mi.UInt32, node: mi.UInt32
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
    """Compute the irradiance of lamps i at nodes, and their paths.

    The irradiance is negative where anything may hide the lamp, or the search failed. Three numbers describe a path:
    the irradiance if nothing blocked it, negative where there is no path, and (y, z) where it enters the front surface,
    in its frame. The paths of several points are replaced by their mean, unless the rim attenuates that otherwise.
    """
    half, lamp, front = _half(frame), frame.lights[i], frame.surfaces[0]
    row = node // _SIDE
    column = node - row * _SIDE
    a, b = (half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (column, row))
    x = frame.stop.centre + a * frame.stop.u + b * frame.stop.v
    within = (a * a + b * b < dr.square(half)) & behind(frame.surfaces[-1], x, _AHEAD_MM)
    k, total, gain, whole, entry, hidden = mi.UInt32(0), *(mi.Float(0) for _ in range(3)), mi.Vector3f(0), ~within
    unknown = mi.Bool(hidden)
    while dr.hint(within & (k < points), label="grid of the iris", exclude=[frame, lamp, front]):
        path = LampPath.find(frame, lamp, lamp.node(k, points), x, within, ahead_mm=_AHEAD_MM)
        hidden |= path.failed | (path.enters & (path.blocked | ~_free(frame, i, path)))
        unknown |= path.whole <= 0
        total += dr.select(path.blocked, 0, path.gain)
        gain += path.gain
        whole += path.whole
        entry += front.point_in(path.entry)
        k += 1
    each = dr.rcp(mi.Float(points))
    entry *= each
    unknown |= dr.abs(whole * (1 - opacity(frame, limbal_radius(frame, entry))) - gain) > _SAME * whole
    return dr.select(hidden, -1, total * each), dr.select(unknown, -1, whole * each), entry.y, entry.z


def _free(frame: DeviceFrame, lamp: mi.UInt32, path: LampPath) -> mi.Bool:
    """Return whether the shadow maps, if there are any, exclude anything near a path in front of the eye."""
    maps = frame.caches.shadow_maps
    return mi.Bool(True) if maps is None else maps.at(lamp, frame.point_to_scene(path.entry), path.whole > 0)
