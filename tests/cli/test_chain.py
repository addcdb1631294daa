"""Every command on every shipped scene, and on what the other commands wrote: each ends well, or says what to do."""

from __future__ import annotations

import json
import re

import pytest

import eyerender as er
from eyerender.cli.main import run
from eyerender.dataset.export import FORMATS
from eyerender.gaze.estimators import ESTIMATORS

pytestmark = pytest.mark.slow
SCENES = sorted(er.shipped_scenes())
# What an estimator lacks on some rigs; each reason names what it needs or what to give.
NEEDS = (
    r"for one eye give --monocular",
    r"this estimator needs lights at the screen's four corners",
    r"this estimator needs two cameras, but the rig has 1",
    r"no eye is seen by both cameras",
    r"needs \d lights",
    r"usable calibration targets?, but",
    r"has no screen",
    r"needs a screen",
)


@pytest.fixture
def ends(capsys):
    """A function that runs a command; it returns whether it ended well, else its line matched one of some reasons."""

    def call(*argv: object, reasons: tuple[str, ...] = ()) -> bool:
        code = run([str(one) for one in argv])
        said = capsys.readouterr().err
        if code:
            assert code == 2, said
            assert any(re.search(reason, said) for reason in reasons), f"{argv}: {said}"
        return not code

    return call


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.timeout(900)
def test_what_a_scene_leads_to(scene, tmp_path, monkeypatch, ends):
    monkeypatch.chdir(tmp_path)
    ends("features", scene, "--json", "features.json")
    fitted = []
    for name in ESTIMATORS:
        if ends("gaze", "fit", "features.json", "--estimator", name, "-o", f"{name}.json", reasons=NEEDS):
            ends("gaze", "predict", "features.json", "--calibration", f"{name}.json", "-o", f"{name}.csv")
            fitted.append(name)
    assert fitted, "no estimator can be calibrated on this scene"
    ends("fit-eye", "features.json", "-o", "fit")
    assert json.loads((tmp_path / "fit" / "fit.json").read_text())
    for eye in sorted((tmp_path / "fit").glob("*.yaml"))[:1]:
        ends("features", scene, "--eye", eye, "--json", "fitted.json")
    ends("view", "scene", scene, "-o", "scene.svg")
    ends("rig", scene, "--people", 2, "-o", "rig")


@pytest.mark.render
@pytest.mark.parametrize("scene", ["headset", "headset_binocular", "quickstart", "desktop_tracker"])
@pytest.mark.timeout(1800)
def test_what_a_rendered_scene_leads_to(scene, tmp_path, monkeypatch, ends):
    monkeypatch.chdir(tmp_path)
    ends("render", scene, "-o", "out", "--spp", 1)
    for command in ("validate", "inspect", "compare"):
        ends(command, "out")
    ends("bench-extractors", "out", "-o", "bench")
    ends("export-dataset", "out", "coco", "--format", "coco")
    pictures = sorted((tmp_path / "out" / "images").glob("*.png"))
    ends("extract", *pictures[:3], "--json", "some.json")
    ends("extract", *pictures, "--scene", scene, "--json", "all.json")
    ends("fit-eye", "all.json", "-o", "fit", reasons=(r"names? the targets|no targets|targets",))


@pytest.mark.render
@pytest.mark.parametrize("spec", ["dataset_binocular", "people_pupil_core"])
@pytest.mark.timeout(1800)
def test_what_a_dataset_leads_to(spec, tmp_path, monkeypatch, ends):
    monkeypatch.chdir(tmp_path)
    ends("generate", spec, "-o", "out", "--count", 2, "--workers", 1)
    for command in ("validate", "inspect", "compare", "status"):
        ends(command, "out")
    ends("bench-extractors", "out", "-o", "bench")
    for layout in FORMATS:
        unfit = ("is not of the layout webdataset", "no frame of a sequence")
        ends("export-dataset", "out", layout, "--format", layout, reasons=unfit)
    ends("generate", spec, "-o", "out", "--count", 3, "--workers", 1)
    ends("validate", "out")
    ends("merge", "out", "-o", "merged")
    pictures = sorted((tmp_path / "out" / "images").rglob("*.png"))
    ends("extract", *pictures[:2], "--json", "some.json")
