"""Every reader of strangers' files, with mutated files (see `readers`)."""

from __future__ import annotations

import pytest

from eyerender.base.errors import InputError
from tests.fuzz.readers import READERS, fuzz

SECONDS, FEWEST = 4, 20  # of processor time, and cases
NEEDS_MITSUBA = ("exr", "hdr", "npy", "pfm")


def named(*names: str) -> list[object]:
    marks = {name: [pytest.mark.render] if name in NEEDS_MITSUBA else [] for name in names}
    return [pytest.param(name, marks=marks[name]) for name in names]


@pytest.mark.parametrize("name", named(*READERS))
def test_the_unharmed_files_are_read(name, tmp_path):
    if name == "network":
        pytest.importorskip("onnx")
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
@pytest.mark.parametrize("name", named(*READERS))
def test_a_fuzzed_file_is_read_or_refused_in_one_line(name, tmp_path):
    count, failures = fuzz(name, SECONDS, 1, tmp_path)
    assert failures == []
    assert count >= FEWEST
