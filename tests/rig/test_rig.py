"""Lights, screen and rig: the eyes that they serve, mounts, and distances between eyes that are set."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import eyerender as er
from eyerender.analytic.observer import trace
from eyerender.apps.rigs.options import RigSize
from eyerender.apps.rigs.report import survey_of
from eyerender.base.errors import InputError
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise, sample_line
from eyerender.dataset.spec import DatasetSpec
from eyerender.design.information import information
from eyerender.design.noise import sensor_noise
from eyerender.design.people import fitted, people_of
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
from eyerender.rig.mount import IpdAdjustment, Mount
from eyerender.rig.rig import Rig
from eyerender.rig.screen import Screen
from eyerender.scene import Scene, load_scene
from eyerender.scene.observation import EYES, Observations
from eyerender.scene.spec import SceneSpec

CAMERA = {
    "position_mm": [30, -40, -15],
    "look_at_mm": [0, -31.5, 0],
    "focal_length_px": 600,
    "resolution_px": [640, 480],
}


def test_ring_lies_in_the_nodal_plane_around_the_axis():
    rig = Rig.from_mapping(
        {"cameras": [CAMERA], "lights": [{"ring": {"radius_mm": 12, "count": 6}, "radius_mm": 0.5}]}
    ).build()
    camera = rig.cameras[0]
    offsets = np.array([light.position_mm - camera.nodal_point_mm for light in rig.lights])
    assert len(offsets) == 6
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 12, atol=1e-12)
    np.testing.assert_allclose(offsets @ camera.axis, 0, atol=1e-12)
    np.testing.assert_allclose(offsets.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(offsets[0], 12 * camera.R[0], atol=1e-12)  # the first is at the image's right


def test_a_ring_about_a_display_lens_lies_across_its_axis():
    """The first LED is where a camera at the centre that looks at the eye has it at the image's right: at +y."""
    own = {"radius_mm": 22, "count": 8, "centre_mm": [16, -31.5, 0]}

    def rig_of(ring):
        return Rig.from_mapping({"cameras": [CAMERA, CAMERA], "lights": [{"ring": ring}]})

    places = {
        name: np.array([lamp.position_mm for lamp in rig_of(ring).build().lights])
        for name, ring in {"plain": own, "turned": {**own, "axis": [0.5, 0, -0.1], "phase_deg": 90}}.items()
    }
    angle = np.pi / 4 * np.arange(8)
    wanted = [16, -31.5, 0] + 22 * np.column_stack([0 * angle, np.cos(angle), -np.sin(angle)])
    np.testing.assert_allclose(places["plain"], wanted, atol=1e-12)
    offsets = places["turned"] - [16, -31.5, 0]
    np.testing.assert_allclose(offsets @ [0.5, 0, -0.1], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 22, atol=1e-12)
    assert offsets[0, 1] == pytest.approx(0, abs=1e-12)
    assert offsets[0, 2] < -21
    for change, reason in (({"camera": 1}, "either camera or"), ({"axis": [0, 0, 0]}, "must not be zero")):
        with pytest.raises(InputError, match=reason):
            rig_of({**own, **change})
    with pytest.raises(InputError, match="axis is that of a ring with centre_mm"):
        rig_of({"radius_mm": 22, "count": 8, "axis": [1, 0, 0]})


def test_light_axis_points_at_its_aim():
    rig = Rig.from_mapping(
        {"cameras": [CAMERA], "lights": [{"position_mm": [100, 0, 0], "aim_mm": [0, 50, 0]}]}
    ).build()
    np.testing.assert_allclose(rig.lights[0].axis, np.array([-2, 1, 0]) / np.sqrt(5), atol=1e-12)


@pytest.mark.parametrize(
    ("place", "aim"),
    [
        ([12, -45, 5], [0, -31.75, 0]),
        ([12, 45, 5], [0, 31.75, 0]),
        ([600, 0, -50], [0, 0, 0]),
        ([9, 2, 0], [0, 31.75, 0]),
    ],
)
def test_a_light_aims_at_the_nearest_eye_and_one_midway_between_the_eyes(place, aim):
    lights = [{"position_mm": place}]
    lamp = Rig.from_mapping({"cameras": [CAMERA], "lights": lights}).build().lights[0]
    way = np.subtract(aim, place)
    np.testing.assert_allclose(lamp.axis, way / np.linalg.norm(way), atol=1e-12)


def test_leds_of_a_ring_keep_their_aims_when_they_become_single_ones():
    ring = {"ring": {"radius_mm": 40, "count": 5}}
    rig = Rig.from_mapping({"cameras": [{**CAMERA, "position_mm": [30, 3, -15]}], "lights": [ring]})
    single = rig.with_light(0, intensity_mw_sr=3.0)
    assert len(single.lights) == 5
    for one, other in zip(rig.build().lights, single.build().lights, strict=True):
        np.testing.assert_array_equal(one.axis, other.axis)


def test_a_word_that_is_no_aim_is_refused_in_one_line():
    lights = [{"position_mm": [9, 2, 0], "aim_mm": "the eye"}]
    with pytest.raises(InputError, match=r"lights\.0\.aim_mm: must be 'nearest_eye'"):
        Rig.from_mapping({"cameras": [CAMERA], "lights": lights})


def test_screen_grid_is_in_the_studys_order():
    screen = Screen.from_mapping({"centre_mm": [800, 0, -131.5], "size_mm": [495, 280]}).build()
    targets = screen.grid(15, 9)
    assert targets.shape == (135, 3)
    np.testing.assert_allclose(targets[0], [800, 247.5, -131.5 + 140])  # column from the left (+y), row from the top
    np.testing.assert_allclose(targets[8], [800, 247.5, -131.5 - 140])
    np.testing.assert_allclose(targets[67], [800, 0, -131.5], atol=1e-12)
    np.testing.assert_allclose(targets[134], [800, -247.5, -131.5 - 140])


def test_screen_intersection_reverses_world():
    screen = Screen.from_mapping({"centre_mm": [600, 20, -50], "size_mm": [400, 300], "tilt_deg": 15}).build()
    rng = np.random.default_rng(2)
    on_screen = rng.uniform(-150, 150, (50, 2))
    origin = rng.uniform(-30, 30, (50, 3))
    back, ok = screen.intersect(origin, screen.world(on_screen) - origin)
    assert ok.all()
    np.testing.assert_allclose(back, on_screen, atol=1e-9)
    assert screen.normal[0] < 0  # it faces the subject
    _, behind = screen.intersect([0.0, 0, 0], [-1.0, 0, 0])
    assert not behind


@pytest.mark.parametrize(
    ("lights", "words"),
    [
        ([{"ring": {"camera": 1, "radius_mm": 12, "count": 6}}], "there is no camera 1"),
        ([{"radius_mm": 1}], "lights.0: give either position_mm or ring"),
        ([{"position_mm": [1, 2, 3], "radius_mm": -1}], "lights.0.radius_mm: must be >= 0"),
        ([], "lights"),
    ],
)
def test_bad_rigs_are_refused(lights, words):
    with pytest.raises(InputError, match=words):
        Rig.from_mapping({"cameras": [CAMERA], "lights": lights})


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


MOUNT = {"rotation_deg": [3.0, -2.0, 4.0], "translation_mm": [0.4, -0.3, 0.8], "about_mm": [10.0, 0.0, 5.0]}


def moved(points):
    """The motion by SciPy: extrinsic turns about x, y and z."""
    about = np.array(MOUNT["about_mm"])
    return (
        Rotation.from_euler("xyz", MOUNT["rotation_deg"], degrees=True).apply(points - about)
        + about
        + np.array(MOUNT["translation_mm"])
    )


def built(name, **rig):
    data = load_scene(name).spec.to_mapping()
    data["rig"] |= rig
    return Scene.of(SceneSpec.from_mapping(data))


def test_a_moved_camera_sees_moved_points_where_it_saw_them():
    still, tilted = built("headset").rig, built("headset", mount=MOUNT).rig
    points = np.random.default_rng(1).uniform(-10, 10, (20, 3))
    for a, b in zip(still.cameras, tilted.cameras, strict=True):
        np.testing.assert_allclose(moved(points) @ b.R.T + b.t, points @ a.R.T + a.t, atol=1e-11)
        np.testing.assert_allclose(b.R @ b.R.T, np.eye(3), atol=1e-14)
    for a, b in zip(still.lights, tilted.lights, strict=True):
        np.testing.assert_allclose(b.position_mm, moved(a.position_mm), atol=1e-11)
        np.testing.assert_allclose(b.axis, moved(a.position_mm + a.axis) - moved(a.position_mm), atol=1e-12)


RIGS: tuple[dict[str, Any], ...] = ({}, {"mount": {}}, {"mount": MOUNT})


def test_a_mount_moves_the_features_and_nothing_else(tmp_path):
    still, same, tilted = (built("headset", **rig) for rig in RIGS)
    a, b, c = (trace(scene.frames()).pupil.centre_px for scene in (still, same, tilted))
    np.testing.assert_array_equal(a, b)
    assert np.nanmin(np.linalg.norm(c - a, axis=1)) > 1.0
    tilted.spec.dump(tmp_path / "scene.yaml")
    assert SceneSpec.load(tmp_path / "scene.yaml").rig == tilted.spec.rig
    assert "mount" not in still.spec.to_mapping()["rig"]


def test_a_changed_light_stays_on_its_mount():
    rig = load_scene("headset").spec.rig.model_copy(update={"mount": Mount.from_mapping(MOUNT)})
    changed = rig.with_light(0, moved_mm=(0.0, 1.0, 0.0))
    still = rig.model_copy(update={"mount": None}).build().lights[0].position_mm
    np.testing.assert_allclose(
        changed.build().lights[0].position_mm, moved(still + np.array([0.0, 1.0, 0.0])), atol=1e-11
    )
    for before, after in zip(rig.build().lights[1:], changed.build().lights[1:], strict=True):
        np.testing.assert_allclose(after.position_mm, before.position_mm, atol=1e-11)


@pytest.mark.parametrize("key", ["rotation", "translation"])
def test_a_misspelt_key_is_refused(key):
    with pytest.raises(InputError, match=f"{key}: unknown key"):
        Mount.from_mapping({key: [0, 0, 0]})


ADJUST = {"range_mm": [58.0, 70.0], "residual_mm": 0.4}


@pytest.fixture(scope="module")
def scene():
    """The headset with two eyes, whose cameras and LEDs serve one each."""
    return er.load_scene("headset_binocular").with_({"rig.ipd_adjust": ADJUST})


def test_a_setting_outside_the_range_is_refused():
    with pytest.raises(InputError, match=r"set_mm is 90, outside range_mm, 58 to 70"):
        IpdAdjustment.from_mapping({"range_mm": [58.0, 70.0], "set_mm": 90.0})
    drawn = {"range_mm": [58.0, 70.0], "set_mm": 70.4, "residual_mm": 0.1}  # the residual of a person is in it
    assert IpdAdjustment.from_mapping(drawn).set_mm == 70.4


def test_the_pictures_of_both_eyes_stay_within_the_range_and_move_beyond_it(scene):
    def seen(ipd_mm, adjusted=True):
        changes = {"subject.ipd_mm": ipd_mm, **({} if adjusted else {"rig.ipd_adjust": None})}
        # Gaze by angles, so that eyes at another distance do not turn.
        return er.trace(scene.with_(changes, gaze_deg=[[5.0, -3.0]]))

    plain, same, fixed = seen(63.0), seen(69.0), seen(69.0, adjusted=False)
    np.testing.assert_allclose(same.pupil.centre_px, plain.pupil.centre_px, atol=1e-6)
    np.testing.assert_allclose(same.glints.xy_px, plain.glints.xy_px, atol=1e-6)
    assert np.abs(fixed.pupil.centre_px - plain.pupil.centre_px).min(axis=0).max() > 5
    beyond, known = seen(74.0), seen(67.0, adjusted=False)
    # 4 mm beyond the range are 2 mm for each eye, as are 4 mm beyond 63 without the mechanism.
    np.testing.assert_allclose(beyond.pupil.centre_px, known.pupil.centre_px, atol=1e-6)
    np.testing.assert_array_equal(seen(63.0).pupil.centre_px, seen(63.0, adjusted=False).pupil.centre_px)


def test_a_camera_takes_its_mirror_along_and_the_mount_comes_last():
    mirror = {"point_mm": [30.0, -31.5, 0.0], "normal": [1.0, 0.3, 0.2]}
    changes = {
        "rig.cameras.0.mirror": mirror, "rig.cameras.0.eyes": ["right"], "rig.mount": {"rotation_deg": [5, 0, 3]},
        "rig.ipd_adjust": {"range_mm": [50, 80]}, "rig.obstacles": [],
    }  # fmt: skip
    rig = er.load_scene("headset").with_(changes).spec.rig
    moved, still = rig.build(69.0), rig.build(63.0)
    turn = rig.model_copy(update={"ipd_adjust": None}).mount.motion()[0]
    shift = moved.cameras[0].nodal_point_mm - still.cameras[0].nodal_point_mm
    np.testing.assert_allclose(shift, turn @ [0.0, -3.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(moved.lights[0].position_mm, still.lights[0].position_mm)  # it serves both eyes


def test_only_the_residual_is_slippage_for_a_population(scene):
    wide = scene.with_({"rig.ipd_adjust": {**ADJUST, "range_mm": [50, 80]}})
    survey = survey_of(wide.of_first_eye(), er.Population("adults"), RigSize(slippage_mm=0.0))
    people, _ = people_of(survey, 0, 24)
    gaps = np.array([one.place_mm - one.scene.rig.cameras[0].nodal_point_mm for one in people])
    np.testing.assert_allclose(gaps[:, [0, 2]], np.tile(gaps[0, [0, 2]], (len(gaps), 1)), atol=1e-9)
    assert gaps[:, 1].std() == pytest.approx(0.4, rel=0.45)  # 3 SD of an estimate from 24 people
    assert np.std([one.place_mm[1] for one in people]) > 1.0  # half the spread of the distances


def test_a_person_may_be_set_by_hand():
    scene = er.load_scene("headset_binocular").with_({"rig.ipd_adjust": {**ADJUST, "set_mm": 60.0}})
    plain = er.load_scene("headset_binocular").rig
    shift = [a.nodal_point_mm - b.nodal_point_mm for a, b in zip(scene.rig.cameras, plain.cameras, strict=True)]
    np.testing.assert_allclose(sorted(s[1] for s in shift), [-1.5, 1.5], atol=1e-9)
    person = er.Population("adults").person(3, 0)
    assert fitted(scene, person).spec.rig.ipd_adjust.set_mm == scene.spec.rig.ipd_adjust.nearest_mm(person.ipd_mm)


def test_subjects_of_a_dataset_are_set_but_for_a_residual():
    data = er.load_scene("headset_binocular").with_({"rig.ipd_adjust": ADJUST}).spec.to_mapping()
    data = {k: v for k, v in data.items() if k not in ("look", "region", "eye", "name", "format", "description")}
    data["subject"].pop("ipd_mm")
    given = {
        "kind": "dataset",
        "name": "fitted",
        "count": 6,
        "subjects": 3,
        "population": {"preset": "adults"},
        "scene": data,
    }
    found = [er.sample(er.DatasetSpec.from_mapping(given), k).scene.spec for k in range(6)]
    settings = [one.rig.ipd_adjust.set_mm for one in found]
    assert settings[::2] == settings[1::2]
    errors = [s - one.rig.ipd_adjust.nearest_mm(one.subject.ipd_mm) for s, one in zip(settings, found, strict=True)]
    assert 0 < np.abs(errors).max() < 4 * 2 * 0.4
