"""Eye files of format 1 give the eye that they always gave."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml

from eyerender.base.errors import InputError
from eyerender.eye.catalogue import load_eye
from eyerender.eye.format1 import upgraded
from eyerender.eye.parts import GradientLensSpec
from eyerender.eye.spec import EyeSpec
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.optics.transforms import rotation_x, rotation_y, rotation_z, tilt_rotation
from tests.support.surfaces import centre_of

CENTRED: list[tuple[dict[str, Any], list[float]]] = [
    ({"kind": "sphere", "radius_mm": 7.8}, [-7.8, 0.3, -0.2]),
    ({"kind": "conic", "radius_mm": 7.8, "conic_constant": -0.25}, [-10.4, 0.3, -0.2]),
    ({"kind": "ellipsoid", "semi_axes_mm": [10.4, 9.0, 9.1]}, [-10.4, 0.3, -0.2]),
]


def old(name="E2", **cornea):
    data = load_eye(name).to_mapping() | {"format": 1}
    data["cornea"][0] |= cornea
    return data


@pytest.mark.parametrize("order", ["zyx", "xyz"])
@pytest.mark.parametrize(("shape", "centre"), CENTRED, ids=[c[0]["kind"] for c in CENTRED])
def test_a_surface_placed_by_its_centre_still_turns_about_it(shape, centre, order):
    tilt = [3.0, 2.0, 5.0]
    data = old(shape=shape, position_mm=centre, tilt_deg=tilt, placed_by="centre", tilt_order=order)
    surface = EyeSpec.from_mapping(data).build().front[0]
    about_x, about_y, about_z = (
        turn(np.radians(a)) for turn, a in zip((rotation_x, rotation_y, rotation_z), tilt, strict=True)
    )
    turn = about_z @ about_y @ about_x if order == "zyx" else about_x @ about_y @ about_z
    np.testing.assert_allclose(surface.rotation, turn, atol=1e-15)
    assert isinstance(surface, Quadric)
    np.testing.assert_allclose(centre_of(surface), centre, atol=1e-14)


@pytest.mark.parametrize("tilt", [[10.0, -20.0, 30.0], [3.0, 90.0, 5.0], [0.0, -90.0, 0.0], [200.0, 100.0, -170.0]])
def test_a_tilt_in_the_other_order_is_the_same_rotation(tilt):
    data = old() | {"retina": load_eye("E2").to_mapping()["retina"] | {"tilt_deg": tilt, "tilt_order": "xyz"}}
    found = tilt_rotation(np.radians(upgraded(data)["retina"]["tilt_deg"]))
    x, y, z = np.radians(tilt)
    np.testing.assert_allclose(found, rotation_x(x) @ rotation_y(y) @ rotation_z(z), atol=1e-15)


def test_twice_the_shells_rate_gives_the_layers_that_it_stood_for():
    data = old("E5")
    data["lens"] |= {"shells": 4, "index_rate": 2}
    spec = EyeSpec.from_mapping(data)
    assert isinstance(spec.lens, GradientLensSpec)
    assert spec.lens.shells is None
    assert [(layer.size, layer.index_share) for layer in spec.lens.layers] == [
        (1.0, 0.0), (1.0, 0.25), (np.sqrt(7 / 8), 0.5), (np.sqrt(6 / 8), 0.75), (np.sqrt(5 / 8), 1.0)
    ]  # fmt: skip
    assert len(spec.build().back) == 10


def test_a_file_without_these_keys_is_the_same_eye_and_is_written_in_the_latest(tmp_path):
    file = tmp_path / "eye.yaml"
    for name in ("E1", "E4", "E5"):
        data = old(name)
        for surface in data["cornea"]:
            surface |= {"placed_by": "apex", "tilt_order": "zyx"}
        if name == "E5":
            data["lens"]["index_rate"] = 1
        file.write_text(yaml.safe_dump(data), encoding="utf-8")
        spec = EyeSpec.load(file)
        assert spec == load_eye(name)
        assert "format: 3\n" in spec.to_yaml()


@pytest.mark.parametrize(
    ("change", "path", "reason"),
    [
        ({"placed_by": "middle"}, "cornea.0.placed_by", "must be 'apex' or 'centre', not 'middle'"),
        ({"placed_by": None}, "cornea.0.placed_by", "must be 'apex' or 'centre', not None"),
        ({"tilt_order": ["xyz"]}, "cornea.0.tilt_order", "must be 'zyx' or 'xyz'"),
        ({"shape": {"kind": "biconic", "radii_mm": [7.7, 7.8], "conic_constants": [0.0, 0.0]}, "placed_by": "centre"},
         "cornea.0.placed_by", "a biconic is placed by its apex"),
        ({"shape": {"kind": "conic", "radius_mm": 7.8, "conic_constant": -1.0}, "placed_by": "centre"},
         "cornea.0.placed_by", "a paraboloid has no centre"),
        ({"shape": {"kind": "sphere", "radius_mm": "wide"}, "placed_by": "centre"},
         "cornea.0.shape.radius_mm", "number"),
        ({"shape": {"kind": "ellipsoid"}, "placed_by": "centre"}, "cornea.0.shape.semi_axes_mm", "missing"),
        ({"shape": "round", "placed_by": "centre"}, "cornea.0.shape", ""),
        ({"position_mm": [10**400, 0.0, 0.0], "placed_by": "centre"}, "cornea.0.position_mm.0", ""),
        ({"tilt_deg": [float("nan"), 0.0, 0.0], "tilt_order": "xyz"}, "cornea.0.tilt_deg.0", "finite"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line_with_its_path(change, path, reason):
    with pytest.raises(InputError) as caught:
        EyeSpec.from_mapping(old(**change), source="eye.yaml")
    assert (caught.value.source, caught.value.path) == ("eye.yaml", path)
    assert reason in caught.value.reason


def test_bad_rates_are_refused():
    for lens, path, reason in (
        ({"index_rate": 2}, "lens.index_rate", "must be 1 without 'shells'"),
        ({"index_rate": 3, "shells": 4}, "lens.index_rate", "must be 1 or 2, not 3"),
        ({"index_rate": True, "shells": 4}, "lens.index_rate", "must be 1 or 2, not True"),
        ({"index_rate": 2, "shells": 0}, "lens.shells", "must be >= 1"),
    ):
        data = old("E5")
        data["lens"] |= lens
        with pytest.raises(InputError) as caught:
            EyeSpec.from_mapping(data)
        assert caught.value.path == path
        assert reason in caught.value.reason


def test_a_later_format_is_refused(tmp_path):
    file = tmp_path / "eye.yaml"
    file.write_text(yaml.safe_dump(old() | {"format": 4}), encoding="utf-8")
    with pytest.raises(InputError, match="format: is 4; this version reads format 1, 2 and 3"):
        EyeSpec.load(file)


def test_a_file_of_format_2_is_the_same_eye(tmp_path):
    file = tmp_path / "eye.yaml"
    file.write_text(yaml.safe_dump(load_eye("E5").to_mapping() | {"format": 2}), encoding="utf-8")
    assert EyeSpec.load(file) == load_eye("E5")
