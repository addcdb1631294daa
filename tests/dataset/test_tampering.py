"""Validation against people: each way to change a dataset is found, also where every checksum is signed again."""

from __future__ import annotations

import json
import shutil
from typing import Any

import numpy as np
import pytest

from eyerender.dataset.done import sum_of
from eyerender.dataset.lines import restore_lines
from eyerender.dataset.plan import Plan
from eyerender.dataset.validate import SAMPLE, sampled, validate
from eyerender.imaging.folder import render_folder
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

pytestmark = pytest.mark.render

SHARD, AGAIN = "differ from what was made", "computed again"


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def write_lines(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def sign(folder, lines=True):
    """Write every checksum of a dataset anew, as somebody would who knows the format; `lines`: those of lines, too."""
    for path in folder.glob("shards/*/done.json"):
        done = json.loads(path.read_text())
        if lines:
            restore_lines(folder)
        done["files"] |= {name: sum_of(folder / name) for name in done["files"] if (folder / name).is_file()}
        path.write_text(json.dumps(done))
    path = folder / "dataset.json"
    dataset = json.loads(path.read_text())
    if "checksums" in dataset:
        dataset["checksums"] = {name: sum_of(folder / name) for name in dataset["checksums"]}
    path.write_text(json.dumps(dataset))


def changed(line, path, by):
    """Add to the number at a path, or put another value there; `scene_json` and `eye_json` are texts of JSON."""
    *keys, last = (int(key) if key.isdigit() else key for key in path.split("."))
    if "json" in path:
        key = keys.pop(1)
        tree = json.loads(line["parameters"][key])
        changed(tree, path.partition(f"{key}.")[2], by)
        line["parameters"][key] = json.dumps(tree)
        return
    for key in keys:
        line = line[key]
    line[last] = line[last] + by if isinstance(by, int | float) else by


GLINT, OF_RECORD, FOCAL_PX = "labels.glints.0.xy_px.0", "records.0.glints.1.xy_px.1", "labels.camera.K.0.0"
POSE, SCENE_CAMERA = "records.0.pose.azimuth_deg", "parameters.scene_json.rig.cameras.0.focal_length_px"
CORNEA, PUPIL = "parameters.eye_json.cornea.0.shape.radius_mm", "records.0.pupil.semi_axes_px.0"
# What is added or put to which place of each line, and what is said of it where every checksum is signed again.
HARMS: list[tuple[dict[str, Any], str]] = [
    ({GLINT: 50}, GLINT),
    ({OF_RECORD: -50}, OF_RECORD),
    ({OF_RECORD: -50, "labels.glints.1.xy_px.1": -50}, OF_RECORD),
    ({"labels.glints.0.spot_xy_px.0": 50}, "the spot of light 0"),
    ({FOCAL_PX: 24.0}, FOCAL_PX),
    ({"labels.camera.R.0": [1.0, 0.0, 0.0]}, "labels.camera.R.0"),
    ({"labels.camera.t_mm.2": 1}, "labels.camera.t_mm.2"),
    ({SCENE_CAMERA: 10.0}, SCENE_CAMERA),
    ({CORNEA: 0.1}, CORNEA),
    ({"parameters.draws": {"look.iris_albedo": 0.9}}, "parameters.draws.look.iris_albedo"),
    ({"labels.space": {}}, "labels.space.world is missing"),
    ({"labels.space": None}, "labels.space is null"),
    ({"labels.space.camera.target_mm.0": 5}, "labels.space.camera.target_mm.0"),
    ({PUPIL: 0.5, "labels.pupil.amodal.semi_axes_px.0": 0.5}, PUPIL),
    ({"labels.iris.amodal.centre_px.0": 1}, "labels.iris.amodal.centre_px.0"),
    ({POSE: 0.5}, POSE),
]


@pytest.fixture
def copy(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "copy")


@pytest.fixture
def one_line(monkeypatch):
    """Few lines are computed again, for harm that is found without that."""
    monkeypatch.setattr("eyerender.dataset.validate.SAMPLE", 1)


def tamper(folder, change, *, shards):
    """Give `change` the lines of metadata.jsonl by their samples; sign all anew, those of the shards if told to."""
    lines = lines_of(folder / "metadata.jsonl")
    change({line["sample"]: line for line in lines})
    write_lines(folder / "metadata.jsonl", lines)
    sign(folder, lines=shards)


@pytest.mark.parametrize("shards", [False, True])
def test_changed_values_are_found(copy, shards):
    def change(lines):
        for number in set(range(len(HARMS))) & lines.keys():
            for path, by in HARMS[number][0].items():
                changed(lines[number], path, by)

    tamper(copy, change, shards=shards)
    found = validate(copy, quick=True)["problems"]
    for number, (harm, words) in enumerate(HARMS):
        mine = [p for p in found if f"/{number:08d}-right.png" in p]
        assert any(words in p for p in mine), (harm, mine)
    # Where the shards' checksums were left as they were, they differ.
    assert sum(SHARD in p for p in found) == (0 if shards else len({number // 3 for number in range(len(HARMS))}))
    assert not any(f"/{number:08d}" in p for number in range(16, 24) for p in found)


@pytest.mark.usefixtures("one_line")
@pytest.mark.parametrize("key", ["file_name", "mask_file_name"])
@pytest.mark.parametrize("both", [False, True])
def test_two_swapped_names_are_found(copy, key, both):
    def change(lines):
        if 4 in lines:
            lines[4][key], lines[5][key] = lines[5][key], lines[4][key]

    tamper(copy, change, shards=both)
    found = validate(copy, quick=True)["problems"]
    assert sum(f": {key} is '" in p for p in found if SHARD not in p and AGAIN not in p) == 2
    assert any(SHARD in p for p in found) != both


@pytest.mark.usefixtures("one_line")
@pytest.mark.parametrize("both", [False, True])
def test_a_subject_in_another_split_is_found(copy, both):
    moved = {"train": "test", "test": "train"}

    def change(lines):
        for line in lines.values():
            if line["subject"] == 1:
                line["split"] = moved.get(line["split"], "train")

    tamper(copy, change, shards=both)
    found = validate(copy, quick=True)["problems"]
    assert sum(": split is '" in p for p in found if SHARD not in p and AGAIN not in p) == 6
    assert any(SHARD in p for p in found) != both


@pytest.mark.usefixtures("one_line")
def test_lost_and_new_lines_are_found(copy):
    path = copy / "metadata.jsonl"
    lines = lines_of(path)
    extra = json.loads(json.dumps(lines[0]))
    write_lines(path, [extra, *lines[1:7], *lines[8:], {**lines[3], "file_name": "images/00001/x.png"}])
    found = validate(copy, quick=True)["problems"]
    words = "metadata.jsonl: the lines of shard"
    assert {f"{words} 1 are 4, not 3", f"{words} 2 are 2, not 3"} <= set(found)


def test_the_order_of_lines_does_not_matter(copy):
    write_lines(copy / "metadata.jsonl", reversed(lines_of(copy / "metadata.jsonl")))
    sign(copy, lines=False)
    report = validate(copy, quick=True)
    assert report["ok"], report["problems"]


def test_a_changed_spec_is_found(copy):
    path = copy / "dataset.json"
    dataset = json.loads(path.read_text())
    dataset["spec"]["scene"]["rig"]["cameras"][0]["focal_length_px"] = 2500.0
    path.write_text(json.dumps(dataset))
    found = validate(copy, quick=True)["problems"]
    assert "dataset.json: its digest does not match its spec, eyes and files" in found
    # With digests that agree every line still tells of another camera.
    dataset["digest"] = Plan.from_mapping(dataset, copy).digest
    path.write_text(json.dumps(dataset))
    for place in copy.glob("shards/*/done.json"):
        done = json.loads(place.read_text())
        place.write_text(json.dumps(done | {"digest": dataset["digest"]}))
    sign(copy)
    report = validate(copy, quick=True)
    assert report["problem_count"] >= 24
    assert all("computed again" in p for p in report["problems"])


@pytest.mark.usefixtures("one_line")
@pytest.mark.parametrize(
    "harm",
    [
        lambda done: done.pop("files"),
        lambda done: done.update(files=5),
        lambda done: done.update(files={"images/00001/x.png": {}}),
        lambda done: done.update(digest="0" * 64),
        lambda done: done.update(schema=None),
    ],
)
def test_a_damaged_done_is_a_problem(copy, harm):
    path = copy / "shards" / "00001" / "done.json"
    done = json.loads(path.read_text())
    harm(done)
    path.write_text(json.dumps(done))
    report = validate(copy, quick=True)
    assert any("00001" in p for p in report["problems"])


@pytest.mark.usefixtures("one_line")
@pytest.mark.parametrize("text", ["", "[]", "{", "\xff\xfe", "[" * 100_000])
def test_what_is_no_done_is_a_problem(copy, text):
    (copy / "shards" / "00001" / "done.json").write_bytes(text.encode("latin-1"))
    assert any("shards/00001/done.json" in p for p in validate(copy, quick=True)["problems"])


@pytest.mark.usefixtures("one_line")
def test_a_missing_shard_is_a_problem(copy):
    shutil.rmtree(copy / "shards" / "00002")
    assert "shards/00002: missing" in validate(copy, quick=True)["problems"]


@pytest.mark.usefixtures("one_line")
@pytest.mark.parametrize("key", ["spec", "eyes", "digest", "statistics", "versions"])
@pytest.mark.parametrize(
    "value", [None, {"a": 1}, pytest.param(5, marks=pytest.mark.slow), pytest.param([], marks=pytest.mark.slow)]
)
def test_a_damaged_dataset_json_is_a_problem_and_no_traceback(copy, key, value):
    path = copy / "dataset.json"
    dataset = json.loads(path.read_text())
    dataset[key] = value
    path.write_text(json.dumps(dataset))
    report = validate(copy, quick=True)
    assert not report["ok"] or key in ("statistics", "versions")


@pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_every_kind_of_wrong_value_in_a_line_is_a_problem_and_no_traceback(copy, part):
    """Every key of a line, one by one, gets a value of another kind; each part has every fourth key."""
    path = copy / "metadata.jsonl"
    lines = lines_of(path)

    def paths(node, at=()):
        yield from ((at, node),) if at else ()
        for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
            if not isinstance(key, int) or key == 0:
                yield from paths(value, (*at, key))

    every = [at for at, _ in paths(lines[3])][part::4]
    rng = np.random.default_rng([1, part])
    for start in range(0, len(every), 23):
        changed = json.loads(json.dumps(lines))
        chosen = every[start : start + 23]
        for line, at in zip(changed[1:], chosen, strict=False):
            node = line
            for key in at[:-1]:
                node = node[key]
            node[at[-1]] = [None, "x", [], {}, -1, 10**30, True][rng.integers(7)]
        write_lines(path, changed)
        report = validate(copy, quick=True)
        assert not report["ok"]
        assert all("\n" not in p and len(p) <= 400 for p in report["problems"])


@pytest.mark.usefixtures("one_line")
def test_a_line_nested_too_deeply_is_a_problem(copy):
    path = copy / "metadata.jsonl"
    lines = path.read_text().splitlines()
    deep = "[" * 900 + "]" * 900
    lines[5] = lines[5].replace('"failed_paths": 0', f'"failed_paths": {deep}')
    assert deep in lines[5]
    path.write_text("\n".join(lines) + "\n")
    assert not validate(copy, quick=True)["ok"]


def test_results_of_another_version_are_not_computed_again(copy):
    path = copy / "dataset.json"
    dataset = json.loads(path.read_text())
    dataset["versions"]["results"] = "0"
    path.write_text(json.dumps(dataset))
    report = validate(copy, quick=True)
    assert report["ok"], report["problems"]
    assert report["recomputed"] == 0
    assert any("results of version '0'" in note for note in report["notes"])


def test_the_sample_is_spread_and_the_same_each_time():
    assert sampled(SAMPLE, "a") == list(range(SAMPLE))
    rows = sampled(1_000_000, "a")
    assert rows == sampled(1_000_000, "a") != sampled(1_000_000, "b")
    assert [row * SAMPLE // 1_000_000 for row in rows] == list(range(SAMPLE))


def test_deep_computes_every_line_again(copy, monkeypatch):
    def change(lines):
        if 13 in lines:
            changed(lines[13], FOCAL_PX, 24.0)

    tamper(copy, change, shards=True)
    monkeypatch.setattr("eyerender.dataset.validate.SAMPLE", 2)
    assert validate(copy, quick=True)["recomputed"] == 2
    report = validate(copy, quick=True, deep=True)
    assert report["recomputed"] == 24
    assert any("labels.camera.K.0.0" in p for p in report["problems"])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory, tiny):
    """A folder that one scene was rendered into."""
    line = lines_of(tiny / "metadata.jsonl")[0]
    data = json.loads(line["parameters"]["scene_json"])
    data["eye"]["margin"] = {"seed": 3}
    data["targets"] = {"grid": [3, 2]}
    folder = tmp_path_factory.mktemp("rendered") / "out"
    render_folder(Scene.of(SceneSpec.from_mapping(data)), folder)
    report = validate(folder)
    assert report["ok"], report["problems"]
    assert report["recomputed"] == 6
    return folder


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (lambda line: changed(line, OF_RECORD, -50), OF_RECORD),
        (lambda line: changed(line, POSE, 0.5), POSE),
        (lambda line: line["records"][0]["pupil"]["points_px"][0].reverse(), "records.0.pupil.points_px.0.0"),
        (lambda line: line["window_px"].update(x0=3), "window_px.x0"),
        (lambda line: line["parameters"].update(pupil_diameter_mm=3.0), "parameters.pupil_diameter_mm"),
        (lambda line: line.update(file_name="images/000002_right.png"), "file_name is '"),
    ],
)
def test_a_rendered_folder_is_computed_again(rendered, tmp_path, harm, words):
    folder = shutil.copytree(rendered, tmp_path / "copy")
    lines = lines_of(folder / "metadata.jsonl")
    harm(lines[4])
    write_lines(folder / "metadata.jsonl", lines)
    assert any(words in p for p in validate(folder, quick=True)["problems"])


def test_a_changed_scene_of_a_rendered_folder_is_found(rendered, tmp_path):
    folder = shutil.copytree(rendered, tmp_path / "copy")
    path = folder / "dataset.json"
    dataset = json.loads(path.read_text())
    dataset["spec"]["rig"]["cameras"][0]["focal_length_px"] = 2500.0
    path.write_text(json.dumps(dataset))
    found = validate(folder, quick=True)["problems"]
    assert "dataset.json: its digest does not match its scene, its eye and its files" in found
    dataset["spec"]["eye"]["model"] = "gone.yaml"
    path.write_text(json.dumps(dataset))
    report = validate(folder, quick=True)
    assert report["recomputed"] == 0
    assert any("gone.yaml" in note for note in report["notes"])
