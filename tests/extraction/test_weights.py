"""The file of fitted weights: every weight belongs to a feature, and a damaged table is refused."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from eyerender.extraction import FAST, REFINED, extract
from eyerender.extraction.compile import drawn_eye
from eyerender.extraction.pupil.scoring import features
from eyerender.extraction.weights import FILE, ConfidenceTable, confidence_table, design


@pytest.mark.parametrize("settings", [FAST, REFINED])
def test_every_row_is_a_feature(settings):
    pupil = extract(drawn_eye(), settings=settings).pupil
    table = confidence_table(settings.method)
    assert set(table.names) <= set(features(pupil.ellipse, pupil.goodness))
    # The middle of a range is one half, which exceeds the knots 0 and 1/3.
    row = design(table.limits.mean(axis=0)[None], table.limits)[0]
    np.testing.assert_allclose(row, [1.0, *np.repeat([1.0 / 2.0, 1.0 / 6.0, 0.0], len(table.names))], atol=1e-12)


def test_a_damaged_table_is_refused():
    table = json.loads(FILE.read_text())["confidence"]["fast"]
    damaged = copy.deepcopy(table)
    next(iter(damaged["features"].values())).pop()
    for wrong in (damaged, table | {"calibration": [1.0]}, table | {"constant": [1.0, float("nan")]}):
        with pytest.raises(ValueError, match="expected finite numbers of shape"):
            ConfidenceTable.of(wrong)
