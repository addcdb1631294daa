"""The maximum-likelihood estimator: exact where its model holds, small errors for another eye, storable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import eyerender as er
from eyerender.apps.rigs.report import estimator_errors
from eyerender.design.people import RigPopulation
from eyerender.gaze.store import choose_estimator, load_estimator, save_estimator


@pytest.fixture(scope="module")
def seen():
    scene = er.load_scene("guestrin2006")
    frames = scene.frames()
    rows = np.flatnonzero((frames.index.head == 0) & (frames.index.eye == frames.index.eye.min()))
    return scene, er.trace(frames.take(rows))


def errors(estimator, observations, rig):
    rays = estimator.predict_rays(observations, rig)
    assert rays.ok.all()
    return er.gaze.ray_errors_deg(observations, rays)


def test_it_is_exact_for_its_own_eye(seen):
    """The eye of the scene, with positions that are off by half a millimetre in each frame."""
    scene, observed = seen
    rng = np.random.default_rng(4)
    place = observed.index.eye_position_mm + 0.5 * rng.standard_normal((len(observed), 3))
    observed = replace(observed, index=replace(observed.index, eye_position_mm=place))
    estimator = er.gaze.MaximumLikelihood(scene.eye_spec.name).fit(observed, scene.rig)
    # Features weigh as much as real eyes differ from the model, so the priors pull a little.
    assert errors(estimator, observed, scene.rig).max() < 0.1


def test_another_eye_costs_little_and_the_calibration_can_be_stored(seen, tmp_path):
    scene, observed = seen
    estimator = choose_estimator("maximum-likelihood", eye="E4").fit(observed, scene.rig)
    found = errors(estimator, observed, scene.rig)
    assert found.max() < 0.3
    save_estimator(tmp_path / "c.json", estimator, scene.rig)
    again = load_estimator(tmp_path / "c.json")
    assert errors(again, observed, scene.rig) == pytest.approx(found, abs=1e-12)
    points = again.predict(observed, scene.rig)
    assert points.ok.all()


def test_what_it_cannot_do_is_named(seen):
    scene, observed = seen
    estimator = er.gaze.MaximumLikelihood()
    with pytest.raises(er.InputError, match="not calibrated"):
        estimator.predict_rays(observed, scene.rig)
    with pytest.raises(er.InputError, match="target_mm"):
        estimator.fit(observed.with_targets(np.full(3, np.nan)), scene.rig)


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["headset", "desktop_tracker"])
def test_it_has_the_smallest_error_on_exact_features_of_drawn_people(rig):
    """Median person's 95th percentile, calibrated on nine targets; people differ from each other by a factor of two."""
    survey = RigPopulation(
        scene=er.load_scene(rig).spec.to_mapping(),
        population={"preset": "adults"},
        seed=1,
        unknowns=er.Unknowns.population().to_mapping(),
    )
    found = estimator_errors(survey, list(range(6)))
    e95 = {one.name: float(np.median(np.nanquantile(one.error_deg, 0.95, axis=1))) for one in found}
    assert min(e95, key=lambda name: e95[name]) == "maximum-likelihood"
    assert e95["maximum-likelihood"] < 0.08
