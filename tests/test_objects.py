"""Scenes built from objects: the same scenes, and the same mistakes, as from YAML."""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.spec import Spec

ROOT = Path(__file__).parents[1]

RIG = er.Rig.from_mapping(
    {
        "cameras": [{"position_mm": [600, 0, -150], "look_at_mm": [0, 0, 0], "resolution_px": [640, 480],
                     "focal_length_px": 4000}],
        "lights": [{"position_mm": [600, 120, 0]}, {"position_mm": [600, -120, 0]}],
        "screen": {"centre_mm": [650, 0, 0], "size_mm": [377, 301]},
    }
)  # fmt: skip


def rebuilt(value):
    """The same value made by constructors, with lists for tuples."""
    if isinstance(value, Spec):
        return type(value)(**{name: rebuilt(getattr(value, name)) for name in type(value).model_fields})
    return [rebuilt(v) for v in value] if isinstance(value, tuple) else value


@pytest.mark.parametrize("name", sorted(er.shipped_scenes()))
def test_objects_give_the_scene_of_the_file(name):
    loaded = er.load_scene(name)
    made = rebuilt(loaded.spec)
    assert made == loaded.spec
    assert made.digest() == loaded.spec.digest()
    parts = {key: getattr(made, key) for key in type(made).model_fields if key not in ("subject", "rig", "eye")}
    scene = er.Scene(er.Subject(made.eye, **rebuilt_fields(made.subject)), made.rig, **parts)
    assert scene.spec == loaded.spec
    assert scene == loaded


def rebuilt_fields(subject):
    return {key: rebuilt(getattr(subject, key)) for key in ("eyes", "ipd_mm", "head_positions_mm")}


def test_arrays_and_positions_without_names():
    assert er.Led(np.array([1.0, 2, 3])) == er.Led(position_mm=(1, 2, 3)) == er.Led([1, 2, 3])
    assert er.Screen([650, 0, 0], (377, 301)) == RIG.screen
    camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -150), focal_length_px=4000, size_px=(640, 480))
    assert camera == RIG.cameras[0]
    with pytest.raises(TypeError, match="takes position_mm without a name"):
        er.Led((1, 2, 3), (4, 5, 6))  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="no values without a name"):
        er.Sensor(12)  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("make", "data"),
    [
        (er.Led, {"position_mm": [1, 2]}),
        (er.Led, {"position_mm": [1, 2, 3], "radius_mm": -1}),
        (er.Led, {"position_mm": [1, 2, 3], "radius": 1}),
        (er.Led, {"position_mm": [float("nan"), 2, 3]}),
        (er.Sensor, {"bit_depth": "12"}),
        (er.Rig, {"cameras": [], "lights": []}),
        (er.Subject, {"eyes": ["left", "left"]}),
        (er.Targets, {}),
        (er.SceneSpec, {"name": "x", "rig": {"cameras": [{"resolution_px": [640, 480]}], "lights": []}}),
    ],
)
def test_a_mistake_is_the_same_line_as_in_yaml(make, data):
    with pytest.raises(er.InputError) as from_yaml:
        make.from_mapping(yaml.safe_load(yaml.safe_dump(data)))
    with pytest.raises(er.InputError) as from_python:
        make(**data)
    assert str(from_python.value) == str(from_yaml.value)
    assert "\n" not in str(from_python.value)


def test_what_is_no_value_at_all_is_refused():
    with pytest.raises(er.InputError, match="object is not allowed"):
        er.Led(object())


def test_an_eye_can_be_given_as_its_own_record():
    spec = er.load_eye("E2")
    inline, named = (
        er.Scene(er.Subject(er.Eye.load(model)), RIG, targets=er.Targets(grid=(2, 1))) for model in (spec, "E2")
    )
    assert inline.eye_spec == named.eye_spec
    np.testing.assert_array_equal(er.trace(inline).pupil.points_px, er.trace(named).pupil.points_px)
    again = er.SceneSpec.from_mapping(yaml.safe_load(inline.spec.to_yaml()))
    assert again == inline.spec
    with pytest.raises(er.InputError, match="E9: no such eye"):
        er.Eye.load("E9")
    with pytest.raises(er.InputError, match="wider than the iris"):
        er.Eye.load("E1", pupil_diameter_mm=40.0)
    with pytest.raises(er.InputError, match="given twice"):
        er.SceneSpec(
            name="x", eye=er.Eye("E1"), subject=er.Subject(er.Eye("E2")), rig=RIG, targets=er.Targets(grid=(1, 1))
        )


def test_with_changes_what_it_names_and_nothing_else():
    scene = er.load_scene("quickstart")
    changed = scene.with_({"rig.lights.0.radius_mm": 2.5}, pupil_diameter_mm=3, gaze_deg=(5, -3), seed=7)
    assert changed.pupil_diameter_mm == pytest.approx(3)
    assert changed.spec.poses == (er.EyeDirection(azimuth_deg=5, elevation_deg=-3),)
    assert changed.spec.targets is None
    assert changed.spec.rig.lights[0].radius_mm == 2.5
    assert changed.spec.seed == 7
    radius = scene.spec.rig.lights[0].radius_mm
    back = changed.with_({"rig.lights.0.radius_mm": radius, "poses": None},
                         targets=scene.spec.targets, eye=scene.spec.eye, seed=scene.spec.seed)  # fmt: skip
    assert back.spec == scene.spec
    np.testing.assert_allclose(np.degrees(changed.frames().pose.azimuth_rad), 5)
    lines = {
        "rig.lights.9.radius_mm": "rig.lights.9.radius_mm: there is no such key",
        "rig.foo": "rig.foo: unknown key",
        "seed.x": "seed.x: there is no such key",
    }
    for wrong, line in lines.items():
        with pytest.raises(er.InputError, match=re.escape(line)):
            scene.with_({wrong: 1})


def test_a_new_exposure_time_drops_the_gain_that_was_chosen_with_the_old_one():
    dim = er.load_scene("webcam").with_(sensor={})
    assert dim.spec.sensor.gain_dn_per_e is not None
    longer = dim.with_({"sensor.exposure_ms": 20})
    assert (longer.spec.sensor.exposure_ms, longer.spec.sensor.gain_dn_per_e) == (20, None)
    assert dim.with_({"sensor.exposure_ms": None}) == dim
    stated = dim.with_({"sensor.gain_dn_per_e": 2.0}).with_({"sensor.exposure_ms": 20})
    assert stated.spec.sensor.gain_dn_per_e == 2


def test_with_keeps_an_eye_that_was_given_instead_of_the_files(tmp_path, monkeypatch):
    er.load_eye("E4").dump(tmp_path / "own.yaml")
    monkeypatch.chdir(tmp_path)
    scene = er.load_scene("quickstart", eye="own.yaml")
    assert scene.with_(pupil_diameter_mm=3).eye_spec == scene.eye_spec
    assert scene.with_({"eye.model": "E1"}).eye_spec.name == "E1"


def test_with_leaves_the_callers_values_alone():
    sensor = {"bit_depth": 12}
    changed = er.load_scene("quickstart").with_({"sensor.bit_depth": 8}, sensor=sensor)
    assert changed.spec.sensor.bit_depth == 8
    assert sensor == {"bit_depth": 12}


def test_a_camera_in_an_eye_is_warned_of():
    camera = er.Camera.from_mapping(
        {"resolution_px": [640, 480], "calibration": {"K": [[900, 0, 320], [0, 900, 240], [0, 0, 1]],
         "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t_mm": [0, 32, 0]}}
    )  # fmt: skip
    rig = er.Rig(cameras=(camera,), lights=RIG.lights, screen=RIG.screen)
    scene = er.Scene(er.Subject(er.Eye("E1"), ipd_mm=64), rig, targets=er.Targets(grid=(1, 1)))
    assert any("the camera is in the right eye" in str(warning) for warning in scene.warnings())
    assert set(scene.windows().values()) == {(0, 0, 640, 480)}


def test_one_led_of_a_ring_can_be_moved():
    ring = er.rig.LedRing(radius_mm=20, count=6)
    rig = er.Rig(cameras=RIG.cameras, lights=(er.Led((600, 0, 100)), er.Led(ring=ring, radius_mm=1.5)))
    moved = rig.with_light(3, moved_mm=(0, 0, 2), intensity_mw_sr=5)
    before, after = rig.build().lights, moved.build().lights
    assert len(after) == len(before) == moved.light_count
    for k, (a, b) in enumerate(zip(before, after, strict=True)):
        if k == 3:
            np.testing.assert_allclose(b.position_mm, a.position_mm + np.array([0, 0, 2]), rtol=0, atol=1e-12)
            assert (b.radius_mm, b.intensity_mw_sr) == (1.5, 5)
        else:
            assert a == b
    with pytest.raises(er.InputError, match="there is no light 7, only 7"):
        rig.with_light(7, radius_mm=1)


def test_frames_are_a_sequence_of_one_eye_in_one_frame():
    frames = er.Subject(er.Eye("E1")).fixating(RIG.screen.grid(3, 3), RIG)
    assert len(frames) == 18
    assert isinstance(frames[0], er.Frame)
    assert len(list(frames)) == 18
    assert int(frames[-1].index.fixation[0]) == 8
    assert len(frames[frames.index.eye == 1]) == 9
    with pytest.raises(IndexError):
        frames[18]
    looking = er.Subject(er.Eye("E1"), eyes=["left"]).looking([(5, -3), (0, 0)], RIG)
    np.testing.assert_allclose(np.degrees(looking.pose.azimuth_rad), [5, 0])


def test_another_rig_sees_the_same_eyes():
    frames = er.Subject(er.Eye("E1")).fixating(RIG.screen.grid(2, 2), RIG)
    other = RIG.with_light(0, moved_mm=(0, 10, 0))
    seen, direct = er.trace(frames, other), er.trace(er.Subject(er.Eye("E1")).fixating(RIG.screen.grid(2, 2), other))
    assert seen == direct
    with pytest.raises(er.InputError, match="are 2, but the frames were made for 1"):
        er.trace(frames, er.Rig(cameras=RIG.cameras * 2, lights=RIG.lights))


@pytest.mark.render
def test_the_short_example_of_the_documentation():
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    example = re.search(r"```python\n(import eyerender as er\n.*?)```", page, re.S).group(1)
    assert len(example.strip().splitlines()) <= 15
    names: dict = {}
    exec(example, names)
    image, truth, found, gaze = (names[key] for key in ("image", "truth", "found", "gaze"))
    assert image.counts.shape == image.irradiance.shape == image.parts.shape
    assert image.labels["pupil"]["visible_fraction"] == 1.0
    assert image._repr_png_().startswith(b"\x89PNG")
    assert found.pupil.ok.all()
    assert np.abs(found.pupil.centre_px - truth.pupil.centre_px).max() < 0.5
    wanted = truth.index.target_mm
    assert np.median(np.linalg.norm(gaze.point_mm - wanted, axis=1)) < 5  # mm on a screen 650 mm away
    with pytest.raises(er.InputError, match="eye: changes more than the picture"):
        er.render(names["frames"][0], rig=names["rig"], eye=er.Eye("E1"))


@pytest.mark.render
def test_a_picture_in_memory_is_the_one_in_the_folder(tmp_path):
    scene = er.load_scene("quickstart").with_(spp=2, targets={"grid": [2, 2]})
    frames = scene.frames()
    er.render_folder(scene, tmp_path / "out")
    entry = er.ImageFolder.load(tmp_path / "out").entries[3]
    image = er.render(frames[3])
    np.testing.assert_array_equal(entry.image(), image.counts)
    np.testing.assert_array_equal(entry.mask(), image.parts)
    assert er.render(frames[3:5], look=er.Look(iris_albedo=0.5))[0].irradiance.mean() > image.irradiance.mean()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: er.Camera(resolution_px=(640, 480), focal_length_px=-3), "focal_length_px: must be > 0, not -3"),
        (lambda: er.SceneSpec.from_mapping({"rig": {}}), "rig.cameras: missing"),
        (lambda: er.Subject(ipd_mm="wide"), "ipd_mm: must be a valid number, not 'wide'"),
    ],
)
def test_a_refusal_is_shown_without_the_validators_own_error(call, words):
    with pytest.raises(er.InputError) as caught:
        call()
    shown = "".join(traceback.format_exception(caught.value))
    assert shown.rstrip().endswith(words)
    assert "pydantic" not in shown


def test_what_cannot_be_changed_says_what_to_do():
    scene: Any = er.load_scene("quickstart")
    with pytest.raises(AttributeError, match=r"scene\.with_\(pupil_diameter_mm=\.\.\.\)"):
        setattr(scene, "pupil_diameter_mm", 3)  # noqa: B010  (mypy knows that it cannot)
    with pytest.raises(AttributeError, match="a Scene cannot be changed"):
        setattr(scene, "spec", None)  # noqa: B010
    assert scene.spec.eye is not None
    with pytest.raises(AttributeError, match=r"Eye: cannot be changed; make a new Eye, .* scene\.with_") as caught:
        setattr(scene.spec.eye, "pupil_diameter_mm", 3)  # noqa: B010
    assert "pydantic" not in "".join(traceback.format_exception(caught.value))
    assert scene == er.load_scene("quickstart")


@pytest.mark.parametrize("function", [er.trace, er.render, lambda x: next(er.render_windows(x))])
def test_frames_or_a_scene_are_wanted(function):
    with pytest.raises(er.InputError, match=r"frames: must be .* or .*Source, not 3"):
        function(3)
    with pytest.raises(TypeError, match="give frames or a scene, not Rig"):
        function(RIG)


def test_windows_of_a_scene_are_those_of_its_frames(monkeypatch):
    """A scene is checked as its frames are, before any renderer is made."""
    monkeypatch.setattr("eyerender.imaging.capture.MAX_PIXELS", 10)
    scene = er.load_scene("quickstart")
    with pytest.raises(er.InputError) as of_frames:
        next(er.render_windows(scene.frames()))
    with pytest.raises(er.InputError) as of_scene:
        next(er.render_windows(scene))
    assert str(of_scene.value) == str(of_frames.value)


@pytest.mark.parametrize("side", ["right", "left"])
def test_one_eye_is_where_it_shall_be(side):
    """The features are those of an eye at the middle of a head without width, up to the mirror and rounding."""
    place = np.array([5.0, 7.0, -3.0])
    subject = er.Subject.one_eye(er.Eye("E4"), side=side, at_mm=place)
    assert subject.ipd_mm == 63
    frames = subject.looking([(5, 5)], RIG)
    assert len(frames) == 1
    np.testing.assert_allclose((frames.index.eye_position_mm + frames.index.head_mm)[0], place, atol=1e-12)
    seen = er.trace(frames)
    narrow = er.Subject(er.Eye("E4"), eyes=[side], ipd_mm=1e-9, head_positions_mm=[place]).looking([(5, 5)], RIG)
    same = er.trace(narrow)
    # 1e-9 mm of the head's width are 1e-8 px.
    np.testing.assert_allclose(seen.pupil.centre_px, same.pupil.centre_px, atol=1e-6)
    np.testing.assert_allclose(seen.glints.xy_px, same.glints.xy_px, atol=1e-6)


def test_one_eye_at_several_places_has_frames_at_each():
    places = [(0, 0, 0), (10, -4, 2)]
    subject = er.Subject.one_eye(at_mm=places, look=er.Look(iris_contrast=0.8))
    frames = subject.looking([(0, 0)], RIG)
    np.testing.assert_allclose(frames.index.eye_position_mm + frames.index.head_mm, places, atol=1e-12)
    assert subject.look.iris_contrast == 0.8
    with pytest.raises(er.InputError, match="eyes"):
        er.Subject.one_eye(side="third")  # type: ignore[arg-type]


def test_examples_need_no_head_without_width():
    assert not [p.name for p in (ROOT / "examples").glob("*.py") if "ipd_mm=0.001" in p.read_text(encoding="utf-8")]


def test_none_removes_a_key_or_an_entry() -> None:
    scene = er.load_scene("guestrin2006").with_({"eye.pupil_diameter_mm": 3.5, "image.spp": 7})
    again = scene.with_({"image.spp": None, "eye.pupil_diameter_mm": None, "rig.lights.1": None})
    assert again.spec.image.spp == er.Picture().spp
    assert again.spec.eye.pupil_diameter_mm is None
    assert again.spec.rig.lights == scene.spec.rig.lights[:1] + scene.spec.rig.lights[2:]
    with pytest.raises(er.InputError, match=r"image\.sp: unknown key"):
        scene.with_({"image.sp": None})
