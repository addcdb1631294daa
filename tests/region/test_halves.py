"""Half precision against NumPy's."""

from __future__ import annotations

import numpy as np

from eyerender.region.halves import to_halves


def test_halves_are_those_of_numpy():
    rng = np.random.default_rng(7)
    scales = 10.0 ** rng.uniform(-9, 4, (200, 300))
    values = (scales * rng.choice([-1, 1], scales.shape)).astype(np.float32)
    # Numbers between two halves at equal distances, and those around the smallest normal and subnormal halves.
    halves = np.arange(0x7BFF, dtype=np.uint16).view(np.float16).astype(np.float32)
    values = np.concatenate([values.ravel(), halves, 0.5 * (halves[1:] + halves[:-1]), [np.float32(-0.0)]])
    np.testing.assert_array_equal(to_halves(values).view(np.uint16), values.astype(np.float16).view(np.uint16))
