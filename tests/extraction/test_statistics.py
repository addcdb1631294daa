"""Medians and quantiles against numpy's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from eyerender.extraction.statistics import median, quantile


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
@pytest.mark.parametrize("size", [1, 2, 3, 10, 101, 1000])
def test_as_numpy_has_them(size, dtype):
    values = (np.random.default_rng(size).normal(100.0, 20.0, size)).astype(dtype)
    assert median(values) == pytest.approx(float(np.median(values)), rel=1e-6)
    for share in (0.0, 0.03, 0.25, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(float(np.quantile(values, share)), rel=1e-5)


def test_of_none_is_not_a_number():
    assert math.isnan(median(np.zeros(0)))
