"""Failing disks: each call of the package that writes fails in turn, and what remains is whole, and can be resumed."""

from __future__ import annotations

import errno
import os
import random
import shutil
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
import yaml

from eyerender.base.errors import EyerenderError
from eyerender.cli.main import run
from eyerender.dataset import run as dataset_run
from eyerender.dataset.assemble import verify_dataset
from eyerender.dataset.export import FORMATS, OF_SEQUENCES
from eyerender.dataset.lines import restore_lines
from eyerender.dataset.maker import MadeSample, Maker
from eyerender.dataset.pool import Events
from eyerender.dataset.shard import verify, write_shard
from eyerender.dataset.worker import Job
from eyerender.folders.imagefolder import finished
from eyerender.imaging.capture import render_windows
from eyerender.scene import load_scene
from tests.support.dataset_specs import mapping, tree
from tests.support.failing_disk import Disk, Name

pytestmark = [
    pytest.mark.packaging,
    pytest.mark.render,
    pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="asks the kernel for a handle's path"),
]
CODES = (errno.EIO, errno.ENOSPC)


@dataclass
class Case:
    """A command that fills the folder `out` of a place; `begin` lays the place out, and `wrong` looks at remains."""

    argv: Callable[[Path], list[str]]
    begin: Callable[[Path], None]
    wrong: Callable[[Path], list[str]]


def nothing(place: Path) -> None:
    place.mkdir()


def remains(out: Path) -> list[str]:
    """What a command that writes all or nothing has left."""
    return [str(p) for p in out.rglob("*")] if out.exists() else []


def unfinished(out: Path) -> list[str]:
    """What is wrong with what a run's folder says is complete."""
    if not out.is_dir():
        return []
    problems = [p for shard in sorted(finished(out)) for p in verify(out, shard)]
    return problems + (list(verify_dataset(out)) if (out / "dataset.json").exists() else [])


def attempt(case: Case, place: Path, capsys: Any, fails: Name | None, code: int) -> None:
    """One command with one failing call, and the same again on a good disk."""
    case.begin(place)
    with Disk(place / "out", fails, code) as disk:
        status = run(case.argv(place))
    said = capsys.readouterr().err
    where = f"{fails} {errno.errorcode[code]}: {status} {said}"
    assert disk.failed, where
    if status == 0:  # something that is not needed, such as the removal of what a killed run left
        assert "error" not in said, where
    else:
        assert status == 1, where
        errors = [line for line in said.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1, where
        assert "Traceback" not in said, where
        assert case.wrong(place / "out") == [], where
    assert run(case.argv(place)) in ((0,) if status else (0, 2)), where + capsys.readouterr().err
    capsys.readouterr()


def sweep(case: Case, root: Path, capsys: Any, sample: int | None) -> None:
    """Let each call fail in turn, or a sample of them."""
    case.begin(root / "good")
    with Disk(root / "good" / "out") as disk:
        assert run(case.argv(root / "good")) == 0, capsys.readouterr().err
    good = tree(root / "good" / "out")
    kinds = {kind for kind, _, _ in disk.calls}
    assert {"create", "write", "mkdir"} <= kinds
    calls: Iterable[Name] = dict.fromkeys(call for call in disk.calls if call[0] != "read")
    # The package treats the codes alike, so they take turns.
    trials = list(zip(calls, cycle(CODES), strict=False))
    if sample is not None:
        trials = random.Random(1).sample(trials, sample)
    found = []
    for k, (fails, code) in enumerate(trials):
        place = root / str(k)
        try:
            attempt(case, place, capsys, fails, code)
            assert tree(place / "out") == good, f"{fails} {errno.errorcode[code]}: other bytes"
        except Exception as error:  # all are reported, with the call that failed
            found.append(f"{fails} {errno.errorcode[code]}: {type(error).__name__}: {str(error)[:200]}")
        shutil.rmtree(place)
    assert found == [], f"{len(found)} of {len(trials)}:\n" + "\n".join(found)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A scene of two frames, and their pictures."""
    path = tmp_path_factory.mktemp("scene") / "small.yaml"
    data = mapping()["scene"]
    data |= {"name": "small", "format": 2, "targets": {"screen_mm": [[0.0, 0.0], [50.0, 20.0]]}}
    data["eye"] = {"model": "E2", "pupil_diameter_mm": 4.0}
    data["subject"]["ipd_mm"] = 62.0
    data.pop("look")
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path, list(render_windows(load_scene(path).frames()))


@pytest.fixture
def rendered(small, monkeypatch):
    """The scene; its pictures are not rendered again."""
    path, images = small
    monkeypatch.setattr("eyerender.imaging.folder.render_windows", lambda *_args, **_keys: iter(images))
    return path


class Cook:
    """Makes the samples of a plan, each once for all runs."""

    def __init__(self) -> None:
        self.made: dict[int, MadeSample] = {}
        self.maker: Maker | None = None

    def of(self, maker: Maker) -> Cook:
        self.maker = self.maker or maker
        self.plan, self.backend = maker.plan, self.maker.backend
        return self

    def make_all(self, samples: Iterable[int]) -> Iterable[MadeSample]:
        for k in samples:
            if k not in self.made:
                self.made[k] = self.maker.make(k)
            yield self.made[k]


COOK = Cook()


class InThisProcess:
    """The engine of a run, whose shards are written here instead of by workers."""

    def __init__(self, job: Job, _workers: int, *, timeout_s: float) -> None:
        self.job = job

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        maker = COOK.of(self.job.maker())
        events.ready(maker.backend, "0")
        for shard in shards:
            try:
                staged = write_shard(maker, Path(self.job.folder), shard, lambda *_: None)  # type: ignore[arg-type]
            except OSError as error:
                raise EyerenderError(f"{self.job.folder}: cannot be written ({error.strerror})") from None
            events.staged(staged, "0")
        return {}


@pytest.fixture
def two(tmp_path, monkeypatch):
    """The spec of a dataset of two samples in two shards."""
    monkeypatch.setattr(dataset_run, "LocalPool", InThisProcess)
    path = tmp_path / "two.yaml"
    path.write_text(yaml.safe_dump(mapping(count=2, shard_size=1, subjects=2, splits={"train": 1.0})), encoding="utf-8")
    return path


def images_case(scene: Path) -> Case:
    return Case(lambda place: ["render", str(scene), "-o", str(place / "out")], nothing, remains)


def generate_case(spec: Path, begin: Callable[[Path], None] = nothing) -> Case:
    return Case(lambda place: ["generate", str(spec), str(place / "out")], begin, unfinished)


def export_case(dataset: Path, layout: str) -> Case:
    return Case(
        lambda place: ["export-dataset", str(dataset), "--format", layout, "-o", str(place / "out")], nothing, remains
    )


def resumed_case(spec: Path, root: Path) -> Case:
    """A run that was killed after its first shard, while the second one was put in place."""
    assert run(["generate", str(spec), str(root / "whole")]) == 0
    restore_lines(root / "whole")  # as before the dataset was assembled
    assembled = ("dataset.json", "metadata.jsonl", "failures.jsonl", "croissant.json", "README.md")

    def begin(place: Path) -> None:
        place.mkdir()
        shutil.copytree(root / "whole", place / "out")
        for name in (*assembled, "shards/00001/done.json", "masks/00001"):
            path = place / "out" / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        (place / "out" / ".partial-00001-0123456789ab" / "images").mkdir(parents=True)

    return generate_case(spec, begin)


def test_images_on_a_failing_disk(rendered, tmp_path, capsys):
    sweep(images_case(rendered), tmp_path, capsys, 6)


def test_a_run_on_a_failing_disk(two, tmp_path, capsys):
    sweep(resumed_case(two, tmp_path), tmp_path, capsys, 6)


def test_an_export_on_a_failing_disk(two, tmp_path, capsys):
    assert run(["generate", str(two), str(tmp_path / "data")]) == 0
    sweep(export_case(tmp_path / "data", "csv"), tmp_path, capsys, 6)


@pytest.mark.slow
def test_images_whatever_call_fails(rendered, tmp_path, capsys):
    sweep(images_case(rendered), tmp_path, capsys, None)


@pytest.mark.slow
@pytest.mark.parametrize("resumed", [False, True])
def test_a_run_whatever_call_fails(two, tmp_path, capsys, resumed):
    sweep(resumed_case(two, tmp_path) if resumed else generate_case(two), tmp_path, capsys, None)


@pytest.mark.slow
@pytest.mark.parametrize("layout", [f for f in FORMATS if f not in OF_SEQUENCES])
def test_an_export_whatever_call_fails(two, tmp_path, capsys, layout):
    if layout == "parquet":
        pytest.importorskip("pyarrow")
    files = ["--layout", "webdataset" if layout == "labels" else "files"]
    assert run(["generate", str(two), str(tmp_path / "data"), *files]) == 0
    sweep(export_case(tmp_path / "data", layout), tmp_path, capsys, None)


@pytest.fixture
def disk_of(tmp_path):
    """Mounts file systems of some bytes."""
    places: list[Path] = []

    def mounted(size: int) -> Path:
        place = tmp_path / f"disk{len(places)}"
        place.mkdir()
        options = ["-t", "tmpfs", "-o", f"size={size},mode=700", "tmpfs", str(place)]
        if os.geteuid() != 0 or subprocess.run(["mount", *options], capture_output=True).returncode != 0:
            pytest.skip("needs the right to mount a small file system")
        places.append(place)
        return place

    yield mounted
    for place in places:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["teyed", "parquet", "ellseg"])
def test_an_export_on_a_full_disk(two, disk_of, tmp_path, capsys, layout):
    """OpenCV, pyarrow and h5py write these; their writes cannot be made to fail from Python."""
    if layout == "parquet":
        pytest.importorskip("pyarrow")
    assert run(["generate", str(two), str(tmp_path / "data")]) == 0
    case = export_case(tmp_path / "data", layout)
    assert run(case.argv(tmp_path)) == 0
    good = tree(tmp_path / "out")
    needed = sum(-(-p.stat().st_size // 4096) * 4096 for p in (tmp_path / "out").rglob("*") if p.is_file())
    capsys.readouterr()
    for share in (0.1, 0.4, 0.7, 0.9):
        place = disk_of(4096 * max(1, int(share * needed / 4096)))
        status = run(case.argv(place))
        said = capsys.readouterr().err
        assert status == 1, (share, said)
        assert len([line for line in said.splitlines() if line.startswith("error: ")]) == 1, (share, said)
        assert remains(place / "out") == [], share
        subprocess.run(["mount", "-o", f"remount,size={20 * needed}", str(place)], check=True)
        assert run(case.argv(place)) == 0, capsys.readouterr().err
        assert tree(place / "out") == good
