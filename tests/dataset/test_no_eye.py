"""Pictures without an eye: a recipe draws the head out of the camera's view, and the labels say so."""

from __future__ import annotations

import json

import pytest

from eyerender.cli.main import run
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make_or_skip, plan

HOME, ASIDE, BEHIND = [0, 0, 0], [0, 400, 0], [800, 0, 0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A camera that does not follow the eye, with the head in its view, beside it, or behind the camera."""
    camera = {
        "position_mm": [615.0, 0.0, -150.5], "look_at_mm": [0.0, -31.5, 0.0], "focal_length_px": 800.0,
        "resolution_px": [96, 72],
    }  # fmt: skip
    changes = {
        "count": 9, "subjects": 3, "require": "nothing", "scene.rig.cameras": [camera], "scene.image": {"spp": 2},
        "scene.lens": {"focus_mm": 630.0}, "scene.targets": {"world_mm": [[900.0, -31.5, 0.0]]},
        "scene.subject.head_positions_mm": {"draw": "sequence", "values": [[HOME], [ASIDE], [BEHIND]]},
    }  # fmt: skip
    return make_or_skip(tmp_path_factory.mktemp("none") / "made", plan(**changes))


@pytest.mark.render
def test_a_picture_without_an_eye_says_so(folder):
    entries = list(ImageFolder.load(folder))
    present = [entry.labels["eye_present"] for entry in entries]
    assert present == [entry.records[0]["head_mm"] == HOME for entry in entries]
    assert sum(present) == 3
    for entry in entries:
        assert (entry.mask().max() > 0) == entry.labels["eye_present"]
        assert any(glint["visible"] for glint in entry.labels["glints"]) == entry.labels["eye_present"]
        if entry.records[0]["head_mm"] == BEHIND:
            assert entry.labels["pupil"]["amodal"]["status"] == entry.labels["iris"]["amodal"]["status"] == "missing"


@pytest.mark.render
def test_pictures_without_an_eye_are_valid_and_no_fault(folder, capsys):
    assert run(["validate", str(folder), "--deep"]) == 0
    capsys.readouterr()
    assert run(["inspect", str(folder), "--json", "-"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["datasets"]
    assert found["shares"]["eye"] == pytest.approx({"none": 6 / 9, "there": 3 / 9})
    assert not {"black", "flat", "white"} & {kind for kind, fault in found["faults"].items() if fault["count"]}
