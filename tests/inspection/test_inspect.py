"""What is said of sound datasets: the same for all layouts and numbers of processes, and the difference of two."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image
from scipy.stats import ks_2samp, spearmanr

from eyerender.apps.inspection import inspect
from eyerender.apps.inspection.comparing import distance_and_chance
from eyerender.apps.inspection.duplicates import equal_pictures, near_duplicates
from eyerender.apps.inspection.missing import missing_labels
from eyerender.apps.inspection.outliers import outliers, scores
from eyerender.apps.inspection.pictures import measure
from eyerender.apps.inspection.reading import read
from eyerender.apps.inspection.statistics import rank_correlations
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageEntry
from tests.support.drawn_dataset import FRAMES, draw, packed


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A sound dataset of 120 images."""
    folder = tmp_path_factory.mktemp("drawn") / "data"
    draw(folder, 120)
    return folder


@pytest.fixture(scope="module")
def found(data):
    return inspect(data)


def test_packed_shards_give_the_same(data, found, tmp_path):
    """Numbers of packed lines have 9 digits, and its images have another order."""
    packed(tmp_path / "packed", data)
    (own,), (other,) = found["datasets"], inspect(tmp_path / "packed")["datasets"]
    for key in ("images", "images_read", "splits", "subjects_in_two_splits", "groups", "faults"):
        assert own[key] == other[key], key
    assert own["columns"].keys() == other["columns"].keys()
    for name, column in own["columns"].items():
        assert other["columns"][name]["median"] == pytest.approx(column["median"], rel=1e-6, abs=1e-6), name
    assert {o["image"] for o in own["outliers"]} == {o["image"] for o in other["outliers"]}


def test_some_images_are_spread_over_the_dataset(data):
    contents = read(data, limit=30, workers=1)
    assert contents.rows.tolist() == list(range(0, 120, 4))
    assert contents.names[1] == "images/00000004-right.png"


@pytest.mark.packaging
def test_the_number_of_processes_changes_nothing(data, found):
    assert inspect(data, workers=2) == found


def test_splits_are_those_of_the_lines(data, found):
    (own,) = found["datasets"]
    splits = [json.loads(line)["split"] for line in (data / "metadata.jsonl").read_text().splitlines()]
    assert {name: split["images"] for name, split in own["splits"].items()} == {n: splits.count(n) for n in set(splits)}
    assert sum(split["subjects"] for split in own["splits"].values()) == 120 // FRAMES


def test_a_shift_between_datasets_is_the_first_difference(data, tmp_path):
    draw(tmp_path / "wider", 100, shift=0.7)
    page = tmp_path / "page.html"
    difference = inspect(data, tmp_path / "wider", output=page)["difference"]
    beyond = [s["column"] for s in difference["columns"] if s["distance"] > s["chance"]]
    pupil = {"draw eye.pupil_diameter_mm", "label pupil stop diameter (mm)", "label pupil entrance diameter (mm)",
             "label pupil radius (px)"}  # fmt: skip
    assert pupil <= set(beyond[:5])
    assert "draw sensor.exposure_ms" not in beyond
    assert "Difference of the two" in page.read_text()


def test_distances_are_those_of_scipy(data, tmp_path):
    draw(tmp_path / "other", 60, shift=0.2)
    contents = [read(path, limit=1000, workers=1) for path in (data, tmp_path / "other")]
    listed = {s["column"]: s for s in inspect(data, tmp_path / "other")["difference"]["columns"]}
    name = "draw eye.pupil_diameter_mm"
    assert listed[name]["distance"] == pytest.approx(ks_2samp(*(c.columns[name] for c in contents)).statistic)
    assert listed[name]["counts"] == (120 // FRAMES, 60 // FRAMES)


def test_images_of_the_same_subjects_differ_by_chance_in_one_case_of_twenty():
    """Subjects of two random samples differ from each other; with images as the unit, half of the cases would."""
    rng = np.random.default_rng(5)

    def sample(subjects, shift):
        units = np.repeat(np.arange(subjects), rng.integers(3, 12, subjects))
        return shift + rng.normal(size=subjects)[units] + rng.normal(scale=0.5, size=len(units)), units

    def differ(shift):
        pairs = [distance_and_chance(sample(30, 0.0), sample(20, shift)) for _ in range(300)]
        return np.mean([distance > chance for distance, chance in pairs])

    assert 0.02 <= differ(0.0) <= 0.09
    assert differ(1.5) > 0.95


def test_correlations_are_those_of_scipy():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(200, 4))
    values[:, 1] += 2 * values[:, 0]
    np.testing.assert_allclose(rank_correlations(values), spearmanr(values).statistic, atol=1e-12)
    values[:, 3] = 1.0
    assert np.isnan(rank_correlations(values)[3, 0])


def test_a_number_is_unusual_alone_or_together():
    rng = np.random.default_rng(4)
    values = rng.normal(size=(500, 3))
    values[:, 2] = values[:, 0] + values[:, 1]
    values[100, 1] = 40
    values[100, 2] = values[100, 0] + 40
    values[200, 2] -= 2.5  # usual alone
    assert np.abs(scores(values[:, 2])[200]) < 2.5
    found = outliers(values, ["a", "b", "c"])
    assert {100, 200} <= {o.at for o in found[:4]}
    assert next(o for o in found if o.at == 100).reasons[0].column in "bc"
    assert "suggest" in next(o for o in found if o.at == 200).reasons[0].usual


def test_few_images_have_no_outliers():
    assert outliers(np.random.default_rng(5).normal(size=(9, 2)), ["a", "b"]) == []


def test_duplicates_are_equal_or_alike():
    rng = np.random.default_rng(6)
    thumbnails = rng.integers(0, 256, (50, 16, 16), dtype=np.uint8)
    thumbnails[20] = np.clip(0.8 * thumbnails[10].astype(float) + 20 + rng.normal(0, 0.5, (16, 16)), 0, 255)
    thumbnails[30:33] = 7  # flat
    digests = [bytes([k]) for k in range(50)]
    digests[40] = digests[5]
    digests[45] = b""
    assert equal_pictures(digests) == [[5, 40]]
    (pair,) = near_duplicates(thumbnails, digests)
    assert (pair.first, pair.second) == (10, 20)


def test_the_command_writes_page_and_json(data, tmp_path, capsys):
    page, file = tmp_path / "page.html", tmp_path / "found.json"
    assert run(["inspect", str(data), "-o", str(page), "--json", str(file), "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "120 of 120 images read" in printed
    assert "no faults" in printed
    assert json.loads(file.read_text())["schema"] == "eyerender/inspection/1"
    assert page.stat().st_size > 50_000


def test_images_must_be_some(data):
    with pytest.raises(InputError, match="--images: must be >= 1"):
        inspect(data, images=0)


def test_leds_of_one_eye_are_not_missing_from_the_other():
    eyes = np.array(["right", "left"] * 50, dtype=object)
    x = np.where(eyes == "right", 10.0, np.nan)
    angle = np.linspace(0.0, 60.0, 100)
    lost = np.where(angle > 50.0, np.nan, x)
    columns = {"label glint 0 x (px)": x, "label glint 1 x (px)": lost, "label gaze off straight ahead (deg)": angle}
    contents: Any = SimpleNamespace(names=["a"] * 100, columns=columns, groups={"eye": eyes})
    (found,) = missing_labels(cast(Any, contents))
    assert found.labels == ["label glint 1 x (px)"]
    assert found.share == np.mean(angle[eyes == "right"] > 50.0)
    assert found.depends_on == "label gaze off straight ahead (deg)"


def test_a_further_mask_that_is_gone_is_a_fault(tmp_path):
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16)).save(tmp_path / "a.png")
    line: dict[str, Any] = {"file_name": "a.png", "annotated_mask_file_name": "as_annotated/a.png", "bit_depth": 8}
    line["window_px"] = {"x0": 0, "y0": 0, "width": 16, "height": 12}
    entry = ImageEntry(folder=tmp_path, line=line, number=1)
    (found,) = measure(entry).faults
    assert found.kind == "file"
    assert "annotated_mask" in found.detail
    (tmp_path / "as_annotated").mkdir()
    Image.new("L", (16, 12)).save(tmp_path / "as_annotated" / "a.png")
    assert measure(entry).faults == []
