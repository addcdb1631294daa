"""The bench end to end: the shipped extractors on drawn and rendered images, and what it writes."""

from __future__ import annotations

import csv
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.own import ellipse_of_mask
from eyerender.apps.benchmark.protocol import OPENCV
from eyerender.apps.benchmark.registry import defaults, names, resolve
from eyerender.apps.benchmark.run import bench_extractors
from eyerender.apps.benchmark.separate import cheshm_pupil, eight_bits, pupil_of
from eyerender.apps.benchmark.shipped import PUPIL_LABS_PYTHON, cheshm_python, pupil_labs_python
from eyerender.base.errors import InputError
from eyerender.cli.benchmark import _table
from eyerender.cli.main import run
from eyerender.extraction.baseline import contour_pupil
from eyerender.folders.imagefile import read_image, write_png
from eyerender.optics.ellipse import Ellipse, iou, signed_distance
from tests.support.paths import ROOT, TOOLS


def test_the_shipped_extractors_are_installed():
    assert {"own-fast", "own-refined", "opencv-contour", "pupil-detectors"} <= set(names())


def test_what_is_given_may_have_a_name_of_its_own():
    assert resolve("mine=own-fast").name == "mine"
    assert resolve("a.b:c").name == "a.b:c"
    command = resolve(f"{sys.executable} x.py --path 'a b' k=v")
    assert command.argv == (sys.executable, "x.py", "--path", "a b", "k=v")
    assert resolve(f"label={sys.executable} x.py").name == "label"
    with pytest.raises(InputError, match=r"is neither an extractor \(.*own-fast"):
        resolve("own_fast")


def test_without_its_environment_pupil_detectors_is_named_but_not_run(monkeypatch):
    monkeypatch.setenv(PUPIL_LABS_PYTHON, "/nonexistent/python")
    ready, absent = defaults()
    assert "pupil-detectors" not in [e.name for e in ready]
    assert absent["pupil-detectors"].startswith("not set up; scripts/tools/setup_pupil_detectors.sh")
    with pytest.raises(InputError, match="--extractor pupil-detectors: not set up"):
        resolve("pupil-detectors")


@pytest.fixture(scope="module")
def bench(drawn, tmp_path_factory):
    """Own refined, the contour baseline and one that dies, over the drawn folder."""
    out = tmp_path_factory.mktemp("bench") / "out"
    dead = f"dead={sys.executable} -c 'import sys; sys.exit(\"no licence\")'"
    chosen = [w for e in ("own-refined", "opencv-contour", dead) for w in ("--extractor", e)]
    target = out.parent / "results.json"
    # 1, because the one that dies answers nothing.
    assert run(["bench-extractors", str(drawn), "-o", str(out), *chosen, "--json", str(target)]) == 1
    return out, json.loads(target.read_text())


def test_the_figures_are_those_of_the_extractors(bench):
    out, data = bench
    assert data["schema"] == "eyerender/bench-extractors/3"
    own, contour, dead = data["extractors"]
    s = own["summary"]
    assert (s["right"], s["with_pupil"]) == (6, 6)
    assert s["centre_px"]["worst"] < 0.1  # six errors about a bound of some 0.01 px each
    assert 0.3 < s["efficiency"]["value"] < 3.0  # the median of six errors scatters by a factor of two
    assert s["glints"]["recall"] == 1.0
    assert s["glints"]["precision"] == 1.0
    printed = _table(data, json.loads((out / "times.json").read_text())).splitlines()
    low, high = s["intervals"]["right"]["subjects"] or s["intervals"]["right"]["wilson"]
    assert f" 6 {low:.1%} - {high:.1%} " in " ".join(printed[1].split())
    assert "common px: median centre error on the 6 pupils that all extractors find right" in printed
    spent = json.loads((out / "times.json").read_text())["extractors"]
    assert spent[0]["cpu_ms"]["median"] > 0
    assert spent[2]["cpu_ms"]["n"] == 0
    assert data["problems"] == ["dead: gave no usable answer to any image"]
    # A contour runs through the centres of the outermost dark pixels.
    assert contour["summary"]["right"] == 6
    assert all(-0.8 < b < -0.1 for b in contour["summary"]["semi_axes_bias_px"])
    assert contour["summary"]["glints"] is None
    assert contour["conventions"]["axes"] == "full"
    assert dead["summary"]["rates"]["error"] == 1.0
    assert dead["failures"] == [
        {"outcome": "error", "reason": "ended with exit code 1: no licence", "count": 6, "first": own_first(data)}
    ]
    assert "noise_dn" in own["breakdown"]


def own_first(data):
    return "images/small-010000.png" if data["images"] == 6 else ""


def test_the_folder_holds_report_table_and_json(bench):
    out, data = bench
    assert {p.name for p in out.iterdir()} == {"report.html", "results.json", "results.csv", "times.json"}
    assert json.loads((out / "results.json").read_text()) == data
    with open(out / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 18
    mine = [float(r["centre_px"]) for r in rows if r["extractor"] == "own-refined"]
    assert np.median(mine) == pytest.approx(data["extractors"][0]["summary"]["centre_px"]["median"])
    page = (out / "report.html").read_text()
    common = data["common"]["extractors"]["own-refined"]["centre_px"]["median"]
    assert f"{common:.4f} px" in page
    assert "least median centre error on the 6 pupils that all of them find right: own-refined" in page
    for words in ("own-refined", "opencv-contour", "ended with exit code 1: no licence", "identity swaps"):
        assert words in page
    # Self-contained: no address but the namespaces of SVG.
    addresses = set(re.findall(r"https?://[^\s\"'<)]+", page))
    assert {a for a in addresses if "w3.org" not in a and "purl.org" not in a and "creativecommons" not in a} <= {
        "https://matplotlib.org/"
    }
    assert "<script" not in page


@pytest.mark.usefixtures("no_report")
def test_an_earlier_bench_is_replaced_and_other_files_are_not(bench, drawn, tmp_path, capsys):
    out = shutil.copytree(bench[0], tmp_path / "bench")
    dead = ["--extractor", f"{sys.executable} -c 0"]
    assert run(["bench-extractors", str(drawn), "-o", str(out), *dead, "--json", "-"]) == 1
    shown = json.loads(capsys.readouterr().out)
    assert [e["summary"]["error"] for e in shown["extractors"]] == [6]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "report.html").write_text("mine")
    assert run(["bench-extractors", str(drawn), "-o", str(tmp_path / "other"), *dead]) == 2
    assert (tmp_path / "other" / "report.html").read_text() == "mine"


@pytest.mark.render
@pytest.mark.usefixtures("no_report")
def test_glints_of_rendered_images_are_named_by_light(rendered, tmp_path):
    target = tmp_path / "results.json"
    argv = ["bench-extractors", str(rendered), "-o", str(tmp_path / "out"), "--extractor", "own-fast"]
    assert run([*argv, "--json", str(target)]) == 0
    data = json.loads(target.read_text())
    s = data["extractors"][0]["summary"]
    assert (s["right"], s["error"]) == (4, 0)
    assert (s["glints"]["true"], s["glints"]["matched"], s["glints"]["named"], s["glints"]["swapped"]) == (8, 8, 8, 0)
    assert s["centre_px"]["worst"] < 0.2  # eight samples a pixel at a semi-axis of 13 px
    assert data["edge"]["source"] == "measured along the true outline"
    assert data["edge"]["n"] == 4


def test_the_contour_baseline_on_a_plain_disc():
    y, x = np.mgrid[:120, :160]
    image = np.full((120, 160), 180, dtype=np.uint8)
    image[np.hypot(x - 80, y - 60) < 45] = 90
    image[np.hypot((x - 82.0) / 18, (y - 61.0) / 14) < 1] = 25
    pupil = contour_pupil(image, bit_depth=8)
    assert not isinstance(pupil, str), pupil
    (cx, cy), axes, degrees = pupil
    assert (cx, cy) == pytest.approx((82, 61), abs=0.1)
    assert sorted(axes) == pytest.approx([2 * 14, 2 * 18], abs=0.8)
    assert degrees == pytest.approx(90, abs=2)  # the minor axis comes first
    assert contour_pupil(image.astype(np.uint16) * 257, bit_depth=16)[0] == pytest.approx((cx, cy), abs=0.01)
    assert contour_pupil(np.zeros((120, 160), dtype=np.uint8), bit_depth=8) == "no dark region of a likely size"
    assert contour_pupil(np.zeros((3, 3), dtype=np.uint8), bit_depth=8) == "the image is 3 x 3"


def test_the_detector_s_answer_is_passed_on_as_it_is():
    found: dict[str, Any] = {"ellipse": {"center": (3.0, 4.0), "axes": (10.0, 12.0), "angle": 30.0}, "confidence": 0.9}
    assert pupil_of(found)["axes_px"] == [10.0, 12.0]
    assert pupil_of({**found, "confidence": 0.0})["status"] == "missing"
    assert pupil_of({**found, "ellipse": {**found["ellipse"], "axes": (0.0, 0.0)}})["status"] == "missing"


def test_deep_images_are_scaled_to_eight_bits(tmp_path):
    deep = np.array([[0, 2000], [4095, 1000]], dtype=np.uint16)
    write_png(tmp_path / "a.png", deep)
    assert eight_bits(str(tmp_path / "a.png"), 12).tolist() == [[0, 125], [255, 62]]
    assert eight_bits(str(tmp_path / "a.png"), 12).flags.writeable


@pytest.mark.skipif(pupil_labs_python() is None, reason="scripts/tools/setup_pupil_detectors.sh has not been run")
def test_pupil_detectors_in_its_own_environment(drawn, tmp_path):
    target = tmp_path / "results.json"
    argv = ["bench-extractors", str(drawn), "-o", str(tmp_path / "out"), "--extractor", "pupil-detectors"]
    assert run([*argv, "--json", str(target)]) == 0
    entry = json.loads(target.read_text())["extractors"][0]
    assert entry["says"].startswith("pupil-detectors ")
    assert entry["summary"]["error"] == 0
    assert entry["summary"]["right"] >= 4
    # Wrong axes, angle or origin would show as errors of half a pixel and more.
    assert entry["summary"]["centre_px"]["median"] < 0.2
    assert entry["summary"]["boundary_px"]["median"] < 0.4


def test_cheshm_s_answers_are_rotated_rectangles_or_missing():
    found = cheshm_pupil({"center": (3, 4), "ellipse": ((3.25, 4.5), (10.0, 20.0), 30.0), "confidence": 0.5})
    assert (found["centre_px"], found["axes_px"], found["angle"]) == ([3.25, 4.5], [10.0, 20.0], 30.0)
    assert cheshm_pupil({"method": "blob_fallback", "center": (3, 4)}) == {"status": "missing", "reason": "no ellipse"}
    assert cheshm_pupil({"ellipse": ((3.0, 4.0), (0.0, 20.0), 30.0)})["status"] == "missing"
    assert cheshm_pupil(None)["reason"] == "no pupil detected"


@pytest.mark.skipif(cheshm_python() is None, reason="scripts/tools/setup_cheshm.sh has not been run")
@pytest.mark.parametrize("name", ["pure", "else_", "excuse", "swirski"])
def test_cheshm_s_detectors_in_their_own_environment(drawn, tmp_path, name):
    data = bench_extractors(drawn, tmp_path / "out", [f"eyerender.apps.benchmark.shipped:{name}"])
    summary = data["extractors"][0]["summary"]
    assert "cheshm" in data["extractors"][0]["says"]
    assert summary["error"] == 0
    if name != "swirski":  # it looks for radii of 20 px and more
        assert summary["right"] >= 2
        assert summary["centre_px"]["median"] < 1.0


@pytest.mark.parametrize("name", ["otsu", "hough", "starburst"])
def test_simple_detectors_find_drawn_pupils(drawn, monkeypatch, name):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    detector = getattr(importlib.import_module("simple_detectors"), name)
    overlaps = []
    for image in load_labelled(drawn):
        pupil = detector(read_image(image.path)[0], {"bit_depth": image.bit_depth})["pupil"]
        found = (
            None if pupil["status"] != "ok" else OPENCV.ellipse(pupil["centre_px"], pupil["axes_px"], pupil["angle"])
        )
        overlaps.append(0.0 if found is None else iou(found, image.pupil))
    # Hough's circles are coarse, and the starburst begins at a glint's edge in some.
    assert np.median(overlaps) > {"otsu": 0.9, "hough": 0.3, "starburst": 0.6}[name]


@pytest.mark.parametrize("script", ["setup_pupil_detectors.sh", "setup_cheshm.sh"])
def test_the_set_up_script_refuses_what_it_does_not_know(tmp_path, script):
    script = TOOLS / script
    env = {"PATH": os.environ["PATH"], "XDG_CACHE_HOME": str(tmp_path)}
    wrong = subprocess.run([script, "--farce"], env=env, capture_output=True, text=True)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "usage:" in wrong.stderr
    # A Python that cannot make an environment leaves nothing that looks like one.
    broken = tmp_path / "python"
    broken.write_text('#!/bin/sh\n[ "$2" = pip ] && exit 0\nexit 1\n')
    broken.chmod(0o755)
    failed = subprocess.run([script], env={**env, "EYERENDER_PYTHON": str(broken)}, capture_output=True, text=True)
    assert failed.returncode == 1
    assert "cannot make an environment" in failed.stderr
    assert not [path for path in (tmp_path / "eyerender").iterdir() if path.is_dir()]


@pytest.mark.packaging
@pytest.mark.usefixtures("no_report")
def test_own_images_with_a_table_or_masks(drawn, tmp_path):
    """The drawn images again, labelled in the two ways that people label their own, give the same outcome."""
    known = load_labelled(drawn)
    # One extractor is enough: labels are read before any runs. A mask has whole pixels.
    for kind, least in (("table", 0.05), ("masks", 0.1)):
        folder = tmp_path / kind
        (folder / "images").mkdir(parents=True)
        lines = ["image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg"]
        if kind == "masks":
            (folder / "masks").mkdir()
        for image in known:
            name = image.path.name
            shutil.copy(image.path, folder / "images" / name)
            e = image.pupil
            values = (*e.centre_px, *e.semi_axes_px, np.degrees(e.angle_rad))
            lines.append(f"{name}," + ",".join(str(float(v)) for v in values))
            if kind == "masks":
                y, x = np.mgrid[: image.size[1], : image.size[0]]
                inside = signed_distance(e, np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(x.shape) < 0.0
                write_png(folder / "masks" / name, inside.astype(np.uint8))
        if kind == "table":
            (folder / "labels.csv").write_text("\n".join(lines) + "\n")
        data = bench_extractors(folder, tmp_path / f"out_{kind}", ["own-fast"])
        assert [e["summary"]["right"] for e in data["extractors"]] == [len(known)]
        assert data["extractors"][0]["summary"]["centre_px"]["median"] < least


def masked(folder, mask):
    """A folder with one image and its mask."""
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    write_png(folder / "images" / "a.png", np.zeros(mask.shape, np.uint8))
    write_png(folder / "masks" / "a.png", mask.astype(np.uint8))
    return folder


def test_masks_of_classes_need_the_pupil_s_value(tmp_path):
    true = Ellipse(np.array([100.0, 80.0]), np.array([30.0, 24.0]), 0.5)
    y, x = np.mgrid[:160, :200]
    points = np.stack([x, y], axis=-1)
    classes = 1 + 1 * (signed_distance(true.scaled(2.2), points) < 0) + 1 * (signed_distance(true, points) < 0)
    folder = masked(tmp_path / "f", classes)
    with pytest.raises(InputError, match=r"masks/a\.png: has several classes \(1, 2, 3\); --pupil-class names"):
        load_labelled(folder)
    assert run(["bench-extractors", str(folder), "-o", str(tmp_path / "o"), "--extractor", "opencv-contour"]) == 2
    (image,) = load_labelled(folder, pupil_class=3)
    assert iou(image.pupil, true) > 0.99


@pytest.mark.parametrize("hidden", [0.16, 0.5, *(pytest.param(h, marks=pytest.mark.slow) for h in (0.05, 0.3))])
def test_a_mask_of_the_visible_part_gives_the_whole_pupil(hidden):
    """Lids cut the upper part along slanted lines. The moments of the rest would give an IoU of 0.85 at 0.16 hidden."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:200, :260]
    points = np.stack([x, y], axis=-1)
    least = 1.0
    for _ in range(12):
        b = rng.uniform(15, 40)
        axes = np.array([b / rng.uniform(0.75, 1.0), b])
        true = Ellipse(rng.uniform((110, 85), (150, 115)), axes, rng.uniform(0, 3))
        mask = signed_distance(true, points) < 0
        height = y - rng.uniform(-0.2, 0.2) * x
        cut = mask & (height > np.quantile(height[mask], hidden))
        least = min(least, iou(ellipse_of_mask(cut), true))
    # An outline of whole pixels is known to about 0.3 px; an arc extrapolates that.
    assert least > {0.05: 0.95, 0.16: 0.95, 0.3: 0.92, 0.5: 0.8}[hidden]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.png,1,2,3,4,0", "is not an ellipse"),
        ("a.png,1,2,x,3,0", "needs five numbers"),
        ("../a.png,1,2,3,3,0", "a.png"),
    ],
)
def test_a_broken_table_names_the_line(line, message, tmp_path):
    (tmp_path / "labels.csv").write_text(
        f"image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg\n{line}\n"
    )
    write_png(tmp_path / "a.png", np.zeros((20, 20), np.uint8))
    with pytest.raises(InputError, match=message) as error:
        load_labelled(tmp_path)
    assert "line 2" in str(error.value)


def test_failures_have_thumbnails(drawn, tmp_path, monkeypatch):
    """An extractor that finds another ellipse: the report shows the first of its failures."""
    for other in ("factor_figure", "curve_figure"):
        monkeypatch.setattr(f"eyerender.apps.benchmark.page.{other}", lambda *_: "<svg></svg>")
    given = "tests.benchmark.test_bench:beside"
    bench_extractors(drawn, tmp_path / "out", [f"beside={given}"])
    assert "the first images of every kind of failure" in (tmp_path / "out" / "report.html").read_text()


def beside(image, request):
    return {"pupil": {"status": "ok", "centre_px": [20.0, 20.0], "semi_axes_px": [9.0, 8.0], "angle_rad": 0.0}}
