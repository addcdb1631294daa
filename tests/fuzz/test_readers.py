"""Every reader of strangers' files, fuzzed with the coverage of its code as the guide (atheris; see `readers`)."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from eyerender.base.errors import InputError
from tests.fuzz.readers import READERS

SECONDS = 5
ROOT = Path(__file__).resolve().parents[2]
NEEDS_MITSUBA = ("exr", "hdr", "npy", "pfm")


def named(*names: str) -> list[object]:
    marks = {name: [pytest.mark.render] if name in NEEDS_MITSUBA else [] for name in names}
    return [pytest.param(name, marks=marks[name]) for name in names]


@pytest.mark.parametrize("name", named(*READERS))
def test_the_unharmed_files_are_read(name, tmp_path):
    READERS[name].case(READERS[name].seeds()[0], tmp_path / "case")


@pytest.mark.render
def test_a_map_with_a_broken_shape_is_refused(tmp_path):
    data = READERS["npy"].seeds()[0].replace(b"(4, 8)", b"(4 8 )")
    with pytest.raises(InputError, match="is not a readable map"):
        READERS["npy"].case(data, tmp_path / "case")


def test_vertices_of_two_coordinates_are_refused(tmp_path):
    with pytest.raises(InputError, match="has vertices without three coordinates"):
        READERS["obj"].case(b"v 0 0\nv 100 0\nv 0 100\nf 1 2 3\n", tmp_path / "case")


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="needs atheris (the extra `fuzz`)")
@pytest.mark.parametrize("name", named(*READERS))
def test_a_fuzzed_file_is_read_or_refused_in_one_line(name, tmp_path):
    command = [sys.executable, "-m", "tests.fuzz.readers", name, str(SECONDS), "1", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    found = [path for path in tmp_path.iterdir() if path.is_file()]
    assert done.returncode == 0, f"{[path.read_bytes()[:2000] for path in found]}\n{done.stderr[-3000:]}"
    assert found == []
    assert int(done.stdout.split()[-2]) > 20, done.stdout
