"""Specs that name files, HDR maps and head meshes: found from anywhere, a part of what a run is, refused in a line."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import trimesh

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.cluster import ShardActor
from eyerender.dataset.files import sums_of_files
from eyerender.dataset.maker import Maker
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of
from eyerender.dataset.shard import write_shard
from eyerender.dataset.spec import DatasetSpec
from eyerender.dataset.worker import Job
from eyerender.eye.catalogue import load_eye
from eyerender.folders.imagefile import read_image
from tests.support import stages
from tests.support.dataset_specs import command, make, mapping, tree, write

HEAD = {"unit": "mm", "licence": "CC0-1.0", "forward": [1, 0, 0], "up": [0, 0, 1], "right_eye": [0, 0, 0]}
# A bar above the pupil: it stands before the iris, and lamps and maps light it.
BAR_MM = [[13, -12, 4], [14, 12, 12]]
ROOM = {"ambient.map.file": {"draw": "choice", "per": "sample", "values": ["rooms/day.npy", "rooms/night.npy"]}}


def files(place: Path) -> Path:
    """Two maps and a head with its manifest."""
    (place / "rooms").mkdir(parents=True)
    (place / "heads").mkdir()
    np.save(place / "rooms" / "day.npy", np.linspace(1, 4, 128).reshape(8, 16))
    np.save(place / "rooms" / "night.npy", np.full((8, 16), 0.5))
    bar = trimesh.creation.box(bounds=BAR_MM)
    bar.export(place / "heads" / "bar.ply")
    total = hashlib.sha256((place / "heads" / "bar.ply").read_bytes()).hexdigest()
    manifest = {"schema": "eyerender/head/1", "file": "bar.ply", "sha256": total, **HEAD}
    (place / "heads" / "bar.json").write_text(json.dumps(manifest))
    return place


def changes(**more):
    """The tiny spec with both, each in a draw, one image a shard."""
    ambient = {"map": {"file": ROOM["ambient.map.file"], "scale_w_m2_sr": 0.2}}
    region = {"draw": "choice", "per": "sample", "values": [None, {"head": {"file": "heads/bar.json"}}]}
    return {
        "scene.ambient": ambient,
        "scene.region": region,
        "scene.eye.pupil_diameter_mm": 4.0,
        "eye_parameters": {},
        "count": 6,
        "subjects": 1,
        "splits": {"train": 1.0},
        "shard_size": 1,
        **more,
    }


def spec_in(place: Path, **more) -> Path:
    return write(files(place) / "spec.yaml", **changes(**more))


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        ({"ambient": {"map": {"file": "rooms/day.npy"}}}, {"rooms/day.npy"}),
        ({"ambient": {"draw": "choice", "values": [{}, {"map": {"file": "rooms/night.npy"}}]}}, {"rooms/night.npy"}),
        (
            {"ambient": {"map": {"draw": "fixed", "value": {"file": {"draw": "grid", "values": ["rooms/day.npy"]}}}}},
            {"rooms/day.npy"},
        ),
        ({"rig": {"obstacles": [{"file": "heads/bar.ply"}, {"ring": {}}]}}, {"heads/bar.ply"}),
        ({"region": {"head": {"file": "heads/bar.json"}}}, {"heads/bar.json", "heads/bar.ply"}),
        ({"region": {"head": {**HEAD, "file": ["heads/bar.ply"]}}}, {"heads/bar.ply"}),
        (
            {"region": {"head": {"file": "heads/bar.ply", "texture": {"draw": "choice", "values": ["rooms/day.npy"]}}}},
            {"heads/bar.ply", "rooms/day.npy"},
        ),
        ({"region": {"lids": {}}, "ambient": {"irradiance_w_m2": {"draw": "uniform", "low": 0, "high": 1}}}, set()),
        ({"ambient": {"map": {"file": {"draw": "choice", "values": 3}}}}, set()),  # its draw is refused later
    ],
)
def test_files_are_found_wherever_a_draw_may_name_them(tmp_path, scene, expected):
    found = sums_of_files(scene, files(tmp_path))
    assert set(found) == expected
    for name, total in found.items():
        assert total == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()


def test_the_files_content_is_a_part_of_the_plan(tmp_path):
    spec = spec_in(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    own, moved = Plan.load(spec), Plan.load(tmp_path / "b" / "spec.yaml")
    assert own.digest == moved.digest  # where the files lie means nothing
    assert own.to_mapping() == moved.to_mapping()
    for name in ("rooms/night.npy", "heads/bar.ply", "heads/bar.json"):
        kept = (tmp_path / "b" / name).read_bytes()
        (tmp_path / "b" / name).write_bytes(kept + b" ")
        with pytest.raises(InputError, match=f"{Path(name).name}: has changed since the run began"):
            moved.check_files()
        assert Plan.load(tmp_path / "b" / "spec.yaml").digest != own.digest
        (tmp_path / "b" / name).write_bytes(kept)
        moved.check_files()
    # Nothing is added to what a spec without files is.
    assert "files" not in Plan.of(DatasetSpec.from_mapping(mapping())).to_mapping()


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("rooms/night.npy", Path.unlink, "night.npy: no such file"),
        ("heads/bar.json", Path.unlink, "bar.json: no such file"),
        ("heads/bar.ply", Path.unlink, "bar.ply: no such file"),
        ("heads/bar.json", lambda path: path.write_text("{"), "bar.json: line 1: is not valid JSON"),
        ("rooms/day.npy", lambda path: (path.unlink(), path.mkdir()), "day.npy: is a folder, not a file"),
        ("heads/bar.json", lambda path: (path.unlink(), path.mkdir()), "bar.json: is a folder, not a file"),
    ],
)
def test_files_that_cannot_be_read_are_refused_before_anything_is_written(
    tmp_path, capsys, monkeypatch, name, spoil, words
):
    spec_in(tmp_path / "spec")
    spoil(tmp_path / "spec" / name)
    monkeypatch.chdir(tmp_path)
    for argv in (
        ["generate", "spec/spec.yaml", "out"],
        ["generate", "spec/spec.yaml", "--dry-run"],
        ["generate", "spec/spec.yaml", "out", "--shard", "1/2"],
        ["sample", "spec/spec.yaml", "0", "-o", "out"],
        ["preview", "spec/spec.yaml", "-o", "out.png"],
    ):
        assert run(argv) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert err.startswith("error: ")
        assert words in err
        assert [p.name for p in tmp_path.iterdir()] == ["spec"]


@pytest.mark.render
@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("rooms/day.npy", b"hello", "day.npy: is not a readable map"),
        ("heads/bar.ply", b"hello", "bar.ply: does not have the given sha256"),
    ],
)
def test_files_that_hold_something_else_leave_nothing(tmp_path, capsys, monkeypatch, name, content, words):
    monkeypatch.chdir(tmp_path)
    spec = spec_in(tmp_path / "spec")
    (tmp_path / "spec" / name).write_bytes(content)
    assert run(["generate", str(spec), "out", "--workers", "1"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    errors = [line for line in err.splitlines() if not line.startswith("generating:")]
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    assert words in errors[0]
    assert [p.name for p in tmp_path.iterdir()] == ["spec"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a spec and its files, and the dataset that a run from that folder makes of it."""
    place = tmp_path_factory.mktemp("files")
    spec_in(place / "spec")
    with contextlib.chdir(place / "spec"):
        assert run(["generate", "spec.yaml", "../out", "--workers", "1"]) == 0
    return place


@pytest.mark.packaging
@pytest.mark.render
def test_paths_start_at_the_spec_wherever_the_command_and_its_workers_run(made, tmp_path):
    """From another folder, of a copy elsewhere, by two workers, in parts: the same bytes, the run's record included."""
    copy = tmp_path / "elsewhere"
    shutil.copytree(made / "spec", copy)
    (tmp_path / "here").mkdir()
    for argv, folder in (
        (["../elsewhere/spec.yaml", "parts", "--workers", "2", "--threads", "2", "--shard", "2/2"], None),
        (["../elsewhere/spec.yaml", "parts", "--workers", "1", "--shard", "1/2"], "parts"),
    ):
        process = command("generate", *argv, cwd=tmp_path / "here")
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        if folder is not None:
            assert tree(tmp_path / "here" / folder) == tree(made / "out")
    lines = [json.loads(line) for line in (made / "out" / "metadata.jsonl").read_text().splitlines()]
    drawn = {(line["parameters"]["draws"]["ambient.map.file"], line["parameters"]["draws"]["region"]) for line in lines}
    assert len(drawn) > 2  # both rooms, with and without the head
    assert run(["validate", str(made / "out")]) == 0


@pytest.mark.packaging
@pytest.mark.render
def test_an_actor_in_another_folder_makes_the_same_shard(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made / "spec", tmp_path / "spec")
    plan = Plan.load("spec/spec.yaml")
    (tmp_path / "out").mkdir()
    job = Job.of(plan, frames_of(plan), Path("out"), "auto", 1)
    (tmp_path / "away").mkdir()
    monkeypatch.chdir(tmp_path / "away")
    actor = ShardActor(asdict(job))
    for shard in range(2):
        answer = actor.render(shard, 100)
        assert answer["ok"], answer
        (image,) = (Path(answer["staged"]["stage"]) / "images").iterdir()
        assert image.read_bytes() == (made / "out" / "images" / f"{shard:05d}" / image.name).read_bytes()
        shutil.rmtree(answer["staged"]["stage"])
    (tmp_path / "spec" / "rooms" / "day.npy").unlink()
    answer = actor.render(2, 100)
    assert (answer["ok"], answer["kind"]) == (False, "input")
    assert answer["reason"].endswith("day.npy: no such file")


@pytest.mark.render
@pytest.mark.slow
def test_a_ray_run_makes_the_same_bytes(made, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.chdir(made)
    plan = Plan.load("spec/spec.yaml")
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "ray", plan, engine="ray", workers=2, threads=2)
    assert tree(tmp_path / "ray") == tree(made / "out")


@pytest.mark.render
def test_a_sample_written_as_a_scene_renders_the_datasets_image(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = [json.loads(line) for line in (made / "out" / "metadata.jsonl").read_text().splitlines()]
    assert {line["sample"] for line in lines} == set(range(6))
    (own,) = [line for line in lines if line["sample"] == 0]
    assert run(["sample", str(made / "spec" / "spec.yaml"), "0", "-o", "deep/down"]) == 0
    assert run(["render", "deep/down/scene.yaml", "-o", "out"]) == 0
    (image,) = (tmp_path / "out" / "images").glob("*.png")
    np.testing.assert_array_equal(read_image(image)[0], read_image(made / "out" / own["file_name"])[0])


@pytest.mark.render
@pytest.mark.parametrize("name", ["rooms/day.npy", pytest.param("heads/bar.json", marks=pytest.mark.slow)])
def test_a_run_is_not_gone_on_with_when_a_file_has_changed(made, tmp_path, capsys, monkeypatch, name):
    spec, folder = tmp_path / "spec", tmp_path / "out"
    shutil.copytree(made / "spec", spec)
    shutil.copytree(made / "out", folder)
    shutil.rmtree(folder / "shards" / "00003")
    stages.unassemble(folder)
    before = tree(folder)
    monkeypatch.chdir(tmp_path)
    kept = (spec / name).read_bytes()
    if name.endswith(".npy"):
        np.save(spec / name, 2 * np.load(spec / name))
    else:
        (spec / name).write_text(json.dumps({**json.loads(kept), "tolerance_mm": 0.2}))
    assert run(["generate", "spec/spec.yaml", "out", "--workers", "1"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert f"({name}: other content)" in err
    assert tree(folder) == before
    (spec / name).write_bytes(kept)
    assert run(["generate", "spec/spec.yaml", "out", "--workers", "1"]) == 0
    assert tree(folder) == tree(made / "out")


@pytest.mark.packaging
@pytest.mark.render
def test_a_file_that_changes_while_a_run_is_at_work_ends_it(made, tmp_path):
    """The shards that were finished before stay, and with the old content back the run ends as it would have."""
    spec, folder = tmp_path / "spec", tmp_path / "out"
    shutil.copytree(made / "spec", spec)
    room = spec / "rooms" / "night.npy"
    kept = room.read_bytes()
    # When the first shard is about to be finished.
    hook = stages.environment(tmp_path, folder, match="/shards/00000$", at=1, how="stop")
    argv = ("generate", "spec/spec.yaml", "out", "--workers", "1")
    process = command(*argv, cwd=tmp_path, env=hook, start_new_session=True)
    stages.wait_until_stopped(process)
    np.save(room, np.full((8, 16), 0.75))
    os.killpg(process.pid, signal.SIGCONT)
    _, err = process.communicate()
    assert process.returncode == 2, err
    errors = [line for line in err.splitlines() if not line.startswith("generating:")]
    assert errors == [f"error: {room}: has changed since the run began"]
    assert (folder / "shards" / "00000" / "done.json").is_file()
    assert not list(folder.glob(".partial-*"))
    room.write_bytes(kept)
    make(folder, Plan.load(spec / "spec.yaml"))
    assert tree(folder) == tree(made / "out")


def test_eye_files_are_files_of_the_run(tmp_path, monkeypatch):
    load_eye("E2").model_copy(update={"name": "mine"}).dump(tmp_path / "mine.yaml")
    spec = write(tmp_path / "spec.yaml", eye_parameters={}, **{"scene.eye.model": "mine.yaml"})
    own = Plan.load(spec)
    assert set(own.files) == {"mine.yaml"}
    (tmp_path / "away").mkdir()
    monkeypatch.chdir(tmp_path / "away")
    own.check_files()
    # Also the eye file that an option names, which is meant from where the command runs.
    (by_option,) = Plan.load("dataset_quick", eye="../mine.yaml").files
    assert by_option == str(tmp_path / "mine.yaml")
    with (tmp_path / "mine.yaml").open("a") as file:
        file.write("description: another\n")
    with pytest.raises(InputError, match=r"mine\.yaml: has changed since the run began"):
        own.check_files()
    # Eyes of the catalogue belong to the package; its source counts as a version.
    assert Plan.load("dataset_quick").files == {}


@pytest.mark.render
def test_no_shard_holds_two_states_of_a_file(made, tmp_path):
    shutil.copytree(made / "spec", tmp_path / "spec")
    plan = Plan.load(write(tmp_path / "spec" / "long.yaml", **changes(shard_size=6)))
    maker = Maker(plan, frames_of(plan), threads=1)

    def sample(samples: int, images: int) -> None:
        if samples == 2:
            np.save(tmp_path / "spec" / "rooms" / "day.npy", np.ones((8, 16)))

    with pytest.raises(InputError, match=r"day\.npy: has changed since the run began"):
        write_shard(maker, tmp_path, 0, sample)
    # A slow machine has kept a checkpoint of the first state, which is not continued with the second one.
    with pytest.raises(InputError, match=r"day\.npy: has changed since the run began"):
        write_shard(maker, tmp_path, 0, lambda *_: None)
