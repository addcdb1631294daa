"""Labels of rendered images against independent geometry and against the pixels."""

from __future__ import annotations

import json

import numpy as np
import pytest

import eyerender as er
from eyerender.eye.parts import ConicSpec
from eyerender.eye.spec import EyeSpec
from eyerender.folders.imagefile import read_image
from eyerender.folders.imagefolder import ImageFolder
from eyerender.imaging.labels import moments_ellipse, whole_pixels
from eyerender.optics.ellipse import Ellipse, points_on_ellipse, signed_distance
from eyerender.scene.spec import SceneSpec
from tests.support.dataset_specs import plan
from tests.support.labels import labels_of

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def entries(tiny):
    return ImageFolder.load(tiny).entries


def near(a, b, tolerance=1e-9):
    np.testing.assert_allclose(np.array(a), np.array(b), atol=tolerance)


def test_the_moments_of_a_drawn_ellipse_give_it_back():
    v, u = np.mgrid[:200, :300]
    for angle in (0.0, 0.4, 2.0):
        ellipse = Ellipse(np.array([140.3, 95.7]), np.array([60.0, 41.0]), angle)
        inside = signed_distance(ellipse, np.stack([u + 10, v + 20], axis=-1)) <= 0
        found = moments_ellipse(inside, (10, 20, 300, 200))
        # Whole pixels: the moments of some 7,700 of them are within a few hundredths of the area's.
        near(found["centre_px"], [140.3, 95.7], 0.05)
        near(found["semi_axes_px"], [60, 41], 0.05)
        assert abs(np.sin(found["angle_rad"] - angle)) < 5e-3
        assert found["pixels"] == np.count_nonzero(inside)
        assert not found["cut"]
    assert moments_ellipse(np.ones((4, 4), bool), (0, 0, 4, 4))["cut"]
    assert moments_ellipse(np.zeros((4, 4), bool), (0, 0, 4, 4))["centre_px"] is None


def test_what_lies_outside_the_window_is_unseen():
    v, u = np.mgrid[:60, :100]
    whole = np.where(np.hypot(u - 99.5, v - 30) < 25, 3, np.where(np.hypot(u - 99.5, v - 30) < 45, 2, 0)).astype(
        np.uint8
    )
    amodal = {"centre_px": [109.5, 50.0], "angle_rad": 0.3}
    labels = {"pupil": {"amodal": {**amodal, "semi_axes_px": [25.0, 25.0]}},
              "iris": {"amodal": {**amodal, "semi_axes_px": [45.0, 45.0]}}}  # fmt: skip
    # The right half of both is outside, and of the iris what is more than 30 px above or below the middle.
    stripe = 30 * np.sqrt(45**2 - 30**2) + 45**2 * np.arcsin(30 / 45)
    for name, part, share in (("pupil", 3, 0.5), ("iris", 2, (stripe / np.pi - 25**2 / 2) / (45**2 - 25**2))):
        seen = np.count_nonzero(whole == part) / whole_pixels(whole, labels, name, (10, 20, 100, 60))
        assert seen == pytest.approx(share, abs=0.01)
    labels["pupil"]["amodal"]["centre_px"] = [60.0, 50.0]  # within the window, its pixels count
    assert whole_pixels(whole, labels, "pupil", (10, 20, 100, 60)) == np.count_nonzero(whole == 3)
    nowhere = {"amodal": {"centre_px": None, "semi_axes_px": None, "angle_rad": None}}
    assert whole_pixels(np.zeros_like(whole), {"pupil": nowhere, "iris": nowhere}, "iris", (0, 0, 100, 60)) == 0


def test_a_small_window_says_what_it_cuts_off():
    lights = [{"position_mm": [615.0, y, 0.0], "radius_mm": 2.5, "intensity_mw_sr": 100.0} for y in (600.0, -600.0)]
    scene = plan(scene__image__window_px=[16, 16], scene__rig__lights=lights).draw(0).build()
    (image,) = er.render(scene)
    labels = labels_of(image)
    share = labels["pupil"]["visible"]["pixels"] / (np.pi * np.prod(labels["pupil"]["amodal"]["semi_axes_px"]))
    assert labels["pupil"]["visible_fraction"] == pytest.approx(share)
    assert share < 0.9
    assert labels["pupil"]["visible"]["cut"]
    assert 0 < labels["iris"]["visible_fraction"] < 0.2
    outside = [glint for glint in labels["glints"] if not glint["in_window"]]
    assert outside
    assert {(g["visible"], g["hidden_by"]) for g in outside} == {(False, "outside the picture")}


def test_ellipses_hold_the_masks(entries):
    for entry in entries:
        mask, _ = read_image(entry.mask_path)
        x0, y0 = entry.window[:2]
        v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
        at = np.stack([u + x0, v + y0], axis=-1)
        for part, inside in (("pupil", mask == 3), ("iris", mask >= 2)):
            labels = entry.line["labels"][part]
            a = labels["amodal"]
            assert a["status"] == "ok"
            ellipse = Ellipse(a["centre_px"], a["semi_axes_px"], a["angle_rad"])
            distance = signed_distance(ellipse, at)
            # The mask is the part at each pixel's centre; 0.1 px is what outline and ellipse may differ by.
            assert inside[distance < -0.1].all()
            assert not inside[distance > 0.1].any()
            assert labels["visible_fraction"] == 1.0
            near(labels["visible"]["centre_px"], a["centre_px"], 0.15)
            near(labels["visible"]["semi_axes_px"], a["semi_axes_px"], 0.2)


def test_glints_are_where_the_light_is(entries):
    for entry in entries:
        image = read_image(entry.path)[0].astype(float)
        x0, y0 = entry.window[:2]
        glints = entry.line["labels"]["glints"]
        assert [g["light"] for g in glints] == [0, 1]
        for g in glints:
            assert g["visible"]
            assert g["in_window"]
            assert g["visible_share"] == 1.0
            # A lamp of 2.5 mm at 615 mm: its image is 0.02 px wide here, its centre that of the energy.
            near(g["spot_xy_px"], g["xy_px"], 1e-3)
            x, y = np.round(np.array(g["xy_px"]) - [x0, y0]).astype(int)
            assert image[y, x] > np.median(image) + 0.3 * (image.max() - np.median(image))


def test_points_and_lines_hang_together(entries):
    for entry in entries:
        line = entry.line
        labels, record = line["labels"], line["records"][0]
        world, camera = labels["space"]["world"], labels["space"]["camera"]
        R, t = np.array(labels["camera"]["R"]), np.array(labels["camera"]["t_mm"])
        for name, value in world.items():
            shift = 0 if name in ("optic_axis", "line_of_sight") else t
            near(camera[name], R @ np.array(value) + shift)
        M, shift = np.array(labels["pose"]["rotation"]), np.array(labels["pose"]["translation_mm"])
        near(M @ M.T, np.eye(3), 1e-12)
        axis, apex = np.array(world["optic_axis"]), np.array(world["cornea_apex_mm"])
        near(axis, M[:, 0])
        near(apex, shift)
        azimuth, elevation = np.radians([record["pose"]["azimuth_deg"], record["pose"]["elevation_deg"]])
        near(axis, [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1e-12)
        eye = EyeSpec.from_mapping(json.loads(line["parameters"]["eye_json"]))
        radius = line["parameters"]["draws"]["eye_parameters.E2.cornea.0.shape.radius_mm"]
        shape = eye.cornea[0].shape
        assert isinstance(shape, ConicSpec)
        assert shape.radius_mm == radius
        # The paraxial radius from the sag at 0.05 mm: 1e-4 of it.
        near(world["cornea_centre_mm"], apex - radius * axis, 2e-3)
        near(world["pupil_centre_mm"], apex - 3.6 * axis)
        for name in ("azimuth_centre_mm", "elevation_centre_mm"):
            near(world[name], apex - 13.5 * axis)
            # E2 turns about one point, which stays where it is in the head.
            near(labels["space"]["head"][name], np.array(record["eye_position_mm"]) - [13.5, 0, 0])
            near(world[name], np.array(record["eye_position_mm"]) + record["head_mm"] - [13.5, 0, 0])
        target = np.array(world["target_mm"])
        near(target, record["target_mm"])
        way = target - world["line_of_sight_point_mm"]
        near(way / np.linalg.norm(way), world["line_of_sight"], 1e-9)
        # Kappa of E2: about 5.45 degrees horizontally, 2.5 vertically at the node; a degree of play for the media.
        kappa = np.degrees(np.arccos(np.dot(world["line_of_sight"], axis)))
        assert 4.0 < kappa < 7.5
        assert line["parameters"]["draws"]["eye.pupil_diameter_mm"] == line["parameters"]["pupil_diameter_mm"]


def test_the_apparent_limbus_is_the_projected_circle(entries):
    """A point of the limbus' circle on a sphere-free path: the front cornea's sag at that radius, no refraction."""
    for entry in entries[::5]:
        line = entry.line
        labels = line["labels"]
        scene = SceneSpec.from_mapping(json.loads(line["parameters"]["scene_json"]))
        assert scene.sensor.exposure_ms is not None  # also where the spec leaves it to the scene
        shape = json.loads(line["parameters"]["eye_json"])["cornea"][0]["shape"]
        R, q = shape["radius_mm"], shape["conic_constant"]
        rho = 5.85 - scene.look.limbus_width_mm / 2
        sag = -(rho**2) / (R + np.sqrt(R**2 - (1 + q) * rho**2))
        angle = np.linspace(0, 2 * np.pi, 40)
        points = np.stack([np.full(40, sag), rho * np.cos(angle), rho * np.sin(angle)], axis=-1)
        M, t = np.array(labels["pose"]["rotation"]), np.array(labels["pose"]["translation_mm"])
        c = labels["camera"]
        x = (points @ M.T + t) @ np.array(c["R"]).T + c["t_mm"]
        pixels = (x @ np.array(c["K"]).T)[:, :2] / x[:, 2:]
        a = labels["iris"]["amodal"]
        ellipse = Ellipse(a["centre_px"], a["semi_axes_px"], a["angle_rad"])
        assert np.abs(signed_distance(ellipse, pixels)).max() < 1e-6
        outline = points_on_ellipse(ellipse.centre_px, ellipse.semi_axes_px, ellipse.angle_rad, 8)
        assert np.abs(signed_distance(ellipse, outline)).max() < 1e-9
