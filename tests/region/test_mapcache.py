"""Maps on disk: what is read is what was made, damage is mended, the size is limited, and processes do not collide."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.region import mapcache
from eyerender.region.anatomy import Region
from eyerender.region.mapcache import kept

made: list[object] = []


def ramp(seed: int) -> np.ndarray:
    """Make a map that is counted."""
    made.append(seed)
    return np.random.default_rng(seed).standard_normal((60, 50)).astype(np.float32)


def halves(spec: Region) -> np.ndarray:
    made.append(spec)
    return np.full((4, 5, 2), spec.skin.albedo, np.float16)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(mapcache.LIMIT, raising=False)
    made.clear()
    found = mapcache.folder()
    assert found is not None
    return found


def files(place: Path) -> list[Path]:
    return sorted(place.iterdir())


def test_a_map_is_made_once(place):
    first, second = kept(ramp, 3), kept(ramp, 3)
    assert made == [3]
    assert second.dtype == np.float32
    assert np.array_equal(first, second)
    assert not second.flags.writeable
    assert second.ctypes.data % 4 == 0


def test_a_region_is_known_by_all_its_keys(place):
    spec = Region(seed=4)
    other = spec.model_copy(update={"skin": spec.skin.model_copy(update={"albedo": 0.4})})
    for one in (spec, other, spec):
        assert kept(halves, one)[0, 0, 0] == np.float16(one.skin.albedo)
    assert made == [spec, other]


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data + b"\0",
        lambda data: data[:-40] + bytes([data[-40] ^ 1]) + data[-39:],
        lambda data: b"",
        lambda data: b"{}\n" + data,
        lambda data: data.replace(b"float32", b"float64"),
        lambda data: data.replace(b"[60, 50]", b"[30, 100]").replace(b"crc32", b"crc33"),
        lambda data: data.replace(b"[60, 50]", b"[-6, -5]"),
        lambda data: b"\xff" * 5000,
        lambda data: b"[" * 4000 + b"\n" + data,
        lambda data: b'{"a":' * 800 + b"\n" + data,
        lambda data: b'{"shape": [' + b"9" * 3000 + b"]}\n" + data,
        lambda data: b"[]\n" + data,
    ],
)
def test_a_damaged_file_is_made_again(place, damage):
    truth = kept(ramp, 3)
    (file,) = files(place)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert np.array_equal(kept(ramp, 3), truth)
    assert made == [3, 3]
    assert file.read_bytes() == whole


def test_what_is_not_a_file_is_left_alone(place):
    kept(ramp, 3)
    (file,) = files(place)
    file.unlink()
    file.symlink_to("/dev/zero")
    kept(ramp, 3)
    assert made == [3, 3]


def test_the_oldest_files_make_room(place, monkeypatch):
    monkeypatch.setenv(mapcache.LIMIT, "0.04")  # three of these maps
    for seed in range(3):
        kept(ramp, seed)
        for k, file in enumerate(sorted(files(place), key=lambda p: p.stat().st_mtime)):
            os.utime(file, (1000.0 + k, 1000.0 + k))
    kept(ramp, 0)  # used last
    kept(ramp, 9)
    assert sum(p.stat().st_size for p in files(place)) <= 40000
    made.clear()
    for seed in (0, 9, 1):
        kept(ramp, seed)
    assert made == [1]


def test_temporary_files_of_ended_processes_are_removed(place):
    kept(ramp, 1)
    old, new = place / ".a.map.1.part", place / ".b.map.2.part"
    for file in (old, new):
        file.touch()
    os.utime(old, (1.0, 1.0))
    kept(ramp, 2)
    assert not old.exists()
    assert new.exists()


def test_nothing_is_kept_without_the_cache(place):
    with mapcache.without_cache():
        kept(ramp, 1)
        kept(ramp, 1)
    assert made == [1, 1]
    assert not place.exists()
    kept(ramp, 1)
    assert place.exists()


def test_a_limit_that_is_no_number_is_an_error(place, monkeypatch):
    monkeypatch.setenv(mapcache.LIMIT, "much")
    with pytest.raises(InputError, match="megabytes"):
        kept(ramp, 1)


def test_a_folder_that_cannot_be_written_costs_only_time(place):
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("a file in its place")
    kept(ramp, 1)
    kept(ramp, 1)
    assert made == [1, 1]


def test_processes_share_the_folder(place):
    code = (
        "import numpy as np; from tests.region.test_mapcache import ramp; from eyerender.region.mapcache import kept\n"
        "for turn in range(40): assert np.array_equal(kept(ramp, turn % 4), ramp(turn % 4))"
    )
    environment = {**os.environ, mapcache.LIMIT: "0.03"}  # they remove each other's files all the time
    runs = [subprocess.Popen([sys.executable, "-c", code], env=environment) for _ in range(2)]
    assert [run.wait(120) for run in runs] == [0, 0]
