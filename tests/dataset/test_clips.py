"""Datasets of sequences: clips, their splits and shards, resuming, and what a loader gets."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec
from eyerender.scene import load_scene
from tests.support.sequences import turning


def spec(**changes):
    """Two people, two clips of five frames each, bare eyes in small pictures."""
    scene = {
        key: value for key, value in load_scene("headset").spec.to_mapping().items() if key not in ("targets", "poses")
    }
    for camera in scene["rig"]["cameras"]:
        camera["frame_rate_hz"] = 50.0
    scene["rig"]["lights"] = scene["rig"]["lights"][:1]
    scene["rig"]["screen"] = {"centre_mm": [600.0, 0.0, 0.0], "size_mm": [480.0, 270.0]}
    scene["sensor"]["exposure_ms"] = 1.0  # few moments of motion blur
    scene |= {
        "image": {"spp": 1, "window_px": [48, 40]},
        "region": None,
        "sequence": {**turning(40.0, -3.0, 0.1), "lids": {"blinks_per_minute": 0, "at_s": [0.0]}},
        "lens": {"vignetting": {"draw": "uniform", "low": 0.0, "high": 0.5}},
        "look": {"iris_albedo": {"draw": "uniform", "low": 0.2, "high": 0.4}},
    }
    del scene["name"], scene["description"]
    data = {
        "format": 3,
        "kind": "dataset",
        "name": "clips",
        "count": 20,
        "subjects": 2,
        "splits": {"train": 0.5, "test": 0.5},
    }
    return DatasetSpec.from_mapping({**data, "scene": scene, **changes})


def test_samples_are_frames_of_clips_and_clips_belong_together():
    plan = Plan.of(spec())
    assert plan.spec.clip_frames == 5
    drawn = [plan.draw(k) for k in range(20)]
    for clip in range(4):
        frames = drawn[5 * clip : 5 * clip + 5]
        assert len({json.dumps(sample.draws) for sample in frames}) == 1
        assert len({(sample.split, sample.turn.subject) for sample in frames}) == 1
        assert [sample.scene["sequence"]["instants"] for sample in frames] == [[k] for k in range(5)]
        assert len({sample.scene["sequence"]["seed"] for sample in frames}) == 1
    values = [drawn[k].draws["lens.vignetting"] for k in (0, 5, 10, 15)]
    assert len(set(values)) == 4
    assert (
        drawn[0].draws["look.iris_albedo"] == drawn[5].draws["look.iris_albedo"] != drawn[10].draws["look.iris_albedo"]
    )
    for shard in plan.spec.shards:
        assert len(plan.spec.shard_samples(shard)) % 5 == 0


def test_a_spread_choice_takes_whole_clips_of_different_subjects():
    some = spec().first(10)
    assert list(some.selection.samples) == [*range(5), *range(10, 15)]
    with pytest.raises(InputError, match="must be a multiple of 5"):
        spec().first(7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 21}, "count: must be a multiple of 5, the frames of a clip"),
        ({"shard_size": 4}, "shard_size: must be a multiple of 5"),
        ({"subjects": 5}, "subjects: must be at most 4"),
    ],
)
def test_numbers_that_cut_clips_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        spec(**change)


def test_a_draw_that_would_change_within_a_clip_is_refused():
    scene = spec().scene
    lens = {"vignetting": {"draw": "uniform", "low": 0.0, "high": 0.5, "per": "sample"}}
    with pytest.raises(InputError, match=r"lens\.vignetting\.per: would change within a clip; use clip"):
        Plan.of(spec(scene={**scene, "lens": lens}))


def test_the_length_of_clips_must_be_plain():
    scene = spec().to_mapping()["scene"]
    scene["sequence"]["duration_s"] = {"draw": "uniform", "low": 0.1, "high": 0.2}
    with pytest.raises(InputError, match="must be a plain number"):
        spec(scene=scene)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    (folder / "spec.yaml").write_text(yaml.safe_dump(spec().to_mapping()))
    er.generate(folder / "spec.yaml", folder / "out", workers=1)
    return folder


def test_a_made_dataset_is_valid_and_its_frames_are_in_order(made):
    found = er.validate(made / "out")
    assert found["problems"] == []
    lines = [entry.line for entry in er.ImageFolder.load(made / "out")]
    assert [line["sample"] for line in lines] == list(range(20))
    assert [line["instant"] for line in lines] == list(range(20))
    assert [line["records"][0]["frame"] for line in lines] == list(range(20))
    times = np.array([line["time_s"] for line in lines]).reshape(4, 5)
    np.testing.assert_allclose(np.diff(times, axis=1), 0.02, atol=1e-12)
    np.testing.assert_array_equal(times[0], times[3])


def test_a_single_frame_on_demand_is_that_of_the_run(made):
    """Sample 13 alone, in another order than the run's, has the same pixels."""
    found = er.sample(made / "spec.yaml", 13)
    (image,) = er.render_windows(found.frames)
    line = er.ImageFolder.load(made / "out").entries[13]
    np.testing.assert_array_equal(image.counts, line.image())


def test_clips_of_a_loader_are_frames_in_a_row(made):
    torch = pytest.importorskip("torch")
    from eyerender.torch import ClipDataset, FolderDataset

    clips = ClipDataset(made / "out", frames=3, parts=("image", "pupil"), split="train")
    assert len(clips) == 2 * 3
    assert clips.shares["blink"] == 1.0  # each clip begins with one
    item = clips[0]
    assert item["image"].shape == (3, 40, 48)
    single = FolderDataset(made / "out", parts=("image", "pupil"), split="train")
    assert torch.equal(item["image"][2:], single[2]["image"])
    assert torch.equal(item["pupil"], single[2]["pupil"])
    assert len(ClipDataset(made / "out", frames=3, stride=2, split="train")) == 2
    assert len(list(clips.sampler(4, blink=2.0))) == 4
    with pytest.raises(InputError, match="must be one of blink, saccade, slippage"):
        clips.sampler(winks=2.0)
    with pytest.raises(InputError, match="has no clip of 9 frames"):
        ClipDataset(made / "out", frames=9)


def _without_a_line(folder):
    lines = (folder / "metadata.jsonl").read_text().splitlines(keepends=True)
    (folder / "metadata.jsonl").write_text("".join(lines[:3] + lines[4:]))


def _with_half_a_line(folder):
    lines = (folder / "metadata.jsonl").read_text().splitlines(keepends=True)
    (folder / "metadata.jsonl").write_text("".join([*lines[:3], lines[3][: len(lines[3]) // 2] + "\n", *lines[4:]]))


def _with_half_a_picture(folder):
    path = sorted((folder / "images").rglob("*.png"))[3]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _without_a_picture(folder):
    sorted((folder / "images").rglob("*.png"))[3].unlink()


def _without_times(folder):
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    for line in lines:
        line["records"][0]["time_s"] = None
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_the_command_warns_of_a_screen_whose_pixels_are_not_square(made, tmp_path, capsys):
    command = ["export-dataset", str(made / "out"), "--format", "bids"]
    assert run([*command, str(tmp_path / "square")]) == 0
    assert "warning" not in capsys.readouterr().err
    assert run([*command, str(tmp_path / "other"), "--screen-px", "1920", "1200"]) == 0
    assert capsys.readouterr().err.count("0.25 x 0.225 mm, not square") == 1


HARMS = (_without_a_line, _with_half_a_line, _without_times, _with_half_a_picture, _without_a_picture)


@pytest.mark.parametrize("layout", ["video", "bids"])
@pytest.mark.parametrize("harm", HARMS)
def test_an_export_of_a_harmed_folder_says_so_in_one_line_and_leaves_nothing(made, tmp_path, capsys, layout, harm):
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(made / "out", folder)
    harm(folder)
    code = run(["export-dataset", str(folder), str(out), "--format", layout])
    said = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert [line for line in said if line.startswith("error: ")] == said[-1:]
    assert "Traceback" not in "".join(said)
    assert not out.exists() or not any(out.iterdir())
