"""Runs: the same bytes whatever happens, refusals, exclusion, and workers that die or hang."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from eyerender.base.errors import EyerenderError, InputError
from eyerender.base.storage.lock import run_lock
from eyerender.dataset.options import RunOptions
from eyerender.dataset.pool import LocalPool
from eyerender.dataset.realise import frames_of
from eyerender.dataset.worker import Job
from eyerender.folders.imagefolder import finished
from tests.support import stages
from tests.support.dataset_specs import command, make, plan, tree, write

pytestmark = pytest.mark.render


def log(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


class Listener:
    """Events of an engine, with something to do when the first sample of a run is made."""

    def __init__(self, act=None):
        self.act = act
        self.retries = []
        self.made = []
        self.pids = []

    def ready(self, backend, worker):
        self.pids.append(int(worker))

    def sample(self, shard, samples, images):
        if self.act is not None:
            act, self.act = self.act, None
            act(self.pids[-1])

    def staged(self, staged, worker):
        self.made.append(staged.shard)
        shutil.rmtree(staged.stage)

    def retry(self, shard, reason, tries):
        self.retries.append((shard, reason))


def pool(folder, workers=1, **options):
    made = plan()
    return LocalPool(Job.of(made, frames_of(made), folder, "auto", 1), workers, **options)


def test_the_folder_is_as_agreed(tiny):
    dataset = json.loads((tiny / "dataset.json").read_text())
    assert dataset["schema"] == "eyerender/dataset/1"
    assert dataset["digest"] == plan().digest
    assert dataset["statistics"]["images"] == 24
    lines = [json.loads(line) for line in (tiny / "metadata.jsonl").read_text().splitlines()]
    assert [line["sample"] for line in lines] == list(range(24))
    assert [line["records"][0]["frame"] for line in lines] == list(range(24))
    for line in lines:
        assert (tiny / line["file_name"]).is_file()
        assert (tiny / line["mask_file_name"]).is_file()
        assert line["split"] == plan().split_of(line["subject"])
    done = json.loads((tiny / "shards" / "00003" / "done.json").read_text())
    assert done["samples"] == [9, 12]
    assert done["versions"]["mitsuba"]
    assert done["backend"]["name"] in ("llvm", "cuda")
    assert len(done["files"]) == 7
    events = [entry["event"] for entry in log(tiny)]
    assert events.count("shard") == 8
    assert events[0] == "start"
    assert events[-1] == "end"
    assert not list(tiny.glob(".partial-*"))


def test_two_workers_make_the_same_bytes(tiny, tmp_path):
    make(tmp_path / "two", plan(), workers=2, threads=2)
    assert tree(tmp_path / "two") == tree(tiny)


@pytest.mark.packaging
def test_parts_make_the_same_bytes_and_the_last_puts_them_together(tiny, tmp_path):
    folder = tmp_path / "parts"
    first = make(folder, plan(), part=(2, 2))
    assert not first["complete"]
    assert first["shards_missing"] == 4
    assert not (folder / "dataset.json").exists()
    assert make(folder, plan(), part=(1, 2))["complete"]
    assert tree(folder) == tree(tiny)


def test_a_finished_shard_is_never_made_again(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    shutil.rmtree(folder / "shards" / "00002")
    stamps = {p: p.stat().st_mtime_ns for p in (folder / "images").rglob("*.png") if p.parent.name != "00002"}
    done = make(folder, plan())
    assert done["shards_made"] == 1
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps
    assert tree(folder) == tree(tiny)
    assert make(folder, plan())["shards_made"] == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scene.image.spp": 3}, "spec.scene.image.spp: 2 -> 3"),
        ({"seed": 6}, "spec.seed: 5 -> 6"),
        ({"count": 30}, "spec.planned: 24 -> 30"),
    ],
)
def test_another_spec_is_refused_with_the_difference(tiny, changes, words):
    before = tree(tiny)
    with pytest.raises(InputError) as caught:
        make(tiny, plan(**changes))
    assert words in str(caught.value)
    assert tree(tiny) == before


def test_other_versions_are_refused_with_the_difference(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "copy")
    run = json.loads((folder / "run.json").read_text())
    run["versions"]["drjit"] = "0.1"
    run["versions"]["python"] = "3.0"  # shapes no byte
    (folder / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match=r"\(versions.drjit: .0.1. -> "):
        make(folder, plan())


@pytest.mark.packaging
def test_overwrite_replaces_and_other_folders_are_left_alone(tmp_path):
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    small = plan(count=2, subjects=2, shard_size=2)
    with pytest.raises(InputError, match="is not empty"):
        make(folder, small)
    assert [p.name for p in folder.iterdir()] == ["thesis.txt"]
    with pytest.raises(InputError, match="was not made by this package, so it is not overwritten"):
        make(folder, small, overwrite=True)
    assert [p.name for p in folder.iterdir()] == ["thesis.txt"]
    made = tmp_path / "made"
    make(made, small)
    other = plan(count=2, subjects=2, shard_size=2, seed=5)
    make(made, other, overwrite=True)
    assert json.loads((made / "run.json").read_text())["digest"] == other.digest
    (made / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"holds 'thesis\.txt', which this package did not make"):
        make(made, small, overwrite=True)


def test_two_runs_exclude_each_other(tmp_path):
    with run_lock(tmp_path, (1, 1), print):
        for part in ((1, 1), (1, 2)):
            with pytest.raises(InputError, match="another run is using"):
                make(tmp_path, plan(), part=part)
    with run_lock(tmp_path, (1, 2), print), run_lock(tmp_path, (2, 2), print):
        for part in ((1, 1), (2, 2), (3, 3)):
            with pytest.raises(InputError, match="another run is using"):
                make(tmp_path, plan(), part=part)


@pytest.mark.packaging
def test_a_crashed_worker_is_replaced(tmp_path):
    listener = Listener(lambda pid: os.kill(pid, signal.SIGABRT))
    assert pool(tmp_path).run([0, 1], listener) == {}
    assert sorted(listener.made) == [0, 1]
    assert [reason for _, reason in listener.retries] == ["the worker was ended by SIGABRT"]
    assert len(set(listener.pids)) == 2


def test_a_shard_that_cannot_be_put_in_place_ends_the_run(tmp_path):
    class Full(Listener):
        def staged(self, staged, worker):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left on device"):
        pool(tmp_path, timeout_s=60.0).run([0], Full())


@pytest.mark.slow
def test_a_hung_worker_is_ended_and_replaced(tmp_path):
    listener = Listener(lambda pid: os.kill(pid, signal.SIGSTOP))
    assert pool(tmp_path, timeout_s=30.0).run([0], listener) == {}
    assert listener.made == [0]
    assert [reason for _, reason in listener.retries] == ["no sign of life for 30 s"]


@pytest.mark.slow
def test_a_shard_is_given_up_after_three_tries(tmp_path):
    class Killer(Listener):
        def sample(self, shard, samples, images):
            super().sample(shard, samples, images)
            if shard == 1:
                os.kill(self.pids[-1], signal.SIGKILL)

    listener = Killer()
    lost = pool(tmp_path).run([0, 1, 2], listener)
    assert lost == {1: "the worker was ended by SIGKILL"}
    assert sorted(listener.made) == [0, 2]
    assert len(listener.retries) == 3


class Troubled(LocalPool):
    """A pool of one worker, some of whose starts are deadly."""

    def __init__(self, folder, deadly):
        made = plan(shard_size=1)
        super().__init__(Job.of(made, frames_of(made), folder, "auto", 1), 1, recycle_images=1)
        self.deadly = deadly
        self.starts = 0

    def _start(self):
        super()._start()
        self.starts += 1
        if self.starts in self.deadly:
            self._workers[-1].process.kill()


@pytest.mark.packaging
def test_only_deaths_one_after_the_other_end_a_run(tmp_path):
    listener = Listener()
    assert Troubled(tmp_path, (1, 2, 4, 5)).run([0, 1], listener) == {}
    assert listener.made == [0, 1]
    assert listener.retries == [(-1, "the worker was ended by SIGKILL")] * 4
    with pytest.raises(EyerenderError, match="workers cannot start: the worker was ended by SIGKILL"):
        Troubled(tmp_path, (1, 2, 3)).run([0], listener)


@pytest.mark.slow
def test_workers_are_recycled(tmp_path):
    listener = Listener()
    pool(tmp_path, recycle_images=3).run([0, 1, 2], listener)
    assert len(set(listener.pids)) == 3
    assert listener.retries == []


def test_threads_are_divided():
    assert RunOptions(workers=2, threads=8).processes(100) == (2, 4)
    assert RunOptions(workers=3, threads=2).processes(100) == (3, 1)
    assert RunOptions(threads=2).processes(1) == (1, 2)


def test_samples_given_up_are_recorded(tmp_path):
    made = plan(
        **{
            "scene.targets": {"world_mm": [[{"draw": "grid", "values": [650, -600]}, 0, 0]]},
            "scene.eye.pupil_diameter_mm": 4.0,
            "count": 4,
            "subjects": 2,
            "shard_size": 2,
        }
    )
    warnings: list[Any] = []
    done = make(tmp_path / "some", made, warn=warnings.extend)
    assert done["statistics"]["samples_given_up"] == 2
    assert done["statistics"]["subjects_left_out"] == 0
    assert done["statistics"]["images"] == 2
    assert [w.reason for w in warnings if w.code == "given-up"] == [
        "2 of 4 samples could not be made, and 0 subjects have no image, so the dataset may be biased "
        "(failures.jsonl has the reasons)"
    ]
    failures = [json.loads(line) for line in (tmp_path / "some" / "failures.jsonl").read_text().splitlines()]
    assert [f["sample"] for f in failures] == [1, 3]
    assert all("cannot fixate" in f["reason"] for f in failures)


@pytest.mark.packaging
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_run_says_so_and_can_go_on(tiny, tmp_path, number):
    spec, folder = write(tmp_path / "tiny.yaml"), tmp_path / "out"
    hook = stages.environment(tmp_path, folder, match="/shards/00002$", at=1, how="stop")
    argv = ("generate", str(spec), str(folder), "--workers", "1")
    process = command(*argv, env=hook, start_new_session=True)
    stages.wait_until_stopped(process)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    os.killpg(process.pid, signal.SIGCONT)
    _, err = process.communicate()
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted"
    words = r"2 of 8 shards are finished, and [1-3] images of others; start again on .* to resume"
    assert re.fullmatch(words, err.splitlines()[-2]), err
    assert "Traceback" not in err
    assert make(folder, plan())["complete"]
    assert tree(folder) == tree(tiny)


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="mounting a tmpfs needs root")
def test_a_full_disk_ends_with_one_line_and_nothing_lost(tiny, tmp_path):
    small = tmp_path / "small"
    small.mkdir()

    def mount(*options):
        return subprocess.run(["mount", *options], capture_output=True).returncode == 0

    if not mount("-t", "tmpfs", "-o", "size=400k", "tmpfs", str(small)):
        pytest.skip("this machine does not let a tmpfs be mounted")
    try:
        spec, folder = write(tmp_path / "tiny.yaml"), small / "out"
        process = command("generate", str(spec), str(folder), "--workers", "1")
        out, err = process.communicate()
        assert process.returncode == 1
        assert out == ""
        errors = [line for line in err.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1
        assert "No space left on device" in errors[0]
        kept = finished(folder)
        assert 0 < len(kept) < 8
        assert mount("-o", "remount,size=20m", str(small))
        assert make(folder, plan())["shards_made"] == 8 - len(kept)
        assert tree(folder) == tree(tiny)
        assert mount("-o", "remount,ro", str(small))
        with pytest.raises(EyerenderError, match="cannot be written"):
            make(folder, plan())
        with pytest.raises(EyerenderError, match="cannot be written"):
            make(small / "new", plan())
    finally:
        subprocess.run(["umount", small], check=True)


def kill_at_random(tmp_path: Path, kills: int, seed: int) -> Path:
    """Runs of one folder, each killed at a random stage of what is left to do, then one that may finish."""
    spec, folder = write(tmp_path / "tiny.yaml"), tmp_path / "killed"
    draws = random.Random(seed)
    stages_in_all = 2 * 24 + 4 * 8  # 24 images and masks; images, masks, lines and done.json of 8 shards
    for at in [*stages.cuts(draws, stages_in_all, kills + 1), 0]:
        hook = stages.environment(tmp_path, folder, at=at, how=draws.choice(["kill", "kill all"]))
        argv = ("generate", str(spec), str(folder), "--workers", "2")
        process = command(*argv, env=hook, start_new_session=True)
        _, err = process.communicate()
        assert process.returncode == (-signal.SIGKILL if at else 0), err
    return folder


@pytest.mark.packaging
def test_a_killed_run_ends_with_the_same_bytes(tiny, tmp_path):
    folder = kill_at_random(tmp_path, 1, seed=1)
    assert tree(folder) == tree(tiny)
    assert not list(folder.glob(".partial-*"))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_many_kills_end_with_the_same_bytes(tiny, tmp_path):
    for seed in range(2):
        place = tmp_path / str(seed)
        place.mkdir()
        assert tree(kill_at_random(place, 5, seed)) == tree(tiny)
