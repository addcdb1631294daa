"""Datasets for PyTorch: folders and streams give the same images, with workers, ranks and after resuming."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError, UnfinishedRunWarning
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import plan
from tests.support.paths import ROOT
from tests.support.stages import unassemble

torch = pytest.importorskip("torch", reason="needs PyTorch; run ./scripts/test-torch")

from torch.utils.data import DataLoader  # noqa: E402

from eyerender.dataset.training.item import LABELS  # noqa: E402
from eyerender.torch import PARTS, Augment, FolderDataset, StreamDataset, collate, place  # noqa: E402

pytestmark = pytest.mark.render
LACKING = (
    "amodal_mask",
    "annotated_mask",
    "highlight_mask",
    "lens_reflection_mask",
    "instance_mask",
    "depth",
    "normals",
    "iris_coordinates",
)
ALL = tuple(part for part in PARTS if part not in LACKING)


def brighter(item):
    return {**item, "image": 2 * item["image"]}


def same(a, b):
    assert a.keys() == b.keys()
    for key, value in a.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == b[key].dtype
            torch.testing.assert_close(value, b[key], rtol=0, atol=0, equal_nan=True)
        elif key in ("camera", "valid"):
            same(value, b[key])
        else:
            assert value == b[key]


def numbers(loader):
    return [int(i) for batch in loader for i in batch["sample"]]


def without_files(lines):
    return [{k: v for k, v in line.items() if k != "schema" and not k.endswith("file_name")} for line in lines]


def test_what_is_finished_of_a_run_can_be_trained_on(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    unassemble(copy)
    shards = sorted((copy / "shards").iterdir())
    (shards[1] / "done.json").unlink()
    lost = {json.loads(line)["sample"] for line in (shards[1] / "lines.jsonl").read_text().splitlines()}
    with pytest.warns(UnfinishedRunWarning, match="the run is unfinished"):
        data = FolderDataset(copy, parts=("image", "mask", "line"))
    whole = {item["sample"]: item for item in FolderDataset(folder, parts=("image", "mask", "line"))}
    assert [item["sample"] for item in data] == sorted(whole.keys() - lost)
    for item in data:
        same(item, whole[item["sample"]])


def test_a_folder_gives_its_pictures_and_labels(folder):
    data = FolderDataset(folder, parts=ALL)
    assert len(data) == 20
    for item, entry in zip((data[k] for k in range(len(data))), ImageFolder.load(folder), strict=True):
        share = entry.image().astype(np.float32) / 65535
        assert item["image"].dtype == torch.float32
        assert item["image"].shape == (1, 72, 96)
        np.testing.assert_array_equal(item["image"][0], share)
        np.testing.assert_array_equal(item["noiseless"][0], entry.noiseless().astype(np.float32) / 65535)
        assert item["mask"].dtype == torch.int64
        np.testing.assert_array_equal(item["mask"], entry.mask())
        assert item["line"] == entry.line
        assert (item["sample"], item["subject"]) == (entry.line["sample"], entry.line["subject"])
        # The ellipses lie in the window: the pupil's centre is on a pixel of the pupil.
        for part, least in (("pupil", 3), ("iris", 2)):
            x, y, a, b, _ = item[part].tolist()
            assert a >= b > 0
            assert entry.mask()[round(y), round(x)] >= least
        space = entry.labels["space"]["camera"]
        to_target = np.array(space["target_mm"]) - space["globe_centre_mm"]
        assert item["gaze"] @ torch.tensor(to_target / np.linalg.norm(to_target), dtype=torch.float32) > 0.99
        assert torch.linalg.norm(item["gaze"]) == pytest.approx(1, abs=1e-6)
        azimuth, elevation = torch.deg2rad(item["optic_axis_deg"])
        pose = torch.tensor([entry.records[0]["pose"][f"{a}_deg"] for a in ("azimuth", "elevation")])
        assert torch.rad2deg(torch.stack([azimuth, elevation])) == pytest.approx(pose, abs=1e-3)
        assert item["valid"].keys() == {part for part in LABELS if part in ALL}
        assert item["valid"]["gaze"]
        assert item["eye"] == 0


def test_a_rendered_scene_is_a_folder_too(spec, tmp_path):
    er.render_folder(spec.draw(0).build(), tmp_path / "rendered")
    data = FolderDataset(tmp_path / "rendered")
    assert sorted(data[0]) == ["image", "mask"]
    np.testing.assert_array_equal(data[0]["image"][0] * 65535, data.folder.entries[0].image())
    assert torch.linalg.norm(FolderDataset(tmp_path / "rendered", parts=("gaze",))[0]["gaze"]) == pytest.approx(1)


def test_splits_of_a_folder_share_no_subject(folder):
    subjects = {}
    for split, count in (("train", 10), ("validation", 5), ("test", 5)):
        data = FolderDataset(folder, split=split, parts=("eye",))
        assert len(data) == count
        subjects[split] = {data[k]["subject"] for k in range(count)}
    assert [len(s) for s in subjects.values()] == [2, 1, 1]
    assert len(set.union(*subjects.values())) == 4


def test_a_folder_with_workers_that_stay(folder):
    data = FolderDataset(folder, split="train", parts=("image", "mask", "line"), transform=brighter)
    loader = DataLoader(
        pickle.loads(pickle.dumps(data)),
        batch_size=4,
        num_workers=2,
        persistent_workers=True,
        multiprocessing_context="spawn",
        collate_fn=collate,
    )
    own = [data[k] for k in range(len(data))]
    for _ in range(2):
        found = list(loader)
        for k, batch in enumerate(found):
            same(batch, collate(own[4 * k : 4 * k + 4]))
        assert [len(batch["line"]) for batch in found] == [4, 4, 2]


@pytest.mark.parametrize(
    ("workers", "batch_size", "options"), [(0, 4, {}), (2, 3, {}), (1, 20, {"multiprocessing_context": "forkserver"})]
)
def test_a_stream_equals_what_generate_writes(folder, spec, workers, batch_size, options):
    stream = StreamDataset(spec, parts=ALL, batch_size=batch_size, transform=brighter)
    data = FolderDataset(folder, parts=ALL, transform=brighter)
    own = [data[k] for k in range(len(data))]
    found = list(stream.loader(workers, **options))
    assert len(found) == -(-20 // batch_size)
    assert sorted(numbers(found)) == list(range(20))
    for batch in found:
        assert (batch["sample"].diff() == 1).all()
        expected = collate([own[k] for k in batch["sample"]])
        assert without_files(batch.pop("line")) == without_files(expected.pop("line"))
        same(batch, expected)


def test_a_split_of_a_stream_is_that_of_the_folder(folder, spec):
    for split in ("train", "validation", "test"):
        own = FolderDataset(folder, split=split, parts=("eye",))
        stream = StreamDataset(spec, split=split, parts=("image",), batch_size=3)
        assert numbers(stream) == [own[k]["sample"] for k in range(len(own))]


def test_a_stream_yields_each_picture_again_with_other_changes(spec):
    options: Any = {"batch_size": 4, "shuffle": 2, "reuse": 3, "lanes": 2, "parts": ("image", "glints", "eye"),
               "size": (48, 40), "augment": Augment(seed=1)}  # fmt: skip
    stream = StreamDataset(spec, **options)
    found = list(stream)
    assert len(found) == len(stream) == 15
    assert sorted(numbers(found)) == sorted(3 * list(range(20)))
    assert found[0]["image"].shape == (4, 1, 40, 48)
    of_first = [batch["image"][k] for batch in found for k in range(4) if batch["sample"][k] == 0]
    assert all(not torch.equal(a, b) for a, b in pairwise(of_first))
    for batch in found[:6]:  # the window of the first two batches, each time in another order
        assert set(batch["sample"].tolist()) <= {0, 1, 2, 3, 12, 13, 14, 15}
    # A resumed stream makes the same, and so do two ranks together.
    resumed = StreamDataset(spec, **options, start=7)
    assert len(resumed) == 8
    for got, want in zip(resumed, found[7:], strict=True):
        same(got, want)
    ranks = [StreamDataset(spec, **options, rank=rank, ranks=2) for rank in range(2)]
    assert [len(one) for one in ranks] == [len(numbers(one)) // 4 for one in ranks] == [9, 6]


def test_a_folder_is_changed_anew_in_each_epoch_and_mirrors_left_eyes(folder):
    data = FolderDataset(folder, parts=(*LABELS, "mask", "image", "camera"), size=(64, 64), augment=Augment(),
                         mirror_left=True)  # fmt: skip
    loader = DataLoader(data, batch_size=10)
    torch.manual_seed(3)
    first, second = (torch.cat([batch["image"] for batch in loader]) for _ in range(2))
    assert not torch.equal(first, second)
    torch.manual_seed(3)
    batch = next(iter(loader))
    torch.testing.assert_close(batch["image"], first[:10])
    assert batch["mirrored"].any()
    assert not batch["mirrored"].all()
    assert batch["valid"]["glints"].shape == (10, 2)
    assert torch.equal(batch["eye"], batch["mirrored"].long())  # the folder's eyes are right ones


def test_pictures_of_ones_own_are_changed_alike(folder):
    item = FolderDataset(folder)[0]
    torch.manual_seed(0)
    own = {"image": (item["mask"] == 3)[None].float(), "mask": item["mask"]}
    found = Augment(erase=0, noise=(0, 0), blur_px=(0, 0), compression=0)(own, (64, 48))
    assert found["image"].shape == (1, 48, 64)
    assert found["mask"].dtype == torch.int64
    assert ((found["image"][0] > 0.5) == (found["mask"] == 3)).float().mean() > 0.97
    with pytest.raises(InputError, match="item: cannot be changed here; give 'augment' to the dataset"):
        Augment()({**own, "gaze": torch.zeros(3)})


def test_every_batch_has_one_place():
    for count in (0, 1, 7, 24, 25):
        assert [place(batch, count, 1) for batch in range(count)] == list(range(count))
        for lanes in (2, 3, 6, 40):
            order = [place(batch, count, lanes) for batch in range(count)]
            assert sorted(order) == list(range(count))
            for lane in range(lanes):
                own = order[lane::lanes]
                assert own == list(range(own[0], own[0] + len(own))) if own else lane >= count


def test_ranks_and_workers_make_every_sample_once(spec):
    def batches(workers, **options):
        stream = StreamDataset(spec, batch_size=3, parts=("eye",), **options)
        return [batch["sample"].tolist() for batch in stream.loader(workers)]

    whole = batches(0, lanes=4)
    assert sorted(i for batch in whole for i in batch) == list(range(20))
    assert whole[0] == [0, 1, 2]
    assert whole[4] == [3, 4, 5]  # the second batch of the first lane
    for rank in range(2):
        assert batches(2, rank=rank, ranks=2) == whole[rank::2]  # four workers in all
    assert batches(2, lanes=4, start=3) == whole[3:]
    with pytest.raises(InputError, match="lanes: must be a multiple of 2, the number of workers of all ranks"):
        batches(0, ranks=2, rank=0, lanes=3)


RANK = """
import sys
import torch.distributed as dist
from eyerender.torch import StreamDataset
from tests.support.dataset_specs import plan
rank, place = int(sys.argv[1]), sys.argv[2]
dist.init_process_group("gloo", init_method=f"file://{place}", rank=rank, world_size=2)
stream = StreamDataset(plan(count=6, subjects=2), batch_size=2, parts=("eye",))
print(stream.rank, stream.ranks, [int(i) for batch in stream for i in batch["sample"]])
dist.barrier()
dist.destroy_process_group()
"""


def test_a_process_group_says_which_rank_this_is(tmp_path):
    argv = [sys.executable, "-c", RANK]
    processes = [
        subprocess.Popen([*argv, str(rank), str(tmp_path / "group")], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        for rank in range(2)
    ]
    found = [process.communicate(timeout=120)[0].strip() for process in processes]
    assert found == ["0 2 [0, 1, 2, 3]", "1 2 [4, 5]"]


def test_a_stream_goes_on_where_it_stopped(folder, spec):
    data = FolderDataset(folder)
    rest = list(StreamDataset(spec, batch_size=4, start=3, lanes=2).loader(2))
    assert numbers(rest) == [16, 17, 18, 19, 8, 9, 10, 11]
    same(rest[0], collate([data[k] for k in range(16, 20)]))
    stream = StreamDataset(spec, batch_size=4, lanes=2)
    parts = iter(stream)
    for _ in range(3):
        next(parts)
    state = json.loads(json.dumps(stream.state_dict()))
    resumed = StreamDataset(spec, batch_size=4, lanes=2)
    resumed.load_state_dict(state)
    for got, want in zip(resumed, rest, strict=True):
        same(got, want)
    assert sorted(numbers(resumed)) == list(range(20))  # another pass begins at the start
    for other in (StreamDataset(plan(count=21), batch_size=4, lanes=2), StreamDataset(spec, batch_size=5, lanes=2)):
        with pytest.raises(InputError, match=r"(digest|batch_size): is .* in the state, but .* here"):
            other.load_state_dict(state)


def test_each_worker_goes_on_in_its_own_batches(spec, monkeypatch):
    """As a loader does that asks its workers for their states."""

    class Worker:
        id, num_workers = 1, 2

    monkeypatch.setattr("eyerender.torch.get_worker_info", Worker)
    own = [batch["sample"].tolist() for batch in StreamDataset(spec, batch_size=3, parts=("eye",), start=1)]
    stream = StreamDataset(spec, batch_size=3, parts=("eye",), start=1)
    assert next(iter(stream))["sample"].tolist() == own[0]
    resumed = StreamDataset(spec, batch_size=3, parts=("eye",), start=1)
    resumed.load_state_dict(stream.state_dict())
    assert [batch["sample"].tolist() for batch in resumed] == own[1:]


def test_samples_that_were_given_up_are_left_out():
    # Some targets are so far aside that the pupil leaves the window, and only one attempt is made.
    wide = plan(
        scene__image__window_px=[40, 40],
        scene__targets__screen_mm=[[{"draw": "sobol", "low": -500, "high": 500}, 0.0]],
        attempts=1,
        seed=3,  # whose first sample can be made
    )
    found = numbers(StreamDataset(wide, batch_size=4, parts=("mask",)))
    assert found == sorted(set(found))
    assert 0 < len(found) < wide.spec.count


def test_bad_arguments_are_one_line(folder, spec, tmp_path):
    for make, words in (
        (lambda: FolderDataset(tmp_path / "nowhere"), "no such folder"),
        (
            lambda: FolderDataset(folder, split="val"),
            "no image is of the split 'val'; there are test, train, validation",
        ),
        (lambda: FolderDataset(folder, parts=("colour",)), "parts: must be some of image, noiseless, mask"),
        (lambda: FolderDataset(folder, parts=()), "parts: is empty; name some of image, noiseless"),
        (
            lambda: FolderDataset(folder, parts=("amodal_mask",))[0],
            "line 1: has no part 'amodal_mask': its line names no 'amodal_masks'",
        ),
        (lambda: StreamDataset("no_such_spec"), "no such dataset file"),
        (lambda: StreamDataset(spec, batch_size=0), "batch_size: must be >= 1, not 0"),
        (lambda: StreamDataset(spec, start=-1), "start: must be >= 0, not -1"),
        (lambda: StreamDataset(spec, reuse=0), "reuse: must be >= 1, not 0"),
        (
            lambda: FolderDataset(folder, parts=("glints",), lights=1)[0],
            "lights: must be >= 2, the number of the lamps",
        ),
        (lambda: StreamDataset(spec, rank=2, ranks=2), "rank: must be 0 to 1, not 2"),
        (lambda: StreamDataset(spec, threads=0), "threads: must be >= 1, not 0"),
        (lambda: StreamDataset(spec, split="val"), "split: must be one of train, validation, test, not 'val'"),
        (lambda: StreamDataset(spec, parts=("amodal_mask",)), "amodal_mask: the spec makes none"),
    ):
        with pytest.raises(InputError) as refused:
            make()
        assert words in str(refused.value)


def test_the_example_for_recorded_images_outlines_them(folder, tmp_path):
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    source = next((folder / "images").rglob("*.png"))
    (recorded / "eye.png").write_bytes(source.read_bytes())
    (recorded / "broken.png").write_bytes(b"no picture")
    script = [sys.executable, ROOT / "examples" / "segment_recorded.py", folder, "--epochs", "1"]
    done = subprocess.run(
        [*script, "--apply", recorded, "--overlays", tmp_path / "out"], capture_output=True, text=True, check=True
    )
    assert "loss" in done.stdout
    assert "broken.png: cannot be read" in done.stderr
    assert [f.name for f in (tmp_path / "out").iterdir()] == ["eye.png"]


def test_the_example_with_own_labels_compares_the_networks(folder, tmp_path):
    source = next((folder / "images").rglob("*.png"))
    (tmp_path / "one__eye.png").write_bytes(source.read_bytes())
    header, eye = "file,x_px,y_px,a_px,b_px,angle_deg", ",20,20,5,4,30"
    table = tmp_path / "ellipses.csv"
    table.write_text(f"{header}\none__eye.png{eye}\nnone.png{eye}\n")
    script = [sys.executable, ROOT / "examples" / "own_labels.py", folder, "--steps", "1", "--test", tmp_path]
    done = subprocess.run([*script, "--ellipses", table], capture_output=True, text=True, check=True)
    assert "none.png: cannot be read" in done.stderr
    name, part, count, *scores = done.stdout.splitlines()[-1].split()
    assert (name, part, count) == ("one", "pupil", "1")
    assert all(0 <= float(score) <= 1 for score in scores)
    assert len(scores) == 3
    table.write_text("file,x_px\nno,1\n")
    failed = subprocess.run([*script, "--ellipses", table], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert failed.stderr.strip() == f"error: {table}: line 2: lacks y_px, a_px, b_px, angle_deg"
