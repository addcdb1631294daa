"""Compiled functions for cameras that view posed eyes."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, Statuses
from ..base.jit import compiled


@compiled("f8[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1]")
def see_all(
    turn: Floats, shift: Floats, R: Floats, t: Floats, rotation: Floats, translation: Floats, camera_mm: Floats
) -> None:
    """Compute the motions from the eyes' frames to a camera's frame, and the camera's position in each eye's frame.

    Eyes turn by `turn` (n, 3, 3) and move by `shift` (n, 3) mm to the world; R and t (mm) lead from there to the
    camera. `rotation` (n, 3, 3), `translation` (n, 3) and the nodal point `camera_mm` (3, n) are written.
    """
    for i in range(len(turn)):
        for row in range(3):
            x, y, z = R[row, 0], R[row, 1], R[row, 2]
            translation[i, row] = x * shift[i, 0] + y * shift[i, 1] + z * shift[i, 2] + t[row]
            for column in range(3):
                rotation[i, row, column] = x * turn[i, 0, column] + y * turn[i, 1, column] + z * turn[i, 2, column]
        for column in range(3):
            # R^T (0 - t)
            camera_mm[column, i] = -(
                rotation[i, 0, column] * translation[i, 0]
                + rotation[i, 1, column] * translation[i, 1]
                + rotation[i, 2, column] * translation[i, 2]
            )


@compiled("f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i1[:,::1], f8[::1], i8, f8[:,:,::1]")
def project_all(
    rotation: Floats,
    translation: Floats,
    x: Floats,
    y: Floats,
    z: Floats,
    status: Statuses,
    scale: Floats,
    behind: int,
    out: Floats,
) -> None:
    """Project points (n, k) of each eye's frame to pixels f_x X/Z + c_x, f_y Y/Z + c_y; NaN where the status is not 0.

    Rotation and translation are those of `see_all`; `scale` is f_x, c_x, f_y, c_y. `status` (n, k) is set to `behind`
    where a point with status 0 is not in front of the camera; `out` (n, k, 2) is written.
    """
    for i in range(x.shape[0]):
        r, t = rotation[i], translation[i]
        for k in range(x.shape[1]):
            depth = r[2, 0] * x[i, k] + r[2, 1] * y[i, k] + r[2, 2] * z[i, k] + t[2]
            across = r[0, 0] * x[i, k] + r[0, 1] * y[i, k] + r[0, 2] * z[i, k] + t[0]
            down = r[1, 0] * x[i, k] + r[1, 1] * y[i, k] + r[1, 2] * z[i, k] + t[1]
            status[i, k] = behind if status[i, k] == 0 and not depth > 0.0 else status[i, k]
            inverse = 1.0 / depth if status[i, k] == 0 else np.nan
            out[i, k, 0], out[i, k, 1] = (
                scale[0] * (across * inverse) + scale[1],
                scale[2] * (down * inverse) + scale[3],
            )
