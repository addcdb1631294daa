"""Every reader of strangers' files, with mutated files (see `readers`); all are listed, and take linear time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from eyerender.base.errors import EyerenderError, InputError
from eyerender.base.storage.files import read_json
from eyerender.eye import biometry
from eyerender.gaze.records import load_observations
from eyerender.optics.meshfile import read_objects
from eyerender.rig.opencv import read_opencv
from tests.fuzz.readers import READERS, fuzz
from tests.support.fuzzing import proper
from tests.support.growth import growth
from tests.support.readings import called, readers

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


# Functions that interpret nothing of what they read, or read only what this process has just written.
EXCEPTIONS = {
    "apps.benchmark.answers._digest": "hashes bytes",
    "apps.benchmark.answers.image_key": "hashes bytes",
    "cli.benchmark.bench_extractors": "the result of this run",
    "dataset.packing.pack": "the shard of this run",
    "dataset.packing._write_tar": "the pictures of this run",
    "dataset.partial.PartialShard._sort_lines": "the lines of this run",
    "dataset.assemble.LineTable._lines": "shards that were just verified",
    "dataset.lines.ShardLines.of": "lines whose places were just found by `index`; their checksum is compared",
    "dataset.run.Run._assembled": "a dataset that was just verified",
    "OwnEstimator.load": "imports a class that the caller names",
}


@pytest.mark.render
def test_every_function_that_reads_a_file_is_fuzzed(tmp_path):
    run: set[str] = set()
    biometry._adult.cache_clear()  # which another test may have filled
    for reader in READERS.values():
        for data in reader.seeds():
            run |= called(lambda r=reader, d=data: proper(lambda: r.case(d, tmp_path / "case")))  # type: ignore[misc]
    assert len(readers()) > 60  # the search does find
    assert readers() - run == EXCEPTIONS.keys()


SIZE = 40_000
TEXTS = {
    "camera.xml": ["<" + "<!--", "<?x <!-- ", "<!-- -", "<a>", "<a b='", "<a>&#65;", "<![CDATA[", "<a><m>1 "],
    "camera.json": ["[", '{"a":', '{"a": "\\', "1", "{" + " "],
    "camera.yml": ["%YAML:", "a: >\n\n", "&a ", "1:", "1_", "- ", "[", "{a: ", "a: '', ", "? ", "# ", "a: [*a,"],
    "data.json": ["[", '{"a":', '"\\u0000', "1", "-", "1e", " "],
    "records.csv": ["a,", "a\n", '"', '"a""b', ";", "pupil_x_px_", "-mm", "pupil_x,pupil_y\n1,"],
    "records.jsonl": ["{}\n", "["],
    "head.obj": [
        "v 0 0 0\n",
        "f 1 1 1\n",
        "f 1//",
        "o a\n",
        "g a\n",
        "\\\n",
        "v 1 ",
        "usemtl a\n",
        "usemtl a\nf 1 1 1\n",
    ],
    "head.stl": ["solid a\n", "facet normal 0 0 1\n", "vertex 0 0 0\n", "endfacet\n", "\n", "a "],
    "head.ply": ["ply\n", "ply\ncomment ", "ply\nelement vertex 1\n", "ply\nproperty float x\n"],
}
TEXT_READERS: dict[str, Callable[[Path], object]] = {
    "camera": read_opencv,
    "data": read_json,
    "records": lambda path: load_observations(path, None),
    "head": read_objects,
}


@pytest.mark.parametrize("name", TEXTS)
def test_repeated_text_takes_linear_time(name, tmp_path):
    path = tmp_path / name

    def read(first: str, repeated: str, size: int) -> None:
        path.write_text(first + repeated * (size // len(repeated)))
        try:
            TEXT_READERS[path.stem](path)
        except EyerenderError as error:
            assert "\n" not in str(error)  # noqa: PT017

    for text in TEXTS[name]:
        assert growth(partial(read, "", text), SIZE) < 8, text
        assert growth(partial(read, text, text[-2:]), SIZE) < 8, text
