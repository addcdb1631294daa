"""Write OpenEXR files: linear irradiance in full float precision."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ...base.arrays import Singles
from ...base.errors import EyerenderError


@contextmanager
def second_thread() -> Iterator[None]:
    """Give Dr.Jit a second thread; Mitsuba's OpenEXR hangs with a single one."""
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
    """Write irradiance (h, w), W/m^2, as a one-channel EXR with the attributes `quantity` and `unit` in its header.

    Raises:
        EyerenderError: the file cannot be written.
    """
    import mitsuba as mi

    try:
        # a copy, because Mitsuba rejects read-only arrays
        with second_thread():
            bitmap = mi.Bitmap(np.array(image, dtype=np.float32)[..., None])
            header = bitmap.metadata()
            header["quantity"], header["unit"] = "irradiance", "W/m^2"
            bitmap.write(str(path))
    except RuntimeError as error:
        raise EyerenderError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None
