"""Labels and exports of gaze: optic axis, rotation centres and pupil diameters, without images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import eyerender as er
from eyerender.dataset.export import teyed
from eyerender.dataset.export.item import Item
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.folders.imagefolder import ImageEntry
from eyerender.imaging.labels import RIM_HIDDEN, EyeInWindow, entrance_diameter_mm, known_labels, limbus_px
from eyerender.optics.ellipse import Ellipse, signed_distance
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

HEAD_MM = [[4.0, -9.0, 6.0]]


def scene_of(**who):
    """Both eyes in nine poses of up to 25 degrees, before one camera."""
    camera = {"position_mm": [600, 0, -150], "look_at_mm": [0, 0, 0], "focal_length_px": 2000}
    return Scene.of(
        SceneSpec.from_mapping(
            {
                "format": 2,
                "name": "gaze",
                "rig": {
                    "cameras": [{**camera, "resolution_px": [800, 400]}],
                    "lights": [{"position_mm": [600, 99, 0], "radius_mm": 2, "intensity_mw_sr": 100}],
                },
                "poses": [{"azimuth_deg": a, "elevation_deg": e} for a in (-25, 3, 25) for e in (-25, 0, 25)],
                "subject": {"head_positions_mm": HEAD_MM},
                **who,
            }
        )
    )


def labels_of(scene, rows=None):
    """Yield (frames, row, labels) of frames."""
    frames = scene.frames()
    frames = frames if rows is None else frames.take(rows)
    observed = er.trace(frames)
    for row in range(len(frames)):
        yield frames, row, known_labels(scene, observed, EyeInWindow.of(frames, row))


def written_gaze(labels):
    """Gaze vector as TEyeD's text file holds it."""
    line = {
        "labels": {**labels, "lid_margins_px": None},
        "window_px": dict.fromkeys(("x0", "y0", "width", "height"), 0),
    }
    for part in ("pupil", "iris"):
        line["labels"][part] = {**labels[part], "visible": {"pixels": 0}}
    rows = teyed.rows_of(Item(ImageEntry(folder=Path(), line=line)))
    return np.array([float(teyed._number(value)) for value in rows["gaze_vec"]])


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))


def check_gaze(frames, row, labels):
    azimuth, elevation = frames.pose.azimuth_rad[row], frames.pose.elevation_rad[row]
    # Rz(az) Ry(-el) x, written out.
    axis = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    # Nine decimals of the file: 5e-10 rad in each component.
    assert angle_deg(written_gaze(labels), np.array(labels["camera"]["R"]) @ axis) < 1e-7


@pytest.mark.parametrize("model", ["E1", "E2", "E3", "E4", "E5"])
def test_teyed_gaze_vector_is_the_optic_axis_of_published_eyes(model):
    for frames, row, labels in labels_of(scene_of(eye={"model": model})):
        check_gaze(frames, row, labels)


@pytest.mark.parametrize("people", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_teyed_gaze_vector_is_the_optic_axis_of_drawn_people(people):
    """Each person is seen with both eyes in one pose; together they show all poses."""
    for subject in range(people):
        scene = scene_of(population={"preset": "adults", "seed": 5, "subject": subject})
        for case in labels_of(scene, np.flatnonzero(scene.frames().index.fixation == subject % 9)):
            check_gaze(*case)


@pytest.mark.parametrize("who", [{"eye": {"model": "E5"}}, {"population": {"preset": "adults", "subject": 3}}])
def test_rotation_centres_stay_in_the_head_and_do_not_move_when_the_eye_turns(who):
    """A pure turn in azimuth leaves the azimuth centre where it is; one in elevation the elevation centre."""
    scene = scene_of(**who)
    head: dict[tuple[int, str], list[float]] = {}
    for frames, row, labels in labels_of(scene):
        space, side = labels["space"], int(frames.index.eye[row])
        for name in ("azimuth_centre_mm", "elevation_centre_mm"):
            assert space["head"][name] == head.setdefault((side, name), space["head"][name])
            np.testing.assert_allclose(space["world"][name], np.array(space["head"][name]) + HEAD_MM[0], atol=1e-12)
            R, t = np.array(labels["camera"]["R"]), np.array(labels["camera"]["t_mm"])
            np.testing.assert_allclose(space["camera"][name], R @ space["world"][name] + t, atol=1e-9)
    assert len(set(map(tuple, head.values()))) == 4
    anchors = frames.index.eye_position_mm
    for side, name in head:
        eye = scene.eye(("right", "left")[side])
        turns = Poses(*np.radians([[20.0], [0.0], [0.0]] if name.startswith("azimuth") else [[0.0], [20.0], [0.0]]))
        M, t = rigid_motion(turns, eye)
        centre = np.array(head[side, name]) - anchors[frames.index.eye == side][0]
        np.testing.assert_allclose(M[0] @ centre + t[0], centre, atol=1e-12)


@pytest.mark.parametrize("who", [{"eye": {"model": "E2"}}, {"population": {"preset": "adults", "subject": 3}}])
def test_entrance_diameter_is_what_the_analytic_observer_sees_on_the_axis(who):
    """A camera on the optic axis; its distance goes to infinity by Richardson extrapolation of 1 / distance."""
    scene = scene_of(**who)
    side = "left" if "population" in who else "right"
    eye = scene.eye(side)
    position = np.array(
        scene.frames().index.eye_position_mm[scene.frames().index.eye == ("right", "left").index(side)][0]
    )
    sizes = []
    for distance in (2e4, 4e4, 8e4):
        camera = er.Camera(
            position_mm=(position + np.array([distance, 0, 0])).tolist(),
            look_at_mm=position.tolist(),
            focal_length_px=1000.0 * distance,
            resolution_px=(8000, 8000),
        )
        rig = er.Rig(cameras=(camera,), lights=scene.spec.rig.lights)
        seen = scene.with_({"subject.head_positions_mm": [[0, 0, 0]]}, gaze_deg=(0, 0), rig=rig)
        observed = er.trace(seen.frames(), boundary_points=180)
        row = int(np.flatnonzero(observed.index.eye == ("right", "left").index(side))[0])
        u, v = observed.pupil.points_px[row].T / 1000
        # Area by Fourier series, as exact as the number of points allows; a polygon's would be 2e-4 too small.
        c = np.fft.fft(u + 1j * v) / len(u)
        sizes.append(2 * np.sqrt(abs(np.sum(np.fft.fftfreq(len(u), 1 / len(u)) * np.abs(c) ** 2))))
    first, second = (2 * sizes[1] - sizes[0], 2 * sizes[2] - sizes[1])
    # What is left of the series in 1 / distance is of third order: (3 mm / 2e4 mm)^3 of a pupil.
    assert entrance_diameter_mm(eye) == pytest.approx((4 * second - first) / 3, abs=1e-6)
    ((_, _, labels),) = labels_of(scene, np.flatnonzero(scene.frames().index.eye == (side == "left"))[:1])
    assert labels["pupil"]["entrance_diameter_mm"] == entrance_diameter_mm(eye)
    assert labels["pupil"]["stop_diameter_mm"] == scene.stop_diameter_mm(side)
    assert 1.08 < labels["pupil"]["entrance_diameter_mm"] / labels["pupil"]["stop_diameter_mm"] < 1.2


def turned(*poses, camera_mm=(300, -31.5, 0)):
    """A right eye with a round cornea, turned by (azimuth, elevation); its camera is straight ahead by default."""
    camera = {"position_mm": list(camera_mm), "look_at_mm": [0, -31.5, 0], "focal_length_px": 6000}
    lamp = {"position_mm": [300, 0, 30], "radius_mm": 2, "intensity_mw_sr": 100}
    rig = {"cameras": [{**camera, "resolution_px": [640, 480]}], "lights": [lamp]}
    angles = [{"azimuth_deg": a, "elevation_deg": e} for a, e in poses]
    spec = {"format": 2, "name": "turned", "rig": rig, "poses": angles, "subject": {"eyes": ["right"]}}
    return Scene.of(SceneSpec.from_mapping(spec))


def test_the_iris_has_its_outline_in_views_to_80_degrees():
    scene = turned(*((a, 0.4 * a) for a in range(-76, 78, 4)))
    hidden = []
    for frames, row, labels in labels_of(scene):
        label = labels["iris"]["amodal"]
        pixels, reason = limbus_px(scene, EyeInWindow.of(frames, row), 720)
        assert (label["status"], label["reason"]) == ("ok", None)
        assert label["rim_hidden"] == (reason == RIM_HIDDEN)
        ellipse = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
        assert np.abs(signed_distance(ellipse, pixels)).max() < 1e-6
        hidden.append(label["rim_hidden"])
    assert 10 < sum(hidden) < len(hidden) - 10


def test_an_eye_that_looks_away_has_no_iris():
    ((_, _, labels),) = labels_of(turned((-60, 0), camera_mm=(-100, 268.5, 0)))
    label = labels["iris"]["amodal"]
    assert (label["status"], label["reason"], label["rim_hidden"]) == ("missing", "the eye turns it away", False)
