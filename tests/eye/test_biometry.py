"""Eyes from the numbers of a biometer, read back by rays."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

import eyerender as er
from eyerender.base.status import Status
from eyerender.dataset.ownscenes import given_scene
from eyerender.dataset.plan import Plan
from eyerender.eye.landmarks import path_to_retina
from eyerender.eye.spec import EyeSpec
from eyerender.optics.trace import trace

NUMBERS = {
    "k1_d": 42.5, "k1_axis_deg": 20.0, "k2_d": 44.25,
    "acd_mm": 3.31, "lens_mm": 3.87, "axial_mm": 24.42, "wtw_mm": 11.9,
}  # fmt: skip
LAMPS, FAR_MM, RING_MM = 12, 600.0, 5.0


def keratometry(eye, side):
    """Measure powers (D) and axis (deg) as a keratometer: the glints of a ring of lamps about a camera straight ahead.

    With the lamp at L and the glint at p, both across the axis, the law of reflection is L / d = 2 (C + I / d) p near
    the axis, C the matrix of curvatures and d the distance. The examiner sees +y on the right.
    """
    angle = 2 * np.pi * np.arange(LAMPS) / LAMPS
    ring = RING_MM * np.column_stack([np.cos(angle), np.sin(angle)])
    camera = er.Camera(position_mm=(FAR_MM, 0, 0), look_at_mm=(0, 0, 0), focal_length_px=1e5, resolution_px=(800, 800))
    lamps = tuple(er.Led((FAR_MM, y, z)) for y, z in ring)
    rig = er.Rig(cameras=(camera,), lights=lamps)
    seen = er.trace(er.Subject.one_eye(eye, side=side).looking((0, 0), rig))
    assert (seen.glints.status == Status.OK).all()
    # Seen from the front, the subject's left (+y) is to the right and up (+z) is up in the picture.
    places = (seen.glints.xy_px[0] - 399.5) * [1, -1] * FAR_MM / 1e5
    turn = np.linalg.lstsq(places, ring / FAR_MM, rcond=None)[0].T / 2 - np.eye(2) / FAR_MM
    assert turn == pytest.approx(turn.T, abs=1e-6)
    curvature, way = np.linalg.eigh((turn + turn.T) / 2)
    return 337.5 * curvature, np.degrees(np.arctan2(way[1], way[0])) % 180


def lengths(eye):
    """Depths (mm) at which a ray along the axis meets both surfaces of the cornea and of the lens, and the retina."""
    traced = trace(path_to_retina(eye), 1.0, np.array([20.0, 0, 0]), np.array([-1.0, 0, 0]))
    return -traced.points_mm[1:, 0]


@pytest.mark.parametrize("axis", [20.0, 90.0, 155.0])
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_numbers_are_read_back_by_rays_in_both_eyes(side, axis):
    eye = er.Eye(biometry={**NUMBERS, "k1_axis_deg": axis})
    powers, axes = keratometry(eye, side)
    assert np.abs(powers - [42.5, 44.25]).max() < 0.01
    assert np.abs((axes - [axis, axis + 90] + 90) % 180 - 90).max() < 0.1
    front, _, lens, back, retina = lengths(eye.build(side))
    assert np.abs([front, lens - 3.31, back - lens - 3.87, retina - 24.42]).max() < 1e-6
    assert 2 * eye.build(side).limbus_radius_mm == 11.9


def test_scenes_eye_files_and_python_make_the_same_eye(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"format": 3, "name": "biometry", "biometry": NUMBERS}))
    eye = er.Eye(biometry=NUMBERS)
    assert er.load_eye(path) == eye.spec() == EyeSpec.from_mapping({"biometry": NUMBERS})
    scene = er.load_scene("headset").with_({"eye": {"biometry": NUMBERS}})
    assert scene.eye_spec == eye.spec()
    # Written and read again, in both layouts.
    scene.spec.dump(tmp_path / "scene.yaml")
    assert "model" not in yaml.safe_load((tmp_path / "scene.yaml").read_text())["eye"]
    assert er.load_scene(tmp_path / "scene.yaml").digest() == scene.digest()
    eye.spec().dump(path)
    assert er.load_eye(path) == eye.spec()
    assert keratometry(er.Eye(str(path)), "left")[1][0] == pytest.approx(20, abs=0.1)


def test_a_toric_eye_file_is_mirrored_unless_it_says_otherwise(tmp_path):
    data = er.Eye(biometry=NUMBERS).spec().to_mapping()
    del data["toric_axis"]
    mirrored = EyeSpec.from_mapping(data)
    assert keratometry(er.Eye(mirrored), "right")[1][0] == pytest.approx(20, abs=0.1)
    assert keratometry(er.Eye(mirrored), "left")[1][0] == pytest.approx(160, abs=0.1)


@pytest.mark.slow
def test_the_file_of_a_fitted_left_eye_is_that_of_the_left_eye():
    """From exact features and from its own eye, a fit finds no change, so that the file has the same left eye."""
    eye = er.Eye(biometry=NUMBERS)
    rig = er.load_scene("desktop_tracker").spec.rig
    frames = er.Subject(eye, eyes=["left"]).fixating([[620, 31.5, 0], [620, 131.5, 80]], rig)
    (fit,) = er.fit_eye(er.trace(frames), frames.scene.rig, prior=eye.spec())
    assert keratometry(er.Eye(fit.spec), "left")[1][0] == pytest.approx(20, abs=0.5)


def test_other_keys_of_an_eye_file_stay():
    eye = EyeSpec.from_mapping({"biometry": NUMBERS, "name": "A", "fovea": {"field_deg": [5.0, 1.0]}})
    assert (eye.name, eye.fovea.field_deg) == ("A", (5.0, 1.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k1_d": 337.5 / 7.8e-3}, r"eye.biometry.k1_d: must be <= 80"),
        ({"k1_axis_deg": 200}, r"eye.biometry.k1_axis_deg: must be <= 180"),
        ({"axial_mm": None}, r"eye.biometry.axial_mm: missing"),
        ({"acd_mm": 7.0, "lens_mm": 8.0, "axial_mm": 14.0}, r"eye.biometry.retina.position_mm: crosses the lens"),
    ],
)
def test_impossible_numbers_name_the_key(change, message):
    numbers = {key: value for key, value in {**NUMBERS, **change}.items() if value is not None}
    with pytest.raises(er.InputError, match=message):
        er.load_scene("headset").with_({"eye": {"biometry": numbers}})


def test_biometry_stands_beside_no_other_eye():
    with pytest.raises(er.InputError, match=r"^biometry: cannot stand beside 'model'"):
        er.Eye("E4", biometry=NUMBERS)
    with pytest.raises(er.InputError, match=r"^retina: cannot stand beside 'biometry'"):
        EyeSpec.from_mapping({"biometry": NUMBERS, "retina": {}})


def test_datasets_name_an_eye_file_and_own_scenes_keep_their_eye(tmp_path):
    scene = er.load_scene("headset").with_({"eye": {"biometry": NUMBERS}})
    spec = {"format": 3, "kind": "dataset", "name": "d", "count": 1, "scene": scene.spec.to_mapping()}
    with pytest.raises(er.InputError, match=r"scene.eye.biometry: write it to an eye file"):
        Plan.of(er.DatasetSpec.from_mapping(spec))
    for given in (scene, scene.spec, scene.spec.to_mapping()):
        made = given_scene(given, {}, tmp_path)
        assert EyeSpec.from_mapping(made.eye) == scene.eye_spec
