"""The spec language: shared and correlated draws, tables, specs that extend others, and mistakes that are named."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.dataset.expressions import evaluate, names_of
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of
from tests.support.dataset_specs import mapping, plan, write

PUPIL = "scene.eye.pupil_diameter_mm"


def drawn(made, count, read):
    return np.array([read(made.draw(i).scene) for i in range(count)])


def pupil(scene):
    return scene["eye"]["pupil_diameter_mm"]


def test_a_shared_variable_is_the_same_value_in_every_place():
    power = {"draw": "uniform", "low": 50.0, "high": 150.0}
    data = mapping(variables={"power": power})
    for light in data["scene"]["rig"]["lights"]:
        light["intensity_mw_sr"] = {"var": "power"}
    data["scene"]["sensor"]["exposure_ms"] = {"var": "1500 / power"}
    from eyerender.dataset.spec import DatasetSpec

    made = Plan.of(DatasetSpec.from_mapping(data))
    for i in range(24):
        sample = made.draw(i)
        a, b = (light["intensity_mw_sr"] for light in sample.scene["rig"]["lights"])
        assert a == b == sample.draws["variables.power"]
        assert sample.scene["sensor"]["exposure_ms"] == 1500 / a
    assert len({made.draw(i).draws["variables.power"] for i in range(24)}) == 24
    # Another process draws the same.
    assert Plan.from_mapping(made.to_mapping(), made.base).draw(3).to_mapping() == made.draw(3).to_mapping()


def test_a_variable_of_a_subject_changes_the_eye_and_the_scene_together():
    size = {"draw": "normal", "mean": 0.0, "sd": 1.0, "per": "subject"}
    made = plan(
        variables={"z": size},
        eye_parameters={"E2": {"cornea.0.shape.radius_mm": {"var": "7.8 + 0.1 * z"}}},
        **{PUPIL: {"var": "4 + 0.2 * z"}},
    )
    radii = [made.draw(i).eye["cornea"][0]["shape"]["radius_mm"] for i in range(24)]
    np.testing.assert_allclose(drawn(made, 24, pupil) - 4, 2 * (np.array(radii) - 7.8), atol=1e-12)
    assert len(set(radii)) == 4
    with pytest.raises(InputError, match="once per subject; write 'per: subject' for 'z'"):
        plan(
            variables={"z": {**size, "per": "sample"}},
            eye_parameters={"E2": {"cornea.0.shape.radius_mm": {"var": "7.8 + 0.1 * z"}}},
        )


def test_correlated_draws_have_their_covariance():
    """Within three standard errors of a sample covariance of normal numbers (Wishart)."""
    mean, covariance = [4.0, 63.0], [[0.25, 0.6], [0.6, 9.0]]
    n = 4000
    made = plan(
        count=n,
        subjects=None,
        variables={"both": {"draw": "multivariate_normal", "mean": mean, "covariance": covariance}},
        **{PUPIL: {"var": "both[0]"}, "scene.subject.ipd_mm": {"var": "both[1]"}},
    )
    values = np.array([made.variable_template.values(_turn(i))[0]["variables"]["both"] for i in range(n)])
    c = np.array(covariance)
    found = np.cov(values.T)
    for j in range(2):
        assert abs(values[:, j].mean() - mean[j]) < 3 * math.sqrt(c[j, j] / n)
        for k in range(2):
            assert abs(found[j, k] - c[j, k]) < 3 * math.sqrt((c[j, j] * c[k, k] + c[j, k] ** 2) / n)
    scene = made.draw(7).scene
    assert [pupil(scene), scene["subject"]["ipd_mm"]] == values[7].tolist()


def _turn(sample):
    from eyerender.dataset.template import Turn

    return Turn(sample=sample, subject=sample, sequence=0, attempt=0, subject_attempt=0)


def test_beta_and_mixtures_have_their_moments():
    n = 3000
    made = plan(
        count=n,
        subjects=None,
        variables={
            "b": {"draw": "beta", "a": 2.0, "b": 6.0, "low": 2.0, "high": 6.0},
            "m": {
                "draw": "mixture",
                "components": [
                    {"weight": 3, "draw": "normal", "mean": 3.0, "sd": 0.1},
                    {"weight": 1, "draw": "uniform", "low": 5.0, "high": 6.0},
                ],
            },
        },
    )
    values = [made.variable_template.values(_turn(i))[0]["variables"] for i in range(n)]
    b, m = (np.array([v[name] for v in values]) for name in "bm")
    sd = 4 * math.sqrt(2 * 6 / (8**2 * 9))
    assert abs(b.mean() - 3.0) < 3 * sd / math.sqrt(n)
    assert b.std() == pytest.approx(sd, rel=0.06)  # three standard errors of a standard deviation are 4 %
    assert abs((m > 4.5).mean() - 0.25) < 3 * math.sqrt(0.25 * 0.75 / n)
    assert abs(m[m < 4.5].mean() - 3.0) < 3 * 0.1 / math.sqrt(0.7 * n)
    assert m[m > 4.5].min() >= 5.0


def test_rows_of_a_table_are_drawn_whole_with_their_weights(tmp_path):
    (tmp_path / "people.csv").write_text("pupil,ipd,w\n3,60,1\n4,63,0\n5,66,3\n")
    path = write(
        tmp_path / "spec.yaml",
        count=150,
        subjects=None,
        variables={"row": {"draw": "table", "file": "people.csv", "weights": "w"}},
        **{PUPIL: {"var": "row.pupil"}, "scene.subject.ipd_mm": {"var": "row.ipd"}},
    )
    made = Plan.load(path)
    scenes = [made.draw(i).scene for i in range(150)]
    pairs = [(pupil(scene), scene["subject"]["ipd_mm"]) for scene in scenes]
    assert set(pairs) == {(3.0, 60.0), (5.0, 66.0)}
    assert abs(pairs.count((3.0, 60.0)) / 150 - 0.25) < 3 * math.sqrt(0.25 * 0.75 / 150)
    (tmp_path / "people.csv").write_text("pupil,ipd,w\n3,sixty,1\n")
    with pytest.raises(InputError, match=r"people.csv: line 2: every cell must be a number"):
        Plan.load(path)


def test_a_spec_extends_another(tmp_path):
    write(tmp_path / "base.yaml")
    child: dict[str, Any] = {"format": 3, "kind": "dataset", "extends": "base.yaml", "name": "child"}
    child["scene"] = {"image": {"spp": 3}, "eye": {"pupil_diameter_mm": {"draw": "normal", "mean": 4, "sd": 0.1}}}
    (tmp_path / "child.yaml").write_text(yaml.safe_dump(child))
    expected = mapping(name="child", **{"scene.image.spp": 3, PUPIL: child["scene"]["eye"]["pupil_diameter_mm"]})
    made = Plan.load(tmp_path / "child.yaml")
    assert made.spec.scene == expected["scene"]
    assert made.digest == Plan.of(type(made.spec).from_mapping(expected)).digest
    (tmp_path / "child.yaml").write_text(yaml.safe_dump({**child, "splits": {"rest": 0.8, "test": 0.2}}))
    assert Plan.load(tmp_path / "child.yaml").spec.splits == {"rest": 0.8, "test": 0.2}
    (tmp_path / "base.yaml").write_text(yaml.safe_dump({"extends": "base.yaml"}))
    with pytest.raises(InputError, match=r"child.yaml: extends: must be a dataset file"):
        Plan.load(tmp_path / "child.yaml")
    (tmp_path / "child.yaml").write_text(yaml.safe_dump({**child, "extends": "nowhere"}))
    with pytest.raises(InputError, match=r"child.yaml: extends: no such dataset file"):
        Plan.load(tmp_path / "child.yaml")


def test_an_aliased_draw_is_warned_of(tmp_path):
    text = yaml.safe_dump(mapping())
    draw = "{draw: uniform, low: 50, high: 150}"
    text = text.replace("intensity_mw_sr: 100.0", f"intensity_mw_sr: &power {draw}", 1)
    text = text.replace("intensity_mw_sr: 100.0", "intensity_mw_sr: *power", 1)
    (tmp_path / "spec.yaml").write_text(text)
    found = [str(w) for w in Plan.load(tmp_path / "spec.yaml").warnings() if w.code == "alias"]
    assert len(found) == 1
    assert "scene.rig.lights.1.intensity_mw_sr: is an alias of scene.rig.lights.0.intensity_mw_sr" in found[0]
    assert not Plan.load(write(tmp_path / "plain.yaml")).warnings()


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"darw": "uniform", "low": 3, "high": 5}, "pupil_diameter_mm.darw: unknown key; did you mean 'draw'?"),
        ({"draw": "uniform", "low": 3, "hihg": 5}, "pupil_diameter_mm.hihg: unknown key"),
        ({"var": "x + y"}, "pupil_diameter_mm: there is no variable 'y'; the spec has x"),
        ({"var": "x", "low": 3}, "pupil_diameter_mm: no other key may be combined with 'var'"),
        ({"var": "__import__('os')"}, "pupil_diameter_mm: \"__import__('os')\" is not made of numbers"),
        ({"draw": "multivariate_normal", "mean": [1, 2], "covariance": [[1, 2], [2, 1]]}, "positive definite"),
        (
            {"draw": "mixture", "components": [{"draw": "fixed", "value": 3}]},
            "components.0: must be a draw with a weight",
        ),
    ],
)
def test_mistakes_are_named_at_once(value, words):
    with pytest.raises(InputError) as caught:
        plan(variables={"x": 3.0}, **{PUPIL: value})
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2),
        ("-x ** 2 + 1", -8.0),
        ("max(x, v[1], row.a) / 2", 3.5),
        ("exp(log(x))", pytest.approx(3.0)),
        ("v", [4, 7]),
    ],
)
def test_expressions_are_arithmetic(text, value):
    assert evaluate(text, {"x": 3.0, "v": [4, 7], "row": {"a": 5.0}}) == value
    assert names_of("max(x, v[1], row.a)") == {"x", "v", "row"}


@pytest.mark.parametrize(
    "text",
    ["x.__class__.a", "x if x else 1", "[x for x in v]", "open('f')", "lambda: 1", "x @ x", "'a'", "v[x]", "1" * 300],
)
def test_nothing_else_is_an_expression(text):
    with pytest.raises(InputError):
        names_of(text)


@pytest.mark.parametrize("text", ["1 / (x - x)", "row", "v[9]", "9.0 ** 9999", "sqrt(-x)", "v + 1"])
def test_what_cannot_be_computed_is_reported(text):
    with pytest.raises(InputError, match=r"cannot be computed|is not a number"):
        evaluate(text, {"x": 3.0, "v": [4, 7], "row": {"a": 5.0}})


@pytest.mark.packaging
def test_a_spec_with_variables_can_be_drawn_by_the_command(tmp_path):
    path = write(
        tmp_path / "spec.yaml", variables={"d": {"draw": "normal", "mean": 4, "sd": 0.1}}, **{PUPIL: {"var": "d"}}
    )
    assert frames_of(Plan.load(path)) == 1
    done = subprocess.run([sys.executable, "-m", "eyerender", "sample", str(path), "3"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    data = yaml.safe_load(done.stdout)
    assert data["scene"]["eye"]["pupil_diameter_mm"] == data["draws"]["variables.d"]
