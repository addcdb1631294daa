"""Subsurface light of all lamps on skin and sclera, computed once per frame on grids over their surfaces.

Light that enters the skin at one point leaves it in the neighbourhood. The radiosity is the irradiance, averaged around
each point with the weights of `optics.diffusion`, times the albedo. So uniform light is reflected as by a matte
surface, shadows have soft edges, and fine relief shows only in the sheen.

`tissuelight` computes the irradiance of the grids. This module averages it over rings of a few points in the tangent
plane, each ring with a sixth of the light (texture-space diffusion). Wide rings are computed for, and read from, grids
reduced by factors of two. On the skin the rings are reached in steps, because the size of the cells varies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...optics.diffusion import rings, transmitted
from ..records.frame import DeviceFrame, aligned_copy, quotient
from ..records.job import LampTable, RenderJob
from ..records.recording import recorded, syntax
from ..scene.diffusiongrids import SIDE, WIDTH, DiffusionGrids
from ..scene.region import SHEET_COLUMNS, RegionScene, SkinGeometry
from .tissuegrids import (
    GlobeGrid,
    Pyramid,
    SheetGrid,
    SheetMetric,
    SheetSize,
    globe_cells,
    globe_direction,
    globe_place,
    level_of,
)
from .tissuelight import TissueScene, light_on_globe, light_on_skin

_RINGS, _TURNS = 6, 6
_LEVEL_RINGS = (0, 1), (1, 4), (4, 6)  # whose light is found on the grid over the skin, and on its two reductions
_FOOTPRINT = 0.8  # size of the cells that a ring reads, in units of its radius
_RAYS = 6  # rays to the lamps from each cell, and at least one to each lamp
_SMALL, _WIDE_RAYS = 0.02, 16  # radius over distance of lamps of which one point is enough; points of larger ones


@dataclass(kw_only=True)
class DiffusedLight:
    """Light of the lamps on skin and globe after subsurface scattering."""

    size: SheetSize  # size of the grid over the skin
    skin: mi.Float  # light of cells of the skin
    skin_seen: mi.Float  # shares of the lamps that its coarse cells see, cell by cell
    globe: mi.Float  # light of cells of the globe
    globe_seen: mi.Float  # shares of the lamps that cells of the globe see
    lamps: mi.UInt32  # number of the lamps, at least 1

    @classmethod
    def build(
        cls, frame: DeviceFrame, job: RenderJob, lamps: LampTable, place: RegionScene, cells: DiffusionGrids
    ) -> DiffusedLight:
        """Compute the light on the tissues of a frame.

        Args:
            frame: the frame.
            job: its job.
            lamps: its lamps, on the host.
            place: the posed region.
            cells: the cells of the grids.
        """
        scattering = job.look.scattering
        assert scattering is not None
        assert job.region is not None
        wide, count = lamps.widest >= _SMALL, max(len(lamps), 1)
        rays = -(-_RAYS // count)
        scene = TissueScene(
            frame=frame,
            relief=place.relief[cells.sheet.rows],
            wide=dr.opaque(mi.Bool, wide),
            skin_rays=dr.opaque(mi.UInt32, max(rays, _WIDE_RAYS if wide else 1)),
            globe_rays=dr.opaque(mi.UInt32, rays),
            lid_loss_per_mm=dr.opaque(mi.Float, transmitted(job.region.skin.albedo, scattering.skin_per_mm)),
            lamps=count,
        )
        grids = SheetGrid.upload(cells.sheet), GlobeGrid.upload(cells.globe)
        return _diffused_light(scene, *grids, RingPoints.of(cells.thick_mm), RingPoints.of(cells.thin_mm))

    def at_skin(self, u: mi.Float, v: mi.Float) -> mi.Float:
        """Interpolate the irradiance (mW/mm^2) at coordinates of the map of the skin."""
        return self.size.cells(*self.size.place(u, v), 0).interpolate(mi.Float, self.skin)

    def lamps_at_skin(self, u: mi.Float, v: mi.Float) -> Callable[[mi.UInt32], mi.Float]:
        """Return a function of a lamp's number: the share of the lamp that the skin sees at coordinates of its map."""
        cells = self.size.cells(*self.size.place(u, v), 1)
        return lambda lamp: dr.clip(cells.interpolate(mi.Float, self.skin_seen, self.lamps, lamp), 0, 1)

    def at_globe(self, frame: DeviceFrame, x: mi.Vector3f) -> mi.Float:
        """Interpolate the irradiance (mW/mm^2) at points of the globe (eye frame)."""
        return globe_cells(*_place_on_globe(frame, x)).interpolate(mi.Float, self.globe)

    def lamps_at_globe(self, frame: DeviceFrame, x: mi.Vector3f) -> Callable[[mi.UInt32], mi.Float]:
        """Return a function of a lamp's number: the share of the lamp that points of the globe (eye frame) see."""
        row, column = (mi.UInt32(dr.clip(p + 0.5, 0, SIDE - 1)) for p in _place_on_globe(frame, x))
        first = (row * SIDE + column) * self.lamps
        return lambda lamp: dr.gather(mi.Float, self.globe_seen, first + lamp)


def _place_on_globe(frame: DeviceFrame, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Return the row and column of points of the globe (eye frame) in the grid over it."""
    return globe_place(frame.vector_to_scene(x - frame.sclera.centre))


@recorded
def _diffused_light(
    scene: TissueScene, sheet: SheetGrid, globe: GlobeGrid, thick: RingPoints, thin: RingPoints
) -> DiffusedLight:
    """Compute the light on skin and globe, and diffuse it; `thick` and `thin` are the rings in skin and sclera."""
    frame = scene.frame
    lit, skin_seen = light_on_skin(scene, sheet)
    skin = spread_in_skin(sheet, frame.region, lit, thick)
    lit, globe_seen = light_on_globe(scene, globe, sheet.size, lit, skin)
    on_globe = spread_in_globe(globe, frame.sclera.radius, lit, thin)
    return DiffusedLight(
        size=sheet.size,
        skin=join_tissues(frame, sheet, skin, on_globe),
        skin_seen=skin_seen,
        globe=on_globe,
        globe_seen=globe_seen,
        lamps=dr.maximum(frame.lights.count, 1),
    )


@dataclass(frozen=True, slots=True)
class RingPoints:
    """Points in the tangent plane with equal shares of the light: (x, y, dx, dy) in mm, row by row.

    A walk leads from the centre outwards; dx and dy are its steps. Successive points alternate in direction, so that
    neighbouring rings fill each other's gaps.
    """

    table: mi.Float

    @classmethod
    def of(cls, length_mm: float) -> RingPoints:
        """Compute the points for a diffusion length of `length_mm`."""
        turn = 2 * np.pi * (np.arange(_TURNS)[:, None] + 0.5 + 0.5 * (np.arange(_RINGS) % 2)) / _TURNS
        point = rings(_RINGS)[:, None] * length_mm * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        steps = np.diff(point, axis=1, prepend=np.zeros((_TURNS, 1, 2)))
        return cls(mi.Float(aligned_copy(np.concatenate([point, steps], axis=-1).astype(np.float32).ravel())))

    def point(
        self, k: mi.UInt32, inner: mi.UInt32, count: mi.UInt32
    ) -> tuple[mi.Point2f, mi.Point2f, mi.Float, mi.Bool]:
        """Return point k of `count` rings from the ring `inner` on, walk by walk.

        Returns:
            The point, the step to it, its distance from the centre (mm), and whether a walk begins there.
        """
        turn = quotient(k, count)
        begins = k == turn * count
        p = dr.gather(mi.Vector4f, self.table, turn * _RINGS + inner + k - turn * count)
        step = dr.select(begins, mi.Point2f(p.x, p.y), mi.Point2f(p.z, p.w))
        return mi.Point2f(p.x, p.y), step, dr.sqrt(p.x * p.x + p.y * p.y), begins


def spread_in_skin(grid: SheetGrid, skin: SkinGeometry, irradiance: mi.Float, points: RingPoints) -> mi.Float:
    """Diffuse the irradiance of the skin: return what leaves each cell."""
    metric, light = SheetMetric.measure(grid, skin), mi.Float(0)
    lit = Pyramid.build(irradiance, grid.size.rows, grid.size.columns, closed=True)
    # Light from farther away is spread more evenly, so fewer cells suffice for it.
    for level, of_rings in reversed(list(enumerate(_LEVEL_RINGS))):
        index, columns, size = grid.cells[level], grid.size.columns >> level, float(1 << level)
        row, column = ((mi.Float(n) + 0.5) * size - 0.5 for n in (index // columns, index % columns))
        wider, light = light, _gather_on_skin(lit, metric, points, row, column, of_rings)
        if level + 1 < len(_LEVEL_RINGS):
            light += grid.size.cells(row, column, level + 1).interpolate(mi.Float, wider)
        dr.eval(light)
        everywhere = dr.zeros(mi.Float, grid.rows * grid.columns >> 2 * level)
        dr.scatter(everywhere, light, index)
        light = everywhere
    return light


@syntax
def _gather_on_skin(
    lit: Pyramid, metric: SheetMetric, points: RingPoints, row: mi.Float, column: mi.Float, of_rings: tuple[int, int]
) -> mi.Float:
    """Sum the light of some of the rings around cells of the skin, as a part of the mean over all ring points."""
    inner, count = mi.UInt32(of_rings[0]), mi.UInt32(of_rings[1] - of_rings[0])
    k, total, i, j = mi.UInt32(0), mi.Float(0) * row, mi.Float(row), mi.Float(column)
    while dr.hint(k < count * _TURNS, label="rings on skin", exclude=[lit, metric, points]):
        _, step, distance, begins = points.point(k, inner, count)
        i, j, cell = metric.step(dr.select(begins, row, i), dr.select(begins, column, j), step.x, step.y)
        total += lit.at(i, j, level_of(_FOOTPRINT * distance, cell))
        k += 1
    return total * (1 / (_RINGS * _TURNS))


def spread_in_globe(grid: GlobeGrid, radius_mm: mi.Float, irradiance: mi.Float, points: RingPoints) -> mi.Float:
    """Diffuse the irradiance of the globe: return what leaves each cell between the lids."""
    side, light = mi.UInt32(SIDE), dr.zeros(mi.Float, SIDE * SIDE)
    lit = Pyramid.build(irradiance, side, side, closed=False)
    dr.scatter(light, _gather_on_globe(lit, grid.between, radius_mm, points), grid.between)
    return light


def join_tissues(frame: DeviceFrame, grid: SheetGrid, skin: mi.Float, globe: mi.Float) -> mi.Float:
    """Blend the light of the conjunctiva with that of the globe below it where it is thin; return that of the sheet."""
    index, columns = grid.cells[0], grid.size.columns
    row, column = index // columns, index % columns
    across = (mi.Float(column) + 0.5) * ((SHEET_COLUMNS - 1) / mi.Float(columns))
    x, _ = frame.region.sheet_point(grid.vertex_row(row, mi.Float(0.5)), across)
    below = globe_cells(*globe_place(x - frame.point_to_scene(frame.sclera.centre))).interpolate(mi.Float, globe)
    share = frame.region.own_share(grid.size.coordinate(mi.Float(row)))
    dr.scatter(skin, below + share * (dr.gather(mi.Float, skin, index) - below), index)
    return skin


@syntax
def _gather_on_globe(lit: Pyramid, index: mi.UInt32, radius_mm: mi.Float, points: RingPoints) -> mi.Float:
    """Average over the ring points around cells of the globe."""
    n = globe_direction(mi.Float(index // SIDE), mi.Float(index % SIDE))
    across = dr.normalize(mi.Vector3f(-n.y, n.x, 0))
    up = dr.cross(n, across)
    k, total = mi.UInt32(0), mi.Float(0) * n.x
    while dr.hint(k < _RINGS * _TURNS, label="rings on globe", exclude=[lit, points]):
        point, _, distance, _ = points.point(k, mi.UInt32(0), mi.UInt32(_RINGS))
        sine, cosine = dr.sincos(distance / radius_mm)
        row, column = globe_place(cosine * n + (sine / distance) * (point.x * across + point.y * up))
        total += lit.at(row, column, level_of(_FOOTPRINT * distance, WIDTH / SIDE * radius_mm))
        k += 1
    return total * (1 / (_RINGS * _TURNS))
