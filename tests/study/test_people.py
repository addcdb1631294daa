"""Studies over people: pupil size, calibrations, stereo, and what is found over people."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.apps.study import (
    blignaut,
    calibration_study,
    guestrin,
    head_movement,
    over_people,
    pupil_size,
    stereo,
)
from eyerender.apps.study.observing import Observing
from eyerender.apps.study.results import ModelResults
from eyerender.apps.study.run import run_study
from eyerender.apps.study.study import StudyJob, changed, of_person
from eyerender.base.errors import InputError
from eyerender.imaging.capture import EyeImage
from eyerender.optics.transforms import direction_of

PERSON = {"preset": "adults", "seed": 0, "subject": 3}


def test_people_are_the_unit_and_an_experiment_has_its_interval():
    """Means and intervals by hand: the people's means are 1, 2 and 6 deg; Student's t of 2 degrees of freedom."""
    errors = {"a": [0.0, 2.0], "b": [2.0, 2.0], "c": [6.0, np.nan]}
    groups = {who: {("own", "analytic"): {"R1, H1": np.array(values)}} for who, values in errors.items()}
    told = over_people.Experiment.of(np.array([1.0, 2.0, 3.0]))
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
    image = cast(EyeImage, SimpleNamespace(counts=counts, window=np.array([10, 20, 160, 120])))
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
            changed(scene, {"eye": {"pupil_diameter_mm": None}, "subject": {"luminance_cd_m2": one}})
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
    with pytest.raises(InputError, match="at most the number of people, 4"):
        run_study("pupil-size", tmp_path / "out", people=4, observer="image", image_people=5)


def test_calibrations_need_their_targets_and_slippage_costs_what_geometry_says(monkeypatch):
    """A pupil that moves by 1.5 mm looks like one that turned by asin(1.5 / 10) = 8.6 deg about the eye's centre."""
    every = calibration_study.estimators
    quick = {calibration_study.SLOW}
    monkeypatch.setattr(
        calibration_study, "estimators", lambda *args: {k: v for k, v in every(*args).items() if k not in quick}
    )
    study = calibration_study.CalibrationStudy()
    part = study.part(StudyJob(who="x", protocols=("own",), person=PERSON))
    errors = part.errors["own", "analytic"]
    named = calibration_study.named
    assert named("headset", "hennessey", 5, "still") not in errors  # six terms
    assert named("headset", "cross-ratio", 9, "still") not in errors  # no lights at the screen's corners
    for kind in calibration_study.SLIPS:
        for name in set(every(9, 0.0)) - quick - ({"cross-ratio"} if kind == "headset" else set()):
            still, slipped = (errors[named(kind, name, 9, when)] for when in ("still", "slipped"))
            assert (len(still), len(slipped)) == (9, 27), name
            assert np.isfinite(still).all(), name
    slipped = errors[named("headset", calibration_study.PUPIL, 25, "slipped")].reshape(3, 9).mean(axis=1)
    assert slipped[1:] == pytest.approx(8.6, rel=0.25)  # to the left and up
    assert slipped[0] < slipped[1:].min()  # towards the lens
    assert {one.id for one in study.findings([part, part])} == {"C1", "C2"}


def test_a_pupil_that_turns_alone_is_the_eye_straight_ahead_and_its_glints_stay():
    scene = stereo.StereoStudy().scenes(StudyJob(who="x", person=PERSON), "own")[""]
    ahead = changed(scene, {"targets": None, "poses": [{"azimuth_deg": 0.0, "elevation_deg": 0.0}]})
    eye = scene.eye("right")

    def same(one):
        return one

    whole, alone = (trace(stereo.turned(ahead.frames(), ahead.eye("right"), turns, same)) for turns in (True, False))
    assert alone.pupil.centre_px == pytest.approx(whole.pupil.centre_px, abs=1e-9)
    assert whole.pupil.centre_px == pytest.approx(trace(ahead).pupil.centre_px, abs=1e-9)
    frames = scene.frames()
    seen = trace(stereo.turned(frames, eye, False, same))
    here = (seen.index.head == 0) & (seen.index.camera == 0)
    assert np.ptp(seen.glints.xy_px[here], axis=0).max() < 1e-9
    assert np.ptp(seen.pupil.centre_px[here], axis=0).min() > 5.0
    single = trace(stereo.turned(frames, eye, True, stereo.single_cornea))
    moved = np.linalg.norm(single.pupil.centre_px - trace(frames).pupil.centre_px, axis=1)
    assert 0.0 < moved.max() < 1.0


def test_causes_of_images_do_nothing_to_ray_optics_but_the_pupil_size():
    """With exact features, glare, light, lamps and lids change nothing; a wider pupil at H2 adds its own rise."""
    study = head_movement.HeadMovementStudy()
    parts = [study.part(StudyJob(who=str(k), person={**PERSON, "subject": k})) for k in (3, 4)]
    for name in ("glare", "uneven light", "glint deformation", "lids"):
        assert head_movement._effects(parts, name) == pytest.approx(0.0, abs=1e-12)
    wider = head_movement._effects(parts, "pupil size")
    assert np.abs(wider).min() > 0.05
    assert head_movement._effects(parts, head_movement.ALL) == pytest.approx(wider, abs=1e-12)
    (row,) = [row for row in study.tables(parts)["causes"] if row["cause"] == "pupil size"]
    assert row["adds to the rise, deg_mean"] == pytest.approx(wider.mean())
    assert [one.id for one in study.findings(parts)] == ["M1"] * 6


@pytest.mark.parametrize(("name", "module"), [("guestrin2006", guestrin), ("blignaut2014", blignaut)])
def test_replications_over_people(name, module, tmp_path):
    """The table over people holds the means of runs of single people."""
    summary = run_study(name, tmp_path / "out", people=3, protocol="corrected")
    means = []
    for k in range(3):
        scene = of_person(module.scene("E2", module.CORRECTED), {"preset": "adults", "seed": 0, "subject": k})
        done = module.run(trace(scene), scene.rig, module.CORRECTED)
        if name == "guestrin2006":
            means.append(done.means["H2"])
        else:
            means.append({one.function: one.mean_deg for one in done if one.calibration == "C14"})
    rows = {row["condition"]: row for row in summary["people"]}
    if name == "guestrin2006":
        row = rows["index fixed, H2"]
        assert row["mean_deg"] == pytest.approx(np.mean(means))
        assert row["measured_low_deg"] < row["measured_deg"] < row["measured_high_deg"]
        assert rows["index fixed, H2 - H1"]["measured_deg"] == pytest.approx(0.133, abs=5e-4)
    else:
        over = {f: np.mean([one[f] for one in means]) for f in means[0] if means[0][f] is not None}
        best = min(over, key=over.__getitem__)
        assert rows[f"{best} on C14"]["mean_deg"] == pytest.approx(over[best])
        assert rows[f"{best} on C14"]["measured_deg"] == 0.58
    assert ">People</h2>" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_images_of_people_are_rendered_within_their_jobs(tmp_path):
    """The features of a person's images are those of ray optics within a fifth of a pixel; the table pairs them."""
    scene = of_person(guestrin.scene("E2", guestrin.CORRECTED), PERSON)
    changes = {"subject": {"eyes": ["right"], "head_positions_mm": [[0.0, 0.0, 0.0]]}, "region": None}
    scene = changed(scene, changes)
    seen = Observing(kind="image-noiseless", spp=4).observe(scene, facing=True)
    assert np.nanmax(np.abs(seen.pupil.centre_px - trace(scene).pupil.centre_px)) < 0.2
    summary = run_study(
        "guestrin2006", tmp_path / "out", people=2, image_people=2, observer="both", noise="off", protocol="corrected",
        spp=4,
    )  # fmt: skip
    rows = [row for row in summary["people"] if row["observer"] == "image-noiseless" and "H1" in row["condition"]]
    assert rows
    assert all(abs(row["added_mean_deg"]) < 0.4 for row in rows)  # lids add up to .15 deg to a person
