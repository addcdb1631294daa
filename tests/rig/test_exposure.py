"""The sensor model (EMVA 1288) and the point-spread function."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, special, stats

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.region.look import Look
from eyerender.rig import psf
from eyerender.rig.camera import Camera
from eyerender.rig.exposure import (
    IRIS_LEVEL,
    automatic_exposure,
    bloomed,
    electrons,
    expose,
    expose_again,
    iris_radiance,
    pattern,
    photon_counts,
    radiance_to_irradiance,
    recorded,
)
from eyerender.rig.plausibility import saturation_warnings
from eyerender.rig.sensor import Sensor


def test_electrons_by_counting_photons():
    # 1 W/m^2 at 850 nm on (5 um)^2 for 2 ms: energy 5e-14 J over hc/lambda = 2.33699e-19 J is 213950 photons.
    sensor = Sensor(pixel_pitch_um=5.0, exposure_ms=2.0, quantum_efficiency=0.5)
    assert float(electrons(sensor, np.array(1.0), 850.0)) == pytest.approx(0.5 * 5e-14 / 2.336989e-19, rel=1e-5)


def test_an_aperture_collects_its_solid_angle():
    # A lens of diameter D at image distance v sends L (pi/4) (D/v)^2 on to the axis, for D small against v.
    assert radiance_to_irradiance(Sensor(f_number=8.0, lens_transmission=1.0)) == pytest.approx(1e3 * np.pi / 4 / 64)


@pytest.mark.parametrize(("bits", "well"), [(8, 1000.0), (10, 5000.0), (12, 20000.0), (16, 20000.0)])
def test_photon_transfer(bits, well):
    # Variance of DN against mean: K^2 (read^2 + electrons) + 1/12 of rounding; 250 k pixels give .3 %.
    sensor = Sensor(bit_depth=bits, full_well_e=well, read_noise_e=8.0, black_level_dn=0.05 * (2**bits - 1))
    scale = float(electrons(sensor, np.array(1.0), 850.0))
    for wanted in (0.01 * well, 0.1 * well, 0.6 * well):
        dn = expose(sensor, np.full((500, 500), wanted / scale), 850.0, 3).astype(float)
        assert dn.mean() == pytest.approx(sensor.black_dn + sensor.gain * wanted, rel=2e-3)
        variance = sensor.gain**2 * (sensor.read_noise_e**2 + wanted) + 1 / 12
        assert dn.var() == pytest.approx(variance, rel=0.02)


def test_full_well_and_range_clip():
    sensor = Sensor(bit_depth=10, noise=False)
    dn = expose(sensor, np.array([[0.0, 1e9]]), 850.0, 0)
    assert dn.tolist() == [[round(sensor.black_dn), 1023]]


def test_noise_belongs_to_the_seed():
    sensor = Sensor()
    image = np.full((20, 20), 0.01)
    assert np.array_equal(expose(sensor, image, 850.0, 5), expose(sensor, image, 850.0, 5))
    assert not np.array_equal(expose(sensor, image, 850.0, 5), expose(sensor, image, 850.0, 6))


@pytest.mark.parametrize("changes", [{}, {"gamma": 2.2}, {"prnu": 0.01, "dsnu_e": 3.0, "column_e": 2.0}])
def test_a_picture_without_noise_is_exposed_again(changes):
    """The noise is that of the same exposure from its irradiance, but for the rounding of 16-bit codes."""
    sensor = Sensor(full_well_e=8000.0, read_noise_e=4.0, **changes)
    scale = float(electrons(sensor, np.array(1.0), 850.0))
    irradiance = np.linspace(0.0, 7000.0, 40_000).reshape(200, 200) / scale
    irradiance[90:110, 90:110] = 50_000.0 / scale  # a glint
    quiet = expose(sensor.model_copy(update={"noise": False}), irradiance, 850.0, 0)
    direct, again = expose(sensor, irradiance, 850.0, 5, (3, 4)), expose_again(sensor, quiet, 5, (3, 4))
    np.testing.assert_array_equal(again[90:110, 90:110], direct[90:110, 90:110])
    off = again.astype(float) - direct
    # A mean that is off by half a code moves a Poisson quantile by one electron in a few pixels.
    assert (
        np.mean(np.abs(off) < 1.5 * sensor.gain) == 1.0 if sensor.gamma == 1 else np.median(np.abs(off)) < sensor.gain
    )
    assert abs(off.mean()) < 0.01 * sensor.gain * np.sqrt(7000.0)


@pytest.mark.parametrize("mean", [0.0, 0.02, 1.0, 7.5, 11.99, 12.0, 20.0, 150.0, 6000.0, 33000.0])
def test_photon_counts_are_quantiles_of_poisson(mean):
    normal = np.linspace(-4.0, 4.0, 40001)
    expected = stats.poisson.ppf(special.ndtr(normal), mean) if mean else np.zeros(40001)
    counts = photon_counts(np.full(40001, mean), normal)
    # The expansion's error moves a count where a quantile falls on a whole number: rarely, and by one at 4 sigma.
    assert np.abs(counts - expected).max() <= 1
    assert np.mean((counts != expected) * stats.norm.pdf(normal)) < 1e-3 * np.mean(stats.norm.pdf(normal))


def test_noise_is_drawn_from_the_bits_of_numpys_generator():
    sensor, mean = Sensor(read_noise_e=0.0, full_well_e=12000.0), 5000.0
    image = np.full((31, 17), mean / float(electrons(sensor, np.array(1.0), 850.0)), np.float32)
    bits = np.random.default_rng((0x5E75, 7)).integers(0, 2**16, (2, 31, 17), np.uint16)[0]
    codes = expose(sensor, image, 850.0, 7)
    order = np.argsort(bits, axis=None, kind="stable")
    assert np.all(np.diff(codes.ravel()[order].astype(int)) >= 0)  # a greater number is a greater count
    assert len(np.unique(codes)) > 100


def test_a_pixel_does_not_move_the_noise_of_others():
    rng = np.random.default_rng(1)
    image = rng.uniform(0.0, 0.02, (40, 30))
    other = image.copy()
    other[7, 11] *= 1.5
    changed = expose(Sensor(), image, 850.0, 5) != expose(Sensor(), other, 850.0, 5)
    assert np.argwhere(changed).tolist() == [[7, 11]]


@pytest.mark.parametrize("sigma", [0.3, 0.7, 1.5, 4.0])
def test_the_kernel_has_the_variance_it_says(sigma):
    k = psf.kernel(sigma)
    n = np.arange(len(k)) - psf.margin(sigma)
    assert k.sum() == pytest.approx(1.0)
    assert (k * n**2).sum() == pytest.approx(sigma**2, rel=2e-3)  # the tails beyond 4 sigma are cut


def test_blur_takes_the_border_and_keeps_the_rest():
    image = np.random.default_rng(0).uniform(size=(40, 50))
    m = psf.margin(1.0)
    out = psf.blur(image, 1.0)
    assert out.shape == (40 - 2 * m, 50 - 2 * m)
    expected = ndimage.convolve(image, np.outer(psf.kernel(1.0), psf.kernel(1.0)))[m:-m, m:-m]
    np.testing.assert_allclose(out, expected, rtol=1e-12)


def test_splats_are_pixel_integrals():
    xy, energy = np.array([[10.3, 8.7], [12.0, 9.0]]), np.array([2.0, 3.0])
    patch, rows, columns = psf.splat(xy, energy, 0.8, (0, 0, 24, 20))
    image = np.zeros((20, 24))
    image[rows, columns] = patch
    v, u = np.meshgrid((np.arange(20 * 50) + 0.5) / 50 - 0.5, (np.arange(24 * 50) + 0.5) / 50 - 0.5, indexing="ij")
    brute = sum(
        e / (2 * np.pi * 0.64) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 1.28)
        for (x, y), e in zip(xy, energy, strict=True)
    )
    brute = brute.reshape(20, 50, 24, 50).sum(axis=(1, 3)) / 2500
    np.testing.assert_allclose(image, brute, atol=5e-5)  # the midpoint rule


def test_a_splat_outside_the_window_adds_nothing():
    patch, rows, columns = psf.splat(np.array([[500.0, 5.0]]), np.ones(1), 1.0, (0, 0, 24, 20))
    assert patch.size == 0
    assert (rows, columns) == (slice(0, 0), slice(0, 0))


def quiet(**fields):
    """A sensor whose full scale is its full well, without noise."""
    return Sensor.from_mapping({"read_noise_e": 0.0, "black_level_dn": 0.0, "full_well_e": 60000.0, **fields})


def bright(sensor, electrons_wanted, shape):
    """Irradiance at which a sensor's mean charge is the wanted one."""
    per_unit = float(electrons(sensor, np.array(1.0), 850.0))
    return np.full(shape, electrons_wanted / per_unit)


def test_the_fixed_pattern_has_the_stated_spread_and_stays():
    sensor = quiet(prnu=0.02, dsnu_e=0.0)
    image = bright(sensor, 20000.0, (300, 300))
    frames = [expose(sensor, image, 850.0, seed).astype(float) for seed in range(40)]
    mean = np.mean(frames, axis=0)
    # What forty frames of shot noise leave is 1 / sqrt(40 x 20000), a twentieth of the pattern.
    assert mean.std() / mean.mean() == pytest.approx(0.02, rel=0.02)
    other = expose(quiet(prnu=0.02, pattern_seed=1), image, 850.0, 0).astype(float)
    same = expose(sensor, image, 850.0, 99).astype(float)
    assert np.corrcoef(mean.ravel(), same.ravel())[0, 1] > 0.9
    assert abs(np.corrcoef(mean.ravel(), other.ravel())[0, 1]) < 0.02


def test_offsets_of_pixels_and_columns_in_the_dark():
    sensor = quiet(dsnu_e=30.0, column_e=50.0, black_level_dn=3000.0)
    dn = expose(sensor, np.zeros((400, 500)), 850.0, 0) / sensor.gain
    columns = dn.mean(axis=0)
    assert columns.std() == pytest.approx(50.0, rel=0.1)  # of 500 columns
    assert (dn - columns).std() == pytest.approx(30.0, rel=0.01)


def test_the_pattern_belongs_to_the_sensors_pixels():
    whole = pattern(7, 0, (0, 0), (60, 80))
    assert np.array_equal(pattern(7, 0, (10, 20), (30, 40)), whole[20:50, 10:50])
    assert stats.kstest(pattern(7, 1, (0, 0), (300, 300)).ravel(), "norm").pvalue > 1e-3
    assert abs(np.corrcoef(whole[:, 1:].ravel(), whole[:, :-1].ravel())[0, 1]) < 0.05


@pytest.mark.parametrize("along", ["columns", "rows"])
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_blooming_keeps_the_charge_that_spills(share, along):
    rng = np.random.default_rng(8)
    charge = rng.uniform(0, 800.0, (120, 90))
    charge[60, 40], charge[61, 40], charge[20, 70] = 9000.0, 4000.0, 3000.0
    out = bloomed(charge, 1000.0, share, along)
    excess = np.maximum(charge - 1000.0, 0).sum()
    assert out.max() <= 1000.0
    assert out.sum() == pytest.approx(np.minimum(charge, 1000.0).sum() + share * excess, rel=1e-12)
    changed = np.nonzero(~np.isclose(out, np.minimum(charge, 1000.0)))
    assert set(changed[1] if along == "columns" else changed[0]) == ({40, 70} if along == "columns" else {20, 60, 61})


def test_nothing_blooms_below_the_full_well():
    charge = np.full((20, 20), 500.0)
    assert np.array_equal(bloomed(charge, 1000.0, 1.0), charge)


@pytest.mark.parametrize("gamma", [1.8, 2.2])
def test_codes_with_a_gamma(gamma):
    linear = quiet(bit_depth=8, noise=False)
    encoded = quiet(bit_depth=8, noise=False, gamma=gamma)
    ramp = np.linspace(0, 1, 200)[None] * bright(linear, 60000.0, (1, 1))
    a, b = (expose(s, ramp, 850.0, 0).astype(float) for s in (linear, encoded))
    assert np.abs(255 * (b / 255) ** gamma - a).max() < 0.5 + 0.5 * gamma  # half a step of either code
    assert encoded.saturation_dn == pytest.approx(255 * (linear.saturation_dn / 255) ** (1 / gamma))
    assert expose(encoded, ramp * 4, 850.0, 0).max() >= encoded.saturation_dn


def test_sharpening_overshoots_at_edges_and_keeps_even_areas():
    """An unsharp mask of amount k and width s takes the codes at a step of height h by up to k h / 2 beyond it."""
    camera = Camera.looking_at([0, 0, 0], position_mm=[40, 0, 0], size_px=(100, 60), focal_length_px=90.0).build()
    plain = quiet(noise=False, full_well_e=15000, gain_dn_per_e=4.0)
    sharp = plain.model_copy(update={"sharpening": 0.5, "sharpening_px": 2.0})
    step = bright(plain, 4000.0, (60, 100))
    step[:, 50:] *= 2.0
    flat, edged = (recorded(s, camera, (0, 0, 100, 60), step, 850.0, 0).astype(float) for s in (plain, sharp))
    height = flat[0, 99] - flat[0, 0]
    assert np.abs(edged - flat)[:, [*range(40), *range(60, 100)]].max() <= 1.0
    share = special.ndtr(-0.25)  # of the blurred step, half a pixel before it
    assert edged[30, 49] - flat[30, 49] == pytest.approx(-0.5 * share * height, rel=0.02)
    assert edged[30, 50] - flat[30, 50] == pytest.approx(0.5 * share * height, rel=0.02)
    assert np.abs(edged.mean() - flat.mean()) < 1.0
    assert (recorded(sharp, camera, (0, 0, 100, 60), 3 * step, 850.0, 0) <= sharp.full_scale_dn).all()
    with pytest.raises(InputError, match="sharpening: "):
        Sensor.from_mapping({"sharpening": -1.0})
    with pytest.raises(InputError, match="sharpening_px: "):
        Sensor.from_mapping({"sharpening_px": 0.0})


def test_a_black_level_below_zero_clips_the_dark():
    sensor = quiet(bit_depth=8, noise=False, black_level_dn=-20.0, gain_dn_per_e=0.01)
    codes = expose(sensor, np.array([[0.0, 1.0, 2.0]]) * bright(sensor, 4000.0, (1, 3)), 850.0, 0)
    assert codes.tolist() == [[0, 20, 60]]


def test_borders_hold_their_code_and_jpeg_needs_eight_bits():
    camera = Camera.looking_at([0, 0, 0], position_mm=[40, 0, 0], size_px=(100, 80), focal_length_px=90.0).build()
    sensor = quiet(border_px=(4, 0, 0, 6), border_dn=17.0)
    dn = recorded(sensor, camera, (0, 0, 100, 80), bright(sensor, 30000.0, (80, 100)), 850.0, 0)
    assert (dn[:, :4] == 17).all()
    assert (dn[74:] == 17).all()
    assert dn[:74, 4:].min() > 20000
    with pytest.raises(InputError, match="jpeg_quality: needs bit_depth 8"):
        Sensor.from_mapping({"jpeg_quality": 60})
    with pytest.raises(InputError, match="border_dn: must be <= 255"):
        Sensor.from_mapping({"bit_depth": 8, "border_dn": 300.0})


EYE_MM = np.array([0.0, -31.5, 0.0])


def rig(count=12, distance_mm=40.0, power=1.5, **led):
    """A camera near an eye, and LEDs on a circle of 18 mm before it."""
    angle = 2 * np.pi * np.arange(count) / count
    places = [(distance_mm, -31.5 + 18 * np.cos(a), 18 * np.sin(a)) for a in angle]
    camera = er.Camera.looking_at(
        (-4, -31.5, 0), position_mm=(37, -35, -15), focal_length_px=540, size_px=(400, 400), name="near"
    )
    leds = [er.Led(place, radius_mm=0.5, intensity_mw_sr=power, **led) for place in places]
    return er.Rig(cameras=(camera,), lights=tuple(leds))


def scene(made, **sensor):
    return er.Scene(er.Subject(eyes=["right"]), made, targets=er.Targets.at((1000, 0, 0)), sensor=sensor)


def level(sensor, made):
    """Level of an iris that faces its lamps, as a share of full scale."""
    radiance = iris_radiance(made.build().lights, EYE_MM, Look().iris_albedo)
    charge = electrons(sensor, np.array(radiance_to_irradiance(sensor) * radiance), 850.0)
    return float(charge) * sensor.gain / (sensor.full_scale_dn - sensor.black_dn)


def test_bright_leds_shorten_the_exposure_and_dim_ones_raise_the_gain():
    bright, dim = (scene(rig(power=power)).spec.sensor for power in (1.5, 0.05))
    assert bright.exposure_ms < 4
    assert bright.gain_dn_per_e is None
    assert level(bright, rig()) == pytest.approx(IRIS_LEVEL, rel=0.01)
    assert dim.exposure_ms == 4
    assert dim.gain_dn_per_e > 1
    assert level(dim, rig(power=0.05)) == pytest.approx(IRIS_LEVEL, rel=0.01)
    longer = scene(rig(power=0.05), exposure_max_ms=40).spec.sensor
    assert longer.exposure_ms == pytest.approx(4 * dim.gain / longer.gain, rel=0.02)


def test_what_a_scene_states_stays():
    assert scene(rig(), exposure_ms=9).spec.sensor.exposure_ms == 9
    gained = scene(rig(), gain_dn_per_e=3).spec.sensor
    assert (gained.exposure_ms, gained.gain_dn_per_e) == (15, 3)
    # A change of the lights keeps what the scene has set, so that power still counts.
    base = scene(rig())
    assert base.with_(rig=rig(power=3.0)).spec.sensor == base.spec.sensor
    assert scene(rig(eyes=["left"])).spec.sensor.exposure_ms == 15  # no LED lights the eye
    dark = automatic_exposure(er.Sensor(), 0.0, lit=True, wavelength_nm=850.0)
    assert (dark.exposure_ms, dark.gain_dn_per_e) == (4, None)


def test_a_warning_says_by_which_factor():
    excess = scene(rig(), exposure_ms=15).exposure_excess
    assert excess == pytest.approx(15 / scene(rig()).spec.sensor.exposure_ms, rel=1e-6)
    (warning,) = saturation_warnings(3, 4, "s.yaml", excess)
    assert f"divide sensor.exposure_ms by {excess:.2g}" in warning.reason


@pytest.mark.render
def test_pictures_of_a_bright_rig_are_well_exposed(tmp_path):
    person = er.Population("adults").person(2, 7)
    subject = er.Subject.of(person, eyes=("right",))
    made = er.Scene(subject, rig(), targets=er.Targets.at((1000, 100, -80)), image={"spp": 2, "window_px": [300, 240]})
    (picture,) = er.render(made)
    levels = picture.counts / made.spec.sensor.full_scale_dn
    iris, pupil = levels[picture.parts == 2], levels[picture.parts == 3]
    assert np.mean((iris > 0.05) & (iris < 0.95)) >= 0.95
    assert np.median(iris) - np.median(pupil) >= 0.1
    assert made.spec.sensor.exposure_ms <= 4
