"""Validation: a sound dataset passes, each kind of harm is found."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
import yaml

from eyerender.apps.inspection import inspect
from eyerender.base.errors import InputError, UnfinishedRunWarning
from eyerender.cli.main import run
from eyerender.dataset.export import export
from eyerender.dataset.spec import shipped_datasets
from eyerender.dataset.validate import validate
from eyerender.folders.imagefile import picture_bytes, read_image, write_png
from eyerender.folders.imagefolder import ImageFolder
from eyerender.scene import load_scene
from tests.support.dataset_specs import mapping
from tests.support.in_process import single_workers_in_process
from tests.support.stages import unassemble

pytestmark = pytest.mark.render


@pytest.fixture
def copy(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "copy")


def edit(folder, number, change):
    """Change a line of metadata, and of its shard the same."""
    for path in [folder / "metadata.jsonl", *folder.glob("shards/*/lines.jsonl")]:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            if line["sample"] == number:
                change(line)
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def problems(folder, **options):
    report = validate(folder, **options)
    assert report["ok"] == (report["problem_count"] == 0)
    return report["problems"]


def test_a_sound_dataset_passes(tiny):
    report = validate(tiny)
    assert report["ok"], report["problems"]
    assert report["images"] == 24
    assert report["statistics"]["subjects_by_split"] == {"test": 1, "train": 2, "validation": 1}
    assert 0.05 < report["statistics"]["mean_level"] < 0.6
    assert validate(tiny, quick=True)["ok"]


def test_every_line_has_the_same_keys(tiny):
    def shape(node):
        if isinstance(node, dict):
            return {k: shape(v) for k, v in node.items()}
        return [shape(v) for v in node] if isinstance(node, list) else type(node).__name__

    lines = [json.loads(line) for line in (tiny / "metadata.jsonl").read_text().splitlines()]
    assert len(lines) == mapping()["count"]
    assert all(shape(line) == shape(lines[0]) for line in lines)


def test_a_part_that_only_some_scenes_have_is_null_elsewhere(copy):
    edit(copy, 4, lambda line: line["labels"].update(lid_margins_px={"upper": [[1.0, 2.0]]}))
    assert not any("other keys" in p for p in problems(copy, quick=True))


def test_a_changed_byte_is_found(copy):
    path = next((copy / "masks" / "00002").iterdir())
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    assert any("checksum differs" in p for p in problems(copy))
    assert problems(copy, quick=True) == []


def test_a_missing_and_a_cut_file_are_found(copy):
    first, second = sorted((copy / "images" / "00001").iterdir())[:2]
    first.unlink()
    second.write_bytes(second.read_bytes()[:-100])
    found = problems(copy, quick=True)
    assert any(f"images/00001/{first.name}'" in p and "no such file" in p for p in found)
    assert any("bytes, not" in p for p in found)


def test_a_moved_mask_is_found(copy):
    path = sorted((copy / "masks" / "00000").iterdir())[0]
    mask, _ = read_image(path)
    write_png(path, np.roll(mask, 3, axis=1))
    found = problems(copy)
    assert any("the mask of its pupil leaves its outline" in p for p in found)
    assert any("does not match its mask" in p for p in found)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda line: line["records"][0]["pupil"].update(angle_rad=4.0), "not an ellipse in the record's convention"),
        (lambda line: line["records"][0].pop("pose"), "pose.azimuth_deg: missing"),
        (lambda line: line["labels"].pop("iris"), "has other keys than line 1"),
        (lambda line: line.update(split="elsewhere"), "is in two splits"),
        (lambda line: line["window_px"].update(width=90), "its window is 90 x 72"),
        (lambda line: line.update(bit_depth=8), "has values above 255"),
    ],
)
def test_wrong_lines_are_found(copy, change, words):
    edit(copy, 4, change)
    assert any(words in p for p in problems(copy))


def test_what_is_finished_of_a_run_is_validated_and_exported(copy, tmp_path, capsys):
    unassemble(copy)
    (copy / "metadata.jsonl").write_text("of an earlier run\n")
    for shard in (2, 5):
        (copy / "shards" / f"{shard:05d}" / "done.json").unlink()
    words = "the run is unfinished: 18 images of 6 finished shards are read, 24 samples are planned"
    with pytest.warns(UnfinishedRunWarning, match=words):
        report = validate(copy)
    assert report["ok"], report["problems"]
    assert (report["images"], report["recomputed"]) == (18, 18)
    assert report["notes"] == [words]
    assert run(["export-dataset", str(copy), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    assert capsys.readouterr().err.splitlines()[0] == f"warning: {copy}: {words}"
    with open(tmp_path / "out" / "labels.csv", newline="") as file:
        samples = [int(row["sample"]) for row in csv.DictReader(file)]
    assert samples == [k for k in range(24) if k // 3 not in (2, 5)]
    assert json.loads((tmp_path / "out" / "export.json").read_text())["unfinished"] is True


def test_damage_of_an_unfinished_run_is_found(copy, tmp_path):
    unassemble(copy)
    edit(copy, 4, lambda line: line["records"][0].pop("pose"))
    with pytest.warns(UnfinishedRunWarning):
        found = validate(copy)["problems"]
    assert any("shards/00001/lines.jsonl: " in problem for problem in found)
    assert any("pose.azimuth_deg: missing" in problem for problem in found)
    with pytest.warns(UnfinishedRunWarning), pytest.raises(InputError, match=r"shards/00001/lines\.jsonl: has"):
        export(copy, "csv", tmp_path / "out")


def test_lines_that_cannot_be_read_are_not_counted_as_read(copy):
    path = copy / "metadata.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], lines[5][:200], *lines[6:]]) + "\n")
    report = validate(copy, quick=True)
    assert (report["images"], report["recomputed"]) == (23, 23)
    assert any("line 6: is not valid JSON: ends too early" in problem for problem in report["problems"])
    assert inspect(copy)["datasets"][0]["images_read"] == 23


def test_a_negative_number_of_images_is_refused(tiny):
    with pytest.raises(InputError, match="render: must be >= 0, not -2"):
        validate(tiny, render=-2)


def test_lost_lines_say_what_makes_them_again(copy):
    (copy / "metadata.jsonl").unlink()
    with pytest.raises(InputError, match=r"holds no metadata.jsonl, which is lost; generate with the same spec makes"):
        validate(copy)


def test_what_is_no_dataset_is_refused(copy, tmp_path):
    unassemble(copy)
    shutil.rmtree(copy / "shards")
    with pytest.raises(InputError, match="an unfinished run without a finished shard"):
        validate(copy)
    with pytest.raises(InputError, match="no such folder"):
        validate(tmp_path / "nowhere")


def written(path, name):
    """A dataset file of two images with all labels of geometry, after a shipped dataset or scene."""
    if name in shipped_datasets():
        data = yaml.safe_load(shipped_datasets()[name].read_text(encoding="utf-8"))
    else:
        scene = "headset" if name == "spectacles" else name
        data = {"format": 3, "kind": "dataset", "name": name, "count": 2, "scene": load_scene(scene).spec.to_mapping()}
        data["scene"]["targets"] = {"world_mm": [[1000.0, 300.0, 200.0]]}
    if name == "spectacles":
        data["scene"]["subject"]["spectacles"] = {"sphere_d": -4.0}
    data["labels"] = {**data.get("labels", {}), "geometry": ["depth", "normals", "iris_coordinates", "instances"]}
    data["scene"].setdefault("image", {}).update(spp=1)
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    "name", ["spectacles", *(pytest.param(name, marks=pytest.mark.slow) for name in ("headset", "people_openeds"))]
)
def test_normals_are_judged_against_their_own_rays(tmp_path, capsys, name):
    folder = tmp_path / "out"
    made = ["generate", written(tmp_path / "d.yaml", name), "-o", str(folder), "--workers", "1", "--count", "1"]
    with single_workers_in_process():
        assert run(made) == 0
    assert run(["validate", str(folder)]) == 0, capsys.readouterr().out
    entry = ImageFolder.load(folder).entries[0]
    normals = entry.normals()
    turned = np.where(np.isnan(normals[..., 2:]), normals, -normals)
    (folder / entry.line["normals_file_name"]).write_bytes(picture_bytes(turned))
    capsys.readouterr()
    assert run(["validate", str(folder)]) == 1
    assert "its normals are no unit vectors to the camera" in capsys.readouterr().out
