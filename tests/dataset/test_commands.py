"""The dataset commands end to end, in this process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.imageobserver import rigs_of
from tests.support.dataset_specs import tree, write

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


@pytest.mark.packaging
def test_a_count_makes_the_same_bytes_as_the_whole_dataset(tiny, spec, capsys):
    # The samples are spread over the subjects, and so over shards.
    assert run(["generate", spec, "part", "--count", "5", "--workers", "1", "--threads", "1"]) == 0
    assert "5 images in part: test 1, train 2, validation 2;" in capsys.readouterr().out
    lines = (tiny / "metadata.jsonl").open().readlines()
    assert Path("part/metadata.jsonl").read_text() == "".join(lines[k] for k in (0, 1, 6, 12, 18))
    made = sorted(p.relative_to("part") for p in Path("part").rglob("*.png"))
    assert len(made) == 10
    for name in made:
        assert ("part" / name).read_bytes() == (tiny / name).read_bytes()
    assert run(["validate", "part"]) == 0
    # The rest is made without making these again.
    assert run(["generate", spec, "part", "--workers", "1", "--threads", "1"]) == 0
    assert "19 images made" in capsys.readouterr().out
    assert tree(Path("part")) == tree(tiny)


def test_a_dataset_of_single_eyes_says_why_gaze_has_no_estimate(tiny, capsys):
    assert run(["compare", str(tiny)]) == 0
    out = capsys.readouterr().out
    assert "gaze error of 4 subjects, each calibrated alone" in out
    assert "  none (" in out
    assert "for one eye give --monocular" in out


def disk_of(folder):
    names = ("*.png", "lines.jsonl", "metadata.jsonl", "done.json")
    return sum(p.stat().st_size for name in names for p in folder.rglob(name))


def test_a_dry_run_makes_nothing_and_tells_time_and_disk(tiny, spec, tmp_path, capsys):
    assert run(["generate", spec, "--dry-run", "--measure", "--workers", "2", "--threads", "2", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"] == 24
    assert found["shards"] == 8
    assert found["bytes"] == pytest.approx(disk_of(tiny), rel=0.1)
    assert found["seconds"] > 0
    assert found["rate"]["how"] == "measured"
    assert [p.name for p in tmp_path.iterdir()] == ["tiny.yaml"]


def dry_run(spec, capsys, *options):
    assert run(["generate", spec, "--dry-run", *options]) == 0
    text = capsys.readouterr().out
    assert run(["generate", spec, "--dry-run", *options, "--json", "-"]) == 0
    return text, json.loads(capsys.readouterr().out)


@pytest.mark.packaging
def test_a_dry_run_uses_the_last_rate_of_the_spec(spec, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    text, found = dry_run(spec, capsys)
    assert "24 images in 8 shards" in text
    assert (
        "time and disk space are unknown, because this spec was never measured on this machine; use --measure" in text
    )
    assert (found["seconds"], found["bytes"], found["rate"]) == (None, None, None)
    assert run(["generate", spec, "out", "--count", "6", "--workers", "1", "--threads", "1"]) == 0
    size = disk_of(tmp_path / "out")
    capsys.readouterr()
    # Of a thousand million samples, with another seed.
    many = ("--count", str(10**9), "--seed", "7", "--workers", "1")
    text, found = dry_run(spec, capsys, *many)
    assert found["rate"]["how"] == "run"
    assert found["rate"]["samples"] == 4  # without the first shard of the worker, which holds its start
    assert found["images"] == 10**9
    assert found["bytes"] == pytest.approx(10**9 * size / 6, rel=0.01)
    assert found["seconds"] == pytest.approx(found["rate"]["start_seconds"] + 10**9 * found["rate"]["seconds"])
    assert (
        f"about {found['seconds'] / 86400:.1f} days, {found['bytes'] / 1e12:.1f} TB (rate of a run with 4 samples"
        in text
    )
    # Another spec, another backend, and a damaged cache: unknown.
    other = write(tmp_path / "other.yaml", scene__image__spp=3)
    assert "time and disk space are unknown" in dry_run(str(other), capsys)[0]
    assert "time and disk space are unknown" in dry_run(spec, capsys, "--backend", "cuda")[0]
    (file,) = (tmp_path / "cache" / "eyerender" / "rates").iterdir()
    good = json.loads(file.read_text())
    for bad in ("", "[" * 10**5, "{}", json.dumps(good | {"seconds": -1}), json.dumps(good | {"bytes": 10**400})):
        file.write_text(bad)
        assert "time and disk space are unknown" in dry_run(spec, capsys)[0]


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
    rig = rigs_of(ImageFolder.load(tiny))[5]
    labels = ImageFolder.load(tiny).entries[5].line["labels"]
    np.testing.assert_array_equal(rig.cameras[0].K, labels["camera"]["K"])
    np.testing.assert_array_equal(rig.cameras[0].t, labels["camera"]["t_mm"])
