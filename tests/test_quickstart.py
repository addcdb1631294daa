"""The main job, for real: rendered, extracted, calibrated, compared, reported; by command and from Python."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.cli.main import run
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageFolder
from eyerender.scene import load_scene
from tests.support.paths import ROOT

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The quickstart's folder, made once."""
    out = tmp_path_factory.mktemp("job") / "quickstart"
    assert run(["quickstart", str(out), "--json", str(out.parent / "result.json")]) == 0
    return out


def test_folder_is_what_the_contract_says(folder):
    images = ImageFolder.load(folder)
    assert len(images.entries) == 18
    assert images.dataset["schema"] == "eyerender/dataset/1"
    for entry in images.entries:
        image, depth = read_image(entry.path)
        mask, _ = read_image(entry.mask_path)
        assert (image.shape, mask.shape, depth) == ((240, 320), (240, 320), 16)
        assert entry.window[2:] == (320, 240)
        assert set(np.unique(mask)) == {0, 1, 2, 3}
        assert entry.line["labels"]["failed_paths"] == 0
    fresh = trace(load_scene("quickstart"))
    np.testing.assert_array_equal(images.truth().pupil.centre_px, fresh.pupil.centre_px)
    np.testing.assert_array_equal(images.truth().glints.xy_px, fresh.glints.xy_px)


def test_labels_agree_with_the_pixels(folder):
    # The mask's pupil and the analytic ellipse are made by two programs: rays of the renderer, and Newton's method.
    images = ImageFolder.load(folder)
    truth = images.truth()
    whole = 0
    for row, entry in enumerate(images.entries):
        mask, _ = read_image(entry.mask_path)
        ys, xs = np.nonzero(mask == 3)
        centre = np.array([xs.mean(), ys.mean()]) + entry.window[:2]
        a, b = truth.pupil.semi_axes_px[row]
        seen = entry.line["labels"]["pupil"]["visible_fraction"]
        # A mask of about 500 pixels has a centroid good to about .05 px, an area good to its outline's pixels.
        assert len(xs) == pytest.approx(seen * np.pi * a * b, rel=0.03)
        if seen == 1:
            np.testing.assert_allclose(centre, truth.pupil.centre_px[row], atol=0.1)
            whole += 1
    assert whole >= 9  # the lids leave most pupils free; covered ones are tested with the labels of regions


def test_both_observers_agree_within_a_fraction_of_a_pixel(folder):
    data = json.loads((folder.parent / "result.json").read_text())
    assert data["schema"] == "eyerender/compare/2"
    features, gaze = data["features"], data["gaze"]
    assert features["pupils"] == {"expected": 18, "found": 18}
    assert features["glints"] == {"expected": 18, "found": 18}
    # Bars an extractor with a half-pixel convention error or a lost calibration would miss.
    assert features["pupil_centre_px"]["median"] < 0.1
    assert features["glint_px"]["median"] < 0.1
    assert 0 < gaze["analytic"]["mean_deg"] < 0.5
    assert gaze["analytic"]["mean_deg"] != gaze["image"]["mean_deg"]
    assert gaze["image"]["mean_deg"] < 1.0


def test_the_pages_quote_what_the_quickstart_prints(folder):
    """README and first hour; rendering rounds by the processor, so the last digit of the README may differ."""
    data = json.loads((folder.parent / "result.json").read_text())
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    first = (ROOT / "docs" / "first_hour.md").read_text(encoding="utf-8")
    sums, gaze = data["features"], data["gaze"]
    printed = {
        "pupil centre": (sums["pupil_centre_px"]["median"], sums["pupil_centre_px"]["max"]),
        "glint": (sums["glint_px"]["median"], sums["glint_px"]["max"]),
        "gaze error, features from ray optics": (gaze["analytic"]["mean_deg"], gaze["analytic"]["max_deg"]),
        "gaze error, features from the images": (gaze["image"]["mean_deg"], gaze["image"]["max_deg"]),
    }
    for name, values in printed.items():
        (row,) = re.findall(rf"^\| {name}[^|]*\|(.*)\|$", readme, re.MULTILINE)
        assert [float(one) for one in re.findall(r"\d\.\d+", row)] == pytest.approx(values, abs=1.5e-3), name
    for name, values in (("analytic", printed["gaze error, features from ray optics"]),
                         ("image", printed["gaze error, features from the images"])):  # fmt: skip
        (row,) = re.findall(rf"^  {name} (.*)$", first, re.MULTILINE)
        assert [float(one) for one in row.split()[:2]] == pytest.approx(values, abs=1e-3), name
    for name, key in (("pupil centre", "pupil_centre_px"), ("semi-axes", "semi_axes_px"), ("glint", "glint_px")):
        (row,) = re.findall(rf"^  {name} (.*)$", first, re.MULTILINE)
        wanted = [sums[key][part] for part in ("median", "p95", "max")]
        assert [float(one) for one in row.split()] == pytest.approx(wanted, abs=1e-3), name


def test_repeating_renders_nothing_again_and_another_job_is_refused(folder, capsys):
    before = (folder / "images" / "000000_right.png").stat().st_mtime_ns
    assert run(["quickstart", str(folder)]) == 0
    assert (folder / "images" / "000000_right.png").stat().st_mtime_ns == before
    capsys.readouterr()
    assert run(["quickstart", str(folder), "--eye", "E1"]) == 2
    assert "is not empty" in capsys.readouterr().err


def test_compare_reads_the_folder_back(folder, capsys):
    assert run(["compare", str(folder), "--json", "-"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert {**again, "warnings": []} == json.loads((folder.parent / "result.json").read_text())


def test_extract_of_its_files_with_the_scene_knows_their_windows(folder, capsys):
    names = sorted(str(path) for path in (folder / "images").glob("*.png"))[:3]
    assert run(["extract", *names, "--scene", "quickstart", "--json", "-"]) == 0
    found = {(r["frame"], r["eye"]): r for r in json.loads(capsys.readouterr().out)["records"]}
    truths = {(r["frame"], r["eye"]): r for entry in ImageFolder.load(folder) for r in entry.records}
    assert len(found) == 3
    for key, own in found.items():
        truth = truths[key]
        assert np.allclose(own["pupil"]["centre_px"], truth["pupil"]["centre_px"], atol=1.0)


def test_extract_of_the_folder_gives_records(folder, capsys):
    assert run(["extract", str(folder), "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["records"]) == 18
    first = data["records"][0]
    assert first["pupil"]["status"] == "ok"
    assert first["pose"]["azimuth_deg"] is None  # the image observer does not know the truth
    assert [g["light"] for g in first["glints"] if g["light"] is not None] == [0]  # highlights of wet lids have none
    assert first["glints"][0]["status"] == "ok"


class Page(HTMLParser):
    """Tags that refer to something outside the page."""

    def __init__(self):
        super().__init__()
        self.outside, self.count = [], {}

    def handle_starttag(self, tag, attributes):
        self.count[tag] = self.count.get(tag, 0) + 1
        for name, value in attributes:
            if name in ("src", "href", "xlink:href") and value and not value.startswith(("data:", "#")):
                self.outside.append(value)


def test_report_is_self_contained_and_shows_every_image(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert page.outside == []
    assert page.count["image"] >= 18
    assert "url(http" not in text
    assert len(re.findall(r'<g class="found"', text)) == 18
    data = json.loads((folder.parent / "result.json").read_text())
    assert f"{data['features']['pupil_centre_px']['median']:.3f} px" in text
    assert f"{data['gaze']['image']['mean_deg']:.3f}°" in text


@pytest.mark.packaging
def test_python_twin_prints_the_same_numbers(folder, tmp_path):
    script = ROOT / "scripts" / "tools" / "quickstart.py"
    if not script.is_file():
        pytest.skip("no checkout")
    source = script.read_text(encoding="utf-8")
    assert len(source.splitlines()) < 30
    assert source in (ROOT / "README.md").read_text(encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "twin")], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
    data = json.loads((folder.parent / "result.json").read_text())
    assert f"{data['features']['pupil_centre_px']['median']:.3f} px" in done.stdout
    assert f"{data['gaze']['image']['mean_deg']:.3f} deg" in done.stdout
    assert (tmp_path / "twin" / "report.html").is_file()
    for name in ("metadata.jsonl", "images/000004_left.png"):
        assert (tmp_path / "twin" / name).read_bytes() == (folder / name).read_bytes()
