"""Pupil margins in datasets, drawn once a subject, and pictures without an eye."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, find_dataset
from eyerender.folders.imagefolder import ImageFolder
from tests.support.dataset_specs import make_or_skip, plan

SEED = {"draw": "integer", "low": 1, "high": 1000000}


def plan_with(margin):
    """Twelve samples of three subjects of the shipped spec."""
    data = DatasetSpec.load(find_dataset("dataset_region")).to_mapping()
    data |= {"count": 12, "subjects": 3, "splits": {"train": 1.0}}
    data["scene"]["eye"]["margin"] = margin
    return Plan.of(DatasetSpec.from_mapping(data))


def test_the_shipped_spec_draws_it_once_a_subject():
    plan = Plan.load("dataset_region")
    frames = plan.spec.count // plan.spec.subject_count
    samples = [plan.draw(subject * frames + k) for subject in range(8) for k in (0, 1)]
    margins: dict[int, set[bytes]] = {}
    for sample in samples:
        stop = sample.build().eye("right").stop
        margins.setdefault(sample.turn.subject, set()).add(stop.contour.tobytes())
        assert np.sqrt(np.sum(stop.contour**2) / 2) == pytest.approx(0.0166)
    assert len(margins) == 8
    assert all(len(found) == 1 for found in margins.values())
    assert len(set.union(*margins.values())) == 8
    # While the pupil's size, and with it the shift, differ between the frames of a subject.
    shifts = [s.build().eye("right").stop.centre_mm[1] for s in samples[:2]]
    sizes = [s.scene["eye"]["pupil_diameter_mm"] for s in samples[:2]]
    assert shifts == pytest.approx([-0.06 * (d - 4.0) for d in sizes])
    assert sizes[0] != sizes[1]


def test_its_numbers_may_be_draws():
    plan = plan_with(
        {
            "seed": SEED,
            "noncircularity": {"draw": "truncated_normal", "mean": 0.0166, "sd": 0.006, "low": 0.005, "high": 0.04},
            "shift_mm_per_mm": [{"draw": "uniform", "low": -0.12, "high": 0.0}, 0.0],
        }
    )
    margins = [plan.draw(i).scene["eye"]["margin"] for i in range(12)]
    for subject in range(3):
        mine = margins[4 * subject : 4 * subject + 4]
        assert all(m == mine[0] for m in mine)
    assert len({m["noncircularity"] for m in margins}) == 3
    assert len({m["shift_mm_per_mm"][0] for m in margins}) == 3
    for i in (0, 5):
        stop = plan.draw(i).build().eye("right").stop
        assert np.sqrt(np.sum(stop.contour**2) / 2) == pytest.approx(margins[i]["noncircularity"])


@pytest.mark.parametrize(
    "margin",
    [{"seed": SEED | {"per": "sample"}}, {"draw": "choice", "values": [{"seed": 1}, {"seed": 2}], "per": "sample"}],
)
def test_a_subject_has_one_margin(margin):
    with pytest.raises(InputError, match="the eye must be drawn once per subject"):
        plan_with(margin)


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
