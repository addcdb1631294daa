"""Glints that no Gaussian describes: clipped, oval, streaked or starred ones, and lamps imaged as bars or rings.

Such a glint is one patch of bright pixels. Its position is the centroid of its light, its size that of the area above
half its height.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from ...base.arrays import Bytes, Floats, Indices
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, Prepared
from ..pupil.glare import around
from ..statistics import median
from .fitting import SpotFit, joined

# Share of the brightest level near the pupil, step between pixels, least pixels of a patch, most patches. First those
# with a dull middle, as overloaded sensors show bright glints; then saturated ones, some pixels of which compression
# lowers.
BRIGHT = ((0.6, 2, 5, 8), (0.92, 1, 2, 10))
LONGEST = 2.0  # longest side of a patch in semi-axes b of the pupil, its smear included
HEAD = 0.8  # of the radius of the largest disc in a patch; smear along rows or columns of the sensor is narrower
OUTLINE = (0.5, 0.75)  # shares of the height that outline a patch; the second parts patches that touch
SOLID = 0.85  # least area of an outline over that of its convex hull, unless patches touch
_SQUARE, _PIXEL = np.ones((3, 3), np.uint8), np.eye(2) / 12.0  # second moments of a pixel
_AREA = 2.0 * math.pi * math.log(2.0)  # area of a Gaussian above half its height, in sigma^2
Box = tuple[int, int, int, int]  # first and last column, first and last row


def measure_patches(prepared: Prepared, ellipse: Ellipse, reach_px: float, fit: SpotFit) -> SpotFit:
    """Replace the fits of spots that are patches by patch measurements, and append patches without a spot.

    Patches count within `reach_px` of the pupil's centre. One with a well-fitted spot is left to that fit.
    """
    columns, rows = around(ellipse.centre_px, reach_px, prepared.linear.shape)
    crop, corner = prepared.linear[rows, columns], np.array([columns.start, rows.start])
    longest, owner = max(LONGEST * float(ellipse.semi_axes_px[1]), 8.0), np.zeros(crop.shape, dtype=np.intp)
    place = np.rint(fit.xy_px - corner).astype(np.intp).clip(0, np.array(crop.shape[::-1]) - 1)
    good, parts = place[fit.converged], [fit.taken(np.zeros(0, dtype=np.intp))]
    for left, right, top, bottom in _bright_boxes(crop, prepared.clip_dn, ellipse.centre_px - corner):
        fitted = ((good >= (left, top)) & (good <= (right, bottom))).all(axis=1).any()
        if max(right - left, bottom - top) < longest and not fitted:
            patch = _patch(crop, (left, right, top, bottom), prepared.clip_dn, owner, len(parts))
            parts += [] if patch is None else [patch]
    own = owner[place[:, 1], place[:, 0]]
    described = np.isin(np.arange(len(parts)), own[fit.converged])
    described[0] = True
    patches = joined(parts).taken(np.flatnonzero(~described[1:]))
    return joined([fit.taken(np.flatnonzero(described[own])), replace(patches, xy_px=patches.xy_px + corner)])


def _bright_boxes(crop: Image, clip_dn: float, middle: Floats) -> list[Box]:
    """Boxes of the bright patches nearest to the pupil."""
    boxes: list[Box] = []
    top = float(crop.max(initial=0.0))
    white = min(clip_dn, BRIGHT[-1][0] * top)
    for share, step, least, most in BRIGHT if crop.size else ():
        part, level = crop[::step, ::step], min(clip_dn, share * top)
        closed = cv2.morphologyEx((part >= level).view(np.uint8), cv2.MORPH_CLOSE, _SQUARE)
        # The labels of connected components take five times as long.
        outlines, hierarchy = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        found = [cv2.boundingRect(one) for i, one in enumerate(outlines) if hierarchy[0, i, 3] < 0]  # no holes
        found.sort(key=lambda box: math.hypot(step * box[0] - middle[0], step * box[1] - middle[1]))
        enough = len(boxes) + most
        for x, y, w, h in found:
            if w * h < least:
                continue
            area = np.count_nonzero(closed[y : y + h, x : x + w])
            dull = level == white or np.count_nonzero(part[y : y + h, x : x + w] >= white) < 0.5 * area
            if area >= least and dull:
                boxes.append((step * x, step * (x + w - 1), step * y, step * (y + h - 1)))
                if len(boxes) == enough:
                    break
    return boxes


def _patch(crop: Image, box: Box, clip_dn: float, owner: Indices, number: int) -> SpotFit | None:
    """Measure the patch in a box and mark its pixels with its number in `owner`; None if open or already measured."""
    left, right, top, bottom = box
    margin = max(right - left, bottom - top) // 2 + 4
    rows = slice(max(top - margin, 0), bottom + margin + 1)
    columns = slice(max(left - margin, 0), right + margin + 1)
    window, known = crop[rows, columns], owner[rows, columns]
    y, x = divmod(int(crop[top : bottom + 1, left : right + 1].argmax()), right - left + 1)
    seed = y + top - rows.start, x + left - columns.start
    if known[seed]:
        return None
    ground = median(np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]]))
    height = float(window[seed]) - ground
    core, solid = None, False
    for share in OUTLINE:
        if not solid and (one := _outlined(window, ground + share * height, seed)) is not None:
            solid = one[1]
            core = one[0] if solid or core is None else core
    if core is None or height <= 0.0:
        return None
    near = cv2.dilate(core, _SQUARE).view(bool)
    known[near] = number
    if window[seed] >= clip_dn:
        core = _head(core)
        near = cv2.dilate(core, _SQUARE).view(bool)
    light = np.where(core, height, np.minimum(np.maximum(window - ground, 0.0), height)) * near
    m, area = cv2.moments(light), float(np.count_nonzero(core))
    moments = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"] + _PIXEL
    sigma2 = moments * (area / _AREA / math.sqrt(moments[0, 0] * moments[1, 1] - moments[0, 1] ** 2))
    return SpotFit(
        xy_px=np.array([[m["m10"] / m["m00"] + columns.start, m["m01"] / m["m00"] + rows.start]]),
        # Of a saturated patch only the outline is known: each of its pixels is uncertain by its own size.
        covariance=_PIXEL[None] * (4.0 / math.sqrt(4.0 * math.pi * area)),
        amplitude_dn=np.array([height]),
        sigma_px=np.sqrt(np.diagonal(sigma2))[None],
        background_dn=np.array([ground]),
        residual_dn=np.array([math.inf]),
        moments_px2=sigma2[None],
        clipped=np.array([np.count_nonzero(window[near] >= clip_dn)], dtype=np.intp),
        converged=np.array([True]),
    )


def _outlined(window: Image, level: float, seed: tuple[int, int]) -> tuple[Bytes, bool] | None:
    """Compute the mask (h, w) of pixels above a level around a seed, holes filled; None if it reaches the border.

    Also returns whether the outline is nearly convex; that of two patches that touch is not.
    """
    labels, stats = cv2.connectedComponentsWithStats((window >= level).view(np.uint8), connectivity=8)[1:3]
    x, y, w, h, _ = stats[labels[seed]].tolist()
    if x == 0 or y == 0 or x + w == window.shape[1] or y + h == window.shape[0]:
        return None
    core = (labels == labels[seed]).view(np.uint8)
    outline, _ = cv2.findContours(core, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    solid = cv2.contourArea(outline[0]) >= SOLID * cv2.contourArea(cv2.convexHull(outline[0]))
    return np.asarray(cv2.drawContours(core, outline, -1, 1, cv2.FILLED)), solid


def _head(core: Bytes) -> Bytes:
    """Mask (h, w) without what is narrower than HEAD of its widest part: an opening with a disc."""
    depth = cv2.distanceTransform(core, cv2.DIST_L2, 5)
    radius = HEAD * float(depth.max())
    return np.asarray(
        (cv2.distanceTransform((depth <= radius).view(np.uint8), cv2.DIST_L2, 5) <= radius).view(np.uint8)
    )
