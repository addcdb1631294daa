"""The light of a flat field falls off as the projection of the lens says, or as its data sheet does."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.rig.camera import Camera
from eyerender.rig.imaging import Ambient
from eyerender.rig.light import Led
from tests.support.render_rigs import BLACK, LampRig, eye_of, job_of

pytestmark = pytest.mark.render
FISHEYE = {"model": "fisheye", "k": [0.05, -0.01, 0.003, -0.001], "p": [0.002, -0.003]}
EQUIDISTANT = {"model": "fisheye", "k": [0.0, 0.0, 0.0, 0.0]}
RATIONAL = {"model": "rational", "coefficients": [0.2, 0.05, 0.001, -0.002, 0.01, 0.5, 0.1, 0.02]}
SHEET = ((0.0, 1.0), (30.0, 0.9), (60.0, 0.5), (110.0, 0.4))


def flat_field(renderer, distortion, focal_px=200, **lens):
    """Relative irradiance (h, w) of an even plane that fills the view, with cosines and angles of its rays."""
    camera = Camera.from_mapping(
        {
            "resolution_px": [800, 800],
            "position_mm": [60, 200, 0],
            "focal_length_px": focal_px,
            "distortion": distortion,
        }
        | lens
    ).build()
    rig = LampRig(camera, Led(position_mm=(40.0, 6.0, 10.0), intensity_mw_sr=1e-9).build((camera,)))
    look = BLACK.model_copy(update={"backdrop_albedo": 0.5, "backdrop_contrast": 0.0, "scattering": "off"})
    window = (100, 100, 600, 600)
    job = job_of(
        eye_of("E2"), rig, window, look=look, labels=False, ambient=Ambient(irradiance_w_m2=1000.0),
        interreflection=False,
    )  # fmt: skip
    v, u = np.mgrid[100:700, 100:700]
    ways = camera.rays(np.stack([u, v], axis=-1))
    angle = np.degrees(np.arccos(ways @ camera.axis))
    globe = -camera.nodal_point_mm / np.linalg.norm(camera.nodal_point_mm)
    seen = (angle < 60) & (ways @ globe < np.cos(np.radians(12)))
    seen[:5] = seen[-5:] = seen[:, :5] = seen[:, -5:] = False  # the blur's border
    assert angle[seen].max() > (59.9 if focal_px == 200 else 40)
    picture = renderer.render(job, spp=4).irradiance
    return picture / picture[300, 300], camera, np.stack([u, v], axis=-1), angle, seen


def solid_angle(camera, pixels):
    """Solid angle of pixels (..., 2) times their focal lengths, by finite differences of their rays."""
    h = 1e-3
    du, dv = (
        (camera.rays(pixels + step) - camera.rays(pixels - step)) / (2 * h) for step in ((h, 0), (0, h))
    )  # fmt: skip
    return camera.K[0, 0] * camera.K[1, 1] * np.linalg.norm(np.cross(du, dv), axis=-1)


@pytest.mark.parametrize(("distortion", "focal_px"), [(FISHEYE, 200), (FISHEYE, 400), (RATIONAL, 200)])
def test_the_falloff_is_that_of_the_projection(renderer, distortion, focal_px):
    """Cosine of the aperture times solid angle of the pixel, within .1 %: pixels average over their area.

    At 200 px the fisheye's rays are found by Newton's method, at 400 px by polynomials.
    """
    picture, camera, pixels, angle, seen = flat_field(renderer, distortion, focal_px)
    wanted = np.cos(np.radians(angle)) * solid_angle(camera, pixels)
    np.testing.assert_allclose(picture[seen], (wanted / wanted[300, 300])[seen], rtol=1e-3)


def test_the_falloff_of_an_equidistant_lens_is_its_closed_form(renderer):
    picture, _, _, angle, seen = flat_field(renderer, EQUIDISTANT)
    t = np.radians(angle)
    wanted = np.cos(t) * np.sin(t) / t
    np.testing.assert_allclose(picture[seen], (wanted / wanted[300, 300])[seen], rtol=1e-3)
    assert wanted[seen].min() / 0.5**4 > 6.5  # cos^4 would be that much darker at 60 degrees


@pytest.mark.parametrize("distortion", [EQUIDISTANT, RATIONAL, [0, 0, 0, 0, 0]])
def test_a_data_sheet_replaces_it(renderer, distortion):
    picture, _, _, angle, seen = flat_field(renderer, distortion, relative_illumination=SHEET)
    wanted = np.interp(angle, *np.array(SHEET).T)
    np.testing.assert_allclose(picture[seen], (wanted / wanted[300, 300])[seen], rtol=1e-5)  # pixels in float32


@pytest.mark.parametrize("lens", [{}, {"relative_illumination": SHEET}])
@pytest.mark.parametrize("distortion", [FISHEYE, EQUIDISTANT])
def test_exposure_and_noise_share_it(renderer, distortion, lens):
    """The share that automatic exposure and `sensor_noise` assume at a point is that of the picture."""
    picture, camera, pixels, _, seen = flat_field(renderer, distortion, **lens)
    for row, column in ((130, 300), (450, 160), (300, 420)):
        assert seen[row, column]
        surface, point = camera.light_shares(camera.nodal_point_mm + 50 * camera.rays(pixels[row, column]))
        centre, _ = camera.light_shares(camera.nodal_point_mm + 50 * camera.rays(pixels[300, 300]))
        assert surface / centre == pytest.approx(picture[row, column], rel=1e-3)
        assert point == pytest.approx(surface / solid_angle(camera, pixels[row, column]), rel=1e-4)


@pytest.mark.parametrize("sheet", [False, True])
def test_a_glint_has_the_falloff_of_the_picture(renderer, sheet):
    """The same lamp's glint through lenses turned away from it: light per light on the axis, from the closed forms."""
    flux = []
    for turn in (0.0, 50.0):
        lens = {"relative_illumination": SHEET} if sheet else {}
        camera = Camera.from_mapping(
            {"resolution_px": [900, 900], "position_mm": [40, 0, 0], "pan_deg": turn, "focal_length_px": 300}
            | {"distortion": EQUIDISTANT}
            | lens
        ).build()
        rig = LampRig(camera, Led(position_mm=(40.0, 6.0, 10.0), intensity_mw_sr=1.0).build((camera,)))
        job = job_of(eye_of("E2"), rig, rig.window(120, 120), look=BLACK, labels=False)
        done = renderer.render(job, spp=1)
        angle = np.arccos(camera.rays(done.glints.xy_px[0]) @ camera.axis)
        # A glint's light spreads over the solid angle's image: A = t / sin t pixels per steradian and focal length^2.
        stretch = angle / np.sin(angle)
        share = np.interp(np.degrees(angle), *np.array(SHEET).T) * stretch if sheet else np.cos(angle)
        flux.append(done.irradiance.sum(dtype=float) / share)
    assert flux[1] == pytest.approx(flux[0], rel=1e-4)
