"""Merging takes nothing from a part but what its done.json lists, and reads a run only if that takes little work."""

from __future__ import annotations

import hashlib
import json
import os

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.base.storage.arrays import mapped_array
from eyerender.dataset.merge import _take
from eyerender.dataset.status import status
from tests.support.dataset_specs import plan

LINES = b'{"a": 1}\n'


class Spec:
    shards = (0,)


class Plan:
    spec = Spec()
    digest = "d"


def entry(data):
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


@pytest.fixture
def part(tmp_path):
    """A part with one finished shard of one picture."""
    folder = tmp_path / "part"
    for kind, name, data in (("images", "a.png", b"picture"), ("shards", "lines.jsonl", LINES)):
        (folder / kind / "00000").mkdir(parents=True)
        (folder / kind / "00000" / name).write_bytes(data)
    write_done(folder, {"images/00000/a.png": entry(b"picture"), "shards/00000/lines.jsonl": entry(LINES)})
    return folder


def write_done(folder, files):
    done = {"schema": "eyerender/shard/1", "shard": 0, "samples": [0, 1], "chosen": None, "images": 1, "cpu": "x"}
    done |= {"images_saturated": 0, "digest": "d", "versions": {}, "backend": {"name": "llvm", "device": "x"}}
    done |= {"rejections": [], "given_up": [], "files": files}
    (folder / "shards/00000/done.json").write_text(json.dumps(done), encoding="utf-8")


def taken(part, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    _take(out, [part], Plan(), lambda *_: None)  # type: ignore[arg-type]
    return {str(p.relative_to(out)): p for p in out.rglob("*") if not p.is_dir()}


def test_a_shard_is_copied_and_not_linked(part, tmp_path):
    found = taken(part, tmp_path)
    assert set(found) == {"images/00000/a.png", "shards/00000/lines.jsonl", "shards/00000/done.json"}
    for name, path in found.items():
        assert path.stat().st_ino != (part / name).stat().st_ino
        assert path.stat().st_nlink == 1


def test_nothing_else_comes_along(part, tmp_path):
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "id_rsa").write_text("key", encoding="utf-8")
    (part / "noiseless").mkdir()
    (part / "noiseless/00000").symlink_to(secret)
    os.mkfifo(part / "images/00000/pipe")
    (part / "images/00000/link.png").symlink_to(secret / "id_rsa")
    (part / "images/00000/done.json").write_text("{}", encoding="utf-8")
    before = (part / "shards/00000/done.json").read_bytes()
    assert len(taken(part, tmp_path)) == 3
    assert (part / "shards/00000/done.json").read_bytes() == before


@pytest.mark.parametrize("name", ["images/00000/link.png", "images/00000/pipe", "images/00000/deep/a.png"])
def test_what_is_listed_must_be_a_plain_file_of_the_shard(part, tmp_path, name):
    (tmp_path / "secret").write_bytes(b"picture")
    (part / "images/00000/link.png").symlink_to(tmp_path / "secret")
    os.mkfifo(part / "images/00000/pipe")
    (part / "images/00000/deep").mkdir()
    (part / "images/00000/deep/a.png").write_bytes(b"picture")
    write_done(part, {name: entry(b"picture"), "shards/00000/lines.jsonl": entry(LINES)})
    with pytest.raises(InputError):
        taken(part, tmp_path)


def test_content_of_another_checksum_is_refused(part, tmp_path):
    (part / "images/00000/a.png").write_bytes(b"PICTURE")
    with pytest.raises(InputError, match="checksum"):
        taken(part, tmp_path)


SPEC = plan(count=10, shard_size=5, subjects=2).to_mapping()["spec"]
EVENT = {"time": "2026-01-01T00:00:00Z", "host": "h", "part": "1/1", "event": "start", "seconds": 1.0}


@pytest.mark.parametrize(
    "change", [{"shard_size": 0}, {"count": 1e290}, {"count": 10**9, "shard_size": 1}, {"count": "x"}, None]
)
def test_status_refuses_a_run_of_too_much_work(tmp_path, change):
    spec = None if change is None else SPEC | change
    (tmp_path / "run.json").write_text(json.dumps({"schema": "eyerender/run/1", "spec": spec}), encoding="utf-8")
    with pytest.raises(InputError, match=r"spec.*(shard_size|count|too large|no spec)"):
        status(tmp_path)


def test_status_skips_events_with_impossible_numbers_and_shows_no_escapes(tmp_path):
    events = [{"seconds": "inf"}, {"seconds": 1e290}, {"event": "shard", "images": -1}, {"host": "a\x1b[2J\nfaked"}]
    run = {"schema": "eyerender/run/1", "spec": SPEC}
    (tmp_path / "run.json").write_text(json.dumps(run), encoding="utf-8")
    (tmp_path / "shards/²").mkdir(parents=True)
    (tmp_path / "shards/²/done.json").write_text("{}", encoding="utf-8")
    lines = "".join(json.dumps(EVENT | one) + "\n" for one in events)  # type: ignore[operator]
    (tmp_path / "log.jsonl").write_text(lines, encoding="utf-8")
    found = status(tmp_path)
    json.dumps(found, allow_nan=False)
    assert all(part["host"].isprintable() for part in found["parts"])


def test_sparse_files_are_not_read(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps({"schema": "eyerender/run/1", "spec": SPEC}), encoding="utf-8")
    with open(tmp_path / "log.jsonl", "wb") as file:
        file.truncate(2**31 + 1)
    with pytest.raises(InputError, match="too large"):
        status(tmp_path)
    with open(tmp_path / "run.json", "wb") as file:
        file.truncate(270 * 2**20)
    with pytest.raises(InputError, match="too large"):
        status(tmp_path)


def test_arrays_are_mapped_or_refused(tmp_path):
    path = tmp_path / "a.npy"
    array = np.arange(12, dtype=np.int16).reshape(3, 4)
    for one in (array, np.asfortranarray(array), array[:0]):
        np.save(path, one)
        assert np.array_equal(mapped_array(path), one)
    np.save(path, array)
    whole = path.read_bytes()
    for bad in (
        whole[:-1],
        whole[:40],
        b"",
        b"\x93NUMPY\x01\x00\x76\x00" + b"(" * 118,
        whole.replace(b"(3, 4)", b"(9, 9)"),
    ):
        path.write_bytes(bad)
        with pytest.raises(InputError):
            mapped_array(path)
    np.save(path, np.array([{}]), allow_pickle=True)
    with pytest.raises(InputError):
        mapped_array(path)
    link = tmp_path / "link.npy"
    link.symlink_to(path)
    with pytest.raises(InputError, match="link"):
        mapped_array(link)
