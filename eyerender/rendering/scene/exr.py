"""OpenEXR files: linear irradiance in full float precision."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ...arrays import Singles
from ...errors import EyerenderError


@contextmanager
def second_thread() -> Iterator[None]:
    """Lend Dr.Jit a second thread; Mitsuba's OpenEXR hangs where it has a single one."""
    import drjit as dr

    count = dr.thread_count()
    if count > 1:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(count)


def write_exr(path: Path, image: Singles) -> None:
    """Write (h, w) float32 as a one-channel EXR.

    Raises:
        EyerenderError: the disk refuses it.
    """
    import mitsuba as mi

    try:
        # Mitsuba accepts no read-only array, so this is a copy.
        with second_thread():
            mi.Bitmap(np.array(image, dtype=np.float32)[..., None]).write(str(path))
    except RuntimeError as error:
        raise EyerenderError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None
