"""What deviations of a unit cost: linear errors against least squares that are solved again for moved rigs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import eyerender as er
from eyerender.cli.main import run
from eyerender.design import people, tolerances
from eyerender.design.information import whitened_rows
from eyerender.design.noise import FeatureNoise
from eyerender.design.tolerances import Tolerances, unit_errors
from eyerender.design.unknowns import LOCAL, Unknowns
from eyerender.design.varied import images_of, lines_of_sight, slopes_of, tangents
from eyerender.scene.spec import SceneSpec

ROTATION = {"part": "camera", "quantity": "rotation_deg", "sd": 0.2}
LENGTH = {"part": "camera", "quantity": "focal_length_percent", "sd": 0.5}
PLACE = {"part": "led", "number": 0, "quantity": "position_mm", "sd": 0.1}


@pytest.fixture(scope="module")
def survey():
    known = Unknowns(slippage_mm=2.0, corneal_radius_mm=0.28, kappa_deg=2.0)
    return people.RigPopulation(
        scene=er.load_scene("headset").spec.to_mapping(), population=er.Population("adults").to_mapping(),
        unknowns=known.to_mapping(), lids=False,
    )  # fmt: skip


def solved_deg(survey, axis, cell):
    """Error of gaze in one direction: one least squares over nine frames with targets and one frame without.

    The features are those of the rig that is moved by one standard deviation, before or only after the calibration.
    """
    scene = er.Scene.of(er.load_scene("headset").spec)
    noise = FeatureNoise.of(0.2, 0.1, rig=scene.rig)
    ((case, _),) = people.cases_of(survey, 1)
    rows = np.array([*people.CALIBRATION_CELLS, cell])
    views, theta = case.instants.take(rows), case.theta[rows]
    point, way = lines_of_sight(views, theta)
    target = point + 1000.0 * way
    moved = replace(views, rig=axis.moved(axis.sd))
    slopes = slopes_of(views, theta, people.POINTS)
    clean, other = (images_of(one, theta, people.POINTS) for one in (views, moved))
    is_moved = np.arange(len(rows)) >= (0 if axis.before else len(rows) - 1)
    data = replace(clean, **{
        name: np.where(is_moved[:, None, None], getattr(other, name), getattr(clean, name))
        for name in ("outline_px", "glints_px")
    })  # fmt: skip
    unknowns = Unknowns.from_mapping(survey.unknowns)
    free, precision = unknowns.free(), unknowns.precision()
    own, person = np.flatnonzero(free[:LOCAL]), LOCAL + np.flatnonzero(free[LOCAL:])

    def unpacked(x):
        out = np.array(theta)
        out[:, own] += x[: len(rows) * len(own)].reshape(len(rows), -1)
        out[:, person] += x[len(rows) * len(own) :]
        return out

    def residuals(x):
        at = unpacked(x)
        seen = images_of(views, at, people.POINTS)
        gap = {name: np.nan_to_num(getattr(seen, name) - getattr(data, name)) for name in ("outline_px", "glints_px")}
        as_slopes = replace(slopes, outline=gap["outline_px"][..., None], glints=gap["glints_px"][..., None])
        features = whitened_rows(as_slopes, noise, views.camera)
        start, direction = lines_of_sight(views, at)
        aim = target - start
        aim /= np.linalg.norm(aim, axis=1, keepdims=True)
        miss = np.einsum("nij,nj->ni", tangents(aim), direction) / np.radians(noise.fixation_deg)
        change = at - theta
        prior = [change[:, own] * np.sqrt(precision[own]), change[:1, person] * np.sqrt(precision[person])]
        return np.concatenate([features.ravel(), miss[:-1].ravel(), *(part.ravel() for part in prior)])

    size = len(rows) * len(own) + len(person)
    found = least_squares(residuals, np.zeros(size), x_scale="jac", method="trf", diff_step=1e-7, max_nfev=20)
    _, direction = lines_of_sight(views, unpacked(found.x))
    return np.degrees(np.einsum("ij,j->i", tangents(way[-1:])[0], direction[-1]))


# Linear in deviations of a size whose errors are some tenths of a degree: 5 % and .002 deg.
@pytest.mark.parametrize(
    ("one", "when", "axis"),
    [
        pytest.param(ROTATION, "after", 0, marks=pytest.mark.slow, id="turned later"),
        pytest.param(ROTATION, "before", 1, id="turned at assembly"),
        pytest.param(LENGTH, "before", 0, marks=pytest.mark.slow, id="focal length"),
        pytest.param(PLACE, "after", 1, marks=pytest.mark.slow, id="LED later"),
        pytest.param(PLACE, "before", 2, marks=pytest.mark.slow, id="LED at assembly"),
    ],
)
def test_errors_are_those_of_solved_scenes(survey, one, when, axis):
    given = Tolerances.from_mapping({"tolerances": [{**one, "when": when}]})
    scene = er.Scene.of(er.load_scene("headset").spec)
    found = unit_errors(survey, given, FeatureNoise.of(0.2, 0.1, rig=scene.rig), 1)
    moving = list(tolerances.axes_of(scene, given))[axis]
    expected = solved_deg(survey, moving, 20)
    np.testing.assert_allclose(found.errors_deg[0, 20, axis], expected, rtol=0.05, atol=0.002)


def test_units_are_drawn_from_the_axes(survey):
    """The mean square over drawn units is the sum over the axes, and a larger deviation costs in proportion."""
    given = Tolerances.from_mapping(
        {"tolerances": [{**ROTATION, "when": "after"}, {**ROTATION, "sd": 0.4, "when": "after"}]}
    )
    scene = er.Scene.of(er.load_scene("headset").spec)
    found = unit_errors(survey, given, FeatureNoise.of(0.2, 0.1, rig=scene.rig), 2)
    small, large = found.by_tolerance(2)
    assert large == pytest.approx(2 * small, rel=1e-3)
    drawn = found.of_units(0, 2000).reshape(2, 2000, -1)
    expected = (found.errors_deg**2).sum(axis=(2, 3))
    assert np.nanmean(drawn**2, axis=1) == pytest.approx(expected, rel=0.2)  # six axes: 5 SD of a chi^2 of 2,000 draws


def test_a_mirror_that_turns_moves_the_picture_twice(survey):
    """A mirror at 45 degrees turned by e turns what the camera sees by 2 e."""
    data = er.load_scene("headset").spec.to_mapping()
    del data["rig"]["obstacles"]
    data["rig"]["cameras"][0]["mirror"] = {"point_mm": [20, -31.5, -10], "normal": [1, 0, -0.3]}
    scene = er.Scene.of(SceneSpec.from_mapping(data))
    for axis in (0, 1):
        turned = tolerances._with_mirror(scene, 0, "rotation_deg", axis, 0.1).cameras[0]
        change = turned.R @ scene.rig.cameras[0].R.T
        angle = np.degrees(np.arccos(np.clip((np.trace(change) - 1) / 2, -1, 1)))
        assert angle == pytest.approx(0.2, rel=1e-4)  # two reflections at planes that differ by e turn by 2 e
    shifted = tolerances._with_mirror(scene, 0, "position_mm", 0, 0.5).cameras[0]
    assert np.linalg.norm(shifted.nodal_point_mm - scene.rig.cameras[0].nodal_point_mm) == pytest.approx(1.0)


def test_the_command(tmp_path, capsys):
    path = tmp_path / "tolerances.yaml"
    lines = ["format: 1", "tolerances:", "- {part: camera, quantity: rotation_deg, sd: 0.2, when: after}",
             "- {part: led, number: 0, quantity: power_percent, sd: 10, when: before}"]  # fmt: skip
    path.write_text("\n".join(lines))
    base = ["rig", "headset", "--people", "1", "--sample", "0", "--workers", "1"]
    assert run([*base, "-o", str(tmp_path / "out"), "--tolerances", str(path), "--json", str(tmp_path / "r.json")]) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    first, second = found["tolerances"]
    assert {**ROTATION, "number": "all", "when": "after"}.items() <= first.items()
    assert 0.1 < first["gaze_deg"] < 0.6
    assert second["gaze_deg"] is None or second["gaze_deg"] == 0.0
    assert found["units"]["units"] == 200
    assert "What costs how much?" in (tmp_path / "out" / "report.html").read_text()
    for bad, reason in [
        ("- {part: led, number: 8, quantity: position_mm, sd: 1, when: after}", "0.number: the rig has no led 8"),
        ("- {part: led, quantity: rotation_deg, sd: 1, when: after}", "a led has position_mm, power_percent"),
        ("- {part: mirror, quantity: position_mm, sd: 1, when: after}", "the rig has no such mirror"),
        ("- {part: led, quantity: position_mm, sd: -1, when: after}", "tolerances.0.sd"),
        (
            "- {part: camera, quantity: rotation_deg, sd: 20, when: after}",
            "must be at most 10 for rotation_deg, not 20",
        ),
    ]:
        path.write_text("\n".join([*lines[:2], bad]))
        assert run([*base, "-o", str(tmp_path / "no"), "--tolerances", str(path)]) == 2
        error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
        assert len(error) == 1
        assert reason in error[0]
        assert error[0].startswith(f"error: {path}: tolerances.0")
        assert not (tmp_path / "no").exists()


def test_drawn_units_deviate_as_stated_and_by_nothing_else():
    """Over 400 units each deviation has its standard deviation (12 %: 3.4 SD of an estimate from 400 draws)."""
    scene = er.load_scene("headset")
    given = Tolerances.from_mapping({"tolerances": [
        {**ROTATION, "when": "before"}, {**LENGTH, "when": "after"}, {**PLACE, "when": "after"},
        {"part": "led", "number": 1, "quantity": "power_percent", "sd": 5.0, "when": "after"},
    ]})  # fmt: skip
    units = [tolerances.drawn_unit(scene.spec.rig, given, (7, k)).build() for k in range(400)]
    plain, old = scene.rig, scene.rig.cameras[0]
    turns = [one.cameras[0].R @ old.R.T for one in units]
    angles = np.degrees([[R[2, 1], R[0, 2], R[1, 0]] for R in turns])
    assert angles.std(axis=0) == pytest.approx(0.2, rel=0.12)
    lengths = [one.cameras[0].K[0, 0] / old.K[0, 0] - 1 for one in units]
    assert np.std(lengths) == pytest.approx(0.005, rel=0.12)
    moves = np.array(
        [[a.position_mm - b.position_mm for a, b in zip(u.lights, plain.lights, strict=True)] for u in units]
    )
    assert moves[:, 0].std(axis=0) == pytest.approx(0.1, rel=0.12)
    np.testing.assert_allclose(moves[:, 1:], 0.0, atol=1e-9)
    power = np.array([[lamp.intensity_mw_sr for lamp in u.lights] for u in units]) / plain.lights[0].intensity_mw_sr
    assert power[:, 1].std() == pytest.approx(0.05, rel=0.12)
    np.testing.assert_allclose(np.delete(power, 1, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose([u.cameras[0].nodal_point_mm for u in units], np.tile(old.nodal_point_mm, (400, 1)))


def test_each_subject_of_a_dataset_has_a_unit_that_labels_state(tmp_path):
    file = tmp_path / "tolerances.yaml"
    file.write_text(f"format: 1\ntolerances:\n- {json.dumps({**ROTATION, 'when': 'before'})}\n")
    spec = tmp_path / "units.yaml"
    spec.write_text(
        "format: 3\nkind: dataset\nextends: dataset_quick\ncount: 4\nsubjects: 2\ntolerances: tolerances.yaml\n"
    )
    drawn = [er.sample(spec, k) for k in range(4)]
    turns = [one.scene.rig.cameras[0].R for one in drawn]
    np.testing.assert_array_equal(turns[0], turns[1])
    assert np.abs(turns[0] - turns[2]).max() > 1e-4
    stated = drawn[2].sample.scene["rig"]["cameras"][0]["calibration"]["R"]  # `scene_json` of the metadata
    np.testing.assert_allclose(stated, turns[2], atol=1e-12)
