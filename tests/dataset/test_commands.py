"""The dataset commands end to end, in this process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from dataset_specs import write
from PIL import Image

from eyerender.cli.app import run
from eyerender.imagefolder import ImageFolder
from eyerender.observers import scene_of

pytestmark = pytest.mark.render


@pytest.fixture
def spec(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return str(write(tmp_path / "tiny.yaml"))


def test_a_sample_written_as_a_scene_has_the_datasets_features(tiny, spec, capsys):
    for index in (0, 13):
        assert run(["sample", spec, str(index), "-o", f"s{index}", "--json", "-"]) == 0
        shown = json.loads(capsys.readouterr().out)
        assert run(["features", f"s{index}/scene.yaml", "--json", "-"]) == 0
        record = json.loads(capsys.readouterr().out)["records"][0]
        line = ImageFolder.load(tiny).entries[index].line
        assert shown["draws"] == line["parameters"]["draws"]
        assert (shown["subject"], shown["split"]) == (line["subject"], line["split"])
        expected = line["records"][0]
        assert record["pupil"] == expected["pupil"]
        assert record["glints"] == expected["glints"]


def test_a_count_makes_the_same_bytes_as_the_whole_dataset(tiny, spec, capsys):
    assert run(["generate", spec, "part", "--count", "2", "--workers", "1", "--threads", "1"]) == 0
    assert "2 images in part: validation 2;" in capsys.readouterr().out
    assert Path("part/metadata.jsonl").read_text() == "".join((tiny / "metadata.jsonl").open().readlines()[:2])
    made = sorted(p.relative_to("part") for p in Path("part").rglob("*.png"))
    assert len(made) == 4
    for name in made:
        assert ("part" / name).read_bytes() == (tiny / name).read_bytes()
    # The rest is another run.
    assert run(["generate", spec, "part"]) == 2
    assert "spec.count: 2 -> 24" in capsys.readouterr().err


def test_a_dataset_without_several_targets_says_what_gaze_needs(tiny, capsys):
    assert run(["compare", str(tiny)]) == 0
    assert "a calibration needs several targets in one scene, such as" in capsys.readouterr().out


def test_a_dry_run_makes_nothing_and_tells_time_and_disk(tiny, spec, tmp_path, capsys):
    assert run(["generate", spec, "--dry-run", "--workers", "2", "--threads", "2", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"] == 24
    assert found["shards"] == 8
    size = sum(p.stat().st_size for kind in ("images", "masks") for p in (tiny / kind).rglob("*.png"))
    size += (tiny / "metadata.jsonl").stat().st_size
    assert found["bytes"] == pytest.approx(size, rel=0.1)
    assert found["seconds"] > 0
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.yaml"]


@pytest.mark.parametrize("what", ["dataset", "scene"])
def test_a_preview_shows_sixteen_images(spec, what, capsys):
    if what == "scene":
        assert run(["sample", spec, "3", "-o", "s3"]) == 0
    assert run(["preview", spec if what == "dataset" else "s3/scene.yaml", "-o", "sheet.png"]) == 0
    sheet = np.asarray(Image.open("sheet.png"))
    tiles = 16 if what == "dataset" else 1
    # Each tile is 96 x 72 px under a line of text, four in a row.
    assert sheet.shape == ((tiles + 3) // 4 * 90 + 4, min(tiles, 4) * 100 + 4)
    assert 20 < sheet[16:88, 4:100].mean() < 235


def test_commands_report_as_json(tiny, capsys):
    assert run(["validate", str(tiny), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"]


def test_a_dataset_of_one_rig_can_be_compared(tiny):
    scene = scene_of(ImageFolder.load(tiny))
    labels = ImageFolder.load(tiny).entries[5].line["labels"]
    np.testing.assert_array_equal(scene.rig.cameras[0].K, labels["camera"]["K"])
    np.testing.assert_array_equal(scene.rig.cameras[0].t, labels["camera"]["t_mm"])
