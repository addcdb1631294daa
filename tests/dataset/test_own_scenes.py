"""Scenes of a user's own function or loop: the same bytes as those of a spec, refusals, kills, and validation."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise
from eyerender.dataset.run import generate
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.validate import validate
from tests.support import own_scenes
from tests.support.dataset_specs import command, mapping, plan, tree
from tests.support.paths import ROOT

OWN = "tests.support.own_scenes"
SMALL: Any = {"workers": 1, "threads": 1}


def rewritten(**changes):
    spec = DatasetSpec.from_mapping(mapping(**changes))
    return Plan.load(spec, scenes=f"{OWN}:rewritten")


@pytest.mark.parametrize("sample", [0, 7, 23])
def test_a_spec_rewritten_as_a_function_gives_the_same_samples(sample):
    """Line by line: scene, eye, draws, subject, split, seed and observations."""
    a, b = realise(plan(), sample), realise(rewritten(), sample)
    assert a.sample.to_mapping() == b.sample.to_mapping()
    assert list(a.observations.records()) == list(b.observations.records())


@pytest.mark.parametrize(
    ("scenes", "words"),
    [
        (f"{OWN}:missing", "has no missing"),
        (f"{OWN}:not_a_function", "is no function"),
        ("no_such_module:scene", "there is no module"),
        (f"{OWN}:impure", "gives two different scenes for (0, 0)"),
        (lambda seed, i: {}, "must be a function at the top of a module"),
    ],
)
def test_what_is_no_function_of_seed_and_number_is_refused(scenes, words):
    with pytest.raises(InputError) as found:
        Plan.load(None, scenes=scenes, count=3)
    assert words in str(found.value)


def test_a_function_alone_needs_the_number_of_samples_and_gives_the_eyes():
    with pytest.raises(InputError, match="--count: needs the number of samples"):
        Plan.load(f"{OWN}:drawn")
    with pytest.raises(InputError, match="--eye: the scenes of a function have their eyes"):
        Plan.load(f"{OWN}:drawn", count=3, eye="E3")


def test_more_samples_of_a_function_are_the_same_plan():
    few, more = (Plan.load(f"{OWN}:drawn", count=count) for count in (3, 40))
    assert few.digest == more.digest
    assert few.draw(2).to_mapping() == more.draw(2).to_mapping()
    assert list(few.spec.selection.samples) == [0, 1, 2]
    assert Plan.load(f"{OWN}:objects", count=3).digest != few.digest


def test_subjects_of_a_function_share_what_it_draws_for_them():
    made = Plan.load(f"{OWN}:drawn", count=6, changes=PlanOptions(subjects=2, splits="train=.5,test=.5"))
    drawn = [made.draw(k) for k in range(6)]
    assert [d.turn.subject for d in drawn] == [0, 0, 0, 1, 1, 1]
    assert len({d.scene["look"]["iris_albedo"] for d in drawn}) == 2
    assert len({d.scene["seed"] for d in drawn}) == 6
    assert len({d.draws["power_mw_sr"] for d in drawn}) == 6
    assert {d.split for d in drawn} == {"train", "test"}


def test_a_scene_of_objects_is_a_sample():
    made = Plan.load(None, scenes=own_scenes.objects, count=3)
    assert made.scenes.reference == f"{OWN}:objects"
    a, b = made.draw(0), made.draw(1)
    assert a.scene["seed"] != b.scene["seed"]
    assert a.build().eye_spec == er.load_eye("E2")


def test_samples_for_which_a_function_fails_are_given_up_with_the_reason():
    made = Plan.load(f"{OWN}:partly", count=8)
    reasons = [realise(made, k).rejections for k in range(4)]
    assert reasons[0] == ()
    assert "raised" in reasons[1][0].reason
    assert "ZeroDivisionError: a defect of the user's code" in reasons[1][0].reason
    assert len(reasons[2]) == 1
    assert "must give a Scene, a SceneSpec or a mapping, not NoneType" in reasons[3][0].reason


def test_a_file_does_not_make_the_package_run_a_function():
    stored = json.loads(json.dumps(Plan.load(f"{OWN}:drawn", count=3).to_mapping()))
    read = Plan.from_mapping(stored, None)
    with pytest.raises(InputError, match="does not make this package run a function"):
        read.draw(0)
    assert read.loaded().draw(0).scene["rig"]
    stored["scenes"]["sha256"] = "0" * 64
    with pytest.raises(InputError, match="has changed since the run began"):
        Plan.from_mapping(stored, None).loaded()


@pytest.mark.parametrize("key", ["scenes", "function"])
def test_a_spec_cannot_name_a_function(key):
    with pytest.raises(InputError):
        DatasetSpec.from_mapping({**mapping(), key: f"{OWN}:drawn"})


def test_a_writer_refuses_what_does_not_fit(tmp_path):
    with pytest.raises(InputError, match="subjects: must be one of name"):
        er.DatasetWriter(tmp_path / "out", 3, subjects=2)
    writer = er.DatasetWriter(tmp_path / "out", 3)
    with pytest.raises(InputError, match="is not open"):
        list(writer.missing())
    with pytest.raises(InputError, match="must be 0 to 2, not 3"):
        assert 3 in writer


@pytest.mark.render
@pytest.mark.packaging
@pytest.mark.parametrize("layout", ["files", "webdataset"])
def test_a_run_of_a_function_has_the_bytes_of_the_spec(tmp_path, layout):
    changes = {} if layout == "files" else {"layout": layout, "shard_size": 6}
    generate(plan(**changes), tmp_path / "spec", **SMALL)
    generate(rewritten(**changes), tmp_path / "own", workers=2, threads=2)
    named = ("dataset.json", "run.json", "README.md", "croissant.json")
    a, b = ({k: v for k, v in tree(tmp_path / name).items() if k not in named} for name in ("spec", "own"))
    assert a == b
    assert any(name.startswith("images/" if layout == "files" else "shards/") for name in a)
    report = validate(tmp_path / "own", render=3, threads=1)
    assert report["problems"] == []
    assert report["recomputed"] == 24


def pictures(folder):
    """Count the pictures of a run that goes on; a folder that is renamed meanwhile counts as none."""
    try:
        return sum(1 for _ in folder.glob("**/images/**/*.png"))
    except FileNotFoundError:
        return 0


@pytest.mark.render
@pytest.mark.packaging
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL])
def test_a_run_of_a_function_survives_kills(tmp_path, number):
    folder, options = tmp_path / "out", ["--count", "48", "--seed", "3", "--workers", "2"]
    for images in (8, 24):
        process = command("generate", f"{OWN}:drawn", str(folder), *options, start_new_session=True)
        while process.poll() is None and pictures(folder) < images:
            time.sleep(0.1)
        process.send_signal(number)
        process.communicate(timeout=60)
        time.sleep(1.0)
    process = command("generate", f"{OWN}:drawn", str(folder), *options)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    generate(scenes=own_scenes.drawn, path=tmp_path / "whole", count=48, seed=3, **SMALL)
    assert tree(folder) == tree(tmp_path / "whole")


@pytest.mark.render
@pytest.mark.packaging
def test_a_writer_stores_a_stream_and_resumes_it(tmp_path):
    settings: Any = {"name": "mine", "shard_size": 4, "licence": "CC0-1.0", "threads": 1}

    def add(writer, i):
        whose: Any = {"subject": i // 5, "split": "train" if i < 5 else "test"}
        return writer.add(i, own_scenes.objects(1, i), draws={"i": i}, **whose)

    class Killed(Exception):
        pass

    def ended_loop():
        with er.DatasetWriter(tmp_path / "a", 10, **settings) as writer:
            for i in writer.missing():
                if i == 6:
                    raise Killed
                assert add(writer, i) == 1

    with pytest.raises(Killed):
        ended_loop()
    with er.DatasetWriter(tmp_path / "a", 10, **settings) as writer:
        assert 5 in writer
        assert list(writer.missing()) == [6, 7, 8, 9]
        for i in range(10):
            assert add(writer, i) == (i >= 6)
    assert writer.summary["statistics"]["subjects_by_split"] == {"test": 1, "train": 1}
    with er.DatasetWriter(tmp_path / "b", 10, **settings) as writer:
        for i in range(10):
            add(writer, i)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    report = validate(tmp_path / "a", render=2, threads=1)
    assert report["problems"] == []
    assert report["recomputed"] == 10


LOOP = """
import sys, time
import eyerender as er
from tests.support.own_scenes import objects
with er.DatasetWriter(sys.argv[1], 30, threads=1) as writer:
    for i in writer.missing():
        writer.add(i, objects(1, i), subject=i)
        print(i, flush=True)
        time.sleep(float(sys.argv[2]))
"""


def loop(folder, pause):
    """Start a loop of a writer of 30 samples."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = [sys.executable, "-c", LOOP, str(folder), str(pause)]
    return subprocess.Popen(run, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.render
@pytest.mark.packaging
@pytest.mark.parametrize("pause", [0.0, 1.0])
def test_a_writer_loses_no_stored_sample_by_sigterm(tmp_path, pause):
    """Neither while it renders and writes, nor while the user's code is at work."""
    stored = 0
    for wanted in (3, 5):
        process = loop(tmp_path / "a", pause)
        with process:
            numbers = [int(process.stdout.readline()) for _ in range(wanted)]
            process.send_signal(signal.SIGTERM)
            numbers += [int(line) for line in process.stdout]
        assert process.returncode == 128 + signal.SIGTERM
        assert numbers[0] in (stored, stored + 1)  # one may be stored but not printed
        stored = numbers[-1] + 1
    assert loop(tmp_path / "a", 0.0).wait(120) == 0
    assert loop(tmp_path / "b", 0.0).wait(120) == 0
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


@pytest.mark.render
@pytest.mark.packaging
def test_a_writer_stores_images_that_the_user_made(tmp_path):
    scene = own_scenes.objects(1, 0)
    images = er.render(scene, threads=1)
    darker = [dataclasses.replace(image, counts=image.counts // 2) for image in images]
    with er.DatasetWriter(tmp_path / "out", 2, threads=1) as writer:
        assert writer.add(0, scene, images=darker) == 1
        cut = [dataclasses.replace(images[0], counts=images[0].counts[:4])]
        with pytest.raises(InputError, match="images: must have counts"):
            writer.add(1, scene, images=cut)
        for change, words in (
            ({"rig.lights.0.position_mm.1": 9.0}, "images.0: shows another scene: rig.lights.0"),
            ({"eye.model": "E1"}, "images.0: shows another scene: eye.model"),
            ({"targets.screen_mm.0.0": 3.0}, "images.0: shows another scene: targets"),
        ):
            others = er.render(scene.with_({**change, "image.spp": 1}), threads=1)
            with pytest.raises(InputError, match=words):
                writer.add(1, scene.with_({"image.spp": 1}), images=others)
        turned = dataclasses.replace(images[0].frame.pose, azimuth_rad=[0.1])
        frame = dataclasses.replace(images[0].frame, pose=turned)
        with pytest.raises(InputError, match=r"images\.0: shows another frame"):
            writer.add(1, scene, images=[dataclasses.replace(images[0], frame=frame)])
        for value in (float("nan"), [1.0, float("inf")], object()):
            with pytest.raises(InputError, match=r"draws\.power"):
                writer.add(1, scene, images=images, draws={"power": value})
        assert writer.add(1, scene, images=images) == 1
    folder = er.ImageFolder.load(tmp_path / "out")
    np.testing.assert_array_equal(folder.entries[0].image(), images[0].counts // 2)
    np.testing.assert_array_equal(folder.entries[1].image(), images[0].counts)
    assert validate(tmp_path / "out")["problems"] == []
