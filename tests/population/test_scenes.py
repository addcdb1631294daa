"""People in scenes and datasets."""

from __future__ import annotations

import json

import numpy as np
import pytest

import eyerender as er
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import realise, sample_line, windows_of
from eyerender.eye.entrance import entrance_pupil_mm
from eyerender.eye.landmarks import at_cornea_d
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.optics.solve import apparent_points
from eyerender.scene.scene import demand_d

RIG = {
    "cameras": [
        {
            "position_mm": [600, 0, -150], "look_at_mm": [0, 0, 0], "focal_length_px": 4000,
            "resolution_px": [1600, 400],
        }
    ],
    "lights": [{"position_mm": [600, 100, -150], "radius_mm": 2, "intensity_mw_sr": 100}],
}  # fmt: skip


def scene_mapping(**more):
    base = {"format": 2, "name": "x", "rig": RIG, "targets": {"world_mm": [[600, 0, 0]]}}
    return {**base, "population": {"preset": "adults", "seed": 3, "subject": 7}, **more}


def dataset_mapping(**more):
    scene = {"rig": RIG, "targets": {"world_mm": [[600, {"draw": "uniform", "low": -99, "high": 99}, 0]]}}
    base = {"format": 3, "kind": "dataset", "name": "d", "count": 6, "subjects": 3, "seed": 3, "scene": scene}
    return {**base, "population": {"preset": "adults"}, "require": "nothing", **more}


@pytest.fixture(scope="module")
def scene():
    return er.Scene.of(er.SceneSpec.from_mapping(scene_mapping()))


def test_a_scene_has_the_person_of_the_draw(scene):
    drawn = er.Population("adults").draw(3, 3, first=6)
    person = drawn.person(1)
    assert scene.spec.person == person
    assert scene.spec.subject.ipd_mm == person.apex_distance_mm
    assert scene.spec.region == person.region()
    same = er.Scene(drawn.subject(1), scene.spec.rig, name="x", targets=scene.spec.targets)
    assert same.spec == scene.spec
    assert same.eye_spec == scene.eye_spec
    assert same.left_eye_spec == scene.left_eye_spec
    assert scene.eye_spec != scene.left_eye_spec


def test_a_scene_survives_its_file(scene, tmp_path):
    scene.spec.dump(tmp_path / "s.yaml")
    again = er.load_scene(tmp_path / "s.yaml")
    assert again.spec == scene.spec
    assert again.digest() == scene.digest()


def test_both_eyes_are_traced_with_their_own_models(scene):
    """Each eye's image is that of a scene of this eye alone, written as an eye file."""
    both = er.trace(scene)
    for row, side in enumerate(("right", "left")):
        mapping = {key: v for key, v in scene.spec.to_mapping().items() if key not in ("person", "eye")}
        mapping["subject"] = {**mapping["subject"], "eyes": [side]}
        alone = er.Scene.of(er.SceneSpec.from_mapping({**mapping, "eye": {"model": scene.eye_file(side)}}))
        found = er.trace(alone)
        np.testing.assert_allclose(found.pupil.centre_px[0], both.pupil.centre_px[row], atol=1e-7)
        np.testing.assert_allclose(found.glints.xy_px[0], both.glints.xy_px[row], atol=1e-7)


def test_what_the_scene_says_stays():
    given = scene_mapping(
        look={"iris_albedo": 0.2}, region={"skin": {"albedo": 0.4}}, subject={"ipd_mm": 60.0, "eyes": ["left"]}
    )
    spec = er.SceneSpec.from_mapping(given)
    assert spec.look.iris_albedo == 0.2
    assert spec.look.iris_seed == spec.person.look().iris_seed
    assert spec.region.skin.albedo == 0.4
    assert spec.region.fissure == spec.person.region().fissure
    assert spec.subject.ipd_mm == 60.0
    assert er.SceneSpec.from_mapping(scene_mapping(region=None)).region is None


def test_light_and_distance_set_pupil_and_lens(scene):
    person = scene.spec.person
    near = scene.with_(target_mm=(250.0, 0.0, 0.0))
    own = np.mean([at_cornea_d(person.number("refraction_d", side)) for side in ("right", "left")])
    assert demand_d(near.spec, near.targets_mm) == pytest.approx(4.0 + own)
    dark, bright = (scene.with_({"subject.luminance_cd_m2": value}) for value in (0.5, 500.0))
    assert dark.stop_diameter_mm("left") > bright.stop_diameter_mm("left") + 1.0
    for one, luminance in ((dark, 0.5), (bright, 500.0)):
        wanted = person.entrance_pupil_mm(luminance, demand_d=1000 / 600 + own, side="right")
        assert entrance_pupil_mm(one.eye("right")) == pytest.approx(wanted, abs=1e-6)
    assert near.stop_diameter_mm("right") <= scene.stop_diameter_mm("right")
    relaxed = scene.with_({"subject.accommodation_d": 0.0})
    assert relaxed.eye_spec.lens == person.eye("right").lens


def seen_pupil_distance_mm(subject):
    """Distance of the middles of both stops as an observer far ahead sees them, while the eyes look at it."""
    far = np.array([1e8, 0.0, 0.0])
    scene = er.Scene(subject, er.Rig.from_mapping(RIG), targets=er.Targets.at(far))
    frames = scene.frames()
    seen = []
    for row, side in enumerate(("right", "left")):
        eye, one = scene.eye(side), frames.pose.take([row])
        poses = Poses(one.azimuth_rad, one.elevation_rad, one.torsion_rad)
        turn, shift = rigid_motion(poses, eye)
        observer = turn[0].T @ (far - scene.eye_position_mm(side) - shift[0])
        indices = tuple(float(n) for n in eye.front_indices)
        found = apparent_points(eye.front, indices, eye.stop.centre_mm[None], observer)
        seen.append(turn[0] @ found.exit_points_mm[0] + shift[0] + scene.eye_position_mm(side))
    return seen[1][1] - seen[0][1]


@pytest.mark.parametrize("n", [12, pytest.param(500, marks=pytest.mark.slow)])
def test_the_far_pupil_distance_is_the_drawn_one(n):
    """Rays from an observer through the cornea to the stop know nothing of the chief ray that is solved for."""
    people = er.Population("adults").draw(n, 9)
    off = [seen_pupil_distance_mm(people.subject(row)) - people["ipd_mm"][row] for row in range(n)]
    assert np.abs(off).max() < 1e-3


def test_the_distance_of_the_apexes_depends_on_the_person_alone(scene):
    """Near targets and light change pupil and lens, not the skull."""
    for changes in ({"subject.luminance_cd_m2": 0.1}, {"subject.accommodation_d": 2.0}):
        assert scene.with_(changes).spec.subject.ipd_mm == scene.spec.person.apex_distance_mm


def test_with_another_population(scene):
    other = scene.with_(population={"preset": "elderly", "subject": 2})
    assert other.spec.person == er.Population("elderly").person(2)
    assert other.spec.region == other.spec.person.region()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"eye": {"model": "E4"}}, "eye.model: cannot be combined with a population"),
        ({"population": {"preset": "none"}}, "population.preset: must be one of"),
        ({"population": {"subject": -1}}, "population.subject: must be >= 0"),
        ({"population": {"where": {"age_years": 5}}}, "population.where.age_years: nobody"),
        ({"subject": {"luminance_cd_m2": 0}}, "subject.luminance_cd_m2: must be > 0"),
    ],
)
def test_wrong_scenes_name_the_key(more, message):
    with pytest.raises(er.InputError, match=message):
        er.SceneSpec.from_mapping(scene_mapping(**more))


def test_a_dataset_draws_its_subjects():
    plan = Plan.of(er.DatasetSpec.from_mapping(dataset_mapping()))
    people = er.Population("adults").draw(3, 3)
    for index in range(6):
        found = realise(plan, index)
        assert found.scene.spec.person == people.person(index // 2)
        row = index % 2
        labels = {"pupil": {"stop_diameter_mm": found.scene.stop_diameter_mm(("right", "left")[row])}}
        _, line = sample_line(found, row, 1, windows_of(found.scene, found.observations)[row], labels)
        told = line["parameters"]["person"]
        assert told["axial_length_mm"] == people["axial_length_mm"][index // 2, row]
        assert told["skin_albedo"] == people["skin.albedo"][index // 2]
        assert told["subject"] == index // 2
        # The person's own number is at the table's luminance, so its name says so.
        assert told["entrance_pupil_at_20_cd_m2_mm"] == people["entrance_pupil_mm"][index // 2]
        assert "entrance_pupil_mm" not in told
        eye = er.EyeSpec.from_mapping(json.loads(line["parameters"]["eye_json"]))
        assert eye.stop.diameter_mm == line["parameters"]["pupil_diameter_mm"]
        assert eye == found.scene.eye_file(("right", "left")[row])


def test_a_subject_whose_eye_cannot_be_is_drawn_again():
    """A stop before the inner cornea refuses an eye; the next attempt has another seed."""
    wild = {"chamber_depth_mm": {"kind": "uniform", "low": 0.3, "high": 3.6}}
    wanted = dataset_mapping(subjects=6, count=6, population={"preset": "adults", "replace": wild})
    plan = Plan.of(er.DatasetSpec.from_mapping(wanted))
    attempts = [plan.identity(k) for k in range(6)]
    again = [k for k, (attempt, _) in enumerate(attempts) if attempt]
    assert again
    assert all(len(reasons) == attempt for attempt, reasons in attempts)
    found = realise(plan, again[0])
    assert found.sample.turn.subject_attempt == attempts[again[0]][0]
    assert found.scene.spec.person.seed != plan.spec.seed


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"eye_parameters": {"E2": {"limbus_radius_mm": 5.8}}}, "eye_parameters: cannot be combined with a population"),
        ({"scene": {"rig": RIG, "population": {}}}, "scene.population: write 'population' next to"),
    ],
)
def test_wrong_datasets_name_the_key(more, message):
    with pytest.raises(er.InputError, match=message):
        Plan.of(er.DatasetSpec.from_mapping(dataset_mapping(**more)))


@pytest.mark.parametrize("eye", ["E1", "E4"])
def test_another_eye_keeps_look_lids_pupil_and_place_of_the_person(eye):
    own = er.DatasetSpec.from_mapping(dataset_mapping())
    plan, other = Plan.of(own), Plan.load(own, eye=eye)
    assert plan.digest != other.digest
    for index in range(6):
        a, b = realise(plan, index).scene, realise(other, index).scene
        assert b.eye_name == eye
        assert b.spec.person is None
        assert (a.spec.look, a.spec.region, a.spec.targets, a.spec.rig) == (
            b.spec.look, b.spec.region, b.spec.targets, b.spec.rig,
        )  # fmt: skip
        assert (a.spec.seed, a.spec.subject.ipd_mm) == (b.spec.seed, b.spec.subject.ipd_mm)
        side = b.spec.subject.eyes[0]
        assert b.stop_diameter_mm(side) == pytest.approx(a.stop_diameter_mm(side))
        np.testing.assert_array_equal(b.frames().index.target_mm, a.frames().index.target_mm)
        # The optics are those of the model: the gaze differs by its angle between optic axis and line of sight.
        model = er.load_eye(eye)
        assert b.eye_file(side).cornea == model.cornea
        assert np.degrees(np.abs(b.frames().pose.azimuth_rad - a.frames().pose.azimuth_rad)).max() < 8
