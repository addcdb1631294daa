"""Subjects, splits and picture size from the command line."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections import Counter
from functools import cache

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
from tests.support.dataset_specs import write


def loaded(path, **options):
    return Plan.load(path, changes=PlanOptions(**options))


def test_subjects_and_splits_are_replaced(tmp_path):
    plan = loaded(write(tmp_path / "tiny.yaml"), subjects=8, splits="train=.75,test=.25")
    assert Counter(plan.split_of(s) for s in range(8)) == {"train": 6, "test": 2}
    assert [plan.subject_of(i)[0] for i in (0, 2, 3, 23)] == [0, 0, 1, 7]


@pytest.mark.parametrize("count", [8, 24, 100])
def test_subjects_are_those_of_the_whole_dataset(tmp_path, count):
    """Also beyond the plan of 24 samples, which then grows instead of being continued by new subjects."""
    selection = loaded_of(tmp_path, count, subjects=8).spec.selection
    images = Counter(selection.subject_of(i) for i in selection.samples)
    assert sorted(images) == list(range(8))
    assert max(images.values()) - min(images.values()) <= 1
    assert sum(images.values()) == count


def loaded_of(tmp_path, count, **options):
    return Plan.load(write(tmp_path / "tiny.yaml"), count=count, changes=PlanOptions(**options))


def test_a_dataset_of_given_subjects_grows_within_its_plan(tmp_path):
    digests = {loaded_of(tmp_path, count, subjects=8).digest for count in (8, 16, 24)}
    assert len(digests) == 1
    assert loaded_of(tmp_path, 25, subjects=8).digest not in digests


def test_samples_per_pixel_are_replaced(tmp_path):
    assert loaded(write(tmp_path / "tiny.yaml"), spp=5).draw(3).build().spec.image.spp == 5
    drawn = write(tmp_path / "drawn.yaml", **{"scene.image": {"draw": "choice", "values": [{"spp": 2}, {"spp": 3}]}})
    with pytest.raises(InputError, match="--spp: the spec draws the whole image"):
        loaded(drawn, spp=5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argv", "shards"),
    [
        (["--count", "5000000", "--subjects", "1000", "--layout", "webdataset"], 5000),
        (["--count", "5000800", "--layout", "webdataset", "--shard-size", "500"], 10002),  # 1645 plans
    ],
)
def test_a_dry_run_states_shards_of_a_stated_size(argv, shards):
    """In processes of their own; five million samples take at most twice the time of 240, start of Python included."""
    (few, cpu_s), (many, more_cpu_s) = (_dry_run(*options) for options in ((), argv))
    assert (few, many) == (16, shards)  # 240 images of a plan of 3,040
    assert more_cpu_s <= 2.0 * cpu_s


@cache
def _dry_run(*argv):
    """Return the number of shards and the CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = subprocess.run(
        [sys.executable, "-m", "eyerender", "generate", "people_openeds", *argv, "--dry-run", "--json", "-"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads(out.stdout)["shards"], spent


@pytest.mark.parametrize(
    "camera",
    [
        {"focal_length_px": 2400.0, "principal_point_px": [300.0, 250.5]},
        {"focal_length_px": None, "focal_length_mm": 18.0, "sensor_mm": [4.8, 3.6]},
    ],
)
def test_the_camera_scales_with_the_size(tmp_path, camera):
    data = {f"scene.rig.cameras.0.{key}": value for key, value in camera.items()}
    path = write(tmp_path / "tiny.yaml", **data)
    own, half = loaded(path), loaded(path, size="48x36")
    scenes = [plan.draw(7).build() for plan in (own, half)]
    a, b = (scene.rig.cameras[0] for scene in scenes)
    assert (b.resolution_px, scenes[1].spec.image.window_px) == ((320, 240), (48, 36))
    # The same rays: an edge of a pixel of the small picture is an edge of the large one.
    pupils = [trace(scene.frames()).pupil.centre_px[0] for scene in scenes]
    np.testing.assert_allclose(pupils[1] + 0.5, (pupils[0] + 0.5) / 2, atol=1e-6)
    assert a.resolution_px == (640, 480)


def test_lengths_in_pixels_scale_with_the_size(tmp_path):
    drawn = {
        "draw": "mixture",
        "components": [
            {"weight": 0.3, "draw": "fixed", "value": 2.0},
            {"weight": 0.7, "draw": "uniform", "low": 1.0, "high": 3.0},
        ],
    }
    star = {"draw": "choice", "values": [{"blades": 6}, {"blades": 6, "reach_px": 3}]}
    data = {
        "variables": {"edge": {"draw": "uniform", "low": 4, "high": 8}},
        "scene.sensor.psf_sigma_px": drawn,
        "scene.sensor.border_px": [6, 0, 0, 3],
        "scene.lens": {"glare": 0.05, "star": star, "openings": [{"half_size": [1, 1], "edge_px": {"var": "edge"}}]},
    }
    path = write(tmp_path / "tiny.yaml", **data)
    for sample in range(6):
        a, b = (loaded(path, **size).draw(sample).build().spec for size in ({}, {"size": "48x36"}))
        assert b.sensor.psf_sigma_px == pytest.approx(a.sensor.psf_sigma_px / 2)
        assert b.sensor.sharpening_px == pytest.approx(a.sensor.sharpening_px / 2)  # its default, too
        assert b.sensor.border_px == (3, 0, 0, 2)
        assert b.lens.glare_radius_px == pytest.approx(a.lens.glare_radius_px / 2)
        assert b.lens.openings[0].edge_px == pytest.approx(a.lens.openings[0].edge_px / 2)
        assert b.lens.star.reach_px == {40: 20, 3: 2}[a.lens.star.reach_px]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"size": "48x48"}, "--size: must have the shape of 96 x 72"),
        ({"size": "48"}, "--size: must be WIDTHxHEIGHT in pixels, not '48'"),
        ({"size": "0x0"}, "--size: must be WIDTHxHEIGHT"),
        ({"splits": "train:1"}, "--splits: must be NAME=SHARE,NAME=SHARE"),
        ({"splits": "train=8,test=2"}, "--splits: splits: shares must add up to 1, not 10"),
        ({"splits": "Train=1"}, "--splits: splits.Train: a name must consist of"),
        ({"subjects": 25}, "--subjects: must be at most 24, the number of samples, not 25"),
        ({"shard_size": 0}, "--shard-size: must be >= 1, not 0"),
        ({"spp": 0}, "--spp: must be >= 1, not 0"),
    ],
)
def test_wrong_options_are_refused(tmp_path, options, words):
    with pytest.raises(InputError) as caught:
        loaded(write(tmp_path / "tiny.yaml"), **options)
    assert words in str(caught.value)


def test_a_drawn_focal_length_is_scaled_and_a_drawn_size_refused(tmp_path):
    focal = {"draw": "uniform", "low": 2000, "high": 2400}
    path = write(tmp_path / "tiny.yaml", **{"scene.rig.cameras.0.focal_length_px": focal})
    a, b = (loaded(path, **size).draw(0).build().rig.cameras[0] for size in ({}, {"size": "48x36"}))
    assert b.K[0, 0] == pytest.approx(a.K[0, 0] / 2)
    drawn = {"draw": "choice", "values": [[640, 480], [320, 240]]}
    path = write(tmp_path / "drawn.yaml", **{"scene.rig.cameras.0.resolution_px": drawn, "scene.image.window_px": None})
    with pytest.raises(InputError, match="--size: the size of a camera is drawn"):
        loaded(path, size="48x36")
