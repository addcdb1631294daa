"""Parts of a rig that follow the distance of the wearer's pupils."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.apps.rigs.options import RigSize
from eyerender.apps.rigs.report import survey_of
from eyerender.base.errors import InputError
from eyerender.design.people import fitted, people_of
from eyerender.rig.mount import IpdAdjustment

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
