"""Results of projecting a region: skin-only tiles, pixels at thin hairs and menisci, and where the lid margins are.

The skin is a sheet with a hole, the fissure, that ends at a border. A ray whose pixel lies inside the border's outline
but outside the hole's outline crosses the sheet, because the number of crossings is the difference of the two winding
numbers. Hairs and the tear meniscus lie in front of the sheet. Menisci, hairs that are thick in the image, and both
outlines are marked with a margin of some pixels; thin hairs are marked pixel by pixel.
"""

from __future__ import annotations

import numpy as np

from ...base.arrays import Bools, Floats
from ...region.mesh import HAIRS, LID_MARKS, LidMargins, RegionMesh
from ...rig.camera import PinholeCamera, Window

_TILE_PX = 8
_STEP_PX = 4.0  # distance between marked points of a curve
_SPARE_PX = 1.0
_HAIR_MM = 0.1  # no hair and no part of a margin is thicker
_THICK_PX, _FINE_STEP_PX, _SLACK_PX = 2.0, 0.5, 0.02
_NEAREST_MM = 3.0  # if hairs are closer to the camera, no tile is skin-only


def skin_only_tiles(region: RegionMesh, camera: PinholeCamera, anchor_mm: Floats, window: Window) -> tuple[Bools, int]:
    """Return which tiles (rows, columns) of a window show only skin and thin hairs, and the tile size (px).

    `supersampled_pixels` marks the thin hairs. No tile qualifies if the region's border is unknown, or if hairs are too
    close to the camera.
    """
    nothing = np.zeros((1, 1), dtype=bool), max(window[2:])
    if len(region.border) == 0:
        return nothing
    hole = np.concatenate([region.upper_margin, region.lower_margin[-2:0:-1]])
    closed = [np.concatenate([c, c[:1]])[None] for c in (hole, region.border)]
    curves = [c for c in (*closed, *region.strands) if c.size]
    hairs = sum(c.size > 0 for c in region.strands[:HAIRS])
    depth = [float(np.min(camera.depth(c + anchor_mm))) for c in curves]
    if min(depth) < _NEAREST_MM or not all(camera.project(c + anchor_mm)[1].all() for c in curves[:2]):
        return nothing
    thick = _HAIR_MM * float(max(camera.K[0, 0], camera.K[1, 1])) / min(depth[2:], default=np.inf)
    reach = _STEP_PX / 2 + _SPARE_PX + thick
    tile = max(_TILE_PX, int(np.ceil(2 * reach)))
    x0, y0, width, height = window
    shape = (-(-height // tile), -(-width // tile))
    corner = np.array([x0, y0]) - 0.5
    marked = np.zeros(shape, dtype=bool)
    outlines = []
    for k, curve in enumerate(curves):
        if 2 <= k < 2 + hairs and _thin(depth[k], camera):
            continue
        xy = (camera.project(curve + anchor_mm)[0] - corner) / tile
        if k < 2:
            outlines.append(_winding(xy[0], shape))
        _mark(marked, _pieces(xy, shape)[:2], _STEP_PX / tile, reach / tile)
    return (outlines[1] != 0) & (outlines[0] == 0) & ~marked, tile


def supersampled_pixels(
    region: RegionMesh | None, camera: PinholeCamera, anchor_mm: Floats, window: Window
) -> tuple[Bools, Bools]:
    """Return the pixels (height, width) of a window at menisci, or touched by hairs at most two pixels thick.

    The second result marks pixels that may show menisci: all of them if a meniscus is too close. The marks of a pixel
    do not depend on the window.
    """
    if region is None:
        return np.zeros((window[3], window[2]), dtype=bool), np.zeros((window[3], window[2]), dtype=bool)
    fine = np.zeros((window[3], window[2]), dtype=bool)
    for curve, radii in zip(region.strands[:HAIRS], region.radii, strict=True):
        _mark_hairs(fine, curve + anchor_mm, radii, camera, window)
    # Menisci are grids; their rows are the strands.
    grids = region.strands[HAIRS:]
    wet, every = _drawn([*grids, *(grid.transpose(1, 0, 2) for grid in grids)], camera, anchor_mm, window)
    wet = _with_beside(wet)
    return fine | wet, wet | (not every)


def _thin(depth_mm: float, camera: PinholeCamera) -> bool:
    """Return whether hairs at this depth are thin in the image."""
    focal = float(max(camera.K[0, 0], camera.K[1, 1]))
    return depth_mm >= _NEAREST_MM and _HAIR_MM * focal <= _THICK_PX * depth_mm


def _mark_hairs(marked: Bools, curves: Floats, radii: Floats, camera: PinholeCamera, window: Window) -> None:
    """Mark the pixels of a window that hairs touch, unless the hairs are thick or too close."""
    depth = camera.depth(curves)
    focal = float(max(camera.K[0, 0], camera.K[1, 1]))
    if not curves.size or not _thin(float(depth.min()), camera):
        return
    # Away from the optical axis the image is stretched.
    way = curves - camera.nodal_point_mm
    distance = np.linalg.norm(way, axis=-1)
    stretch = camera.stretch(way @ camera.axis / distance) if camera.is_fisheye else distance / depth
    thick = radii * focal * stretch / depth + _SLACK_PX
    start, way, ends = _pieces(camera.project(curves)[0] - window[:2], marked.shape, thick)
    half = np.maximum(*ends.T)
    # Along x or y, whichever a piece follows more closely, each pixel has a few pixels across it.
    steep = np.abs(way[:, 1]) > np.abs(way[:, 0])
    a, b = (np.where(steep, v[:, ::-1].T, v.T) for v in (start, way))
    slope = b[1] / np.where(b[0] == 0, 1, b[0])
    first = np.rint(np.minimum(a[0], a[0] + b[0]) - half).astype(int)
    count = np.rint(np.maximum(a[0], a[0] + b[0]) + half).astype(int) - first + 1
    which = np.repeat(np.arange(len(count)), count)
    along = first[which] + np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    share = np.clip((along - a[0][which]) / np.where(b[0] == 0, 1, b[0])[which], 0, 1)
    middle = a[1][which] + share * b[1][which]
    reach = (half * np.sqrt(1 + slope * slope) + 0.5 * np.abs(slope))[which]
    low, high = (np.rint(middle + side * reach).astype(int) for side in (-1, 1))
    steep = steep[which]
    for k in range(int(np.max(high - low, initial=-1)) + 1):
        across = low + k
        row, column = np.where(steep, along, across), np.where(steep, across, along)
        there = (across <= high) & (row >= 0) & (column >= 0) & (row < marked.shape[0]) & (column < marked.shape[1])
        marked[row[there], column[there]] = True


def _drawn(curves: list[Floats], camera: PinholeCamera, anchor_mm: Floats, window: Window) -> tuple[Bools, bool]:
    """Return the pixels on curves, in a window and a one-pixel border, and whether no curve is too close to draw."""
    x0, y0, width, height = window
    marked, every = np.zeros((height + 2, width + 2), dtype=bool), True
    for curve in (c for c in curves if c.size):
        z = camera.depth(curve + anchor_mm)
        if not _thin(float(z.min()), camera):
            every = False
            continue
        xy = camera.project(curve + anchor_mm)[0] - (x0 - 1, y0 - 1)
        # Pieces outside the window need no points.
        start, way, _ = _pieces(xy, (height + 2, width + 2))
        count = np.ceil(np.hypot(way[:, 0], way[:, 1]) / _FINE_STEP_PX).astype(int) + 1
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        column, row = (
            np.rint(np.repeat(start[:, k], count) + step * np.repeat(way[:, k] / count, count)).astype(int)
            for k in (0, 1)
        )
        inside = (column >= 0) & (column < width + 2) & (row >= 0) & (row < height + 2)
        marked[row[inside], column[inside]] = True
    return marked, every


def _with_beside(marked: Bools) -> Bools:
    """Dilate the marks of a grid by one cell, and drop its border."""
    out = marked[1:-1, 1:-1].copy()
    for beside in (marked[:-2, 1:-1], marked[2:, 1:-1], marked[1:-1, :-2], marked[1:-1, 2:]):
        out |= beside
    return out


def _pieces(xy: Floats, shape: tuple[int, int], values: Floats | None = None) -> tuple[Floats, Floats, Floats]:
    """Cut polylines (n, k, 2) into straight pieces near a grid of this shape: start and displacement (m, 2).

    The third result (m, 2) are `values` (n, k) at the ends of the pieces.
    """
    a, b = xy[:, :-1].reshape(-1, 2), xy[:, 1:].reshape(-1, 2)
    near = (np.maximum(a, b) > -1) & (np.minimum(a, b) < (shape[1] + 1, shape[0] + 1))
    near = near[:, 0] & near[:, 1]
    start = a[near]
    ends = np.zeros((len(start), 2))
    if values is not None:
        ends = np.stack([values[:, :-1].ravel()[near], values[:, 1:].ravel()[near]], axis=1)
    return start, b[near] - start, ends


def _mark(marked: Bools, pieces: tuple[Floats, Floats], step: float, reach: float) -> None:
    """Mark the tiles within `reach`, at most half a tile, of points of the pieces that are `step` tiles apart."""
    rows, columns = marked.shape
    start, way = pieces
    count = np.ceil(np.sqrt(way[:, 0] ** 2 + way[:, 1] ** 2) / step).astype(int) + 1
    which = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)) / np.maximum(count - 1, 1)[which]
    xy = start[which] + share[:, None] * way[which]
    for dx in (-reach, reach):
        column = np.floor(xy[:, 0] + dx).astype(int)
        for dy in (-reach, reach):
            row = np.floor(xy[:, 1] + dy).astype(int)
            there = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            marked[row[there], column[there]] = True


def _winding(xy: Floats, shape: tuple[int, int]) -> Floats:
    """Compute the winding number of a closed polyline (k + 1, 2) about the middle of each tile (rows, columns)."""
    rows, columns = shape
    y = np.arange(rows) + 0.5
    (ax, ay), (bx, by) = xy[:-1].T[..., None], xy[1:].T[..., None]
    turn = ((ay <= y) & (by > y)).astype(int) - ((ay > y) & (by <= y))
    edge, row = np.nonzero(turn)
    share = (y[row] - ay[edge, 0]) / (by[edge, 0] - ay[edge, 0])
    x = ax[edge, 0] + share * (bx[edge, 0] - ax[edge, 0])
    # A crossing counts for all tile centres beyond it.
    column = np.clip(np.ceil(x - 0.5).astype(int), 0, columns)
    steps = np.zeros((rows, columns + 1), dtype=int)
    np.add.at(steps, (row, column), turn[edge, row])
    return np.cumsum(steps[:, :-1], axis=1)


def lid_margins_px(
    region: RegionMesh | LidMargins, camera: PinholeCamera, anchor_mm: Floats
) -> dict[str, list[list[float]]] | None:
    """Compute landmarks along the inner edges of both lid margins, in full-sensor pixels.

    They run from canthus to canthus, from temple to nose. None if the mesh's margins are unknown, or a landmark lies
    behind the camera.
    """
    if len(region.upper_margin) == 0:
        return None
    both = region.upper_margin, region.lower_margin
    marks = [margin[np.linspace(0, len(margin) - 1, LID_MARKS).round().astype(int)] for margin in both]
    xy, front = camera.project(np.stack(marks) + anchor_mm)
    return dict(zip(("upper", "lower"), np.round(xy, 4).tolist(), strict=True)) if np.all(front) else None
