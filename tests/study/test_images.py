"""A study's images: a dataset that resumes after a kill, is used again, and shows what the study's scenes say."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.apps.study import guestrin
from eyerender.apps.study.blignaut_study import BlignautStudy
from eyerender.apps.study.guestrin_study import GuestrinStudy
from eyerender.apps.study.images import (
    dataset_spec,
    in_sequence,
    make_images,
    read_images,
    shots,
)
from eyerender.apps.study.observing import Observing
from eyerender.apps.study.options import StudyOptions
from eyerender.apps.study.run import run_study
from eyerender.apps.study.study import StudyJob
from eyerender.dataset.plan import Plan
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import read_image
from eyerender.imaging.causes import without_noise
from tests.support import stages
from tests.support.paths import ROOT
from tests.support.study_scenes import small_scenes


@pytest.mark.parametrize("study", [GuestrinStudy(), BlignautStudy()])
def test_the_dataset_says_exactly_what_the_study_observes(study):
    """Every sample of the plan is one of the study's own noisy shots: scene, eye file, seed and all; the
    others are the same without noise, and exposed beside them."""
    scenes = [study.scenes(StudyJob(who=eye), p)[""] for eye in ("E1", "E5") for p in ("published", "corrected")]

    def wanted_by(*kinds):
        return [
            shot.scene
            for scene in scenes
            for kind in kinds
            for shot in Observing(kind=kind).shots(scene, facing=study.facing, spp=4)
        ]

    wanted, quiet = wanted_by("image"), wanted_by("image-noiseless")
    spec = dataset_spec("study", wanted_by("image", "image-noiseless"))
    plan = Plan.of(spec)
    assert spec.labels.noiseless
    assert [s.spec for s in quiet] == [without_noise(s).spec for s in wanted]
    assert spec.count == len(wanted) == 2 * 2 * (15 if study.facing else 4) / 2
    half = len(wanted) // 2
    for subject in range(2):  # an eye model, which enters the sequence of its scenes anywhere
        drawn = [plan.draw(subject * half + k) for k in range(half)]
        at = next(k for k, scene in enumerate(wanted) if drawn[0].scene == scene.spec.to_mapping()) - subject * half
        for k, sample in enumerate(drawn):
            scene = wanted[subject * half + (k + at) % half]
            assert sample.scene == scene.spec.to_mapping()
            assert sample.eye["name"] == scene.eye_spec.name
            assert sample.turn.subject == subject
    assert {w.spec.image.spp for w in wanted} == {4}
    # One of them alone is a dataset without the other.
    for alone in (wanted, quiet):
        spec = dataset_spec("study", alone)
        assert (spec.count, spec.labels.noiseless) == (len(alone), False)
        assert Plan.of(spec).draw(0).scene in [scene.spec.to_mapping() for scene in alone[: len(alone) // 2]]
    assert {len(w.frames()) for w in wanted} == {9 if study.facing else 135}


def test_shots_cover_every_observation_once():
    scene = guestrin.scene("E2", guestrin.CORRECTED)
    for turned, count in ((True, 10), (False, 2)):
        parts = shots(scene, noise=True, facing=turned)
        assert len(parts) == count
        rows = np.concatenate([p.rows for p in parts])
        assert sorted(rows) == list(range(len(scene.frames())))
        index = scene.frames().index
        for part in parts:
            own = part.scene.frames().index
            np.testing.assert_array_equal(own.target_mm, index.target_mm[part.rows])
            np.testing.assert_array_equal(own.head_mm, index.head_mm[part.rows])
            np.testing.assert_array_equal(own.eye, index.eye[part.rows])


def test_a_sequence_stands_where_values_differ_and_nowhere_else():
    values = [{"a": 1.0, "b": [1, {"c": k}], "d": {"x": 0} if k else {"y": 0}} for k in (0, 1)]
    found = in_sequence(values)
    assert found["a"] == 1.0
    assert found["b"] == [1, {"c": {"draw": "sequence", "per": "sample", "values": [0, 1]}}]
    assert found["d"] == {"draw": "sequence", "per": "sample", "values": [{"y": 0}, {"x": 0}]}


@pytest.mark.render
def test_images_are_made_once_and_a_part_of_them_serves_too(tmp_path):
    scenes = small_scenes()
    made = make_images("small", scenes, tmp_path / "images", StudyOptions(workers=1))
    report = validate(tmp_path / "images")
    assert (report["ok"], report["images"]) == (True, len(scenes) // 2 * 3)
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "images").rglob("*")}
    for part in (scenes[:2], [s for s in scenes if not s.spec.sensor.noise]):
        assert make_images("small", part, tmp_path / "images", StudyOptions(workers=1)) == made
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "images").rglob("*")} == stamps
    lines = tmp_path / "images" / "metadata.jsonl"
    lines.write_text("".join(reversed(lines.read_text().splitlines(keepends=True))))  # their order means nothing
    assert read_images(tmp_path / "images") == made
    # An image is the one that its scene says: pupil and glints lie where ray optics has them.
    for scene in scenes[:4]:
        truth, seen = trace(scene), made.observe(scene)
        np.testing.assert_allclose(seen.pupil.centre_px, truth.pupil.centre_px, atol=0.5)
    # Noise is all that tells the two exposures apart: the same places within what single pixels vary by.
    noisy, quiet = (read_image(made.of(scene)[0].path)[0] / 257 for scene in scenes[0:3:2])
    assert scenes[2].spec == without_noise(scenes[0]).spec
    assert 0.3 < np.std(noisy - quiet) < 10
    assert abs(np.mean(noisy - quiet)) < 0.5
    # Made on their own, the noiseless ones are the same images.
    alone = make_images("small", scenes[2:4], tmp_path / "alone", StudyOptions(workers=1))
    for scene in scenes[2:4]:
        for own, beside in zip(alone.of(scene), made.of(scene), strict=True):
            assert own.path.read_bytes() == beside.path.read_bytes()


@pytest.mark.render
@pytest.mark.slow
def test_images_exposed_automatically_are_others_and_are_used_again(tmp_path):
    """`tests/dataset/test_functions.py` holds the exposure itself."""
    scenes = small_scenes()[2:4]
    alone = make_images("small", scenes, tmp_path / "alone", StudyOptions(workers=1))
    auto = tmp_path / "alone", StudyOptions(workers=1, auto_exposure=0.3)
    exposed = make_images("small", scenes, *auto)
    assert make_images("small", scenes, *auto) == exposed != alone
    codes = read_image(exposed.of(scenes[0])[0].path)[0]
    assert np.quantile(codes, 0.98) / 65535 == pytest.approx(0.3, abs=0.03)


KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, {root!r})
from eyerender.apps.study.images import make_images
from eyerender.apps.study.options import StudyOptions
from tests.support.study_scenes import small_scenes
make_images("small", small_scenes(), Path({folder!r}), StudyOptions(workers=1))
"""


@pytest.mark.packaging
@pytest.mark.render
def test_a_killed_run_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "killed"
    script = KILLED.format(root=str(ROOT), folder=str(folder))
    # When its shards are finished and are about to be put together.
    hook = stages.environment(tmp_path, folder, match=r"/metadata\.jsonl$", at=1)
    process = subprocess.Popen([sys.executable, "-c", script], start_new_session=True, env=hook)
    assert process.wait() == -signal.SIGKILL
    stamps = {p: p.stat().st_mtime_ns for p in (folder / "images" / "00000").glob("*.png")}
    assert stamps
    assert read_images(folder) is None
    scenes = small_scenes()
    after = make_images("small", scenes, folder, StudyOptions(workers=1))
    undisturbed = make_images("small", scenes, tmp_path / "whole", StudyOptions(workers=1))
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps  # what was finished was not made again
    for scene in scenes:
        assert list(after.observe(scene).records()) == list(undisturbed.observe(scene).records())
    assert validate(folder)["ok"]


@pytest.mark.render
@pytest.mark.slow
def test_image_study_resumes(tmp_path):
    arguments: dict[str, Any] = {"observer": "both", "protocol": "corrected", "eyes": ("E2",), "spp": 4}
    first = run_study("guestrin2006", tmp_path / "out", **arguments)
    images = sorted((tmp_path / "out" / "images").rglob("*.png"))
    assert len(images) == 3 * 90  # images with noise and without it, and masks
    stamps = [p.stat().st_mtime_ns for p in images]
    again = run_study("guestrin2006", tmp_path / "out", **arguments)
    assert [p.stat().st_mtime_ns for p in images] == stamps
    assert again["rows"] == first["rows"]
    noisy = run_study("guestrin2006", tmp_path / "out", **arguments, noise="on")
    assert [p.stat().st_mtime_ns for p in images] == stamps
    assert noisy["rows"] == [row for row in first["rows"] if row["observer"] != "image-noiseless"]
    rows = {
        (r["observer"], r["head"]): r for r in first["rows"] if r["eye"] == "both" and r["variant"] == "index fixed"
    }
    for observer in ("image", "image-noiseless"):
        assert rows[observer, "H1"]["missing"] == 0
        assert rows[observer, "H1"]["mean_deg"] < 0.5
    pupils = {f["observer"]: f for f in first["observers"]["features"] if f["feature"] == "pupil centre"}
    assert {f["n"] for f in pupils.values()} == {90}
    assert max(f["median_distance_px"] for f in pupils.values()) < 0.3
    assert {g["observer"] for g in first["observers"]["gaze"]} == {"image", "image-noiseless"}


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_study_killed_again_and_again_ends_with_the_same_summary(tmp_path):
    command = [sys.executable, "-m", "eyerender", "study", "guestrin2006", "--observer", "both", "--eyes", "E2"]
    command += ["--protocol", "published", "--spp", "1", "--workers", "2"]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    hook = stages.environment(tmp_path, tmp_path / "whole")
    subprocess.run([*command, "-o", str(tmp_path / "whole")], check=True, env=hook, **quiet)
    draws = random.Random(5)
    for at in [*stages.cuts(draws, stages.count(tmp_path), 5), 0]:
        how = draws.choice(["kill", "kill all"])
        hook = stages.environment(tmp_path, tmp_path / "killed", at=at, how=how)
        process = subprocess.Popen(
            [*command, "-o", str(tmp_path / "killed")], start_new_session=True, env=hook, **quiet
        )
        assert process.wait() == (-signal.SIGKILL if at else 0)
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("whole", "killed")]
    for summary in summaries:
        del summary["seconds"]
    assert summaries[0] == summaries[1]
    assert validate(tmp_path / "killed" / "images")["ok"]
