"""Measured corneas of eye files: features as of conics, files of topographers, and clear refusals."""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from scipy.optimize import minimize

import eyerender as er
from eyerender.analytic.features import features
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.eye.meshes import eye_meshes
from eyerender.eye.parts import TopographySpec, ZernikeSpec
from eyerender.eye.pose import Poses
from eyerender.eye.topography import read_topography
from eyerender.optics.solve import apparent_points
from eyerender.rig.camera import PinholeCamera
from tests.support.corneas import GOLDEN, conic_depth, eye_with, grid_of, keratoconus, measured_shapes, zernike_of
from tests.support.eye_meshes import crossing
from tests.support.mirror import mirror_points

LIGHTS = np.array([[580.0, -60.0, -150.0], [590.0, 80.0, -140.0], [600.0, 5.0, 160.0]])


def camera() -> PinholeCamera:
    """A remote camera 600 mm before the eye; 1 mm is some 20 px."""
    K = np.array([[12000.0, 0.0, 639.5], [0.0, 12000.0, 511.5], [0.0, 0.0, 1.0]])
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    return PinholeCamera.of(K, R, -R @ np.array([600.0, 0.0, -100.0]), (1280, 1024))


def seen(eyes, count=12, **options):
    rng = np.random.default_rng(4)
    poses = Poses.from_degrees(rng.uniform(-20, 20, count), rng.uniform(-15, 15, count))
    which = np.arange(count) % len(eyes)
    return features(eyes, which, poses, np.zeros((count, 3)), [camera()], np.zeros(count, int), LIGHTS, **options)


def test_features_of_an_expanded_conic_are_those_of_the_conic():
    """Front and back as Zernike terms, all that a camera sees, the images of the lens included."""
    conic = er.load_eye("E4")
    data = conic.to_mapping()
    for surface in data["cornea"]:
        shape = surface["shape"]

        def depth(y, z, shape=shape):
            return conic_depth(y, z, shape["radius_mm"], shape.get("conic_constant", 0.0))

        surface["shape"] = zernike_of(depth, 5.0, 14).to_mapping()
    expanded = er.EyeSpec.from_mapping(data)
    exact, found = (seen([spec.build()], 2, purkinje=(1, 2, 3, 4)) for spec in (conic, expanded))
    assert np.array_equal(exact.glint_status, found.glint_status)
    assert (exact.glint_status[..., 0] == Status.OK).all()
    assert np.abs(exact.points_px - found.points_px).max() < 1e-4
    assert np.abs(exact.glints_px - found.glints_px)[..., 0, :].max() < 1e-4
    # The image of the strong back surface doubles every error of its slope; on 5 mm of 6.5 its expansion is at its end.
    assert np.nanmax(np.abs(exact.glints_px - found.glints_px)) < 1e-3


@pytest.mark.parametrize("name", ["zernike", "zernike on a conic", "grid"])
def test_features_have_exact_rays(name):
    found = seen([eye_with(measured_shapes()[name]).build()])
    assert (found.point_status == Status.OK).all()
    assert np.nanmax(found.point_residual_mm) < 1e-9
    assert (found.glint_status == Status.OK).all()
    assert np.nanmax(found.glint_residual_mm) < 1e-9


@pytest.mark.parametrize("name", ["zernike", "grid"])
def test_many_eyes_in_one_batch_are_each_alone(name):
    """Eleven different corneas, left eyes among them."""
    rng = np.random.default_rng(6)
    eyes = []
    for k in range(11):
        shape: Any
        if name == "zernike":
            c = np.array(GOLDEN) + rng.normal(size=45) * 1e-4 * (np.arange(45) > 2)
            shape = ZernikeSpec(kind="zernike", radius_mm=3.25, coefficients_mm=tuple(c))
        else:
            shape = grid_of(lambda y, z, k=k: conic_depth(y, z, 7.6 + 0.03 * k, -0.2), 5.5 - 0.25 * (k % 2))
        eyes.append(eye_with(shape).build(eye="left" if k % 3 else "right"))
    whole = seen(eyes, 22)
    for k in range(22):
        rng = np.random.default_rng(4)
        poses = Poses.from_degrees(rng.uniform(-20, 20, 22), rng.uniform(-15, 15, 22))
        pose = Poses(poses.azimuth_rad[k : k + 1], poses.elevation_rad[k : k + 1], poses.torsion_rad[k : k + 1])
        alone = features([eyes[k % 11]], [0], pose, np.zeros((1, 3)), [camera()], [0], LIGHTS)
        assert np.abs(alone.points_px[0] - whole.points_px[k]).max() < 1e-7
        assert np.abs(alone.glints_px[0] - whole.glints_px[k]).max() < 1e-7


@pytest.mark.parametrize("name", ["zernike", "zernike on a conic", "grid"])
def test_mirror_and_apparent_points_are_where_the_path_is_shortest(name):
    """Brute force: the optical path over the surface, minimised without derivatives in double precision."""
    eye = eye_with(measured_shapes()[name]).build()
    front, (n, _) = eye.front[0], eye.front_indices
    node = np.array([30.0, 8.0, -12.0])
    rng = np.random.default_rng(1)

    def minimum(length, start):
        best = minimize(length, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-16, "maxiter": 2000})
        return np.array([float(front.sag(*best.x)), *best.x])

    for _ in range(4):
        lamp = np.array([35.0, *rng.uniform(-20.0, 20.0, 2)])
        found = mirror_points(front, lamp, node)

        def mirrored(q, lamp=lamp):
            p = np.array([float(front.sag(*q)), *q])
            return np.linalg.norm(p - lamp) + np.linalg.norm(p - node)

        # Where a path changes by a rounding, 1e-14 mm, its end moves by 1e-7 mm or so.
        assert np.linalg.norm(minimum(mirrored, found.points_mm[1:] + 0.3) - found.points_mm) < 1e-6
        inside = np.array([-3.0, *rng.uniform(-2.0, 2.0, 2)])
        apparent = apparent_points([front], [n], inside, node)

        def refracted(q, inside=inside):
            p = np.array([float(front.sag(*q)), *q])
            return n * np.linalg.norm(p - inside) + np.linalg.norm(p - node)

        exact = apparent.exit_points_mm
        assert np.linalg.norm(minimum(refracted, exact[1:] - 0.3) - exact) < 1e-6


def test_a_cone_displaces_glints_and_nothing_else_does():
    healthy, ill = (seen([eye_with(grid_of(depth)).build()]) for depth in (conic_depth, keratoconus))
    exact = seen([eye_with(None).build()])
    shift = np.linalg.norm(ill.glints_px - healthy.glints_px, axis=-1)
    # 30 um over 1.2 mm lean by up to 15 mrad, which moves a mirror image by tenths of a mm; 1 mm is 20 px.
    assert shift.max() > 1.0
    assert np.isfinite(exact.glints_px).all()


@pytest.mark.parametrize("name", ["zernike", "grid"])
def test_meshes_lie_on_measured_corneas(name):
    eye = eye_with(measured_shapes()[name]).build()
    meshes = eye_meshes(eye, 16, 48)
    assert all(body.is_watertight for body in meshes.bodies.values())
    assert not crossing(eye, meshes)
    front = meshes.patches["cornea_front"]
    assert np.abs(eye.front[0].implicit(front.vertices)).max() < 1e-12


@pytest.mark.parametrize("name", measured_shapes())
def test_eye_files_with_measured_corneas_are_read_as_they_were_written(name, tmp_path):
    if "lens" in name:
        pytest.skip("no cornea")
    spec = eye_with(measured_shapes()[name])
    spec.dump(tmp_path / "eye.yaml")
    again = er.load_eye(tmp_path / "eye.yaml")
    assert again == spec
    assert again.build().front == spec.build().front


def written(folder, data, **shape):
    """Eye file with a front cornea that names a file, and that file."""
    mapping = er.load_eye("E4").to_mapping()
    for name, content in data.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    mapping["cornea"][0]["shape"] = {"kind": "grid", **shape}
    path = folder / "own.yaml"
    path.write_text(yaml.safe_dump(mapping), encoding="utf-8")
    return path


AXES: dict[str, Any] = {"x": "nasal", "y": "up", "z": "in", "unit": "mm"}
PLACE = np.arange(-5.0, 5.01, 0.25)
Y, Z = (a.ravel() for a in np.meshgrid(PLACE, PLACE))
DEPTH = keratoconus(Y, Z)


def table(*columns, header=""):
    return header + "".join(",".join(f"{v:.9g}" for v in row) + "\n" for row in zip(*columns, strict=True))


def polar():
    radius, angle = np.meshgrid(np.arange(0.0, 6.0, 0.2), np.arange(0.0, 360.0, 6.0))
    radius, angle = radius.ravel(), angle.ravel()
    depth = keratoconus(radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle)))
    return table(radius, angle, depth, header="r;theta;z\n".replace(";", ","))


def matrix():
    rows = [["", *PLACE], *([y, *(1e3 * keratoconus(PLACE, y))] for y in PLACE)]
    return "\n".join(";".join(str(v) for v in row) for row in rows)


def ply():
    faces = [[k, k + 1, k + 42] for k in range(1600)]
    return trimesh.Trimesh(np.column_stack([-Y, -Z, -DEPTH]), faces, process=False).export(file_type="ply")


FILES: dict[str, tuple[Any, dict[str, Any]]] = {
    "points": (table(Y, Z, DEPTH), {"layout": "points", **AXES}),
    "names, temporal, down, out": (
        table(-DEPTH, -Y, -Z, header="h,x,y\n"),
        {"layout": "points", "columns": ["x", "y", "h"], "x": "temporal", "y": "down", "z": "out", "unit": "mm"},
    ),
    "micrometres about another centre": (
        table(1e3 * Y + 500.0, 1e3 * Z - 200.0, 1e3 * DEPTH),
        {"layout": "points", **AXES, "unit": "um", "centre": [500.0, -200.0]},
    ),
    "polar": (polar(), {"layout": "polar", **AXES, "columns": ["r", "theta", "z"]}),
    "matrix": (matrix(), {"layout": "matrix", **AXES, "z_unit": "um"}),
    "mesh": (ply(), {"layout": "mesh", "x": "temporal", "y": "down", "z": "out", "unit": "mm"}),
}


@pytest.mark.parametrize("name", FILES)
def test_measured_points_become_the_cornea(name, tmp_path):
    content, keys = FILES[name]
    path = written(tmp_path, {"od.dat": content}, file={"path": "od.dat", "spacing_mm": 0.25, **keys})
    surface = er.load_eye(path).build().front[0]
    y, z = np.random.default_rng(0).uniform(-2.2, 2.2, (2, 300))
    truth = -keratoconus(y, z) + keratoconus(0.0, 0.0)
    # 2e-6 mm is the error of the bicubic; PLY holds single precision, and rings are denser than the grid near the axis.
    assert np.abs(surface.local_sag(y, z) - truth).max() < (2e-5 if name in ("mesh", "polar") else 2e-6)


def test_a_texture_that_measured_points_name_is_not_looked_for(tmp_path, caplog):
    """Trimesh would look for the picture, and log a traceback, which Python prints where nobody has set up logging."""
    content = ply().replace(b"\nelement", b"\ncomment TextureFile pipe\nelement", 1)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a.ply").write_bytes(content)
    keys: dict[str, Any] = {
        "layout": "mesh",
        "x": "temporal",
        "y": "down",
        "z": "out",
        "unit": "mm",
        "spacing_mm": 0.25,
    }
    assert read_topography(TopographySpec(path="a.ply", **keys), tmp_path).heights_mm is not None
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_a_file_with_gaps_is_fitted_around_them(tmp_path):
    keep = ~((np.hypot(Y - 1.0, Z) < 0.6) | (np.hypot(Y, Z) > 4.6))
    text = "".join(f"{y},{z},{d if k else ''}\n" for y, z, d, k in zip(Y, Z, DEPTH, keep, strict=True))
    (tmp_path / "gaps.csv").write_text(text)
    shape = read_topography(TopographySpec(path="gaps.csv", layout="points", spacing_mm=0.25, **AXES), tmp_path)
    assert shape.heights_mm is not None
    assert 0.5 * (len(shape.heights_mm) - 1) * 0.25 == pytest.approx(4.5)
    surface = eye_with(shape).build().front[0]
    truth = -keratoconus(1.0, 0.0) + keratoconus(0.0, 0.0)
    assert abs(float(surface.sag(1.0, 0.0)) - truth) < 1e-3


BAD: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "missing": ({}, {"path": "none.csv", "layout": "points", **AXES}, "none.csv: no such file"),
    "no number": ({"a.csv": "1,2,x\n" * 60}, {"path": "a.csv", "layout": "points", **AXES}, "'x' is not a number"),
    "infinite": ({"a.csv": "1,2,inf\n" * 60}, {"path": "a.csv", "layout": "points", **AXES}, "'inf' is not a number"),
    "empty": ({"a.csv": ""}, {"path": "a.csv", "layout": "points", **AXES}, "is empty"),
    "few columns": ({"a.csv": "1,2\n" * 60}, {"path": "a.csv", "layout": "points", **AXES}, "has 2 cells"),
    "no such column": (
        {"a.csv": "x,y,z\n1,2,3\n"},
        {"path": "a.csv", "layout": "points", **AXES, "columns": ["x", "y", "h"]},
        "has no column 'h'",
    ),
    "metres": (
        {"a.csv": table(Y, Z, DEPTH)},
        {"path": "a.csv", "layout": "points", **AXES, "unit": "m"},
        "are unit and centre right?",
    ),
    "one side": (
        {"a.csv": table(Y + 9.0, Z, DEPTH)},
        {"path": "a.csv", "layout": "points", **AXES},
        "are unit and centre right?",
    ),
    "fine": (
        {"a.csv": table(Y, Z, DEPTH)},
        {"path": "a.csv", "layout": "points", **AXES, "spacing_mm": 0.02},
        "give a larger 'spacing_mm'",
    ),
    "not UTF-8": ({"a.csv": b"\xff\xfe\x00"}, {"path": "a.csv", "layout": "points", **AXES}, "not UTF-8"),
    "PLY of no vertices": (
        {"a.ply": ply().replace(b"element vertex ", b"element vertex -", 1)},
        {"path": "a.ply", "layout": "mesh", **AXES},
        "more than the file can hold",
    ),
    "no PLY": ({"a.ply": b"ply\nnothing"}, {"path": "a.ply", "layout": "mesh", **AXES}, "is not a PLY file"),
    "axes": ({}, {"path": "a.csv", "layout": "points", **AXES, "z": "up"}, "file.z"),
    "ragged": ({"a.csv": ",0,1\n0,1\n"}, {"path": "a.csv", "layout": "matrix", **AXES}, "has 2 cells"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_topographies_end_with_one_line(name, tmp_path, capfd):
    from eyerender.cli.main import run

    files, keys, message = BAD[name]
    path = written(tmp_path, files, file=keys)
    with pytest.raises(InputError, match=r"cornea\.0\.shape\.file") as error:
        er.load_eye(path)
    assert message in str(error.value)
    assert run(["eyes", str(path)]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("shape", "key"),
    [
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": [0.0] * 121}, "coefficients_mm"),
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": []}, "coefficients_mm"),
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": [0.1], "base_radius_mm": 0.0}, "base_radius_mm"),
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": [0.0, 0.0, 0.0, 0.0, 99.0]}, "coefficients_mm.4"),
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": [0.0] * 15 + [1.0]}, "no surface of an eye"),
        ({"kind": "grid", "spacing_mm": 0.2}, "shape"),
        ({"kind": "grid", "spacing_mm": 0.2, "heights_mm": [[0.0] * 6] * 6}, "heights_mm"),
        ({"kind": "grid", "spacing_mm": 0.2, "heights_mm": [[0.0] * 7] * 6 + [[0.0]]}, "heights_mm.6"),
        ({"kind": "grid", "spacing_mm": 0.5, "heights_mm": [[0.0] * 7] * 7, "zone_radius_mm": 3.0}, "zone_radius_mm"),
        ({"kind": "grid", "file": {"path": "a.csv", "layout": "points", **AXES}}, "file"),
        ({"kind": "zernike", "radius_mm": 3.0, "coefficients_mm": [0.0, 0.0, 0.0, 0.0, 9.0]}, "cornea"),
    ],
)
def test_wrong_shapes_are_named(shape, key):
    data = er.load_eye("E4").to_mapping()
    data["cornea"][0]["shape"] = shape
    with pytest.raises(InputError, match=key.replace(".", r"\.")):
        er.EyeSpec.from_mapping(data)


def test_a_dataset_counts_the_points_that_its_eyes_name(tmp_path):
    """A changed table is another dataset."""
    from eyerender.dataset.plan import Plan
    from eyerender.dataset.spec import shipped_datasets

    written(tmp_path, {"od.dat": FILES["points"][0]}, file={"path": "od.dat", "spacing_mm": 0.25, **FILES["points"][1]})
    data = yaml.safe_load(shipped_datasets()["dataset_quick"].read_text(encoding="utf-8"))
    data["scene"]["eye"] = {"model": "own.yaml"}
    data["eye_parameters"] = {}
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    plan = Plan.of(er.DatasetSpec.load(tmp_path / "spec.yaml"), base=tmp_path)
    assert set(plan.files) == {"own.yaml", "od.dat"}
