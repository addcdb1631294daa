"""Stray light keeps its energy, openings cut off what they should, and depths have their own blur."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft, ndimage
from scipy.special import j1

from eyerender.rig.camera import Camera
from eyerender.rig.defocus import Layer, blurred, defocused
from eyerender.rig.imaging import Lens, Opening, Star
from eyerender.rig.sensor import Sensor
from eyerender.rig.stray import (
    block_px,
    border,
    covered,
    framed,
    ghost,
    misses_light,
    scattered,
    scattered_around,
    star_kernel,
    starred,
    transmission,
    veil,
)

CAMERA = Camera.looking_at([0, 0, 0], position_mm=[40, 0, 0], size_px=(320, 240), focal_length_px=300.0).build()
WHOLE = (0, 0, 320, 240)


@pytest.fixture
def picture():
    """Random light with a few bright points."""
    rng = np.random.default_rng(4)
    out = rng.uniform(0.1, 1.0, (240, 320))
    out[rng.integers(30, 210, 9), rng.integers(30, 290, 9)] = 60.0
    return out


@pytest.mark.parametrize(("blades", "arms"), [(4, 4), (5, 10), (6, 6)])
def test_a_star_has_an_arm_on_both_sides_of_every_edge_and_keeps_energy(picture, blades, arms):
    star = Star(blades=blades, share=0.1, turn_deg=10.0, reach_px=30)
    assert starred(picture, star).sum() == pytest.approx(picture.sum(), rel=2e-2)  # its border is a mirror image
    assert starred(np.full((90, 70), 3.0), star) == pytest.approx(np.full((90, 70), 3.0))
    kernel = star_kernel(star)
    assert kernel.sum() == pytest.approx(1)
    turn = np.radians(np.arange(0, 360, 0.5))
    around = ndimage.map_coordinates(kernel, [30 + 20 * np.sin(turn), 30 + 20 * np.cos(turn)], order=1)
    lit = around > 0.3 * around.max()
    assert np.count_nonzero(lit & ~np.roll(lit, 1)) == arms
    assert lit[20]  # of 10 degrees, where one arm was asked for
    # Light of an arm falls as 1 / r^2: between 8 and 24 px by nine, up to the pixels' own steps.
    ring = [ndimage.map_coordinates(kernel, [30 + r * np.sin(turn), 30 + r * np.cos(turn)], order=1).mean() * r
            for r in (8.0, 24.0)]  # fmt: skip
    assert ring[0] / ring[1] == pytest.approx(9, rel=0.15)
    assert starred(picture, None) is picture


@pytest.mark.parametrize("radius", [3.0, 40.0, 500.0])
@pytest.mark.parametrize("glare", [0.02, 0.3])
def test_glare_moves_light_and_keeps_its_energy(picture, glare, radius):
    lens = Lens(glare=glare, glare_radius_px=radius)
    out = scattered(picture, lens, CAMERA, WHOLE)
    assert out.sum() == pytest.approx(picture.sum(), rel=1e-12)
    assert out.min() > 0
    # The stated share leaves every pixel: what remains above the veil is 1 - glare of the picture.
    assert np.allclose(out - glare * veil(picture, radius), (1 - glare) * picture, atol=1e-9)


def test_the_glares_profile_is_that_of_its_kernel():
    radius, size = 6.0, 401
    point = np.zeros((size, size))
    point[200, 200] = 1.0
    spread = veil(point, radius)
    r = np.arange(10, 60)
    expected = radius / (2 * np.pi * (r**2 + radius**2) ** 1.5)
    # The mirrored continuation adds what lies beyond the border: at most a few per cent here.
    assert spread[200, 200 + r] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("radius", [15.0, 80.0])
def test_the_long_waves_that_a_wide_glare_leaves_are_enough(picture, radius):
    waves = fft.dctn(picture, type=2, norm="ortho")
    k = np.hypot(*np.meshgrid(*(np.pi * np.arange(n) / n for n in picture.shape), indexing="ij"))
    expected = fft.idctn(waves * np.exp(-radius * k), type=2, norm="ortho")
    # The waves that are left out have a millionth of their height; about single bright pixels there are many of them.
    assert veil(picture, radius) == pytest.approx(expected, rel=3e-5)


def test_a_dark_pupil_gets_the_stated_share_of_a_wide_field():
    field = np.full((240, 320), 2.0)
    v, u = np.mgrid[:240, :320]
    field[np.hypot(u - 160, v - 120) < 8] = 0.0
    out = scattered(field, Lens(glare=0.05, glare_radius_px=60), CAMERA, WHOLE)
    # The veiling glare index: a small black area in a bright field shows the glare's share of the field.
    assert out[120, 160] / 2.0 == pytest.approx(0.05, rel=0.15)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.6])
def test_a_ghost_lies_opposite_and_has_the_stated_energy(scale):
    cx, cy = CAMERA.K[0, 2], CAMERA.K[1, 2]
    point = np.zeros((240, 320))
    spot = (130, 185)  # row, column
    point[spot] = 100.0
    lens = Lens(ghost=0.01, ghost_scale=scale, ghost_blur_px=5.0)
    out = scattered(point, lens, CAMERA, WHOLE)
    assert out.sum() == pytest.approx(100.0, rel=2e-3)
    made = ghost(point, lens, CAMERA, WHOLE)
    v, u = np.mgrid[:240, :320]
    place = np.array([(made * u).sum(), (made * v).sum()]) / made.sum()
    assert place == pytest.approx([cx - scale * (spot[1] - cx), cy - scale * (spot[0] - cy)], abs=0.1)
    assert made.sum() == pytest.approx(100.0, rel=0.02)  # linear interpolation between pixels


WINDOW = (130, 83, 101, 75)  # not on the borders of blocks


def in_window(picture):
    x0, y0, width, height = WINDOW
    return picture[y0 : y0 + height, x0 : x0 + width]


def blocks(picture, lens):
    side = block_px(lens)
    return picture.reshape(240 // side, side, 320 // side, side).mean(axis=(1, 3))


@pytest.mark.parametrize("lens", [Lens(glare=0.06), Lens(ghost=0.02, ghost_blur_px=12.0), Lens(glare=0.2, ghost=0.05)])
def test_a_window_gets_the_scattered_light_of_the_whole_sensor(picture, lens):
    lens = lens.model_copy(update={"glare_radius_px": 48.0})  # blocks of 4, of 4, of 2 px
    whole = scattered(picture, lens, CAMERA, WHOLE)
    part = scattered_around(in_window(picture), blocks(picture, lens), lens, CAMERA, WINDOW)
    # Blocks are small against glare and ghost: by pixels about bright points, and on average.
    np.testing.assert_allclose(part, in_window(whole), rtol=0.02)
    assert part.mean() == pytest.approx(in_window(whole).mean(), rel=2e-4)


def test_a_ghost_of_a_point_outside_of_the_window_arrives_in_it():
    cx, cy = CAMERA.K[0, 2], CAMERA.K[1, 2]
    point = np.zeros((240, 320))
    source, spot = (119, 139), (120, 180)  # row, column; in the window lies its ghost
    window = (150, 83, 101, 75)
    point[source] = 100.0
    assert spot == (2 * cy - source[0], 2 * cx - source[1])
    lens = Lens(ghost=0.02, ghost_blur_px=6.0)
    out = scattered_around(np.zeros((75, 101)), blocks(point, lens), lens, CAMERA, window)
    assert out.sum() == pytest.approx(2.0, rel=0.01)
    v, u = np.mgrid[83:158, 150:251]
    assert [(out * v).sum() / out.sum(), (out * u).sum() / out.sum()] == pytest.approx(spot, abs=1.0)  # half a block


@pytest.mark.parametrize(("lens", "window"), [(Lens(), WINDOW), (Lens(glare=0.1), WHOLE)])
def test_only_windows_with_scattered_light_need_what_is_around(lens, window):
    assert not misses_light(lens, CAMERA, window)
    assert misses_light(Lens(ghost=0.01), CAMERA, WINDOW)


@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_an_elliptic_opening_covers_the_right_area(turn):
    opening = Opening(half_size=(0.8, 0.5), edge_px=0.0, turn_deg=turn)
    through = transmission(opening, CAMERA, WHOLE)
    assert set(np.unique(through)) == {0.0, 1.0}
    assert through.sum() == pytest.approx(np.pi * 0.8 * 0.5 * 160**2, rel=2e-3)


def test_the_edge_of_an_opening_is_as_blurred_as_stated():
    opening = Opening(half_size=(0.6, 0.6), edge_px=5.0)
    row = transmission(opening, CAMERA, WHOLE)[119]
    x = np.arange(320) + 0.5 - 160
    slope = -np.gradient(row[160:])
    place = (slope * x[160:]).sum() / slope.sum()
    width = np.sqrt((slope * (x[160:] - place) ** 2).sum() / slope.sum())
    assert place == pytest.approx(0.6 * 160, abs=0.2)
    assert width == pytest.approx(5.0, rel=0.05)


def test_openings_are_fixed_to_the_sensor_not_to_the_window():
    opening = Opening(centre=(0.1, -0.2), half_size=(0.9, 0.6), power=6, turn_deg=10)
    whole = transmission(opening, CAMERA, WHOLE)
    assert np.allclose(transmission(opening, CAMERA, (40, 20, 100, 90)), whole[20:110, 40:140])


@pytest.mark.parametrize("edge_px", [0.0, 4.0])
def test_a_pixel_on_the_centre_of_an_opening_sees_through_it(edge_px):
    small = Camera.looking_at([0, 0, 0], position_mm=[40, 0, 0], size_px=(100, 160), focal_length_px=75.0).build()
    opening = Opening(centre=(0.05, -0.45), half_size=(0.4, 0.5), power=2.2, edge_px=edge_px)
    through = transmission(opening, small, (0, 0, 100, 160))
    x, y = round(50 * 1.05 - 0.5), round(80 - 50 * 0.45 - 0.5)
    assert np.isfinite(through).all()
    assert (through[y - 2 : y + 3, x - 2 : x + 3] > 0.9).all()


def test_a_wide_rectangle_is_a_straight_edge():
    opening = Opening(centre=(0.0, -9.4), half_size=(30.0 / 2, 10.0), power=50, edge_px=0)
    through = transmission(opening, CAMERA, WHOLE)
    edge = 120 + (10.0 - 9.4) * 160  # rows above it are open
    assert through[: int(edge) - 1].all()
    assert not through[int(edge) + 2 :].any()


def test_the_rim_shows_its_own_radiance(picture):
    lens = Lens(openings=(Opening(half_size=(0.5, 0.5), radiance_w_m2_sr=30.0),))
    out = framed(picture, lens, CAMERA, WHOLE)
    assert out[0, 0] == pytest.approx(0.03)  # mW/mm^2/sr
    assert out[120, 160] == pytest.approx(picture[120, 160])


def test_arcs_of_light_lie_on_the_rim_alone_and_belong_to_the_sensor(picture):
    opening = Opening(half_size=(0.7, 0.5), edge_px=0, arcs_w_m2_sr=2.0, arcs_seed=3)
    out = framed(picture, Lens(openings=(opening,)), CAMERA, WHOLE)
    rim = transmission(opening, CAMERA, WHOLE) == 0
    assert np.array_equal(out[~rim], picture[~rim])
    assert out[rim].max() <= 0.002 * (1 + 1e-6)
    assert np.ptp(out[rim]) > 0.0002
    # A window shows its part of the same arcs, another seed others.
    part = framed(picture[:, 120:], Lens(openings=(opening,)), CAMERA, (120, 0, 200, 240))
    other = framed(picture, Lens(openings=(opening.model_copy(update={"arcs_seed": 4}),)), CAMERA, WHOLE)
    assert np.array_equal(part, out[:, 120:])
    assert np.ptp(part[rim[:, 120:]]) > 0.0002
    assert np.abs(other - out)[rim].max() > 0.0002


def test_what_is_covered():
    assert covered(Lens(), Sensor(), CAMERA, WHOLE) is None
    sensor = Sensor(border_px=(3, 0, 5, 20))
    bars = border(sensor, CAMERA, WHOLE)
    assert bars.sum() == 8 * 240 + 20 * 320 - 8 * 20
    assert np.array_equal(
        border(sensor, CAMERA, (310, 200, 20, 40)), np.pad(bars, ((0, 0), (0, 10)), mode="edge")[200:, 310:]
    )
    both = covered(Lens(openings=(Opening(half_size=(0.9, 0.9)),)), sensor, CAMERA, WHOLE)
    assert both is not None
    assert both[bars].all()
    assert both.sum() > bars.sum()
    assert not both[120, 160]


WIDE = 60  # pixels of the grid of the exact discs, whose ripples reach farther than those of the blur


def spread(pictures: list[np.ndarray], diameters: np.ndarray) -> list[np.ndarray]:
    """Add up the band-limited discs of all pixels, as their Fourier transforms on a periodic grid."""
    down, across = np.meshgrid(np.fft.fftfreq(WIDE), np.fft.fftfreq(WIDE), indexing="ij")
    totals = np.zeros((len(pictures), WIDE, WIDE), complex)
    for (y, x), diameter in np.ndenumerate(diameters):
        argument = np.pi * diameter * np.hypot(down, across)
        argument[0, 0] = 1e-9
        disc = 2 * j1(argument) / argument * np.exp(-2j * np.pi * (down * y + across * x))
        for total, picture in zip(totals, pictures, strict=True):
            total += picture[y, x] * disc
    height, width = diameters.shape
    return [np.fft.ifft2(total).real[:height, :width] for total in totals]


def scene(seed: int, size: int = 34) -> list[Layer]:
    """Stripes before a tilted plane with texture; no pixel is covered wholly, so ripples cannot cover more."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    front = np.where(np.abs(np.sin(9 * (x + 0.3 * y))) < 0.4, rng.uniform(0.2, 0.8, (size, size)), 0.0)
    back = 1 - front
    return [
        Layer(front * rng.uniform(0.5, 1.0, (size, size)), front, 0.4 + 5 * y),
        Layer(back * rng.uniform(0.5, 1.5, (size, size)), back, 0.3 + 3 * x + y),
    ]


@pytest.mark.parametrize("seed", range(3))
def test_every_pixel_is_spread_over_its_own_disc(seed):
    front, back = scene(seed)
    reach = 8
    alpha, radiance = spread([front.coverage, front.radiance], front.confusion_px)
    room, behind = spread([back.coverage, back.radiance], back.confusion_px)
    truth = (radiance + (1 - alpha) * behind / room)[reach:-reach, reach:-reach]
    away = (blurred([front, back], reach) - truth) / truth.mean()
    # Noise shows most how far the ripples of a kernel reach, and the steps between kernels.
    assert np.sqrt(np.mean(away**2)) < 3e-3
    assert np.abs(away).max() < 0.015


@pytest.mark.parametrize("diameter", [0.0, 0.7, 2.3, 9.0, 64.0])
def test_equal_depths_are_one_convolution(diameter):
    rng = np.random.default_rng(5)
    picture = ndimage.gaussian_filter(rng.uniform(size=(90, 110)), 0.7)
    layer = Layer(picture, np.ones_like(picture), np.full(picture.shape, diameter))
    whole = defocused(picture, diameter)
    reach = (len(picture) - len(whole)) // 2
    np.testing.assert_allclose(blurred([layer], reach), whole, atol=2e-3)


def test_the_foremost_layer_hides_what_is_behind_it():
    ones = np.ones((40, 40))
    front, back = Layer(0.2 * ones, ones, 3 * ones), Layer(0 * ones, 0 * ones, 0 * ones)
    np.testing.assert_allclose(blurred([front, back], 8), 0.2, rtol=1e-5)
    half = Layer(0.1 * ones, 0.5 * ones, 3 * ones)
    rest = Layer(0.5 * ones, 0.5 * ones, 1 * ones)
    np.testing.assert_allclose(blurred([half, rest], 8), 0.6, rtol=1e-5)
