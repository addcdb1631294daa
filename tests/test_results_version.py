"""Results change only together with their version."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from eyerender.dataset.plan import Plan
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


@pytest.mark.render
@pytest.mark.fast
def test_rendered_results_are_those_of_the_version(stored):
    for name, image in golden.images().items():
        assert golden.changes(image, stored["images"][name]) == [], f"{name}: {CHANGED}"


@pytest.mark.render
@pytest.mark.slow
def test_a_skin_that_is_lighter_by_half_a_percent_is_seen(stored):
    plan = golden.plan_of("dataset_region")
    scene = deepcopy(dict(plan.spec.scene))
    albedo = scene["region"]["skin"]["albedo"]
    albedo |= {bound: 1.005 * albedo[bound] for bound in ("low", "high")}
    lighter = golden.first_image(Plan.of(plan.spec.replaced("test", {"scene": scene}), base=plan.base))
    assert "one block in ten" in golden.changes(lighter, stored["images"]["dataset_region"])


@pytest.mark.render
def test_an_iris_that_is_wider_by_half_a_percent_is_seen(stored):
    plan = golden.plan_of("dataset_quick")
    eye = deepcopy(dict(plan.eyes["E2"]))
    eye["iris"]["root_radius_mm"] *= 1.005
    wider = golden.first_image(replace(plan, eyes={"E2": eye}))
    assert golden.changes(wider, stored["images"]["dataset_quick"])
