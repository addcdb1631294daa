"""Large saturated glints: lamps seen as bars or rings, blooming, and smear, which no Gaussian describes.

Such a glint is one patch of saturated or nearly saturated pixels on the cornea. Its position is the centroid of its
light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...arrays import Bools, frozen
from ...geometry.ellipse import Ellipse
from ...status import Status
from ..preprocessing import DN, Image, Prepared
from ..result import GlintResult

# The cornea's reflections lie within its radius of 6 mm, which is 1.5 to 3 radii of a pupil of 4 to 8 mm.
REACH = 1.8  # from the pupil's centre, in semi-axes a
NEARLY = 0.92  # share of the brightest level near the pupil that counts as saturated (compression lowers some pixels)
LEAST_PX, LEAST = 30, 0.03  # area of a patch in pixels and in b^2; a smaller one is a Gaussian spot or on a lid margin
LONGEST, THICKEST = 1.1, 0.7  # largest sides of the patch in semi-axes b; a lid margin's highlight is longer
STANDS_OUT = 1.5  # steps from pupil to iris by which a patch is brighter than what surrounds it


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A patch: the glint, and the pixels (h, w) that belong to it and its flanks."""

    glint: GlintResult
    pixels: Bools


def bloomed_glints(prepared: Prepared, ellipse: Ellipse, step_dn: float) -> list[Patch]:
    """Find large saturated patches on the cornea.

    Args:
        prepared: the image.
        ellipse: the pupil.
        step_dn: step from pupil to iris, DN.
    """
    a, b = ellipse.semi_axes_px.tolist()
    (cx, cy), (height, width) = ellipse.centre_px.tolist(), prepared.linear.shape
    reach = REACH * a + 2.0
    x0, x1 = max(0, math.floor(cx - reach)), min(width, math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(height, math.ceil(cy + reach) + 1)
    crop = prepared.linear[y0:y1, x0:x1]
    if crop.size == 0:
        return []
    saturated = min(prepared.clip_dn, NEARLY * float(crop.max()))
    bright = (crop >= saturated).view(np.uint8)
    least = max(LEAST_PX, LEAST * b * b)
    if np.count_nonzero(bright) < least:
        return []
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    out = []
    for k in range(1, count):
        left, top, w, h, area = stats[k].tolist()
        inside = left > 0 and top > 0 and left + w < crop.shape[1] and top + h < crop.shape[0]
        if area < least or not inside or max(w, h) > LONGEST * b or min(w, h) > THICKEST * b:
            continue
        patch = _patch(crop, labels == k, max(prepared.noise_dn, 1e-3), step_dn, prepared.clip_dn)
        corner = np.array([x0, y0], dtype=np.float64)
        if patch is not None and np.hypot(*(patch.glint.xy_px + corner - ellipse.centre_px)) < REACH * a:
            pixels = np.zeros(prepared.linear.shape, dtype=bool)
            pixels[y0:y1, x0:x1] = patch.pixels
            moved = frozen(patch.glint.xy_px + corner)
            out.append(Patch(replace(patch.glint, xy_px=moved), pixels))
    return out


def _patch(crop: Image, core: Bools, noise_dn: float, step_dn: float, clip_dn: float) -> Patch | None:
    """The glint of a saturated patch, None where its surroundings are nearly as bright."""
    near = cv2.dilate(core.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    ring = cv2.dilate(core.astype(np.uint8), np.ones((13, 13), np.uint8)).astype(bool) & ~near
    top = float(np.median(crop[core]))
    if not ring.any() or top - float(np.quantile(crop[ring], 0.75)) < STANDS_OUT * step_dn:
        return None
    ground = float(np.median(crop[ring]))
    light = np.where(near, np.clip(crop - ground, 0.0, top - ground), 0.0)
    y, x = np.nonzero(near)
    weight = light[y, x] / light[y, x].sum()
    xy = np.array([weight @ x, weight @ y])
    offset = np.stack([x, y]) - xy[:, None]
    moments = (offset * weight) @ offset.T
    # Of a saturated patch only the outline is known: each of its pixels is uncertain by its own size.
    outline = math.sqrt(4.0 * math.pi * core.sum())
    covariance = np.eye(2) * (1.0 / 12.0 + (noise_dn / max(top - ground, 1e-3)) ** 2) * 4.0 / outline
    glint = GlintResult(
        status=Status.OK,
        xy_px=frozen(xy),
        covariance=frozen(covariance),
        amplitude=(top - ground) / DN,
        sigma_px=float(np.linalg.det(moments) ** 0.25),
        saturated=bool(crop[core].max() >= clip_dn),
    )
    return Patch(glint, near)
