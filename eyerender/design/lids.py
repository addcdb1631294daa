"""Lids and lashes about people's eyes, and the features that they leave to cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints
from ..eye.model import EyeModel
from ..eye.pose import Poses, rigid_motion
from ..optics.transforms import normalize
from ..region.anatomy import Region
from ..region.contour import inner_margins
from ..region.globe import Globe
from ..region.lashes import free_lashes
from ..region.lids import EDGE_MM, LOWER_TILT_DEG, margin_width_mm
from ..rig.camera import PinholeCamera
from .noise import CORNEAL_RADIUS_MM
from .varied import FeatureSlopes, Views

LEAST_SHARE = 0.5
"""Share of a glint that lashes must leave free for it to count as visible (chosen)."""
_MARGIN_COLUMNS = 44
_ACROSS = (0.2, 0.8, 1.0)  # places across the margin, whose rounded edges are 0 and 1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Lids(ArrayValue):
    """Lids and lashes in the world, for n directions of gaze."""

    margins_mm: Floats  # (n, e, c, 3) lines along the margins around the eye
    lashes_mm: Floats  # (n, k, p, 4) points along the lashes, and the radii of their tubes there; NaN for no lash

    @classmethod
    def of(cls, region: Region, eye: EyeModel, place_mm: Floats, grid_deg: Floats) -> Self:
        """Compute the open lids of an eye for a grid (rows, columns, 2) of azimuth and elevation, row by row.

        They depend mostly on elevation, so they are computed at three azimuths and interpolated. `place_mm` is the apex
        of the unrotated eye.
        """
        rows, columns = grid_deg.shape[:2]
        chosen = np.array([0, columns // 2, columns - 1])
        shares = np.maximum(1.0 - np.abs(np.arange(columns)[:, None] - chosen) / chosen[1], 0.0)

        def everywhere(values: Floats) -> Floats:
            known = values.reshape(rows, len(chosen), int(np.prod(values.shape[1:])))
            return np.asarray((shares @ known).reshape(rows * columns, *values.shape[1:]) + place_mm)

        motions = rigid_motion(Poses.from_degrees(*grid_deg[:, chosen].reshape(-1, 2).T), eye)
        globe = Globe(
            cornea=eye.front[0],
            limbus_radius_mm=float(eye.limbus_radius_mm),
            centre_mm=eye.sclera.centre_mm,
            radius_mm=float(eye.sclera.radius_mm),
            M=np.eye(3),
            t=np.zeros(3),
            mirrored=eye.side == "left",
        )
        inner = everywhere(inner_margins(region, globe, motions, _MARGIN_COLUMNS))
        grown = [free_lashes(region, replace(globe, M=turn, t=shift)) for turn, shift in zip(*motions, strict=True)]
        points = everywhere(np.array([one.points for one in grown]))
        radii = np.broadcast_to(grown[0].radii, points.shape[:-1])
        return cls(
            margins_mm=_across_margin(inner, region, place_mm + eye.sclera.centre_mm),
            lashes_mm=np.concatenate([points, radii[..., None]], axis=3),
        )

    @classmethod
    def joined(cls, parts: Sequence[Lids]) -> Lids:
        """Join the directions of different people."""
        most = max(part.lashes_mm.shape[1] for part in parts)
        room = [((0, 0), (0, most - part.lashes_mm.shape[1]), (0, 0), (0, 0)) for part in parts]
        lashes = [np.pad(part.lashes_mm, pad, constant_values=np.nan) for part, pad in zip(parts, room, strict=True)]
        margins = [part.margins_mm for part in parts]
        return cls(margins_mm=np.concatenate(margins), lashes_mm=np.concatenate(lashes))

    def take(self, rows: Ints) -> Lids:
        """Select directions."""
        return Lids(margins_mm=self.margins_mm[rows], lashes_mm=self.lashes_mm[rows])


def _across_margin(inner_mm: Floats, region: Region, centre_mm: Floats) -> Floats:
    """Compute lines along the margins, (n, len(_ACROSS), c, 3), from their inner edges (n, c, 3) mm; lids are open."""
    angle = 2.0 * np.pi * np.arange(inner_mm.shape[1]) / inner_mm.shape[1]
    upper, lids = np.sin(angle) >= 0.0, region.lids
    normal = normalize(inner_mm - centre_mm)
    up = np.array([0.0, 0.0, 1.0])
    away = normalize(up - normal * normal[..., 2:]) * np.where(upper, 1.0, -1.0)[:, None]
    tilt = np.radians(lids.margin_tilt_deg + np.where(upper, 0.0, LOWER_TILT_DEG))[:, None]
    width = margin_width_mm(lids.margin_mm, angle, upper, 1.0)[:, None]
    out = np.cos(tilt) * normal + np.sin(tilt) * away
    round_mm = EDGE_MM * width / lids.margin_mm
    return np.stack([inner_mm + width * u * out + round_mm * (2 * u - 1) ** 4 * away for u in _ACROSS], axis=1)


def visible(
    slopes: FeatureSlopes, views: Views, camera: PinholeCamera, lids: Lids | None, surface_mm: tuple[Floats, Floats]
) -> tuple[FeatureSlopes, Ints]:
    """Return the features that lids and lashes leave visible, and the numbers (n, 4) of lost glints by reason.

    The reasons are no ray, off the sensor, behind a lid and behind lashes. A glint needs both ways of its light, and
    `LEAST_SHARE` of it between the lashes; a point of the outline counts by its one ray.

    Args:
        slopes: the features of n views.
        views: the views.
        camera: the camera that sees them.
        lids: the lids in these views; None: all is visible.
        surface_mm: where the outline (n, k, 3) and the glints (n, m, 3) are seen on the cornea, NaN without a ray.
    """
    traced = np.isfinite(slopes.images.glints_px).all(axis=2)
    inside = traced & slopes.glint_ok
    passing, left, outline_ok = inside, inside, slopes.outline_ok
    if lids is not None:
        outline_mm, mirror_mm = surface_mm
        for edge in np.moveaxis(lids.margins_mm, 1, 0):
            pixels, _ = camera.project(edge)
            outline_ok = outline_ok & inside_polygon(pixels, slopes.images.outline_px)
            passing = passing & inside_polygon(pixels, slopes.images.glints_px)
            passing = passing & lit_through(edge, mirror_mm, views.lights_mm)
        left = passing & (free_shares(lids, views, camera, mirror_mm) >= LEAST_SHARE)
        seen, node = np.ones(outline_ok.shape), camera.nodal_point_mm
        _leave_free(lids, np.broadcast_to(node, outline_mm.shape[1:]), outline_mm, 0.0 * seen, 0.0, seen)
        outline_ok = outline_ok & (seen > 0.5)
    lost = [~traced, traced & ~inside, inside & ~passing, passing & ~left]
    return replace(slopes, outline_ok=outline_ok, glint_ok=left), np.stack([one.sum(axis=1) for one in lost], axis=1)


def free_shares(lids: Lids, views: Views, camera: PinholeCamera, mirror_mm: Floats) -> Floats:
    """Compute the share (n, m) of each glint that lashes leave free, on its light's ways to the eye and to the camera.

    The light of a lamp of some radius is a round pencil, whose section on the cornea follows from the mirror image.
    """
    node, radii = camera.nodal_point_mm, np.array([light.radius_mm for light in views.rig.lights])
    away, distance = (np.linalg.norm(mirror_mm - place, axis=2) for place in (node, views.lights_mm))
    scale = CORNEAL_RADIUS_MM / (2.0 * distance + CORNEAL_RADIUS_MM)  # of the mirror image, which is this deep, too
    near_mm, out = radii * scale * away / (away + distance * scale), np.ones(away.shape)
    _leave_free(lids, np.broadcast_to(node, (len(radii), 3)), mirror_mm, near_mm, 0.0 * radii, out)
    _leave_free(lids, views.lights_mm, mirror_mm, near_mm, radii, out)
    return out


def _leave_free(
    lids: Lids, starts: Floats, points: Floats, near_mm: Floats, far_mm: Floats | float, out: Floats
) -> None:
    from .lash_kernels import leave_free  # numba is loaded only where lashes are

    far = np.ascontiguousarray(np.broadcast_to(far_mm, len(starts)), dtype=np.float64)
    leave_free(
        np.ascontiguousarray(lids.lashes_mm), np.array(starts), np.ascontiguousarray(points),
        np.ascontiguousarray(near_mm), far, out,
    )  # fmt: skip


def lit_through(edges_mm: Floats, points_mm: Floats, lights_mm: Floats) -> Bools:
    """Return whether each light (m, 3) reaches its point (n, m, 3) through closed curves in space (n, c, 3), (n, m)."""
    out = np.zeros(points_mm.shape[:2], dtype=bool)
    for k, light in enumerate(lights_mm):
        ahead = edges_mm.mean(axis=(0, 1)) - light
        axes = np.linalg.svd(ahead[None])[2]  # the way ahead, and two axes across it
        edge, point = ((places - light) @ axes.T for places in (edges_mm, points_mm[:, k : k + 1]))
        flat = [places[..., 1:] / places[..., :1] for places in (edge, point)]
        out[:, k] = inside_polygon(*flat)[:, 0]
    return out


def inside_polygon(polygon_px: Floats, points_px: Floats) -> Bools:
    """Return whether points (n, k, 2) lie inside closed polygons (n, c, 2), by the parity of crossings to the right."""
    x0, y0 = polygon_px[:, None, :, 0], polygon_px[:, None, :, 1]
    x1, y1 = np.roll(x0, -1, axis=2), np.roll(y0, -1, axis=2)
    x, y = points_px[..., 0:1], points_px[..., 1:2]
    with np.errstate(invalid="ignore", divide="ignore"):
        crosses = (y0 > y) != (y1 > y)
        right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & right).sum(axis=2) % 2 == 1)
