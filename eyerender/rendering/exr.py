"""Writing OpenEXR files: linear irradiance in full float precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import EyerenderError


def write_exr(path: Path, image: NDArray[np.float32]) -> None:
    """Write (h, w) float32 as a one-channel EXR; raises `EyerenderError` where the disk refuses it."""
    import mitsuba as mi

    try:
        # A copy, because Mitsuba takes no read-only array.
        mi.Bitmap(np.array(image, dtype=np.float32)[..., None]).write(str(path))
    except RuntimeError as error:
        raise EyerenderError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None
