"""Direct lamp light on skin and globe, and light through the lids on the globe, on their grids.

On the skin, shadowed light is computed in each cell of a coarse grid as a vector F: the irradiance of a surface with
normal n is F . n, which also serves the finer relief. On the globe it is computed for each cell between the lids. Under
a lid, the globe receives transmitted light: exp(-k t) of the irradiance of the lid's skin, after a path t through the
tissue.

For the highlights, the grids also hold the share of each lamp that every cell sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..hits.interaction import EPSILON_MM
from ..records.frame import DeviceFrame, sequence
from ..records.recording import syntax
from ..scene.diffusiongrids import SIDE
from ..scene.region import SHEET_COLUMNS
from .directlight import irradiance, lamp_blocked
from .tissuegrids import GlobeGrid, SheetGrid, SheetSize, globe_direction

_LID_MM = 4.5  # thicker than any lid
_BETWEEN_MM = 0.05  # smallest distance between the two surfaces of a lid
_JOINT_MM, _ABOVE_MM = 0.05, 0.15  # height above the globe at which the light on conjunctiva and globe is computed
_KEYS = (0x51CA, 0x1A3B)


@dataclass(kw_only=True)
class TissueScene:
    """Input of the light on the tissues of a frame."""

    frame: DeviceFrame
    relief: mi.Float  # slopes of the cells of the skin's grid
    wide: mi.Bool  # whether some lamp is too wide for one point
    skin_rays: mi.UInt32  # number of rays to each lamp from cells of the skin
    globe_rays: mi.UInt32  # number of rays to each lamp from cells of the globe
    lid_loss_per_mm: mi.Float  # attenuation of light in a lid
    lamps: int  # number of lamps, at least 1


@dataclass(kw_only=True)
class _Cells:
    """Coarse cells of the skin: numbers, rows and columns, middles (scene's frame), and middles and normals (eye)."""

    index: mi.UInt32
    row: mi.UInt32
    column: mi.UInt32
    middle: mi.Vector3f
    x: mi.Vector3f
    normal: mi.Vector3f


def light_on_skin(scene: TissueScene, grid: SheetGrid) -> tuple[mi.Float, mi.Float]:
    """Compute the irradiance of the skin's grid, and the share of each lamp that coarse cells see."""
    flux, seen = _flux_on_skin(scene, grid)
    skin, index, columns = scene.frame.region, grid.cells[0], grid.size.columns
    row, column = index // columns, index % columns
    across = (mi.Float(column) + 0.5) * ((SHEET_COLUMNS - 1) / mi.Float(columns))
    _, n = skin.sheet_point(grid.vertex_row(row, mi.Float(0.5)), across)
    relief = dr.gather(mi.Vector2f, scene.relief, index)
    F = grid.size.cells(mi.Float(row), mi.Float(column), 1).interpolate(mi.Vector4f, flux)
    facing = dr.dot(mi.Vector3f(F.x, F.y, F.z), skin.tilted(n, relief.x, relief.y))
    lit = dr.zeros(mi.Float, grid.rows * grid.columns)
    dr.scatter(lit, dr.maximum(facing, 0), index)
    return lit, seen


@syntax
def _flux_on_skin(scene: TissueScene, grid: SheetGrid) -> tuple[mi.Float, mi.Float]:
    """Compute vectors F at coarse cells (scene's frame, four numbers each), and the shares of each lamp they see."""
    frame, count = scene.frame, grid.rows * grid.columns // 4
    flux, seen = dr.zeros(mi.Float, 4 * count), dr.zeros(mi.Float, scene.lamps * count)
    cells = _coarse_cells(frame, grid)
    i, total = mi.UInt32(0), mi.Vector3f(0) * cells.x.x
    while dr.hint(i < frame.lights.count, label="lamps on skin", exclude=[scene, grid, frame, cells, seen]):
        lit, share = _lamp_on_skin(scene, grid, cells, i)
        dr.scatter(seen, share, cells.index * frame.lights.count + i)
        total += lit
        i += 1
    total = frame.vector_to_scene(total)
    dr.eval(total)
    for k in range(3):
        dr.scatter(flux, total[k], 4 * cells.index + k)
    dr.eval(flux, seen)
    return flux, seen


def _coarse_cells(frame: DeviceFrame, grid: SheetGrid) -> _Cells:
    """Return the cells of a grid over the skin that is half as fine as `grid` in both directions."""
    index, columns = grid.cells[1], grid.size.columns // 2
    row, column = index // columns, index % columns
    middle, normal = _skin_point(frame, grid, row, column, mi.Float(0.5), mi.Float(0.5))
    x, facing = frame.point_to_eye(middle), frame.vector_to_eye(normal)
    return _Cells(index=index, row=row, column=column, middle=middle, x=x, normal=facing)


def _skin_point(
    frame: DeviceFrame, grid: SheetGrid, row: mi.UInt32, column: mi.UInt32, s: mi.Float, t: mi.Float
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Compute the point and normal (scene's frame) at shares s and t of the way through a coarse cell, across and down.

    The conjunctiva dips into the globe where both join. Neither shades the other there.
    """
    half, columns = mi.UInt32(2 * t), mi.Float(grid.size.columns // 2)
    across = (mi.Float(column) + s) * ((SHEET_COLUMNS - 1) / columns)
    x, n = frame.region.sheet_point(grid.vertex_row(2 * row + half, 2 * t - mi.Float(half)), across)
    centre = frame.point_to_scene(frame.sclera.centre)
    out = x - centre
    return centre + out * dr.maximum(1, (frame.sclera.radius + _JOINT_MM) * dr.rcp(dr.norm(out))), n


@syntax
def _lamp_on_skin(scene: TissueScene, grid: SheetGrid, cells: _Cells, i: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
    """Compute the vector F (eye frame) of lamp i at coarse cells, and the share of the lamp that they see."""
    frame, lamp = scene.frame, scene.frame.lights[i]
    before = scene.wide | (dr.dot(lamp.position - cells.x, cells.normal) > 0)
    clear = frame.caches.shadow_maps.at(i, cells.middle, before)
    count = dr.select(before, dr.select(clear & ~scene.wide, 1, scene.skin_rays), 0)
    k, flux, free = mi.UInt32(0), mi.Vector3f(0), mi.Float(0)
    while dr.hint(k < count, label="points of a lamp", exclude=[scene, grid, cells, frame, lamp]):
        s, t = _shifted(cells.index, 0, k)
        u, v = _shifted(cells.index, 1, k)
        start = frame.point_to_eye(_skin_point(frame, grid, cells.row, cells.column, s, t)[0])
        source = lamp.point(u, *dr.sincos(v * (2 * dr.pi)))
        hidden = lamp_blocked(frame, start, source, True, True, ~clear)
        to = dr.select(scene.wide, source, lamp.position) - cells.x
        inv2 = dr.rcp(dr.squared_norm(to))
        to *= dr.sqrt(inv2)
        dark = hidden | (dr.dot(to, cells.normal) <= 0)
        flux += dr.select(dark, 0, lamp.radiant_intensity(-to) * inv2 * lamp.shade(cells.x, source)) * to
        free += dr.select(hidden, 0, 1)
        k += 1
    share = dr.rcp(dr.maximum(mi.Float(count), 1))
    return flux * share, free * share


def light_on_globe(
    scene: TissueScene, grid: GlobeGrid, size: SheetSize, lit: mi.Float, skin: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Compute the irradiance of the globe's grid, and the share of each lamp that cells see.

    Cells under the conjunctiva receive the light that falls on it, as if it were a part of the globe. `size`: size of
    the grid over the skin; `lit`: irradiance of that grid; `skin`: the same after diffusion in the skin.
    """
    # Light through a lid varies slowly, so it is computed for two by two cells.
    coarse = dr.zeros(mi.Float, SIDE * SIDE // 4)
    dr.scatter(coarse, _through_lids(scene, grid.coarse, size, skin), grid.coarse)
    cells = dr.zeros(mi.Float, SIDE * SIDE)
    dr.scatter(cells, dr.gather(mi.Float, coarse, grid.over), grid.under)
    direct, seen = _lamps_on_globe(scene, grid.between)
    covered, above = _on_sheet_above(scene, grid.between, size, lit)
    total = dr.gather(mi.Float, cells, grid.between) + dr.select(covered, above, direct)
    dr.scatter(cells, total, grid.between)
    return cells, seen


def _on_sheet_above(scene: TissueScene, index: mi.UInt32, size: SheetSize, lit: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Return which cells of the globe the sheet covers, and its irradiance `lit` above them."""
    frame, skin = scene.frame, scene.frame.region
    n = globe_direction(mi.Float(index // SIDE), mi.Float(index % SIDE))
    start = frame.point_to_scene(_globe_surface(frame, n)[0])
    hit = _next_surface(frame, start, n, mi.Float(0), mi.Bool(True))
    face = skin.face(hit)
    covered = hit.is_valid() & skin.on_sheet(face)
    u, v = skin.map_place(face, hit.prim_uv, covered)
    return covered, size.cells(*size.place(u, v), 0).interpolate(mi.Float, lit)


@syntax
def _lamps_on_globe(scene: TissueScene, index: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Compute the direct irradiance of cells of the globe, and the share of each lamp that they see."""
    lights = scene.frame.lights
    seen = dr.zeros(mi.Float, scene.lamps * SIDE * SIDE)
    i, total = mi.UInt32(0), mi.Float(0) * mi.Float(index)
    while dr.hint(i < lights.count, label="lamps on globe", exclude=[scene, lights, seen]):
        lit, share = _lamp_on_globe(scene, index, i)
        dr.scatter(seen, share, index * lights.count + i)
        total += lit
        i += 1
    dr.eval(total, seen)
    return total, seen


@syntax
def _lamp_on_globe(scene: TissueScene, index: mi.UInt32, i: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Compute the irradiance of cells of the globe from lamp i, and the share of the lamp that they see."""
    frame, lamp = scene.frame, scene.frame.lights[i]
    k, total, free = mi.UInt32(0), mi.Float(0), mi.Float(0)
    while dr.hint(k < scene.globe_rays, label="in cells", exclude=[scene, frame, lamp]):
        s, t = _shifted(index, 0, k)
        row, column = mi.Float(index // SIDE) + t - 0.5, mi.Float(index % SIDE) + s - 0.5
        x, normal = _globe_surface(frame, globe_direction(row, column))
        x += _ABOVE_MM * normal
        u, v = _shifted(index, 1, k)
        source = lamp.point(u, *dr.sincos(v * (2 * dr.pi)))
        lit = irradiance(lamp, source, x, normal)
        local = frame.surfaces[0].point_in(x)
        outside = local.y * local.y + local.z * local.z > dr.square(frame.limbus.radius)
        hidden = lamp_blocked(frame, x, source, False, outside, lit > 0)
        total += dr.select(hidden, 0, lit)
        free += dr.select(hidden, 0, 1)
        k += 1
    share = dr.rcp(mi.Float(scene.globe_rays))
    return total * share, free * share


def _globe_surface(frame: DeviceFrame, n: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Compute the point and normal (eye frame) of the globe along directions (scene's frame) from its centre."""
    away = 8.0
    d = frame.vector_to_eye(n)
    o = frame.sclera.centre + (frame.sclera.radius + away) * d
    front = frame.surfaces[0]
    ol, dl = front.point_in(o), front.vector_in(-d)
    t, met, facing = front.meet(ol, dl)
    y = ol + t * dl
    met &= (y.y * y.y + y.z * y.z < dr.square(frame.limbus.radius)) & (y.x > frame.limbus.floor) & (t < away)
    return o - dr.select(met, t, away) * d, dr.normalize(dr.select(met, front.vector_out(facing), d))


def _through_lids(scene: TissueScene, index: mi.UInt32, size: SheetSize, lit: mi.Float) -> mi.Float:
    """Compute the irradiance of two by two cells of the globe through lids: exp(-k t) of that on the lid's skin."""
    frame, skin, half = scene.frame, scene.frame.region, SIDE // 2
    n = globe_direction(2 * mi.Float(index // half) + 0.5, 2 * mi.Float(index % half) + 0.5)
    start = frame.point_to_scene(_globe_surface(frame, n)[0])
    inner = _next_surface(frame, start, n, mi.Float(EPSILON_MM), mi.Bool(True))
    outer = _next_surface(frame, start, n, inner.t + _BETWEEN_MM, inner.is_valid())
    both = outer.is_valid()
    face = dr.select(both, skin.face(outer), skin.face(inner))
    uv = dr.select(both, outer.prim_uv, inner.prim_uv)
    under = inner.is_valid() & skin.on_sheet(face)
    on_lid = size.cells(*size.place(*skin.map_place(face, uv, under)), 0).interpolate(mi.Float, lit)
    return dr.select(under, on_lid * dr.exp(-scene.lid_loss_per_mm * dr.select(both, outer.t, inner.t)), 0)


def _next_surface(
    frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, first: mi.Float, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Compute the first hit along rays beyond a distance and within a lid's thickness; its t counts from the start."""
    ray = mi.Ray3f(mi.Point3f(o + first * d), d)
    ray.maxt = _LID_MM - first
    hit = frame.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    hit.t += first
    return hit


def _shifted(index: mi.UInt32, key: int, k: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return point k of a sequence that is shifted from cell to cell."""
    return sequence(k, mi.sample_tea_32(index, mi.UInt32(_KEYS[key])))
