"""Cameras and LEDs that serve one eye: a headset with a camera for each eye against two scenes of one eye."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.analytic.observer import trace
from eyerender.base.errors import InputError
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise, sample_line
from eyerender.dataset.spec import DatasetSpec
from eyerender.design.information import information
from eyerender.design.noise import sensor_noise
from eyerender.design.safety import eye_exposure
from eyerender.gaze.directions import DirectionRegression
from eyerender.gaze.estimate import binocular_average
from eyerender.gaze.guestrin import GuestrinEizenman
from eyerender.gaze.homography import Homography
from eyerender.gaze.records import rig_from_mapping
from eyerender.gaze.regression import Regression
from eyerender.imaging.imageobserver import detect
from eyerender.imaging.images import render
from eyerender.imaging.labels import EyeInWindow, known_labels
from eyerender.imaging.lines import image_line
from eyerender.scene import Scene, load_scene
from eyerender.scene.observation import EYES, Observations
from eyerender.scene.spec import SceneSpec

RING = 8


def both_eyes(**image) -> Scene:
    return load_scene("headset_binocular").with_({"region": None, "image": {"spp": 4, **image}})


def one_eye(scene: Scene, side: str) -> Scene:
    """The same headset with the camera and the ring of one eye alone."""
    data, k = scene.spec.to_mapping(), EYES.index(side)
    camera, ring = data["rig"]["cameras"][k], data["rig"]["lights"][k]
    data["rig"]["cameras"] = [{key: value for key, value in camera.items() if key != "eyes"}]
    data["rig"]["lights"] = [{**{k: v for k, v in ring.items() if k != "eyes"}, "ring": {**ring["ring"], "camera": 0}}]
    data["subject"]["eyes"] = [side]
    return Scene.of(SceneSpec.from_mapping(data))


@pytest.mark.parametrize("side", EYES)
def test_features_are_those_of_a_scene_of_one_eye(side):
    both = both_eyes()
    seen, alone = trace(both), trace(one_eye(both, side))
    rows = seen.index.eye == EYES.index(side)
    first = RING * EYES.index(side)
    for mine, own in zip(seen.take(rows).records(), alone.records(), strict=True):
        assert [g["light"] - first for g in mine["glints"]] == [g["light"] for g in own["glints"]] == list(range(RING))
        assert mine["instant"] == own["instant"] == own["frame"] == mine["frame"] // 2
        numbers = {"frame": own["frame"], "camera": 0, "glints": own["glints"]}
        assert {**mine, **numbers} == own
        np.testing.assert_array_equal(
            [g["xy_px"] or [np.nan] * 2 for g in mine["glints"]], [g["xy_px"] or [np.nan] * 2 for g in own["glints"]]
        )
    again = Observations.from_records(json.loads(json.dumps(list(seen.records()))), complete=True)
    assert again.index == seen.index
    assert [r["glints"] for r in again.records()] == [r["glints"] for r in seen.records()]


def test_estimators_calibrate_each_eye_on_its_own_ring():
    both = both_eyes()
    seen = trace(both)
    for side in EYES:
        scene = one_eye(both, side)
        alone, rows = trace(scene), seen.index.eye == EYES.index(side)
        for estimator in (Homography(), GuestrinEizenman(), Regression(normalised=False), DirectionRegression()):
            together = estimator.fit(seen, both.rig).predict(seen, both.rig).point_mm[rows]
            np.testing.assert_array_equal(together, estimator.fit(alone, scene.rig).predict(alone, scene.rig).point_mm)
    gaze = GuestrinEizenman().fit(seen, both.rig).predict(seen, both.rig)
    moments, mean = binocular_average(seen, gaze)
    assert moments.index.instant.tolist() == list(range(9))
    assert mean.ok.sum() >= 7
    np.testing.assert_allclose(mean.point_mm[4], gaze.point_mm[seen.index.instant == 4].mean(axis=0))
    with pytest.raises(InputError, match="there is no light 9: the rig has 8 for each eye"):
        Homography(lights=tuple(range(10))).fit(seen, both.rig)  # type: ignore[arg-type]


def test_the_rig_in_json_says_which_eyes_it_serves():
    rig = both_eyes().rig
    data = json.loads(json.dumps(rig.to_mapping()))
    assert [camera["eyes"] for camera in data["cameras"]] == [["right"], ["left"]]
    assert data["light_eyes"] == [["right"]] * RING + [["left"]] * RING
    assert rig_from_mapping(data).lights_of(1) == tuple(range(RING, 2 * RING))
    with pytest.raises(InputError, match="light_eyes: must have an entry for each of lights_mm"):
        rig_from_mapping({**data, "light_eyes": [None]})


def test_a_rig_of_one_eye_has_its_noise_and_information():
    both = both_eyes()
    alone = one_eye(both, "left")
    assert both.spec.rig.of_eye("left").build().lights == tuple(
        type(lamp)(**{**{k: getattr(lamp, k) for k in lamp.__slots__}, "eyes": ("left",)}) for lamp in alone.rig.lights
    )
    noise, own = sensor_noise(both), sensor_noise(alone)
    np.testing.assert_array_equal(noise.glint_px[1, RING:], own.glint_px[0])
    assert np.isinf(noise.glint_px[1, :RING]).all()
    found = information(both.frames(), noise=noise)["left"]
    expected = information(alone.frames(), noise=own)["left"]
    np.testing.assert_allclose(found.gaze_deg, expected.gaze_deg, rtol=1e-9)
    place = both.eye_position_mm("left")
    # Light of the other ring is stray light to this eye, but light all the same.
    assert eye_exposure(both.rig, place).cornea_share > eye_exposure(alone.rig, place).cornea_share


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rig.cameras.0.eyes": []}, "rig.cameras.0.eyes"),
        ({"rig.lights.0.eyes": ["left", "left"]}, "rig.lights.0.eyes: name each eye only once"),
        ({"rig.cameras.0.eyes": ["both"]}, "rig.cameras.0.eyes.0"),
        ({"subject.eyes": ["left"], "rig.cameras.1.eyes": ["right"]}, "rig.cameras: none sees the left eye"),
    ],
)
def test_wrong_eyes_are_refused(changes, message):
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        both_eyes().with_(changes)


def test_frames_of_an_eye_that_another_rig_does_not_show_are_refused():
    both = both_eyes()
    with pytest.raises(InputError, match=r"rig\.cameras\.0\.eyes: does not see the right eye of these frames"):
        both.frames().seen_by(both.with_({"rig.cameras.0.eyes": ["left"]}).rig)


def test_a_pupil_outside_its_window_is_named():
    data = Plan.load("dataset_binocular").spec.to_mapping()
    data["scene"]["rig"]["cameras"][1]["look_at_mm"] = [-4, -10, 0]
    found = realise(Plan.load(DatasetSpec.from_mapping({**data, "attempts": 1})), 0)
    assert found.sample is None
    words = "the apparent pupil of the left eye in camera 1 (left eye), frame 1, leaves the window by "
    assert words in found.rejections[-1].reason


def test_lines_of_folders_and_of_datasets_have_the_same_keys():
    found = realise(Plan.load("dataset_binocular"), 3)
    assert found.scene is not None
    assert found.observations is not None
    assert found.frames is not None
    view = EyeInWindow.of(found.frames, 1)
    labels = known_labels(found.scene, found.observations, view)
    _, line = sample_line(found, 1, found.scene.frame_count, view.window, labels)
    (record,) = found.observations.take([1]).records()
    rendered = image_line(found.scene, record, view.window, labels)
    assert list(line) == list(rendered)
    assert list(line["parameters"]) == list(rendered["parameters"])
    assert (line["instant"], line["records"][0]["instant"], line["records"][0]["frame"]) == (3, 3, 7)
    assert [rendered[key] for key in ("sample", "split", "sequence_index", "subject")] == [None] * 4


@pytest.mark.render
def test_each_eye_is_lit_by_its_own_ring_alone():
    both = both_eyes(window_px=[200, 200]).with_({"sensor.noise": False})
    middle = [8, 9]  # both eyes at the middle target
    pictures = render(both.frames().take(middle))
    for side, picture in zip(EYES, pictures, strict=True):
        alone = one_eye(both, side)
        (own,) = render(alone.frames().take([4]))
        np.testing.assert_array_equal(picture.counts, own.counts)
        first = RING * EYES.index(side)
        assert [g["light"] for g in picture.labels["glints"]] == list(range(first, first + RING))
        (found,) = detect(picture).records()
        assert {g["light"] for g in found["glints"] if g["light"] is not None} <= set(range(first, first + RING))
        assert sum(g["status"] == "ok" for g in found["glints"]) == RING
