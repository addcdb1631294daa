"""Results change only together with their version."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.support import golden

CHANGED = (
    "what this package computes has changed. If that is intended, raise RESULTS in folders/imagefolder.py, say so in "
    "CHANGELOG.md, and run: python -m tests.support.golden"
)


@pytest.fixture(scope="module")
def stored():
    return json.loads(golden.STORED.read_text(encoding="utf-8"))


def test_analytic_results_are_those_of_the_version(stored):
    found = golden.analytic()
    for name in golden.EYES:
        # Other processors and libraries differ in the last digits only.
        np.testing.assert_allclose(found[name], stored["analytic"][name], 0, 1e-7, err_msg=f"{name}: {CHANGED}")


@pytest.mark.fast
def test_rendered_results_are_those_of_the_version(stored):
    found = golden.images()
    for name, pictures in stored["images"].items():
        for kind, blocks in pictures.items():
            # A pixel that rounds the other way on another processor changes a block's mean by 1/256.
            away = np.abs(np.array(found[name][kind]) - np.array(blocks))
            assert np.quantile(away, 0.99) < 0.05, f"{name}, {kind}: {CHANGED}"
            assert away.max() < 1.0, f"{name}, {kind}: {CHANGED}"
