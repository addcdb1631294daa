"""Exports by several processes, and in a shuffled order."""

from __future__ import annotations

import csv
import tarfile
from itertools import pairwise

import pytest

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.export import FORMATS, OF_SEQUENCES, export
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import tree

pytestmark = pytest.mark.render


def order_of(folder):
    with open(folder / "labels.csv", newline="") as file:
        return [int(row["sample"]) for row in csv.DictReader(file)]


# A file of labels for each image, one for many, and archives; the other formats are tried among the long proofs.
KINDS = ("yolo-seg", "coco", "webdataset")


@pytest.mark.packaging
@pytest.mark.parametrize(
    "format",
    [
        pytest.param(name, marks=() if name in KINDS else pytest.mark.slow)
        for name in FORMATS
        if name not in ("labels", *OF_SEQUENCES)
    ],
)
def test_the_number_of_processes_changes_no_byte(tiny, tmp_path, format):
    shuffle = None if format == "teyed" else 3
    for workers in (1, 2):
        export(tiny, format, tmp_path / f"{workers}", workers=workers, shuffle=shuffle)
    assert tree(tmp_path / "1") == tree(tmp_path / "2")


def test_a_shuffled_export_has_the_same_images_in_another_order(tiny, tmp_path):
    for name, shuffle in (("sorted", None), ("one", 1), ("again", 1), ("two", 2)):
        export(tiny, "csv", tmp_path / name, shuffle=shuffle)
    orders = {path.name: order_of(path) for path in tmp_path.iterdir()}
    assert orders["sorted"] == sorted(orders["sorted"]) == sorted(orders["one"]) == list(range(24))
    assert orders["one"] == orders["again"]
    assert len({tuple(orders[name]) for name in ("sorted", "one", "two")}) == 3
    pictures = {name: digest for name, digest in tree(tmp_path / "one").items() if name.endswith(".png")}
    assert pictures.items() <= tree(tmp_path / "sorted").items()


def test_a_shuffled_tar_mixes_subjects(tiny, tmp_path):
    subjects = {entry.path.stem: entry.line["subject"] for entry in ImageFolder.load(tiny)}
    neighbours = []
    for shuffle in (None, 5):
        export(tiny, "webdataset", tmp_path / f"{shuffle}", shuffle=shuffle)
        with tarfile.open(tmp_path / f"{shuffle}" / "train-000000.tar") as tar:
            order = [subjects[name.split(".")[0]] for name in tar.getnames() if name.endswith(".json")]
        neighbours.append(sum(a != b for a, b in pairwise(order)))
    assert neighbours[0] == 1  # two subjects, one after the other
    assert neighbours[1] > 3


def test_videos_are_not_shuffled(tiny, tmp_path):
    with pytest.raises(InputError, match="--shuffle: the frames of teyed have an order"):
        export(tiny, "teyed", tmp_path / "out", shuffle=1)
    assert not (tmp_path / "out").exists()


def test_workers_must_be_some(tiny, tmp_path):
    with pytest.raises(InputError, match="--workers: must be >= 1"):
        export(tiny, "csv", tmp_path / "out", workers=0)


@pytest.mark.packaging
def test_the_command_takes_both(tiny, tmp_path, capsys):
    words = ["export-dataset", str(tiny), "-o", str(tmp_path / "out"), "--format", "csv"]
    assert run([*words, "--workers", "2", "--shuffle", "1"]) == 0
    assert "24 images as csv" in capsys.readouterr().out
    assert order_of(tmp_path / "out") != list(range(24))
