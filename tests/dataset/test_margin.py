"""Pupil margins in datasets: drawn once a subject, whatever its pupil does from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, find_dataset

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
