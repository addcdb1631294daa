"""Automatic exposure of a dataset: one time for each subject, whatever part of the run is made."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.dataset.maker import Maker
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make, plan

pytestmark = pytest.mark.render
LEVEL = 0.6


def test_each_subject_has_one_exposure(tmp_path):
    spec = plan(
        count=4,
        subjects=2,
        shard_size=2,
        splits={"train": 1.0},
        auto_exposure=LEVEL,
        **{
            "scene.sensor.exposure_ms": {"draw": "uniform", "low": 2, "high": 20},
            "scene.rig.lights.0.intensity_mw_sr": {"draw": "uniform", "low": 5, "high": 50, "per": "subject"},
        },
    )
    make(tmp_path / "run", spec)
    entries = ImageFolder.load(tmp_path / "run").entries
    times = [json.loads(e.line["parameters"]["scene_json"])["sensor"]["exposure_ms"] for e in entries]
    assert times[0] == times[1] != times[2] == times[3]
    for entry in entries[::2]:
        codes, depth = read_image(entry.path)
        # The exposure was settled without noise, on a picture of few samples.
        assert np.quantile(codes, 0.98) / (2**depth - 1) == pytest.approx(LEVEL, abs=0.03)
    assert validate(tmp_path / "run")["ok"]
    # The last sample of a subject alone has the exposure that its first one settles.
    (alone,) = Maker(spec, 1).make(3).images
    np.testing.assert_array_equal(alone.pictures["images"], read_image(entries[3].path)[0])
