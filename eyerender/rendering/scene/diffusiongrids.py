"""Select the grid cells of subsurface light (see `diffusion`) that matter in a pose, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...base.arrays import Bools, Floats, Ints, Singles, frozen
from ...optics.diffusion import half_space_length_mm, slab_length_mm
from ...region.globe import Globe
from ...region.mesh import RegionMesh, sheet_neighbours
from ...region.skin import SHEET_ROWS, sheet_place
from ...rig.stray import misses_light
from ..records.job import RenderJob

GRID_ROWS, GRID_COLUMNS = 160, 768  # size of the finer grid over the sheet of skin
SIDE = 192  # size of the grid over the front of the globe
WIDTH = 2.5  # width of this grid in units of the globe's radius, in Lambert's equal-area projection
_REDUCTIONS = 2  # reductions of the skin's grid by 2 each, with separate marks of their cells
_FINE_PX_PER_MM = 11.0  # in images with fewer pixels per mm, every second row and column of the skin suffices
_SPARE, _SPARE_MM = 24.0, 10.0  # reach outside the window from which light arrives: in units of d, and at least
_EDGE_MM = 0.4  # distance from the lid margins within which the globe may be visible


def skin_grain(job: RenderJob) -> int:
    """Return how many rows and columns of the skin's finest grid and map one of this job stands for, 1 or 2."""
    return 1 if float(job.camera.scale_at(job.t)) > _FINE_PX_PER_MM else 2


@dataclass(frozen=True, slots=True)
class DiffusionGrids:
    """Cells of a pose, and the diffusion length d (mm) in skin and sclera."""

    sheet: SheetCells
    globe: GlobeCells
    thick_mm: float
    thin_mm: float

    @classmethod
    def of(cls, job: RenderJob, posed: RegionMesh, spare_px: int) -> DiffusionGrids:
        """Select the cells of a job with a posed region; `spare_px` pixels beyond the window are rendered."""
        scattering = job.look.scattering
        assert scattering is not None
        assert job.region is not None
        thick = half_space_length_mm(job.region.skin.albedo, scattering.skin_per_mm)
        thin = slab_length_mm(job.look.sclera_albedo, scattering.sclera_per_mm)
        sheet = SheetCells.of(posed, job, max(_SPARE * thick, _SPARE_MM), spare_px)
        globe = GlobeCells.of(posed, job.globe, _SPARE * thin)
        return cls(sheet, globe, thick, thin)


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetCells:
    """Cells of the grid over a posed sheet of skin."""

    rows: int  # number of the grid's rows
    columns: int  # number of its columns, which form a closed ring
    # numbers of the cells that matter, and of the surrounding cells on the grid reduced by 2 and by 4
    numbers: tuple[Ints, ...]
    edges: Singles  # row of the sheet's vertices at the edges of the grid's rows
    middles: Singles  # row of the sheet's vertices in their middles

    @classmethod
    def of(cls, posed: RegionMesh, job: RenderJob, spare_mm: float, spare_px: int) -> SheetCells:
        """Select the cells shown in the window, or so close that their light reaches it."""
        each = skin_grain(job)
        rows, columns = GRID_ROWS // each, GRID_COLUMNS // each
        texels = SHEET_ROWS // rows
        edges = sheet_place(np.arange(rows + 1.0) * texels - 0.5)
        sheet = posed.vertices[: posed.layout.vertex_ends[0]]
        shown = _in_window(sheet + job.anchor_mm, job, spare_mm, spare_px)
        near = _grown(np.any(shown[sheet_neighbours()], axis=0))
        middle = sheet_place((np.arange(rows, dtype=float) + 0.5) * texels - 0.5)
        marks = [near[np.rint(middle).astype(int)][:, np.arange(columns) * near.shape[1] // columns]]
        for _ in range(_REDUCTIONS):
            rows_of = marks[-1][::2] | marks[-1][1::2]
            marks.append(_grown(rows_of[:, ::2] | rows_of[:, 1::2]))
        numbers = tuple(np.flatnonzero(m) for m in marks)
        vertex_rows = {"edges": edges.astype(np.float32), "middles": middle.astype(np.float32)}
        return cls(rows=rows, columns=columns, numbers=numbers, **vertex_rows)


@dataclass(frozen=True, slots=True)
class GlobeCells:
    """Numbers of cells of the grid over the globe, as in `diffusion.GlobeGrid`."""

    between: Ints
    under: Ints
    coarse: Ints
    over: Ints

    @classmethod
    def of(cls, posed: RegionMesh, globe: Globe, reach_mm: float) -> GlobeCells:
        """Select the cells of a pose; light spreads up to `reach_mm` from under a lid."""
        centre = globe.centre * globe.mirror
        y, z = (v + c for v, c in zip(_globe_cells(globe.radius_mm), centre[1:], strict=True))
        upper, lower = (m[np.argsort(m[:, 1])] for m in (posed.upper_margin, posed.lower_margin))
        over = np.maximum(z - np.interp(y, upper[:, 1], upper[:, 2]), np.interp(y, lower[:, 1], lower[:, 2]) - z)
        beside = np.maximum(upper[0, 1] - y, y - upper[-1, 1])
        away = np.maximum(over, beside)
        between, under = np.flatnonzero(away < _EDGE_MM), np.flatnonzero((away > 0) & (away < reach_mm))
        over = under // SIDE // 2 * (SIDE // 2) + under % SIDE // 2
        coarse = np.flatnonzero(np.bincount(over, minlength=SIDE * SIDE // 4))
        return cls(between, under, coarse, over)


@lru_cache(maxsize=4)
def _globe_cells(radius_mm: float) -> tuple[Floats, Floats]:
    """Compute positions (y, z) mm of the cells of the grid over the globe, relative to its centre."""
    row, column = np.divmod(np.arange(SIDE * SIDE), SIDE)
    a, b = ((k - 0.5 * (SIDE - 1)) * (WIDTH / SIDE) for k in (column, row))
    scale = radius_mm * np.sqrt(np.maximum(1 - 0.25 * (a * a + b * b), 0))
    return frozen(a * scale), frozen(b * scale)


def _in_window(points: Floats, job: RenderJob, spare_mm: float, spare_px: int) -> Bools:
    """Return which points (n, 3) project into a window or its margin."""
    camera, whole = job.viewer(), misses_light(job.lens, job.camera, job.window)
    x0, y0, width, height = (0, 0, *camera.resolution_px) if whole else job.window
    xy, front = camera.project(points)
    depth = np.maximum(camera.depth(points), 1.0)
    widest = 2.0 if camera.is_fisheye else 1.0  # theta / sin theta is at most 2 where a fisheye sees
    spare = spare_px + spare_mm * widest * float(max(camera.K[0, 0], camera.K[1, 1])) / depth
    with np.errstate(invalid="ignore"):
        inside = np.abs(xy - (x0 + 0.5 * width, y0 + 0.5 * height)) < 0.5 * np.array([width, height]) + spare[..., None]
    return np.asarray(front & inside[..., 0] & inside[..., 1])


def _grown(marked: Bools) -> Bools:
    """Dilate marks of a grid by one cell; its columns form a closed ring."""
    out = marked | np.roll(marked, 1, axis=1) | np.roll(marked, -1, axis=1)
    grown = out.copy()
    grown[1:] |= out[:-1]
    grown[:-1] |= out[1:]
    return grown
