"""Wrong arguments of the public functions and classes end with one line that names the argument."""

from __future__ import annotations

import inspect
import re
from typing import Any

import numpy as np
import pytest

import eyerender

er: Any = eyerender  # whose types forbid what is tried here

FUNCTIONS = [name for name in dir(er) if inspect.isfunction(getattr(er, name))]
PARAMETERS = [
    (function, name)
    for function in FUNCTIONS
    for name, one in inspect.signature(getattr(er, function)).parameters.items()
    if one.kind != one.VAR_KEYWORD
]


@pytest.mark.parametrize(("function", "name"), PARAMETERS)
def test_each_argument_of_a_wrong_type_is_named(function, name):
    with pytest.raises(er.InputError, match=rf"^{function}: {name}: must be .*, not ") as refused:
        getattr(er, function)(**{name: object()})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: er.generate("dataset_quick", "out", count="20"), "count: must be a whole number or None, not '20'"),
        (lambda: er.generate("dataset_quick", "out", count=True), "count: must be a whole number"),
        (lambda: er.detect("x.png"), "images: must be EyeImage or a series of EyeImage, not 'x.png'"),
        (lambda: er.extract("x.png"), "image: must be an array, not 'x.png'"),
        (lambda: er.load_scene({"format": 2}), "scene: must be text or a path"),
        (lambda: er.load_scene("hedset"), "did you mean headset?"),
        (lambda: er.Eye("E44"), "E44: no such eye; did you mean E4?"),
        (lambda: er.gaze.Regression("R33"), "'R33' is not a regression function; did you mean R3?"),
        (lambda: er.Camera(distortion={"k1": -0.2}), r"must be the five numbers \[k1, k2, p1, p2, k3\]"),
        (lambda: er.Camera(distortion=[0.1]), r"must be the five numbers \[k1, k2, p1, p2, k3\]"),
    ],
)
def test_what_is_wrong_ends_with_what_to_write(call, words):
    with pytest.raises(er.InputError, match=words):
        call()


def test_a_misspelt_name_is_answered_with_a_near_one():
    with pytest.raises(AttributeError, match=re.escape("eyerender has no 'renderr'; did you mean render?")):
        _ = er.renderr


def test_a_name_of_a_namespace_is_found():
    with pytest.raises(
        AttributeError, match=re.escape("eyerender has no 'Regression'; write eyerender.gaze.Regression")
    ):
        _ = er.Regression


def test_a_function_takes_what_its_annotation_names(tmp_path):
    scene = er.load_scene("quickstart", spp=np.int64(2), eye=None)
    assert er.trace(scene, boundary_points=np.int32(12)).pupil.points_px.shape[-2] == 12
    assert er.sensor_noise(scene, fixation_deg=0) is not None
    assert er.render is er.render
    assert er.load_eye.__doc__.startswith("Load an eye of the catalogue")


def test_an_eye_distance_in_metres_warns():
    spec = er.load_scene("headset").spec
    with pytest.warns(UserWarning, match=r"subject\.ipd_mm: is 0\.063 mm; lengths are in mm; did you mean metres\?"):
        er.Scene(er.Subject(er.Eye("E2"), ipd_mm=0.063), spec.rig, targets=spec.targets)


@pytest.mark.parametrize("data", [b"PK\x03\x04 workbook", b"\xd0\xcf\x11\xe0 workbook"])
def test_an_excel_workbook_is_called_what_it_is(tmp_path, data):
    path = tmp_path / "features.csv"
    path.write_bytes(data)
    with pytest.raises(er.InputError, match=r"features\.csv: is an Excel workbook .* save the sheet as CSV"):
        er.load_scene(path)
