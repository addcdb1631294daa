"""Observations and their record: nothing is lost on the way to JSON and back."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.scene.observation import (
    GlintFeatures,
    Index,
    Observations,
    PoseTruth,
    PupilFeatures,
    PurkinjeFeatures,
    concatenate,
)


def observations(n: int = 4, seed: int = 0, points: int = 6, lights: int = 2) -> Observations:
    """A batch with a missing pupil (row 1), a missing glint (row 2) and an entry that is not there (row 3)."""
    rng = np.random.default_rng(seed)

    status = np.full(n, Status.OK)
    reason = np.full(n, None, dtype=object)
    centre, axes, angle = rng.uniform(0, 900, (n, 2)), np.sort(rng.uniform(5, 9, (n, 2)))[:, ::-1], rng.uniform(0, 3, n)
    anatomical, boundary, cov = rng.uniform(0, 900, (n, 2)), rng.uniform(0, 900, (n, points, 2)), rng.random((n, 5, 5))
    status[1], reason[1] = Status.NOT_FOUND, "coarse search: no dark blob"
    for a in (centre, axes, angle, anatomical, boundary, cov):
        a[1] = np.nan
    g_status, g_reason = np.full((n, lights), Status.OK), np.full((n, lights), None, dtype=object)
    xy, g_cov = rng.uniform(0, 900, (n, lights, 2)), rng.random((n, lights, 2, 2))
    light = np.tile(np.arange(lights), (n, 1))
    g_status[2, 0], g_reason[2, 0], xy[2, 0], g_cov[2, 0] = Status.OUTSIDE_LIMBUS, "outside the limbus", np.nan, np.nan
    g_status[3, 1], xy[3, 1], g_cov[3, 1], light[3, 1] = Status.NONE, np.nan, np.nan, -1
    return Observations(
        index=Index(
            frame=np.arange(n) // 2,
            fixation=np.arange(n) // 2,
            camera=np.zeros(n, int),
            head=np.zeros(n, int),
            eye=np.arange(n) % 2,
            eye_model=np.array(["E2"] * n, object),
            target_mm=rng.uniform(-300, 300, (n, 3)),
            head_mm=np.zeros((n, 3)),
            eye_position_mm=np.array([[0, -31.5, 0], [0, 31.5, 0]])[np.arange(n) % 2],
        ),
        pose=PoseTruth(
            azimuth_rad=np.radians(rng.uniform(-20, 20, n)),
            elevation_rad=np.radians(rng.uniform(-20, 20, n)),
            torsion_rad=np.radians(rng.uniform(-20, 20, n)),
            residual_mm=rng.random(n) * 1e-9,
        ),
        pupil=PupilFeatures(
            status=status,
            reason=reason,
            in_image=status == Status.OK,
            centre_px=centre,
            semi_axes_px=axes,
            angle_rad=angle,
            anatomical_centre_px=anatomical,
            points_px=boundary,
            covariance=cov,
        ),
        glints=GlintFeatures(
            status=g_status, light=light, reason=g_reason, in_image=g_status == Status.OK, xy_px=xy, covariance=g_cov
        ),
    )


def assert_same(a: Observations, b: Observations) -> None:
    """Equal up to the last bits that degrees and radians cost."""
    np.testing.assert_allclose(a.pose.azimuth_rad, b.pose.azimuth_rad, rtol=1e-14)
    np.testing.assert_allclose(a.pose.elevation_rad, b.pose.elevation_rad, rtol=1e-14)
    np.testing.assert_allclose(a.pose.torsion_rad, b.pose.torsion_rad, rtol=1e-14)
    assert (a.index, a.pupil, a.glints) == (b.index, b.pupil, b.glints)


def test_records_come_back_through_json():
    before = observations()
    after = Observations.from_records(json.loads(json.dumps(list(before.records()), allow_nan=False)))
    assert_same(before, after)


def test_purkinje_images_come_back_through_json():
    seen = observations()
    xy = np.random.default_rng(1).uniform(0, 900, (4, 3, 2))
    status = np.full((4, 3), Status.OK)
    status[1, 2], xy[1, 2] = Status.BEHIND_IRIS, np.nan
    reason = np.full((4, 3), None, dtype=object)
    reason[1, 2] = Status.BEHIND_IRIS.reason
    images = PurkinjeFeatures(
        status=status, light=np.tile([0, 0, 1], (4, 1)), reason=reason, in_image=status == Status.OK, xy_px=xy,
        time_s=np.full((4, 3), 0.5), order=np.tile([2, 4, 4], (4, 1)),
    )  # fmt: skip
    before = replace(seen, purkinje=images)
    records = json.loads(json.dumps(list(before.records()), allow_nan=False))
    assert list(records[0]["purkinje"][0]) == ["order", "light", "status", "reason", "in_image", "xy_px", "time_s"]
    assert Observations.from_records(records, complete=True).purkinje == images
    assert concatenate([before, seen]).purkinje.take([1]) == images.take([1])
    records[0]["purkinje"][1]["order"] = 5
    with pytest.raises(InputError, match=r"purkinje\.1.*order"):
        Observations.from_records(records)


def test_record_has_every_key_and_null_where_it_does_not_apply():
    records = list(observations().records())
    for record in records:
        assert list(record) == [
            "schema", "frame", "fixation", "camera", "eye", "eye_model", "subject", "instant", "time_s", "target_mm",
            "head_mm", "eye_position_mm", "pose", "rig_pose", "events", "blink_phase", "pupil", "glints", "lens_glints",
            "ghost_glints", "purkinje",
        ]  # fmt: skip
        assert list(record["pose"]) == ["azimuth_deg", "elevation_deg", "torsion_deg", "residual_mm"]
        assert list(record["pupil"]) == [
            "status", "reason", "in_image", "centre_px", "semi_axes_px", "angle_rad", "anatomical_centre_px",
            "points_px", "covariance", "arcs_deg", "arc_ellipse", "time_s",
        ]  # fmt: skip
        for glint in record["glints"]:
            assert list(glint) == ["light", "status", "reason", "in_image", "xy_px", "covariance", "time_s"]
    assert records[1]["pupil"]["centre_px"] is None
    assert records[1]["pupil"]["reason"].startswith("coarse search")
    assert records[2]["glints"][0]["xy_px"] is None
    assert len(records[3]["glints"]) == 1


def test_equality_hash_pickle_and_read_only():
    a, b, c = observations(seed=1), observations(seed=1), observations(seed=2)
    assert a == b
    assert hash(a) == hash(b)
    assert a != c
    assert pickle.loads(pickle.dumps(a)) == a
    with pytest.raises(ValueError, match="read-only"):
        a.pupil.centre_px[0, 0] = 1.0


def test_take_and_concatenate_are_inverse():
    a = observations(6)
    assert concatenate([a.take(slice(0, 2)), a.take(np.arange(6) >= 2)]) == a


def test_concatenate_fills_up_to_the_widest():
    both = concatenate([observations(4, lights=2).take(slice(0, 2)), observations(4, lights=3)])
    assert both.glints.status.shape == (6, 3)
    assert [len(r["glints"]) for r in both.records()] == [2, 2, 3, 3, 3, 2]


def test_one_wide_record_does_not_take_all_memory():
    """Rows are filled up to the widest: 6,000 records of two glints, and one of 1,000, would be six million."""
    record = next(observations().records())
    wide = {**record, "glints": [record["glints"][0]] * 1000}
    with pytest.raises(InputError, match="6001 records of up to 1000 glints are more than 5000000 glints"):
        Observations.from_records([record] * 6000 + [wide])


def test_glint_of_light_where_no_image_has_a_glint():
    some = observations()
    rows = [{**record, "glints": []} for record in some.records()]
    xy, found = Observations.from_records(rows).glints.of_light(0)
    assert xy.shape == (4, 2)
    assert np.isnan(xy).all()
    assert not found.any()


def test_glint_of_light():
    a = observations()
    xy, found = a.glints.of_light(0)
    assert found.tolist() == [True, True, False, True]
    np.testing.assert_array_equal(xy[0], a.glints.xy_px[0, 0])
    assert np.isnan(xy[2]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r.update(schema="other/1"), "records.0.schema: is 'other/1'"),
        (lambda r: r.pop("schema"), "records.0.schema: missing; write 'eyerender/record/3'"),
        (lambda r: r.update(frame=None), "records.0.frame: missing; number the frames of all records or of none"),
        (lambda r: r.update(pose=3), "records.0.pose: must be an object"),
        (lambda r: r.update(pupil=None), "records.0.pupil: must be an object"),
        (lambda r: r.update(eye="both"), "records.0.eye: must be 'right' or 'left'"),
        (lambda r: r["pupil"].update(centre_px=[1, 2, 3]), "records.0.pupil.centre_px: must be null or 2 number"),
        (lambda r: r.update(frame="x"), "records.0.frame: must be a whole number"),
        (lambda r: r.update(frame=10**200), "records.0.frame: must be a whole number"),
        (lambda r: r.update(frame=-1), "records.0.frame: must be a whole number"),
        (lambda r: r.update(eye=["right"]), "records.0.eye: must be null or a text"),
        (lambda r: r.update(eye_model="E" * 501), "records.0.eye_model: must be null or a text of at most 500"),
        (lambda r: r.update(target_mm=[1, 2, "3"]), "records.0.target_mm: must be null or 3 number"),
        (lambda r: r.update(target_mm=[1, 2, 1e200]), "records.0.target_mm: must be null or 3 number"),
        (lambda r: r.update(target_mm=[1, 2, 10**200]), "records.0.target_mm: must be null or 3 number"),
        (lambda r: r.update(target_mm=[1, 2, float("nan")]), "records.0.target_mm: must be null or 3 number"),
        (lambda r: r.update(head_mm=[[1], [2, 3], 4]), "records.0.head_mm: must be null or 3 number"),
        (lambda r: r["pose"].update(azimuth_deg=True), "records.0.pose.azimuth_deg: must be null or one number"),
        (lambda r: r["pupil"].update(status=""), "records.0.pupil.status: must be 'ok' or 'missing'"),
        (lambda r: r["pupil"].update(in_image="yes"), "records.0.pupil.in_image: must be true, false or null"),
        (lambda r: r["pupil"].update(centre_px=None), "records.0.pupil: is 'ok', but has no centre"),
        (lambda r: r["pupil"].update(semi_axes_px=[3, 0]), "records.0.pupil: is 'ok', but has no centre or semi-axes"),
        (lambda r: r["pupil"].update(points_px=[[1, 2, 3]]), "records.0.pupil.points_px: must be null or a list"),
        (lambda r: r["pupil"].update(points_px=[[1, 2]] * 3601), "records.0.pupil.points_px: must be null or a list"),
        (lambda r: r.update(glints=3), "records.0.glints: must be a list"),
        (lambda r: r.update(glints=[{}] * 1001), "records.0.glints: must be a list of at most 1000"),
        (lambda r: r.update(lens_glints=1e9), "records.0.lens_glints: must be a list of at most 1000"),
        (lambda r: r.update(lens_glints=[{}] * 1001), "records.0.lens_glints: must be a list of at most 1000"),
        (lambda r: r.update(purkinje=[{"order": 1}] * 1001), "records.0.purkinje: must be a list of at most 1000"),
        (lambda r: r["glints"].append(3), "records.0.glints.2: is no glint record: must be an object"),
        (lambda r: r["glints"][1].update(light=2**70), "records.0.glints.1: is no glint record: light must be"),
        (lambda r: r["glints"][1].update(status=["ok"]), "records.0.glints.1: is no glint record: status must be"),
        (lambda r: r["glints"][1].update(xy_px=None), "records.0.glints.1: is no glint record: it is 'ok', but has no"),
        (lambda r: r["glints"][1].update(xy_px=[1, "2"]), "records.0.glints.1: is no glint record: xy_px must be null"),
    ],
)
def test_bad_records_are_named(change, words):
    records = json.loads(json.dumps(list(observations().records())))
    change(records[0])
    with pytest.raises(InputError, match=words):
        Observations.from_records(records)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r.pop("pose"), "records.0.pose.azimuth_deg: missing"),
        (lambda r: r.pop("frame"), "records.0.frame: missing"),
        (lambda r: r["pupil"].pop("status"), "records.0.pupil.status: missing"),
        (lambda r: r["pupil"].update(status=None), "records.0.pupil.status: must be 'ok' or 'missing'"),
        (lambda r: r["pupil"].update(semi_axes_px=None), "records.0.pupil: is 'ok', but has no centre or semi-axes"),
        (lambda r: r.update(glints=None), "records.0.glints: must be a list"),
        (lambda r: r["glints"][1].pop("light"), "records.0.glints.1: is no glint record: light is missing"),
    ],
)
def test_records_of_a_folder_have_every_key(change, words):
    records = json.loads(json.dumps(list(observations().records())))
    assert len(Observations.from_records(records, complete=True)) == 4
    change(records[0])
    with pytest.raises(InputError, match=words):
        Observations.from_records(records, complete=True)


def without_nulls(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: without_nulls(v) for k, v in value.items() if v is not None}
    return [without_nulls(v) for v in value] if isinstance(value, list) else value


def test_null_keys_may_be_left_out():
    full = json.loads(json.dumps(list(observations().records())))
    short = [without_nulls(record) for record in full]
    assert sum(len(json.dumps(r)) for r in short) < sum(len(json.dumps(r)) for r in full)
    assert Observations.from_records(short) == Observations.from_records(full)


def test_the_least_that_a_record_may_hold():
    schema = {"schema": "eyerender/record/3"}
    found = Observations.from_records(
        [
            {**schema, "pupil": {"centre_px": [3, 4]}, "glints": [{"light": 0, "xy_px": [5, 6]}, {"light": 1}]},
            {**schema, "target_mm": [1, 2, 3], "notes": "unknown keys are ignored"},
        ]
    )
    assert found.index.frame.tolist() == [0, 1]
    assert found.index.camera.tolist() == found.index.eye.tolist() == [-1, -1]
    assert found.pupil.status.tolist() == [Status.OK, Status.NOT_FOUND]
    assert found.glints.status.tolist() == [[Status.OK, Status.NOT_FOUND], [Status.NONE, Status.NONE]]
    assert found.glints.xy_px[0, 0].tolist() == [5.0, 6.0]
    assert found.index.target_mm[1].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(found.pupil.semi_axes_px).all()


def test_all_errors_of_records_are_reported_together():
    records = json.loads(json.dumps(list(observations(n=30).records())))
    for record in records:
        record["eye"] = "both"
    records[0]["pupil"]["centre_px"] = "x"
    records[1]["glints"][0]["light"] = -3
    with pytest.raises(InputError) as caught:
        Observations.from_records(records, source="r.json")
    error = caught.value
    assert str(error) == "r.json: records.0.eye: must be 'right' or 'left'"
    assert (len(error.others), error.unlisted) == (19, 12)
    with pytest.raises(InputError) as caught:
        Observations.from_records(records[:2], source="r.json")
    paths = {one.path for one in (caught.value, *caught.value.others)}
    assert {"records.0.eye", "records.1.eye", "records.0.pupil.centre_px", "records.1.glints.0"} <= paths
    # What is no record at all hides the rest.
    with pytest.raises(InputError) as caught:
        Observations.from_records([records[0], {"schema": 7}], source="r.json")
    assert [caught.value.path] == ["records.1.schema"]
    assert caught.value.others == ()


def test_columns_left_out_are_unknown():
    given: dict[str, Any] = {"status": [Status.OK, Status.NOT_FOUND], "centre_px": [[3, 4], [np.nan, np.nan]]}
    pupil = PupilFeatures(**given)
    assert pupil.status.dtype == np.int8
    assert pupil.ok.tolist() == [True, False]
    assert pupil.centre_px[0].tolist() == [3.0, 4.0]
    assert pupil.reason.tolist() == [None, None]
    assert pupil.in_image.tolist() == [False, False]
    assert np.isnan(pupil.covariance).all()
    assert (pupil.covariance.shape, pupil.points_px.shape) == ((2, 5, 5), (2, 0, 2))
    assert Index(frame=np.array([5, 6])).camera.tolist() == [-1, -1]
    glints = GlintFeatures(status=np.zeros((2, 3), np.int8))
    assert (glints.light.shape, glints.xy_px.shape) == ((2, 3), (2, 3, 2))


def test_columns_keep_what_nobody_can_write_to():
    centre = np.zeros((2, 2))
    pupil = PupilFeatures(status=np.zeros(2, np.int8), centre_px=centre)
    centre[:] = 1.0
    assert not pupil.centre_px.any()
    with pytest.raises(ValueError, match="read-only"):
        pupil.centre_px[0] = 1.0
    assert replace(pupil, angle_rad=np.zeros(2)).centre_px is pupil.centre_px


@pytest.mark.parametrize(
    ("kind", "given", "error"),
    [
        (
            PupilFeatures,
            {"status": [0, 0], "centre_px": [[1, 2]]},
            r"centre_px: has the shape \(1, 2\) instead of \(2, 2\)",
        ),
        (
            PupilFeatures,
            {"status": [0], "points_px": [[1, 2]]},
            r"points_px: has the shape .* instead of \(1, any, 2\)",
        ),
        (GlintFeatures, {"status": [0, 0]}, r"status: has the shape \(2,\)"),
        (Index, {"frame": [[0]]}, r"frame: has the shape \(1, 1\) instead of \(1\)"),
    ],
)
def test_columns_of_another_shape_are_refused_by_name(kind, given, error):
    with pytest.raises(InputError, match=error):
        kind(**given)


def test_a_record_tells_each_status_in_its_word_and_gets_it_back():
    failures = [s for s in Status if s not in (Status.NONE, Status.OK, Status.PARTIAL)]
    n = len(failures)
    reasons = [s.reason for s in failures]
    batch = replace(
        observations(n=n),
        pupil=PupilFeatures(
            status=np.array(failures), reason=np.array([f"{r} (2 of 3 points)" for r in reasons], object)
        ),
        glints=GlintFeatures(status=np.array(failures)[:, None], reason=np.array(reasons, dtype=object)[:, None]),
    )
    records = json.loads(json.dumps(list(batch.records())))
    assert {r["pupil"]["status"] for r in records} == {r["glints"][0]["status"] for r in records} == {"missing"}
    back = Observations.from_records(records)
    assert back.pupil.status.tolist() == failures
    assert back.glints.status[:, 0].tolist() == failures
