"""Power cuts at random instants of a run: what has a done.json is complete, and starting again repairs the rest."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from eyerender.base.storage.files import read_json
from eyerender.dataset.assemble import verify_dataset
from eyerender.dataset.shard import verify
from eyerender.folders.imagefolder import finished
from tests.support.dataset_specs import make, plan, tree, write
from tests.support.powercut import Disk, record

pytestmark = [
    pytest.mark.packaging,
    pytest.mark.render,
    pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="asks the kernel for a handle's path"),
]
CUTS = 8


def recorded(place, root):
    """A run of the tiny spec with two workers, recorded."""
    process = record(
        place / "journal", root, "generate", str(write(place / "tiny.yaml")), str(root / "out"), "--workers", "2"
    )
    assert process.returncode == 0, process.stderr
    return place / "journal"


@pytest.fixture(scope="module")
def journal(tiny, tmp_path_factory):
    """The journal of a whole run."""
    place = tmp_path_factory.mktemp("powercut")
    (place / "disk").mkdir()
    found = recorded(place, place / "disk")
    assert tree(place / "disk" / "out") == tree(tiny)
    return found


@pytest.fixture(scope="module")
def disk(journal):
    return Disk(journal)


@pytest.fixture(scope="module")
def repairing(tiny, tmp_path_factory):
    """A run that repairs a damaged folder, recorded."""
    place = tmp_path_factory.mktemp("repairing")
    (place / "disk").mkdir()
    folder = shutil.copytree(tiny, place / "disk" / "out")
    for shard in (1, 2, 6):
        (folder / "shards" / f"{shard:05d}" / "lines.jsonl").write_bytes(b"")
    shutil.copytree(place / "disk", place / "before")
    found = Disk(recorded(place, place / "disk"), start=place / "before")
    assert tree(folder) == tree(tiny)
    return found


def wrong(folder):
    """What is wrong with what a folder says is complete."""
    if not folder.is_dir():
        return []
    problems = [p for shard in sorted(finished(folder)) for p in verify(folder, shard, plan().digest)]
    if (folder / "dataset.json").exists():
        problems += verify_dataset(folder)
    if (folder / "shards").exists() and read_json(folder / "run.json")["digest"] != plan().digest:
        problems.append("run.json is of another spec")
    return problems


def test_whatever_says_that_it_is_complete_is_so_at_every_instant(disk, tmp_path):
    draws, kept = random.Random(1), set()
    for count in range(0, len(disk.operations) + 1, 7):
        place = tmp_path / str(count)
        disk.after(count, draws, place)
        assert wrong(place / "out") == [], f"after {count} operations"
        kept.add(len(finished(place / "out")))
        shutil.rmtree(place)
    assert {0, 8} <= kept
    assert len(kept) > 5
    disk.after(len(disk.operations), draws, tmp_path / "end")
    assert (tmp_path / "end" / "out" / "dataset.json").is_file()


def test_the_simulated_disk_loses_what_is_not_synced(journal, tmp_path):
    unsynced = Disk(journal, syncs=False)
    unsynced.after(len(unsynced.operations), random.Random(1), tmp_path / "disk", share=1.0)
    folder = tmp_path / "disk" / "out"
    assert finished(folder) == set(range(8))
    assert all(list(verify(folder, shard)) for shard in range(8))


def resumed(disk, seed, place, tiny):
    draws = random.Random(seed)
    disk.after(draws.randrange(len(disk.operations)), draws, place)
    make(place / "out", plan())
    assert tree(place / "out") == tree(tiny)
    assert not list((place / "out").glob(".partial-*"))


def test_a_run_goes_on_after_a_power_cut(disk, tiny, tmp_path):
    resumed(disk, 4, tmp_path / "disk", tiny)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 100 + CUTS))
def test_power_cuts_end_with_the_same_bytes(disk, tiny, tmp_path, seed):
    resumed(disk, seed, tmp_path / "disk", tiny)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_power_cuts_of_a_run_that_repairs_end_with_the_same_bytes(repairing, tiny, tmp_path, seed):
    resumed(repairing, seed, tmp_path / "disk", tiny)
