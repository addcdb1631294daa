"""What is said of sound datasets, the difference of two, missing labels, and dependences."""

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
from eyerender.apps.inspection.dependence import dependences
from eyerender.apps.inspection.duplicates import equal_pictures, near_duplicates
from eyerender.apps.inspection.missing import missing_labels
from eyerender.apps.inspection.outliers import outliers, scores
from eyerender.apps.inspection.pictures import measure
from eyerender.apps.inspection.planned import draw_plan, may_depend, ordered_draws
from eyerender.apps.inspection.reading import read
from eyerender.apps.inspection.statistics import rank_correlations
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.options import PlanOptions
from eyerender.dataset.plan import Plan
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


GAZE, PUPIL, SEQUENCE = "draw targets.world_mm.0.2", "draw eye.pupil_diameter_mm", "draw subject.eyes"


def undeclared(found):
    return {(one.a, one.b) for one in found if not one.declared}


def none_declared(a, b):
    return False


def drawn(rng, subjects, each, count=12):
    """Independent numbers: even ones, ties, rare values and numbers of subjects, with the subjects."""
    n, unit = subjects * each, np.repeat(np.arange(subjects), each)
    numbers = {f"even {k}": rng.uniform(size=n) for k in range(count)}
    numbers |= {f"choice {k}": rng.integers(0, 2 + k, n).astype(float) for k in range(count // 2)}
    numbers |= {f"rare {k}": (rng.uniform(size=n) < 0.06).astype(float) for k in range(2)}
    numbers |= {f"own {k}": rng.normal(size=subjects)[unit] for k in range(count // 2)}
    numbers |= {f"own rare {k}": (rng.uniform(size=subjects) < 0.1).astype(float)[unit] for k in range(2)}
    # A number that drifts slowly within each subject, as of a video.
    numbers |= {f"slow {k}": rng.normal(size=(subjects, each)).cumsum(axis=1).ravel() for k in range(2)}
    return numbers | {"half": np.where(rng.uniform(size=n) < 0.5, np.nan, rng.uniform(size=n))}, unit


@pytest.mark.parametrize(("subjects", "each"), [(60, 4), (120, 2), (240, 1), (60, 20)])
def test_independent_numbers_are_not_reported(subjects, each):
    rng, flagged = np.random.default_rng(subjects + each), 0
    for _ in range(40):
        numbers, unit = drawn(rng, subjects, each)
        flagged += bool(dependences(numbers, unit, none_declared))
    assert flagged <= 3  # one in a hundred is expected; four of 40 happen in a run of 1400


@pytest.mark.parametrize("each", [1, 2, 4, 20])
@pytest.mark.parametrize(("a", "b"), [("eye", "gaze"), ("gaze", "pupil"), ("split", "camera")])
def test_planted_dependences_are_found(each, a, b):
    rng = np.random.default_rng(each)
    for _ in range(10):
        numbers, unit = drawn(rng, 60, each)
        first = rng.normal(size=60 * each)
        if a == "split":
            first = rng.permutation(np.arange(60) < 48).astype(float)[unit]
        if a == "eye":
            first = np.sign(first)
        # A rank correlation of 0.8 of two normal numbers, or the same camera for all subjects of a split but three.
        second = 0.81 * first + 0.58 * rng.normal(size=60 * each)
        if b == "camera":
            second = np.where(rng.permutation(60)[unit] < 57, first, 1 - first)
        if a == "eye":
            second = 2 * first + rng.normal(size=60 * each)
        numbers |= {a: first, b: second}
        assert {(a, b)} <= undeclared(dependences(numbers, unit, none_declared))


def test_the_fault_of_old_plans_is_found_and_few_subjects_are_not_tested():
    """Even samples were right eyes, and looked down."""
    index = np.arange(240)
    gaze = np.random.default_rng(3).uniform(0, 500, 240) * np.where(index % 2, 1, -1)
    numbers: dict[str, Any] = {SEQUENCE: index % 2 + 0.0, GAZE: gaze, "order": index + 0.0}
    for subjects in (index, index // 4):
        assert (SEQUENCE, GAZE) in undeclared(dependences(numbers, subjects, may_depend({SEQUENCE})))
    assert dependences(numbers, index // 5, may_depend({SEQUENCE})) is None


def test_what_the_spec_or_physics_gives_is_declared():
    declared = may_depend({SEQUENCE})
    azimuth, elevation = "label eye azimuth (deg)", "label eye elevation (deg)"
    pairs = [(SEQUENCE, "order"), (SEQUENCE, "eye right"), (GAZE, elevation), ("eye right", azimuth)]
    pairs += [("person age_years", "label pupil stop diameter (mm)"), ("draw x[0]", "draw x[1]")]
    pairs += [("person flat_axis_deg", "eye right"), ("person flat_axis_deg", SEQUENCE)]
    for pair in pairs:
        assert declared(*pair), pair
        assert declared(*pair[::-1]), pair
    pairs = [(SEQUENCE, GAZE), ("eye right", GAZE), ("eye right", elevation), (GAZE, PUPIL), ("split test", GAZE)]
    pairs += [("split test", "camera 1"), ("order", GAZE), ("person age_years", GAZE), (azimuth, elevation)]
    for pair in pairs:
        assert not declared(*pair), pair
    assert not may_depend(set())("order", "eye right")


def test_a_folder_whose_split_chooses_the_camera_is_named(tmp_path):
    folder = tmp_path / "data"
    draw(folder, 600, pool=20)
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    for line in lines:
        line["records"][0]["camera"] = int(line["split"] == "train")
    (folder / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (found,) = inspect(folder)["datasets"]
    pairs = {(one["a"], one["b"]) for one in found["dependences"] if not one["declared"]}
    assert ("split train", "camera 1") in pairs


RECIPES = (pytest.param("people_openeds", marks=pytest.mark.slow), "dataset_quick")
MORE = (
    "bench_world",
    "people_nvgaze",
    "people_pupil_core",
    "people_eyelink",
    "people_iris_camera",
    "people_two_cameras",
    "people_any_headset",
    "dataset_region",
    "dataset_binocular",
    "dataset_glasses",
)


@pytest.mark.parametrize("name", [*RECIPES, *(pytest.param(name, marks=pytest.mark.packaging) for name in MORE)])
def test_the_draws_of_shipped_recipes_are_independent(name):
    # Datasets of few subjects get more, so that they can be tested.
    changes = PlanOptions(subjects=80) if name.startswith("dataset_") else PlanOptions()
    plan = Plan.load(name, changes=changes)
    found = draw_plan(plan, 240, None)
    assert [one for one in found.dependences if not one.declared] == []
    # Each value of a sequence occurs in the first 16 samples.
    first = [plan.draw(k).draws for k in plan.spread(16)]
    for name in ordered_draws(plan):
        path = name.removeprefix("draw ")
        assert len({draws[path] for draws in first}) > 1, path


def test_a_plan_is_inspected_alone(tmp_path):
    with pytest.raises(InputError, match="--planned: takes one spec"):
        inspect("dataset_quick", "dataset_region", planned=True)
    (found,) = inspect("dataset_quick", planned=True, images=24, output=tmp_path / "page.html")["datasets"]
    page = (tmp_path / "page.html").read_text()
    assert "24 of its" in page
    assert all(name.removeprefix("draw ") in page for name in found["columns"])
