"""Pictures of scenes in time: stillness, pulses under a rolling shutter, blur, and rows at their own times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import eyerender as er
from eyerender.imaging.capture import render_job
from eyerender.imaging.labels import image_labels
from eyerender.imaging.moments import moments
from eyerender.rendering.records.job import SubFrames
from eyerender.scene.observation import EYES
from tests.support.sequences import in_time, turning

SMALL: dict[str, Any] = {"image": {"spp": 2, "window_px": [160, 120]}, "sensor": {"noise": False, "exposure_ms": 4.0}}
SLOW_ROWS: dict[str, Any] = {"shutter": {"rolling": {"row_us": 20.0}}}


def picture(scene, row, renderer):
    (image,) = er.render_windows(scene.frames().take([row]), renderer=renderer)
    return image


def test_a_frame_in_which_nothing_moves_is_that_of_the_single_scene(renderer):
    scene = in_time(sequence=turning(0.0, 5.0), **SMALL)
    there = picture(scene, 0, renderer)
    (alone,) = er.render_windows(scene.with_(gaze_deg=[5.0, 0.0]).frames(), renderer=renderer)
    np.testing.assert_array_equal(there.counts, alone.counts)
    np.testing.assert_array_equal(there.parts, alone.parts)


def test_a_pulse_bands_a_rolling_shutter_as_the_overlap_says(renderer):
    """In one frame, each row gets the light of the pulse for the part of its exposure that overlaps it."""
    scene = in_time(sequence=turning(0.0), camera=SLOW_ROWS, **SMALL)
    whole = picture(scene, 0, renderer)
    pulsed = {"pulse": {"start_ms": 5.0, "width_ms": 2.0}}
    banded = picture(in_time(sequence=turning(0.0), camera=SLOW_ROWS, led=pulsed, **SMALL), 0, renderer)
    rows = np.arange(whole.window[3]) + whole.window[1]
    start, end = rows * 20e-6, rows * 20e-6 + 4e-3
    share = np.maximum(np.minimum(end, 7e-3) - np.maximum(start, 5e-3), 0) / 4e-3
    assert 0 < share.min() < 0.4 < share.max()
    ratio = banded.irradiance.sum(axis=1) / whole.irradiance.sum(axis=1)
    np.testing.assert_allclose(ratio, share, rtol=1e-3)
    everything = {"pulse": {"start_ms": 0.0, "width_ms": 10.0}}
    open_ = picture(in_time(sequence=turning(0.0), led=everything, **SMALL), 0, renderer)
    np.testing.assert_array_equal(open_.counts, picture(in_time(sequence=turning(0.0), **SMALL), 0, renderer).counts)


def test_rows_of_a_rolling_shutter_show_the_eye_at_their_own_time(renderer):
    """The middle of the pupil in each row of the mask is where the eye was when the row was exposed."""
    short: dict[str, Any] = {**SMALL, "sensor": {"noise": False, "exposure_ms": 1.0}}
    scene = in_time(sequence=turning(400.0, -2.0, 0.03), camera=SLOW_ROWS, **short)
    image, timing = picture(scene, 0, renderer), scene.timings[0]
    frames = scene.frames()
    found, expected = [], []
    for row in range(image.window[3]):
        columns = np.flatnonzero(image.parts[row] == 3)
        if len(columns) > 12:
            at = timing.ambient_s(frames.index.start_s[0], row + image.window[1])
            points = er.trace(frames.at([0], np.array([at]))).pupil.points_px[0]
            edge = (
                np.interp(row + image.window[1], *_sorted(points[points[:, 0] < points[:, 0].mean()])),
                np.interp(row + image.window[1], *_sorted(points[points[:, 0] >= points[:, 0].mean()])),
            )
            found.append(columns.mean() + image.window[0])
            expected.append(np.mean(edge))
    assert len(found) > 15
    assert np.ptp(expected) > 2.0  # the pupil is sheared
    assert np.abs(np.array(found) - expected).max() < 1.0


def _sorted(points):
    order = np.argsort(points[:, 1])
    return points[order, 1], points[order, 0]


@pytest.mark.slow
def test_blur_of_a_saccade_is_the_mean_of_many_sharp_frames(renderer):
    scene = in_time(sequence=turning(500.0, -5.0, 0.02), **{**SMALL, "image": {"spp": 64, "window_px": [160, 120]}})
    frames = scene.frames().take([1])
    job = render_job(frames, 0)
    times = frames.index.start_s[0] + (np.arange(64) + 0.5) / 64 * 4e-3
    sharp = [replace(render_job(frames.at([0], np.array([t])), 0), labels=False, seed=k) for k, t in enumerate(times)]
    many = [renderer.render(one, spp=16).irradiance for one in sharp]
    own = renderer.render(job, spp=64, moments=moments(frames, 0, job, render_job)).irradiance
    mean = np.mean(many, axis=0)
    assert np.sqrt(np.mean((own - mean) ** 2)) < 0.005 * np.sqrt(np.mean(mean**2))


def test_moments_are_at_most_half_a_pixel_apart_and_add_up_to_the_exposure():
    scene = in_time(sequence=turning(500.0, -5.0, 0.02), camera=SLOW_ROWS, **SMALL)
    frames = scene.frames().take([1])
    job = render_job(frames, 0)
    parts = moments(frames, 0, job, render_job)
    assert all(isinstance(part, SubFrames) for part in parts)
    np.testing.assert_allclose(sum(part.rows for part in parts), 1.0, atol=1e-12)
    centres = [
        part.jobs[0].camera.project(part.jobs[0].M @ job.eye.stop.centre_mm + part.jobs[0].t)[0] for part in parts
    ]
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 0.55
    assert np.all(sum(part.labelled.astype(int) for part in parts if part.labelled is not None) == 1)


def test_moments_share_lids_and_skin_without_a_change_of_the_picture(renderer):
    """The same exposure, with every moment rendered whole and with lids of its own, differs less than blur may."""
    picture_of = {"image": {"spp": 48, "window_px": [160, 120]}}
    scene = in_time(sequence=turning(500.0, -5.0, 0.02), camera=SLOW_ROWS, **{**SMALL, **picture_of})
    frames = scene.frames().take([1])
    job = render_job(frames, 0)
    shared = moments(frames, 0, job, render_job)
    alone = [replace(p, moving=None, jobs=(replace(p.jobs[0], posed=None, region=job.region),)) for p in shared]
    assert 1 < len({id(part.jobs[0].posed) for part in shared}) < len(shared)
    light, whole = (renderer.render(job, spp=48, moments=parts).irradiance for parts in (shared, alone))
    assert np.sqrt(np.mean((light - whole) ** 2)) < 0.005 * np.sqrt(np.mean(whole**2))


def test_labels_of_a_blink_and_of_the_pupil_are_those_of_the_instant(renderer, tmp_path):
    keys = {"lids": {"blinks_per_minute": 0, "at_s": [0.0]}, "pupil": {"time_s": [0, 1], "mm": [3.0, 4.0]}}
    scene = in_time(sequence={**turning(0.0, 0.0, 0.05), **keys}, **SMALL)
    er.render_folder(scene, tmp_path / "out")
    lines = [entry.line for entry in er.ImageFolder.load(tmp_path / "out")]
    shares = [line["labels"]["lid_opening"]["share"] for line in lines]
    assert shares[0] > 0.9
    assert shares == sorted(shares, reverse=True)
    assert [line["records"][0]["blink_phase"] for line in lines][-1] == "closing"
    sizes = [line["labels"]["pupil"]["stop_diameter_mm"] for line in lines]
    np.testing.assert_allclose(sizes, [round(3 + line["time_s"], 3) for line in lines], atol=1e-9)
    assert {line["records"][0]["eye"] for line in lines} <= set(EYES)
    assert er.validate(tmp_path / "out")["problems"] == []


def test_torsion_turns_the_iris_by_itself(renderer):
    """Coordinates on the iris at the same pixels turn by the torsion; a plane iris lies about the axis of torsion."""
    scene = er.load_scene("headset").with_(
        {"image.spp": 1, "image.window_px": [160, 120]}, region=None, gaze_deg=[0, 0]
    )
    found = []
    for torsion in (0.0, 5.0):
        job = render_job(scene.with_({"poses.0.torsion_deg": torsion}).frames(), 0)
        found.append(renderer.render(replace(job, geometry=("iris_coordinates",))).geometry.iris_coordinates)
    both = np.isfinite(found).all(axis=(0, 3)) & (np.hypot(*np.moveaxis(found[0], -1, 0)) > 2.5)
    angles = [np.arctan2(one[both][:, 1], one[both][:, 0]) for one in found]
    turns = np.degrees(np.angle(np.exp(1j * (angles[1] - angles[0]))))
    assert np.count_nonzero(both) > 1000
    centre = np.abs(scene.eye("right").stop.centre_mm[1:]).max()
    assert abs(abs(np.median(turns)) - 5.0) < 1e-4 + 5 * centre


def test_a_rolling_shutter_before_a_moving_eye_is_valid(renderer, tmp_path):
    """Masks, outlines of pupil and limbus, and records agree, each at the time of its rows."""
    scene = in_time(sequence=turning(300.0, -3.0, 0.02), camera=SLOW_ROWS, region=None, **SMALL)
    er.render_folder(scene, tmp_path / "out")
    found = er.validate(tmp_path / "out")
    assert found["problems"] == []
    lines = [entry.line for entry in er.ImageFolder.load(tmp_path / "out")]
    assert all(line["records"][0]["pupil"]["time_s"] != line["time_s"] for line in lines)


def test_lids_and_spots_under_a_rolling_shutter_are_those_of_their_rows(renderer):
    """Each landmark is where it is in a picture at the time of its row; in a blink, and a saccade."""
    lids = {"time_s": [-0.05, 0.05], "blink": [0.0, 0.8]}
    scene = in_time(sequence={**turning(200.0, -2.0, 0.05), "lids": lids}, camera=SLOW_ROWS, **SMALL)
    frames = scene.frames().take([1])
    (image,) = er.render_windows(frames, renderer=renderer)
    labels = image_labels(image, er.trace(frames))
    timing, start = scene.timings[0], frames.index.start_s[0]
    for lid in ("upper", "lower"):
        for k in (4, 8, 12):
            x, y = labels["lid_margins_px"][lid][k]
            then = frames.at([0], np.array([timing.ambient_s(start, y)]))
            bound, _ = renderer.bind(render_job(then, 0), lit=False)
            np.testing.assert_allclose((x, y), bound.host.lid_margins_px[lid][k], atol=2e-3)
    for glint in labels["glints"]:
        if glint["visible"] and glint["visible_share"] == 1.0:
            assert np.linalg.norm(np.subtract(glint["spot_xy_px"], glint["xy_px"])) < 0.05
    both = (labels["lid_margins_px"], image.rendered.lid_margins_px)  # the latter at mid-exposure
    own, middle = (np.array(lids["upper"] + lids["lower"]) for lids in both)
    assert np.abs(own - middle).max() > 0.2


def test_fields_of_an_interlaced_camera_show_the_eye_one_after_the_other(renderer):
    """Even rows are those of a sharp picture at the first field's exposure, odd rows of one at the second's."""
    delayed = {"shutter": {"interlaced": {"delay_ms": 5.0}}, "frame_rate_hz": 50.0}
    picture_of = {"spp": 32, "window_px": [160, 120]}
    short: dict[str, Any] = {"image": picture_of, "sensor": {"noise": False, "exposure_ms": 0.2}, "region": None}
    scene = in_time(sequence=turning(200.0, -2.0, 0.04), camera=delayed, **short)
    both, frames = picture(scene, 0, renderer), scene.frames()
    assert frames.index.time_s[0] == pytest.approx(2.6e-3)  # midway between the fields
    alone = in_time(sequence=turning(200.0, -2.0, 0.04), camera={"frame_rate_hz": 50.0}, **short)
    for parity, middle_s in ((0, 0.1e-3), (1, 5.1e-3)):
        still = alone.with_(gaze_deg=[-2.0 + 200 * middle_s, 0.0]).frames()
        (sharp,) = er.render_windows(still, renderer=renderer)
        rows = (np.arange(both.window[3]) + both.window[1]) % 2 == parity
        error = both.irradiance[rows] - sharp.irradiance[rows]
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(sharp.irradiance[rows] ** 2))
