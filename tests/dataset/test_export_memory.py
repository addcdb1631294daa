"""Exports of many images need little memory: nothing of an image is kept but some bytes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest

from eyerender.base.errors import InputError
from eyerender.dataset.done import sum_of
from eyerender.dataset.export import FORMATS, OF_SEQUENCES, export
from tests.support.fabricated import SHARD, fabricate, peak_bytes

pytestmark = [pytest.mark.render, pytest.mark.packaging]
LAYOUTS = [
    format for format in FORMATS if format not in ("labels", *OF_SEQUENCES)
]  # that one is of datasets with packed shards only
BAR_BYTES, ROWS = 300 * 2**20, 200_000  # what so many images may take above the base process

# Python's own count, so that some hundred images show what many would take. The first export loads modules, and a table
# of the interpreter's own may grow during any of them: the smaller peak of two counts.
GROWTH = """
import sys
import tracemalloc
from eyerender.dataset.export import export
few, many, out, format = sys.argv[1:]
tracemalloc.start()
peaks = {few: [], many: []}
for source in (few, few, many, many):
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    export(source, format, out, overwrite=True)
    peaks[source].append(tracemalloc.get_traced_memory()[1] - before)
print(min(peaks[many]) - min(peaks[few]))
"""
EXPORT = """
import sys
from eyerender.dataset.export import export
export(*sys.argv[1:])
"""


@pytest.fixture(scope="module")
def folders(tiny, tmp_path_factory):
    """Rows -> a dataset of so many images, made when asked for."""
    place = tmp_path_factory.mktemp("fabricated")

    def made(rows):
        folder = place / str(rows)
        if not folder.exists():
            fabricate(folder, tiny, rows)
        return folder

    return made


# It writes one file for many images; the others are tried among the long proofs.
COLLECTING = "coco"


@pytest.mark.parametrize("format", [f if f == COLLECTING else pytest.param(f, marks=pytest.mark.slow) for f in LAYOUTS])
def test_an_image_more_takes_few_bytes_more(folders, tmp_path, format):
    # The files of two shards are listed at a time; Parquet collects 100 rows of each split. So many images fill these.
    few, many = (1600, 2000) if format == "parquet" else (2 * SHARD, 4 * SHARD)
    argv = [str(folders(few)), str(folders(many)), str(tmp_path / "out"), format]
    done = subprocess.run([sys.executable, "-c", GROWTH, *argv], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < BAR_BYTES / ROWS * (many - few)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("format", ["coco", "parquet", "imagefolder"])  # one file, tables, a file for each image
def test_thousands_of_images_fit_into_the_bar(folders, tmp_path, format):
    # 4000 lines of metadata alone are larger than the bar; the buffers of Parquet are larger, too.
    few, many = 100, 10_000 if format == "parquet" else 4000
    peaks = [peak_bytes(EXPORT, str(folders(n)), format, str(tmp_path / str(n))) for n in (few, many)]
    shutil.rmtree(tmp_path)
    # Of what does not grow with the images, some MB are buffers that few images do not fill.
    assert peaks[1] - peaks[0] < 8 * 2**20 + BAR_BYTES / ROWS * (many - few)


def test_samples_come_in_order_whatever_the_order_of_lines(folders, tmp_path):
    folder = tmp_path / "mixed"
    shutil.copytree(folders(50), folder)
    dataset = json.loads((folder / "dataset.json").read_text())
    del dataset["checksums"]
    lines = (folder / "metadata.jsonl").read_text().splitlines(keepends=True)
    # As metadata.jsonl may be: a line that first fills a column stands before those of earlier samples.
    (folder / "metadata.jsonl").write_text("".join([lines[30], *lines[:30], *lines[31:]]))
    dataset["checksums"] = {"metadata.jsonl": sum_of(folder / "metadata.jsonl")}
    (folder / "dataset.json").write_text(json.dumps(dataset))
    for format in ("csv", "teyed"):
        export(folders(50), format, tmp_path / f"whole-{format}")
        export(folder, format, tmp_path / f"mixed-{format}")
    rows = (tmp_path / "whole-csv" / "labels.csv").read_text()
    assert rows.count("\n") == 51
    assert (tmp_path / "mixed-csv" / "labels.csv").read_text() == rows
    for place in sorted((tmp_path / "whole-teyed").rglob("*")):
        if place.is_file():
            twin = tmp_path / "mixed-teyed" / place.relative_to(tmp_path / "whole-teyed")
            assert twin.read_bytes() == place.read_bytes()


@pytest.mark.parametrize("format", LAYOUTS)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda line: line.update(labels=None), "line 3: cannot be exported, for it is not as this version writes it"),
        (lambda line: line.update(sample=None), "line 3.sample"),
        (lambda line: line.update(file_name="other/00000000-right.png"), "two images have the same file name"),
        (lambda line: line.update(bit_depth=20), "line 3.bit_depth: must be 1 to 16"),
    ],
    ids=["labels", "sample", "name", "depth"],
)
def test_a_wrong_line_ends_an_export_with_its_number(folders, tmp_path, format, change, words):
    folder = tmp_path / "wrong"
    shutil.copytree(folders(50), folder)
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    change(lines[2])
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    dataset = json.loads((folder / "dataset.json").read_text())
    dataset["checksums"] = {"metadata.jsonl": sum_of(folder / "metadata.jsonl")}
    (folder / "dataset.json").write_text(json.dumps(dataset))
    with pytest.raises(InputError) as refused:
        export(folder, format, tmp_path / "out")
    assert words in str(refused.value)
    assert not (tmp_path / "out").exists()
