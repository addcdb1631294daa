"""The face around the eye without its lids: depth x (mm) of the skin over (y nasal, z up).

It is a smooth surface through a table of depths about the corneal apex. The lateral orbital rim lies 16 to 18 mm behind
it (Hertel's exophthalmometry: means of 15.0 mm, Wu et al. 2015, and 15.7 mm, Karti et al. 2015, with 2 to 3 mm of
spread). The inner canthus (8 mm behind), nasion (8 to 10 mm in front), supraorbital ridge (5 mm in front), tip of the
nose (28 mm in front) and everything in between were set by visual judgement. The face is mirrored at its middle.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import RectBivariateSpline

from ..base.arrays import Floats
from .anatomy import Face

MIDDLE_MM = 31.5
_Y = np.array([-75.0, -60.0, -46.0, -36.0, -27.0, -19.0, -11.0, 0.0, 10.0, 16.5, 22.0, 27.0, 31.5])
_Z = np.array([-62.0, -53.0, -45.0, -32.0, -22.0, -14.0, -7.0, 0.0, 6.0, 12.0, 17.0, 22.0, 28.0, 38.0, 52.0, 68.0])
# Rows are z from below upwards, columns y from the temple to the middle of the nose.
_DEPTH = np.array([
    [-62, -44, -33, -25, -18, -13, -8.5, -3.0, 2.0, 6.5, 11.0, 14.0, 15.0],
    [-60, -42, -31, -23, -16, -11, -7.2, -3.0, 1.5, 9.0, 14.0, 17.0, 18.5],
    [-58, -40, -29, -21, -14, -9.5, -6.0, -2.4, 1.5, 11.0, 18.0, 25.5, 29.5],
    [-55, -38, -26, -18.5, -12.5, -8.8, -6.0, -3.4, -0.3, 5.0, 11.5, 20.0, 24.5],
    [-54, -37, -26, -17.0, -11, -7.6, -5.2, -3.6, -2.2, 0.6, 6.0, 13.5, 18.0],
    [-53, -37, -26, -17.5, -11.4, -8.0, -5.6, -4.2, -3.4, -2.4, 2.0, 8.5, 12.5],
    [-52, -37, -26.5, -18.5, -12.6, -9.2, -7.2, -6.4, -5.8, -5.0, -0.6, 6.0, 9.6],
    [-51, -37, -27, -19.5, -13.6, -10.4, -9.4, -10.0, -9.2, -7.2, -2.0, 4.2, 8.0],
    [-50, -36, -26.5, -19, -13, -9.2, -7.4, -7.2, -7.2, -6.6, -2.0, 4.6, 7.8],
    [-49, -35, -25.5, -18, -11.6, -7.6, -5.4, -4.8, -5.2, -4.8, -0.8, 4.8, 7.6],
    [-48, -33, -24, -16.5, -10.4, -6.0, -3.2, -2.0, -2.4, -1.8, 1.4, 5.4, 7.6],
    [-46, -31, -22, -15, -9, -4.2, -1.0, 0.8, 1.4, 2.4, 4.4, 6.8, 8.2],
    [-45, -29.5, -20, -13, -7, -2.2, 1.0, 3.0, 4.0, 5.0, 6.4, 8.0, 9.0],
    [-44, -28.5, -19, -12, -6, -1.5, 1.4, 3.4, 4.8, 5.8, 6.8, 7.8, 8.4],
    [-46, -30, -20, -13, -7, -2.2, 0.8, 3.0, 4.6, 5.6, 6.4, 7.0, 7.4],
    [-50, -34, -24, -17, -11, -6, -2.6, 0.0, 1.8, 3.0, 3.8, 4.4, 4.6],
])  # fmt: skip


def face_depth(face: Face, y_mm: Floats, z_mm: Floats) -> Floats:
    """Compute the depth x (mm) of the face over points (y, z) of the region's frame."""
    off = MIDDLE_MM - y_mm
    # The face is mirrored, and smoothed where the halves meet. More than a centimetre away the smoothing has no effect.
    folded = MIDDLE_MM - (np.sqrt(off * off + 5.5**2) - 5.5 * np.exp(-((off / 9.0) ** 2)))
    spline = _spline(face)
    return np.asarray(spline.ev(np.clip(z_mm, _Z[0], _Z[-1]), np.clip(folded, _Y[0], _Y[-1])))


@lru_cache(maxsize=32)
def _spline(face: Face) -> RectBivariateSpline:
    y, z = _Y[None, :], _Z[:, None]

    def hill(cy: float, cz: float, wy: float, wz: float) -> Floats:
        return np.asarray(np.exp(-(((y - cy) / wy) ** 2) - ((z - cz) / wz) ** 2))

    depth = (
        _DEPTH
        + face.brow_ridge_mm * hill(0.0, 27.0, 26.0, 9.0)
        + face.sulcus_mm * hill(0.0, 12.0, 18.0, 6.0)
        + face.nose_mm * hill(MIDDLE_MM, 0.0, 9.0, 60.0)
        + face.cheek_mm * hill(-8.0, -30.0, 28.0, 14.0)
    )
    return RectBivariateSpline(_Z, _Y, depth, kx=3, ky=3, s=12.0)
