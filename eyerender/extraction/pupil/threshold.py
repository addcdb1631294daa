"""The pupil as laboratory trackers report it: area and centre of mass of the pixels beyond a threshold."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ...optics.ellipse import Ellipse, signed_distance
from .boundary import PupilCandidate
from .glare import around

REACH = 2.0  # half the side of the square that is thresholded, in semi-axes a


def threshold_pupil(found: PupilCandidate, filled: bool) -> Ellipse | None:
    """Threshold the image around a boundary half-way between pupil and iris.

    Of the connected regions in the square of REACH about the boundary, the one with most pixels inside it counts. Lids
    and reflections at the rim cut it, and lashes or shadows that touch the pupil belong to it; if `filled`, reflections
    that it encloses do, too. Returns the ellipse with the region's centre of mass, its area in pixels (pi a b) and the
    orientation and ratio of axes of its second moments; None if no pixel inside the boundary is beyond the threshold.
    """
    outline, linear = found.boundary.ellipse, found.image.linear
    columns, rows = around(outline.centre_px, REACH * float(outline.semi_axes_px[0]), linear.shape)
    level = found.candidate.inside_dn + 0.5 * found.candidate.step_dn
    dark = (linear[rows, columns] < level).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=4)
    y, x = np.mgrid[rows, columns]
    inside = signed_distance(outline, np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(dark.shape) < 0.0
    pixels = np.bincount(labels[inside & (dark > 0)], minlength=1)
    if pixels.max() == 0:
        return None
    region = (labels == pixels.argmax()).astype(np.uint8)
    if filled:
        outside, _ = cv2.findContours(region, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(region, outside, -1, 1, cv2.FILLED)
    m = cv2.moments(region, binaryImage=True)
    # A pixel is a square, whose own second moment is 1/12.
    moments = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"] + np.eye(2) / 12.0
    (short, long), vectors = np.linalg.eigh(moments)
    ratio = math.sqrt(math.sqrt(long / short))
    radius = math.sqrt(m["m00"] / math.pi)
    centre = np.array([columns.start + m["m10"] / m["m00"], rows.start + m["m01"] / m["m00"]])
    axes = np.array([radius * ratio, radius / ratio])
    return Ellipse(centre, axes, math.atan2(vectors[1, 1], vectors[0, 1]))
