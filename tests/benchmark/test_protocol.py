"""What an extractor may say, and what is refused with a reason."""

from __future__ import annotations

import itertools
import json
import math

import cv2
import numpy as np
import pytest

from eyerender.apps.benchmark.protocol import OPENCV, Conventions, Greeting, Reply, Request
from eyerender.base.errors import InputError
from eyerender.optics.ellipse import Ellipse, signed_distance

GOOD = {"status": "ok", "centre_px": [10, 20], "semi_axes_px": [5, 4], "angle_rad": 0.1}


def reply(pupil, glints=(), **more):
    return json.dumps({"id": 3, "record": {"pupil": pupil, "glints": list(glints)}, **more})


def test_a_request_is_one_line_of_json():
    line = Request(3, "/a b/ü.png", 16, {"radius_px": None}).to_line()
    assert line.count("\n") == 1
    data = json.loads(line)
    assert data["schema"] == "eyerender/extractor/1"
    assert (data["id"], data["image"], data["bit_depth"]) == (3, "/a b/ü.png", 16)


def test_names_with_units_say_what_they_are_whatever_is_declared():
    got = Reply.parse(reply(GOOD), 3, OPENCV)
    assert got.ellipse.semi_axes_px.tolist() == [5, 4]
    assert got.ellipse.angle_rad == pytest.approx(0.1)


def test_axes_and_angle_are_as_declared():
    got = Reply.parse(
        reply({"status": "ok", "centre_px": [10, 20], "axes_px": [8, 10], "angle": 90.0}, [{"xy_px": [1, 2]}]),
        3,
        Conventions(pixel_origin="corner", axes="full", angle_unit="deg", angle_of="first"),
    )
    assert got.ellipse.centre_px.tolist() == [9.5, 19.5]
    assert got.ellipse.semi_axes_px.tolist() == [5, 4]
    assert math.sin(got.ellipse.angle_rad) == pytest.approx(0.0, abs=1e-12)
    assert got.glints == (((0.5, 1.5), None),)


def test_a_record_of_this_package_is_a_reply(drawn):
    lines = (drawn / "metadata.jsonl").read_text().splitlines()
    for line in lines:
        record = json.loads(line)["records"][0]
        got = Reply.parse(json.dumps({"id": 0, "record": record}), 0, Conventions())
        assert got.ellipse.centre_px.tolist() == record["pupil"]["centre_px"]
        assert [light for _, light in got.glints] == [g["light"] for g in record["glints"] if g["status"] == "ok"]


def test_missing_and_errors_are_results():
    missing = Reply.parse(reply({"status": "missing", "reason": "too dark"}), 3, Conventions())
    assert (missing.ellipse, missing.reason, missing.error) == (None, "too dark", None)
    broken = Reply.parse('{"id": 3, "error": "no\\nlicence"}', 3, Conventions())
    assert broken.error == "no licence"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Segmentation fault", "printed a line that is not JSON: 'Segmentation fault'"),
        ("[" * 100_000, "printed a line that is not JSON"),
        ("[1, 2]", "not an object"),
        (reply(GOOD).replace('"id": 3', '"id": 4'), "id: must be 3, not 4"),
        ('{"id": 3}', "record: must hold the pupil"),
        (reply({"status": "found"}), "pupil.status: must be 'ok' or 'missing', not 'found'"),
        (reply({"status": "ok"}), "pupil.centre_px: must be two numbers, not None"),
        (reply({**GOOD, "centre_px": [1, math.nan]}), "pupil.centre_px.1: must be a finite number"),
        (reply({**GOOD, "centre_px": "12"}), "pupil.centre_px: must be two numbers"),
        (reply({**GOOD, "centre_px": [True, 1]}), "pupil.centre_px.0: must be a number, not True"),
        (reply({**GOOD, "semi_axes_px": [1e300, 1]}), "pupil.semi_axes_px.0: must be a finite number within"),
        (reply({**GOOD, "semi_axes_px": [10**400, 1]}), "pupil.semi_axes_px.0: must be a finite number within"),
        (reply({**GOOD, "semi_axes_px": [5, 0]}), "semi-axes must be > 0"),
        (reply({**GOOD, "semi_axes_px": [5, -4]}), "semi-axes must be > 0"),
        (reply({**GOOD, "angle_rad": None}), "pupil.angle_rad: must be a number"),
        (reply(GOOD, [{"xy_px": [1]}]), "glints.0.xy_px: must be two numbers"),
        (reply(GOOD, [{"xy_px": [1, 2], "light": "left"}]), "glints.0.light: must be a whole number or null"),
        (reply(GOOD, [{"xy_px": [1, 2]}] * 2000), "glints: must be a list of at most 1000"),
        (reply(GOOD, cpu_s="fast"), "cpu_s: must be a number"),
    ],
    ids=lambda v: v[:40],
)
def test_garbage_is_refused_with_the_reason(line, words):
    with pytest.raises(InputError) as caught:
        Reply.parse(line, 3, Conventions())
    assert words in str(caught.value)


def test_random_bytes_are_never_an_answer():
    rng = np.random.default_rng(1)
    text = reply(GOOD, [{"xy_px": [1, 2]}])
    accepted = 0
    for _ in range(500):
        mutated = list(text)
        for k in rng.integers(0, len(text), 3):
            mutated[k] = chr(rng.integers(32, 127))
        try:
            got = Reply.parse("".join(mutated), 3, Conventions())
        except InputError:
            continue
        accepted += 1
        assert got.ellipse is None or (np.isfinite(got.ellipse.centre_px).all() and got.ellipse.semi_axes_px.min() > 0)
    assert accepted < 250  # most mutations break the JSON or a name; some only change a digit


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Loading model ...", "not JSON"),
        ('{"schema": "eyerender/extractor/9", "name": "x"}', "this version speaks 'eyerender/extractor/1'"),
        ('{"schema": "eyerender/extractor/1"}', "name: must be a name"),
        ('{"schema": "eyerender/extractor/1", "name": "x", "reports": ["iris"]}', "reports: must name 'pupil'"),
        ('{"schema": "eyerender/extractor/1", "name": "x", "conventions": {"axes": "half"}}', "conventions.axes"),
    ],
)
def test_a_wrong_greeting_is_refused(line, words):
    with pytest.raises(InputError) as caught:
        Greeting.parse(line)
    assert words in str(caught.value)


def test_a_greeting_may_leave_out_what_is_usual():
    got = Greeting.parse('{"schema": "eyerender/extractor/1", "name": "x"}')
    assert (got.conventions, got.reports) == (Conventions(), ("pupil", "glints"))


COMBINATIONS = list(
    itertools.product(
        ("centre", "corner"), ("semi", "full"), ("rad", "deg"), ("major", "minor", "first"), ("down", "up")
    )
)


@pytest.mark.parametrize("words", COMBINATIONS, ids="-".join)
def test_every_convention_comes_back_as_the_same_outline(words):
    origin, axes, unit, of, toward = words
    rng = np.random.default_rng(7)
    conventions = Conventions.of(
        dict(zip(("pixel_origin", "axes", "angle_unit", "angle_of", "angle_toward"), words, strict=True))
    )
    for _ in range(10):
        x, y = rng.uniform(5, 90, 2)
        a, b = np.sort(rng.uniform(5, 40, 2))[::-1]
        phi = rng.uniform(-7, 7)  # of a, toward +y
        t = rng.uniform(0, 2 * math.pi, 50)
        outline = np.stack(
            [
                x + a * np.cos(t) * math.cos(phi) - b * np.sin(t) * math.sin(phi),
                y + a * np.cos(t) * math.sin(phi) + b * np.sin(t) * math.cos(phi),
            ],
            axis=-1,
        )
        # Either order of the axes; "first" is what then stands first.
        swap = bool(rng.integers(2))
        listed = [b, a] if swap else [a, b]
        angle = phi + (math.pi / 2 if of == "minor" or (of == "first" and swap) else 0.0)
        angle = -angle if toward == "up" else angle
        angle = math.degrees(angle) if unit == "deg" else angle
        factor = 2.0 if axes == "full" else 1.0
        shift = 0.5 if origin == "corner" else 0.0
        got = conventions.ellipse((x + shift, y + shift), (factor * listed[0], factor * listed[1]), angle)
        assert np.abs(signed_distance(got, outline)).max() < 1e-9  # rounding
        assert conventions.point((x + shift, y + shift)) == pytest.approx((x, y))


def test_opencv_s_rotated_rectangle_is_what_it_is_declared_to_be():
    truth = Ellipse(np.array([61.3, 48.7]), np.array([30.0, 18.0]), 0.7)
    got = OPENCV.ellipse(*cv2.fitEllipse(truth.points(60).astype(np.float32)))
    assert got.centre_px == pytest.approx(truth.centre_px, abs=1e-3)  # it fits in float32
    assert got.semi_axes_px == pytest.approx(truth.semi_axes_px, abs=1e-3)
    assert got.angle_rad == pytest.approx(truth.angle_rad, abs=1e-4)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"axis": "semi"}, "conventions.axis: unknown"),
        ({"axes": "diameter"}, "conventions.axes: must be one of semi, full"),
        ({"angle_unit": ["rad"]}, "conventions.angle_unit"),
        ("semi", "conventions: must be an object"),
    ],
)
def test_other_words_are_refused(stated, words):
    with pytest.raises(InputError, match=words):
        Conventions.of(stated)
