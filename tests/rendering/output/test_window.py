"""Defocus, vignetting, motion and ambient light: each against its own law; none of them moves a label."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j1

from eyerender.base.errors import InputError
from eyerender.imaging.capture import render_windows
from eyerender.rig.defocus import confusion_px, defocused, disc, vignette
from eyerender.rig.imaging import Lens
from eyerender.rig.sensor import Sensor
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

pytestmark = pytest.mark.render


def shot(renderer, shutter="global", **more):
    scene = Scene.of(
        SceneSpec.from_mapping(
            {
                "format": 2,
                "name": "imaging",
                "subject": {"eyes": ["right"], "ipd_mm": 0.001},
                "rig": {
                    "cameras": [
                        {"position_mm": [600, 0, 0], "look_at_mm": [0, 0, 0], "focal_length_px": 5000,
                         "resolution_px": [640, 480], "shutter": shutter}
                    ],
                    "lights": [
                        {"position_mm": [600, 100, 0], "radius_mm": 0, "aim_mm": [0, 0, 0], "intensity_mw_sr": 100}
                    ],
                },
                "poses": [{"azimuth_deg": 0, "elevation_deg": 0}],
                "image": {"spp": 8, "window_px": [160, 160]},
                "sensor": {"noise": False, "pixel_pitch_um": 5.0, "f_number": 4.0, "exposure_ms": 15},
                **more,
            }
        )
    )  # fmt: skip
    (image,) = render_windows(scene.frames(), renderer=renderer)
    return image


@pytest.mark.parametrize("diameter", [0.5, 1.0, 2.7, 6.0, 11.3])
def test_the_disc_is_centred_and_has_its_variance(diameter):
    kernel = disc(diameter)
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-7)
    # The transfer at low frequencies is 1 - (2 pi f)^2 d^2 / 32; a disc's variance along an axis is d^2 / 16.
    n = np.arange(len(kernel)) - len(kernel) // 2
    low = 2 * np.pi * 0.2 / diameter if diameter > 2 else 0.4
    transfer = float(np.sum(kernel * np.cos(low * n)))
    assert transfer == pytest.approx(2 * j1(low * diameter / 2) / (low * diameter / 2), abs=0.01)


def test_the_circle_of_confusion_is_the_parallax_of_the_aperture():
    from eyerender.rig.camera import Camera

    camera = Camera.from_mapping(
        {"position_mm": [600, 0, 0], "look_at_mm": [0, 0, 0], "focal_length_px": 5000, "resolution_px": [640, 480]}
    ).build()
    sensor = Sensor(f_number=4.0, pixel_pitch_um=5.0)
    distance, aperture, s, z = 25.0, 25.0 / 4, 650.0, 600.0
    # Points of a thin lens at the image distance 25 mm see the point in other directions than a point in focus.
    expected = distance * aperture * abs(1 / z - 1 / s) / 5e-3
    assert float(confusion_px(Lens(focus_mm=s), camera, sensor, z)) == pytest.approx(expected, rel=1e-9)
    assert confusion_px(Lens(focus_mm=z), camera, sensor, z) == 0
    # The same by similar triangles behind the lens: the cone from the aperture to the point's image.
    focal = 1 / (1 / distance + 1 / s)
    image_z = 1 / (1 / focal - 1 / z)
    assert aperture * abs(image_z - distance) / image_z / 5e-3 == pytest.approx(expected, rel=1e-9)
    corner = np.asarray(vignette(Lens(vignetting=0.4), camera, (0, 0, 640, 480)))
    assert corner[0, 0] == pytest.approx(0.6, abs=1e-9)
    assert corner[239:241, 319:321].min() > 0.9999


def test_a_picture_of_nothing_but_blur_is_refused(renderer):
    with pytest.raises(InputError, match=r"lens.focus_mm: the picture would be blurred over .* px; at most 400"):
        shot(renderer, lens={"focus_mm": 26.0})


def test_a_picture_that_is_not_finite_is_refused(renderer, tmp_path):
    np.save(tmp_path / "sun.npy", np.full((8, 16), 1e38, np.float32))
    ambient = {"map": {"file": str(tmp_path / "sun.npy"), "scale_w_m2_sr": 1e9}}
    with pytest.raises(InputError, match="too extreme: its image is not finite"), np.errstate(all="ignore"):
        shot(renderer, ambient=ambient)


def test_defocus_keeps_energy_and_centroids(renderer):
    sharp, soft = shot(renderer), shot(renderer, lens={"focus_mm": 660})
    assert soft.irradiance.max() < 0.7 * sharp.irradiance.max()
    assert soft.irradiance[30:-30, 30:-30].mean() == pytest.approx(sharp.irradiance[30:-30, 30:-30].mean(), rel=5e-3)
    assert np.array_equal(sharp.parts, soft.parts)
    spot = np.zeros((81, 81))
    spot[40, 40], spot[40, 41] = 0.3, 0.7
    out = defocused(spot, 7.3)
    x = np.arange(out.shape[1]) + (81 - out.shape[1]) // 2
    assert np.sum(out * x) / out.sum() == pytest.approx(40.7, abs=0.03)  # ripples below 0 are cut off


def test_a_moving_head_smears_the_glint_about_its_place(renderer):
    still = shot(renderer)
    moved = shot(renderer, motion={"head_mm_s": [0, 100, 0], "steps": 16})  # 1.5 mm in 15 ms: 12.5 px
    level = still.irradiance[:20].max() * 3

    def spread(image):
        y, x = np.nonzero(image.irradiance > level)
        w = image.irradiance[y, x]
        mean = np.sum(w * x) / w.sum()
        return mean, np.sqrt(np.sum(w * (x - mean) ** 2) / w.sum())

    (a, narrow), (b, wide) = spread(still), spread(moved)
    assert b == pytest.approx(a, abs=0.3)
    # Even over 12.5 px: 12.5 / sqrt(12) = 3.6 px.
    assert wide == pytest.approx(12.5 / np.sqrt(12), abs=0.5)
    assert narrow < 1.5
    assert np.array_equal(still.parts, moved.parts)


def test_rows_of_an_interlaced_camera_show_two_moments(renderer):
    still = shot(renderer)
    short = shot(renderer, sensor={"exposure_ms": 0.5})
    fields = {"interlaced": {"delay_ms": 10.0}}
    comb = shot(renderer, fields, sensor={"exposure_ms": 0.5}, motion={"head_mm_s": [0, 100, 0], "steps": 2})

    def place(image, parity):
        rows = np.arange(image.irradiance.shape[0]) % 2 == (parity + image.window[1]) % 2
        bright = np.where(rows[:, None], image.irradiance, 0.0)
        bright = np.where(bright > short.irradiance[:20].max() * 3, bright, 0.0)
        return np.sum(bright * np.arange(bright.shape[1])) / np.sum(bright)

    even, odd = place(comb, 0), place(comb, 1)
    # 100 mm/s * 10 ms at 5000 / 600 px/mm; the cornea's apex moves, and with it its mirror images.
    assert abs(odd - even) == pytest.approx(1.0 * 5000 / 600, abs=0.4)
    assert (even + odd) / 2 == pytest.approx(place(short, 0), abs=0.2)
    assert np.array_equal(still.parts, comb.parts)


def test_a_panel_is_mirrored_where_a_lamp_at_its_middle_is(renderer):
    plain = shot(renderer)
    lit = shot(
        renderer, ambient={"panels": [{"centre_mm": [600, 100, 0], "size_mm": [60, 30], "radiance_w_m2_sr": 500}]}
    )
    extra = lit.irradiance - plain.irradiance
    y, x = np.mgrid[: extra.shape[0], : extra.shape[1]]
    there = extra > 0.5 * extra.max()
    xy = lit.rendered.glints.xy_px[0] - lit.window[:2]
    assert np.allclose([x[there].mean(), y[there].mean()], xy, atol=0.5)
    width, height = np.ptp(x[there]) + 1, np.ptp(y[there]) + 1
    # A convex mirror of focal length R/2: the image of w at distance d is w (R/2) / d, here 60 mm at about 608 mm.
    scale = 7.8 / 2 / 608 * 5000 / 603
    assert width == pytest.approx(60 * scale, abs=1.1)
    assert height == pytest.approx(30 * scale, abs=1.1)


def test_even_light_adds_its_share_everywhere(renderer):
    dark, bright = shot(renderer), shot(renderer, ambient={"irradiance_w_m2": 50.0})
    extra = bright.irradiance - dark.irradiance
    assert extra.min() > 0
    # The sclera mirrors nothing: its gain over its albedo is the surround's over its own.
    assert np.median(extra[dark.parts == 3]) < 0.3 * np.median(extra[dark.parts == 2])


def test_irradiance_is_in_watts_per_square_metre(renderer):
    """Photons by hand: counts follow from it with the photon's energy, the pixel's area and the time."""
    image = shot(renderer)
    sensor, photon_j = image.scene.spec.sensor, 6.62607015e-34 * 299792458 / 850e-9
    charge = image.irradiance.astype(float) * (5e-6) ** 2 * sensor.exposure_ms * 1e-3 / photon_j
    counts = charge * sensor.quantum_efficiency * sensor.gain + sensor.black_dn
    inside = (counts > 0) & (charge * sensor.quantum_efficiency < sensor.full_well_e)
    assert np.ptp(image.counts[inside].astype(float)) > 20
    np.testing.assert_allclose(image.counts[inside], counts[inside], atol=0.51)


def exr_attributes(data: bytes) -> dict[str, bytes]:
    """Attributes of the header of an OpenEXR file: name, type, size, value (the format's specification)."""
    at, found = 8, {}
    while data[at]:
        name, kind, rest = data[at:].split(b"\0", 2)
        at += len(name) + len(kind) + 6
        size = int.from_bytes(rest[:4], "little")
        found[name.decode()] = data[at : at + size]
        at += size
    return found


def test_exr_files_say_what_they_hold(renderer, tmp_path):
    from eyerender.rendering.scene.exr import write_exr

    write_exr(tmp_path / "a.exr", np.ones((3, 4), np.float32))
    said = exr_attributes((tmp_path / "a.exr").read_bytes())
    assert (said["quantity"], said["unit"]) == (b"irradiance", b"W/m^2")
