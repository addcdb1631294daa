"""Studies over people: pupil size, calibrations, stereo, and what is found over people."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.apps.study import over_people, pupil_size
from eyerender.apps.study.results import ModelResults
from eyerender.apps.study.run import run_study
from eyerender.base.errors import InputError
from eyerender.optics.transforms import direction_of

PERSON = {"preset": "adults", "seed": 0, "subject": 3}


def test_people_are_the_unit_and_an_experiment_has_its_interval():
    """Means and intervals by hand: the people's means are 1, 2 and 6 deg; Student's t of 2 degrees of freedom."""
    errors = {"a": [0.0, 2.0], "b": [2.0, 2.0], "c": [6.0, np.nan]}
    groups = {who: {("own", "analytic"): {"R1, H1": np.array(values)}} for who, values in errors.items()}
    told = over_people.Measured.of(np.array([1.0, 2.0, 3.0]))
    (row,) = over_people.people_rows(groups, {"H1": told})
    half = 4.302653 * np.std([1, 2, 6], ddof=1) / np.sqrt(3)
    assert row["mean_deg"] == pytest.approx(3.0)
    assert (row["low_deg"], row["high_deg"]) == pytest.approx((3 - half, 3 + half), rel=1e-6)
    assert (row["people"], row["missing"], row["p50_deg"], row["U50E95"]) == (3, 0, 2.0, 2.0)
    assert told.high_deg == pytest.approx(2 + 4.302653 / np.sqrt(3), rel=1e-6)
    assert row["verdict"] == "compatible"


def test_without_refraction_the_area_follows_the_cosine_of_the_optic_axis():
    """The flat stop seen from afar, without the cornea: area ~ cos of the angle from its normal over distance^2."""
    scene = pupil_size.ringed(pupil_size.camera_scene("remote, below", PERSON), 4.0)
    frames = scene.frames()
    seen = trace(over_people.OtherEyes.frames(frames, pupil_size._without_refraction))
    axis = direction_of(frames.pose.azimuth_rad, frames.pose.elevation_rad)
    to_camera = scene.rig.cameras[0].nodal_point_mm - scene.eye_position_mm("right")
    cosine = axis @ to_camera / np.linalg.norm(to_camera)
    found = pupil_size.sizes_of(seen)["root of area"]
    assert found / found[0] == pytest.approx(np.sqrt(cosine / cosine[0]), rel=0.02)
    assert np.ptp(found / found[0]) > 0.2


def test_a_table_of_the_other_half_removes_what_people_share():
    """Planted sizes: a dependence on gaze that all share, and one person's own deviation of one percent."""
    shared = 1.0 + 0.1 * np.sin(np.arange(25.0))
    parts = []
    for k in range(6):
        own = shared / shared[0] * (1.0 + (0.01 * (np.arange(25) > 0) if k == 0 else 0.0))
        sizes = {"root of area": 30.0 * own, "major axis": 30.0 * own, "cosine": np.ones(25)}
        parts.append(ModelResults(eye_model=str(k), more={"sizes": {("analytic", "remote, below", 4.0): sizes}}))
    rows = {row["correction"]: row for row in pupil_size.size_rows(parts)}
    assert rows["none"]["p95"] == rows["cosine"]["p95"] > 8.0
    # Its own half does not contain the deviation; the other half sees a third of it.
    assert rows["table"]["p95"] == pytest.approx(1.0, abs=0.02)
    assert rows["table"]["p50"] == pytest.approx(100 * (1 - 1 / (1 + 0.01 / 3)), abs=0.02)


def test_the_thresholded_area_of_a_disc_with_a_glint():
    y, x = np.indices((120, 160))
    counts = np.where(np.hypot(x - 80.3, y - 60.7) < 25.0, 20, 200)
    counts[55:60, 75:80] = 255
    image = SimpleNamespace(counts=counts, window=np.array([10, 20, 160, 120]))
    found = pupil_size.thresholded(image, 110.0, np.array([90.0, 81.0]))
    assert found == pytest.approx(25.0, rel=0.005)
    assert np.isnan(pupil_size.thresholded(image, 5.0, np.array([90.0, 81.0])))


def test_the_artefact_is_none_at_the_calibration_and_its_shift_follows_the_stop():
    """The part by shift points where the stop's centre moves to, of each eye, seen from the corneal centre."""
    scene = pupil_size.camera_scene("headset, below", PERSON)
    found = pupil_size.artefacts(scene)
    start = pupil_size.LUMINANCES.index(pupil_size.CALIBRATED)
    assert np.abs(found["whole"][start]).max() < 1e-9
    for eye, side in enumerate(("right", "left")):
        ends = [
            pupil_size.changed(scene, {"eye": {"pupil_diameter_mm": None}, "subject": {"luminance_cd_m2": one}})
            for one in (pupil_size.LUMINANCES[0], pupil_size.LUMINANCES[-1])
        ]
        moved = np.subtract(*(one.eye(side).stop.centre_mm[1:] for one in ends))
        shift = found["shift"][0, eye].mean(axis=0) - found["shift"][-1, eye].mean(axis=0)
        wanted = moved * [-1.0, 1.0]  # the subject's right is -y
        cosine = shift @ wanted / np.linalg.norm(shift) / np.linalg.norm(wanted)
        assert cosine > 0.95
        arm = np.linalg.norm(moved) / np.radians(np.linalg.norm(shift))
        assert 3.0 < arm < 6.0  # mm from the centre of corneal curvature to the pupil


def test_a_run_over_a_few_people(tmp_path):
    summary = run_study("pupil-size", tmp_path / "out", people=4)
    assert {row["camera"] for row in summary["artefacts"]} == set(pupil_size.CAMERAS)
    assert (tmp_path / "out" / "sizes.csv").read_text().startswith("observer,camera")
    assert "Straight ahead" in (tmp_path / "out" / "report.html").read_text()
    with pytest.raises(InputError, match="image-people"):
        run_study("pupil-size", tmp_path / "out", people=4, image_people=2)
