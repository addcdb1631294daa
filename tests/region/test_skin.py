"""The lids in motion and the skin's map: what moves, what keeps still, and what each strength does."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from scipy import ndimage

from eyerender.region.anatomy import Region
from eyerender.region.folds import fold_depths
from eyerender.region.globe import Globe
from eyerender.region.lashes import lashes
from eyerender.region.lids import CONJUNCTIVA, FACE, LID, MARGIN, ROWS, sheet
from eyerender.region.skin import SHEET_ROWS, _Tiles, sheet_v, skin_map


def at(blink, **more):
    spec = Region.from_mapping({"seed": 5, "blink": blink, **more})
    return spec, sheet(spec, Globe.sphere())


def test_a_blink_moves_the_lid_and_not_the_brow():
    (_, open_), (_, shut) = at(0.0), at(1.0)
    moved = np.linalg.norm(open_.vertices - shut.vertices, axis=-1)
    lash_line, middle = CONJUNCTIVA + MARGIN - 1, open_.vertices.shape[1] // 4
    assert moved[lash_line, middle] > 8.0
    held = slice(ROWS - FACE // 4, ROWS)
    assert moved[held].max() < 0.05
    assert np.all(np.abs(open_.vertices[held, middle, 2]) > 14.0)


def test_the_hollow_above_the_lid_fills_as_it_shuts():
    (spec, full), (_, flat) = at(1.0), at(1.0, lids={"fill_mm": 0.0})
    (_, open_), (_, open_flat) = at(0.0), at(0.0, lids={"fill_mm": 0.0})
    assert np.array_equal(open_.vertices, open_flat.vertices)
    more = (full.vertices - flat.vertices)[..., 0]
    assert more.min() >= -1e-9
    assert more.max() == pytest.approx(spec.lids.fill_mm, rel=0.1)


def test_shut_upper_lashes_hang_down_and_open_ones_rise():
    rise = []
    for blink in (0.0, 1.0):
        spec, s = at(blink, lashes={"lower_count": 0})
        p = lashes(spec, Globe.sphere(), s).points
        middle = (np.abs(p[:, 0, 1]) < 6) & (np.linalg.norm(p[:, -1] - p[:, 0], axis=-1) > 2)
        rise.append(p[middle, -1, 2] - p[middle, 0, 2])
    assert np.mean(rise[0]) > 0.5
    assert np.mean(rise[1]) < -1.0
    assert np.mean(rise[1] < 0) > 0.9


def test_texels_are_fine_enough_everywhere():
    _, s = at(0.3)
    v = sheet_v(np.linspace(0, 1, ROWS))
    assert np.all(np.diff(v) > 0)
    height = v[-1] / (SHEET_ROWS - 0.5)  # of a texel
    size = np.linalg.norm(np.diff(s.vertices, axis=0), axis=-1).mean(axis=1) / (np.diff(v) / height)
    assert size[CONJUNCTIVA + MARGIN : CONJUNCTIVA + MARGIN + LID].max() < 0.05  # mm
    assert size.max() < 0.2


def test_the_map_is_its_specs_and_strengths_darken_their_own_places():
    spec = Region.from_mapping({"seed": 6, "skin": {"pores": 1.0, "veins": 1.0}})
    bare = Region.from_mapping({"seed": 6, "skin": {"pores": 0.0, "veins": 0.0}})
    full, none = skin_map(spec), skin_map(bare)
    skin_map.cache_clear()
    assert np.array_equal(skin_map(spec), full)
    assert not full.flags.writeable
    rows = (sheet_v(np.linspace(0, 1, ROWS)) * len(full)).astype(int)
    share = full[:SHEET_ROWS, :, 0] / none[:SHEET_ROWS, :, 0]
    # The mean stays that of the spec, so the skin between them is lighter.
    assert 1.0 < share.max() < 1.05
    share /= share.max()
    lid = share[rows[CONJUNCTIVA + MARGIN + 2] : rows[CONJUNCTIVA + MARGIN + LID], 300:460]
    far = share[rows[ROWS - 8] : rows[ROWS - 1]]
    assert 0.8 < lid.mean() < 0.995  # veins
    assert 0.8 < far.mean() < 0.995  # pores: pits between plateaus
    assert np.median(far) > 0.97
    assert far.min() < 0.9


def test_folds_stay_in_their_places_and_deepen():
    y, z = np.meshgrid(np.linspace(-30, 20, 160, dtype=np.float32), np.linspace(-20, 18, 120, dtype=np.float32))
    none, some, all_ = (fold_depths(6, strength, y, z) for strength in (0.0, 0.4, 1.0))
    assert not none.any()
    assert np.all(some <= all_ + 1e-6)
    assert 0.01 < np.mean(some > 0.2) < np.mean(all_ > 0.2) < 0.5
    assert np.max(all_) <= 1
    assert np.corrcoef(all_.ravel(), fold_depths(7, 1.0, y, z).ravel())[0, 1] < 0.5
    aged, smooth = (skin_map(Region.from_mapping({"seed": 6, "skin": {"folds": f}})) for f in (1.0, 0.0))
    assert np.array_equal(smooth, skin_map(Region(seed=6)))
    assert 0.02 < np.mean(np.abs(aged[:SHEET_ROWS, :, 0] / smooth[:SHEET_ROWS, :, 0] - 1) > 0.05) < 0.5


def test_liner_and_shadow_darken_their_own_rows():
    def albedo(**skin):
        return skin_map(Region.from_mapping({"seed": 6, "skin": skin}))[:SHEET_ROWS, 300:460, 0].mean(axis=1)

    rows = (sheet_v(np.linspace(0, 1, ROWS)) * len(skin_map(Region(seed=6)))).astype(int)
    bare, liner, shadow = albedo(), albedo(liner=1.0), albedo(shadow=1.0)
    line, lid, far = rows[CONJUNCTIVA + MARGIN - 1], rows[CONJUNCTIVA + MARGIN + 5], rows[ROWS - 6]
    assert liner[line] < 0.6 * bare[line]
    assert liner[lid] > 0.97 * bare[lid]
    assert shadow[lid] < 0.8 * bare[lid]
    assert shadow[far] > 0.97 * bare[far]


def test_roots_of_lashes_darken_a_strip_at_the_lash_line_and_not_the_whole_margin():
    def profile(**lashes_of):
        spec = Region.from_mapping({"seed": 6, "lashes": lashes_of})
        return np.median(skin_map(spec)[:SHEET_ROWS, 300:460, 0], axis=1)

    rows = (sheet_v(np.linspace(0, 1, ROWS)) * len(skin_map(Region(seed=6)))).astype(int)
    line, middle = rows[CONJUNCTIVA + MARGIN - 1], rows[CONJUNCTIVA + MARGIN // 2]
    few, many, made_up = profile(upper_count=0), profile(upper_count=150), profile(upper_count=150, mascara=1.0)
    assert many[line] < 0.95 * few[line]
    assert made_up[line] < 0.8 * many[line]
    assert many[middle] == pytest.approx(few[middle], rel=0.03)
    assert many[middle] > 0.9 * many[rows[CONJUNCTIVA + MARGIN + 3]]  # the margin is skin there


def test_lashes_and_their_dark_strip_end_before_the_nose():
    with_lashes, without = (
        skin_map(Region.from_mapping({"seed": 6, "lashes": {"upper_count": n, "lower_count": n // 2}}))[..., 0]
        for n in (150, 0)
    )
    rows = (sheet_v(np.linspace(0, 1, ROWS)) * len(without)).astype(int)
    line = rows[CONJUNCTIVA + MARGIN - 1]
    loss = 1 - with_lashes[line] / without[line]
    turn = 2 * np.pi * np.arange(len(loss)) / len(loss)
    np.testing.assert_allclose(loss[np.cos(turn) > 0.76], loss[0], atol=1e-3)
    assert np.mean(loss[np.abs(np.cos(turn)) < 0.4]) > loss[0] + 0.05


def test_a_skin_without_a_map_is_even_and_matte():
    data = yaml.safe_load("{seed: 6, skin: {map: off, albedo: 0.47}}")  # YAML reads `off` as false
    even = Region.from_mapping(data)
    sheet_of_map = skin_map(even)[:SHEET_ROWS]
    assert np.all(sheet_of_map[..., 0] == np.float32(0.47))
    assert not sheet_of_map[..., 1:].any()
    assert Region.from_mapping(even.to_mapping()) == even
    # The key appears only where it is used, so files and digests of other scenes stay as they are.
    assert "map" not in Region.from_mapping({"skin": {"map": True}}).to_mapping()["skin"]
    np.testing.assert_array_equal(skin_map(even)[SHEET_ROWS:], skin_map(Region(seed=6))[SHEET_ROWS:])  # hairs, tears


def test_a_coarse_map_shows_the_same_skin_as_a_fine_one():
    """Blurred to the same width, albedo and gloss differ by little beside what another person's differ by."""
    spec = Region.from_mapping({"seed": 6, "skin": {"folds": 0.7, "mottling": 1.0}})
    fine, coarse, other = skin_map(spec), skin_map(spec, 2), skin_map(spec.model_copy(update={"seed": 7}), 2)
    assert coarse.shape == (len(fine) // 2, fine.shape[1] // 2, 4)
    means = fine.reshape(len(coarse), 2, -1, 2, 4).mean(axis=(1, 3))
    rows = slice(80, SHEET_ROWS // 2)  # of skin
    for channel in (0, 3):
        blurred = [ndimage.gaussian_filter(m[rows, :, channel], 2.0) for m in (means, coarse, other)]
        same, apart = (np.std(m - blurred[0]) for m in blurred[1:])
        assert same < 0.2 * apart
    hairs = slice(SHEET_ROWS // 2, SHEET_ROWS // 2 + 24)  # the rows behind are those of frames of spectacles
    np.testing.assert_allclose(coarse[hairs, :, 0], means[hairs, :, 0], atol=2e-3)


def test_fine_grain_is_shifted_from_person_to_person():
    one, same, other = (_Tiles(Region(seed=seed)).net[:-2, :-2] for seed in (3, 3, 4))
    assert np.array_equal(one, same)
    spectrum = np.fft.rfft2(one - one.mean()).conj() * np.fft.rfft2(other - other.mean())
    match = np.fft.irfft2(spectrum / np.maximum(np.abs(spectrum), 1e-9), s=one.shape)
    shift = divmod(int(np.argmax(match)), match.shape[1])
    assert any(shift)
    np.testing.assert_array_equal(np.roll(one, shift, axis=(0, 1)), other)
