"""Light inside skin and sclera: even light stays even, shadows have the edges of the theory, lids let light through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.optics import diffusion
from eyerender.region.anatomy import Brow, Lashes, Region, Skin
from eyerender.region.contour import COLUMNS
from eyerender.region.lids import ROWS
from eyerender.region.skin import sheet_v
from tests.optics.test_interface import edge
from tests.support import render_rigs as rigs

pytestmark = pytest.mark.render

BARE = Region(
    seed=3,
    lashes=Lashes(upper_count=0, lower_count=0),
    brow=Brow(count=0),
    skin=Skin(sheen=0.0, relief_mm=0.0, wrinkles=0.0, pores=0.0),
)


def job(name: str = "remote", pose=(0.0, 0.0), **options):
    rig = rigs.RIGS[name]()
    return rigs.job_of(rigs.eye_of("E2"), rig, rig.window(320, 240), pose, labels=False, **options)


def grids(renderer, bound):
    """Grids over skin and globe of a job's frame, and the middles (mm, scene's frame) of their cells."""
    import mitsuba as mi

    from eyerender.rendering.scene.diffusiongrids import SIDE, GlobeCells, SheetCells
    from eyerender.rendering.scene.region import SHEET_COLUMNS
    from eyerender.rendering.transport import tissuegrids as light

    shown, place = renderer.bind(bound)
    sheet = light.SheetGrid.upload(SheetCells.of(place.posed, bound, 100.0, 0))
    row, column = sheet.cells[0] // sheet.columns, sheet.cells[0] % sheet.columns
    across = (mi.Float(column) + 0.5) * ((SHEET_COLUMNS - 1) / sheet.columns)
    x, _ = place.skin.sheet_point(sheet.vertex_row(row, mi.Float(0.5)), across)
    on_sheet = np.zeros((sheet.rows * sheet.columns, 3), np.float32)
    on_sheet[sheet.cells[0].numpy()] = x.numpy().T
    globe = light.GlobeGrid.upload(GlobeCells.of(place.posed, bound.globe, 8.0))
    n = light.globe_direction(*(mi.Float(k) for k in np.divmod(np.arange(SIDE**2), SIDE)))
    on_globe = float(bound.eye.sclera.radius_mm) * n.numpy().T
    return (
        (sheet, place.skin),
        on_sheet.reshape(sheet.rows, sheet.columns, 3),
        (globe, shown.frame.sclera.radius),
        on_globe,
    )


def spread(grid, lit, length_mm, on):
    """What leaves a grid's cells of the light that falls on them, as NumPy arrays; `on`: surface, or radius (mm)."""
    import mitsuba as mi

    from eyerender.rendering.transport import diffusion
    from eyerender.rendering.transport.tissuegrids import SheetGrid

    spreads = diffusion.spread_in_skin if isinstance(grid, SheetGrid) else diffusion.spread_in_globe
    return spreads(grid, on, mi.Float(lit.astype(np.float32).ravel()), diffusion.RingPoints.of(length_mm)).numpy()


def test_points_of_the_sheet_lie_on_its_triangles(renderer):
    """Rays back from just before points meet the sheet there, and at the points' own place on the map."""
    import mitsuba as mi

    place = renderer.bind(job(region=BARE), lit=False)[1]
    rng = np.random.default_rng(8)
    row, column = rng.uniform(0, ROWS - 1, 20000), rng.uniform(0, COLUMNS, 20000)
    x, n = place.skin.sheet_point(mi.Float(row), mi.Float(column))
    hit = place.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(x + 0.02 * n), -n), coherent=False, active=True)
    u, v = place.skin.map_place(place.skin.face(hit), hit.prim_uv, hit.is_valid())
    wanted = sheet_v(row / (ROWS - 1))
    found = np.stack([np.abs(hit.t.numpy() - 0.02), np.abs(u.numpy() * COLUMNS - column), np.abs(v.numpy() - wanted)])
    # Within the folds at the canthi, columns are much closer than where the rays start.
    assert np.all(np.percentile(found, 96, axis=1) < [1e-3, 0.05, 1e-4])


def test_even_light_stays_even(renderer):
    (sheet, skin), at, (globe, radius), _ = grids(renderer, job(region=BARE))
    out, cells = spread(sheet, np.ones(at.shape[:2]), 0.7, skin), sheet.cells[0].numpy()
    assert len(cells) > 0.9 * out.size
    assert out[cells] == pytest.approx(1.0, abs=1e-5)
    side = 192
    out = spread(globe, np.ones(side * side), 0.4, radius)
    assert out[globe.between.numpy()] == pytest.approx(1.0, abs=1e-5)


def lit_share(away: np.ndarray, width: np.ndarray | float) -> np.ndarray:
    """Share of cells of a width that is lit, at a distance from the edge of a shadow."""
    return np.clip(away / np.maximum(width, 1e-6) + 0.5, 0, 1).astype(np.float32)


@pytest.mark.parametrize(("name", "rows", "tolerance"), [("head", 160, 0.03), ("remote", 80, 0.05)])
def test_shadow_edges_have_their_shape_on_skin_and_globe(renderer, name, rows, tolerance):
    (sheet, skin), at, (globe, radius), on_globe = grids(renderer, job(name, region=BARE))
    assert sheet.rows == rows  # in pictures of few pixels per mm the cells are twice as large
    # The edge of a shadow runs up and down the cheek and the lower lid, and up and down the sclera.
    away, along = at[..., 1] - 2.0, np.gradient(at, axis=1)
    level = np.abs(along[..., 1]) / np.maximum(np.linalg.norm(along, axis=-1), 1e-6) > 0.95
    known = np.zeros(away.size, bool)
    known[sheet.cells[0].numpy()] = True
    near = level & known.reshape(away.shape) & (np.abs(away) < 2.5) & (at[..., 2] < -9.0) & (at[..., 2] > -14.0)
    assert near.sum() > 100
    lit = lit_share(away, np.abs(along[..., 1]))
    out = spread(sheet, lit, 0.65, skin).reshape(away.shape)[near]
    # Six rings of six places are good to 0.017 on a plane; the rows of cells are bent and of unequal width.
    worst = np.abs(out - edge(away[near], 0.65)).max()
    assert worst < tolerance
    side = 192
    away = on_globe[:, 1] - 1.0
    inside = np.zeros(side * side, bool)
    inside[globe.between.numpy()] = True
    inside &= np.abs(away) < 2.0
    assert inside.sum() > 500
    out = spread(globe, lit_share(away, 0.16), 0.38, radius)[inside]
    worst = np.abs(out - edge(away[inside], 0.38)).max()
    assert worst < 0.03


@pytest.mark.parametrize("name", ["remote", "head"])
def test_smooth_skin_and_sclera_reflect_as_much_as_before(renderer, name):
    soft_job = job(name, region=BARE)
    matte = replace(soft_job, look=soft_job.look.model_copy(update={"scattering": None}))
    soft, hard = (renderer.radiance(j, spp=16) for j in (soft_job, matte))
    part = renderer.labels(soft_job).part
    edges = np.s_[:20, :], np.s_[-20:, :]  # forehead or upper lid, and cheek
    if name == "remote":
        for skin in edges:
            assert soft[skin].sum() == pytest.approx(hard[skin].sum(), rel=0.01)
    # Near the lids the sclera loses light to what lies under them.
    assert 0.9 * hard[part == 1].sum() < soft[part == 1].sum() < hard[part == 1].sum()
    iris = ndimage.binary_erosion(part == 2, iterations=3)  # pixels of its edge show some of the sclera and the lids
    assert soft[iris].sum() == pytest.approx(hard[iris].sum(), rel=3e-3)
    # Shadows are softer: the sum of squared differences of neighbours is smaller.
    assert np.square(np.diff(soft, axis=0)).sum() < np.square(np.diff(hard, axis=0)).sum()


def test_shut_lids_transmit_light(renderer):
    import mitsuba as mi

    shut = job("remote", region=BARE.model_copy(update={"blink": 1.0}))
    shown, place = renderer.bind(shut)
    assert shown.frame.caches.diffusion is not None
    upper = place.posed.upper_margin
    up = upper[np.argmin(np.abs(upper[:, 1]))]  # where the lids meet before the eye
    inside = float(shown.frame.caches.diffusion.at_globe(shown.frame, mi.Vector3f(*(float(v) for v in up))).numpy()[0])
    lamp = shut.lights[0]
    way = lamp.position_mm - up
    outside = lamp.intensity_mw_sr / float(way @ way)  # more than what falls on the slope of the lid
    # The lids are 2 to 3.5 mm thick there.
    k = diffusion.transmitted(BARE.skin.albedo, 2.04)
    assert 0.5 * np.exp(-3.5 * k) < inside / outside < np.exp(-2.0 * k)


@pytest.mark.parametrize("name", ["remote", "head"])
def test_light_goes_on_from_the_globe_into_the_conjunctiva(renderer, name):
    """Where the conjunctiva rises from the globe in the inner corner, both have the same light; below is no shadow."""
    import mitsuba as mi

    shown, place = renderer.bind(job(name, region=BARE))
    frame, light = shown.frame, shown.frame.caches.diffusion
    column = np.linspace(-24, 24, 25) % COLUMNS  # the columns begin in the inner corner

    def both(row):
        x, _ = place.skin.sheet_point(mi.Float(np.full(25, row)), mi.Float(column))
        v = np.full(25, sheet_v(row / (ROWS - 1)))
        on_skin = light.at_skin(mi.Float(column / COLUMNS), mi.Float(v)).numpy()
        return on_skin, light.at_globe(frame, frame.point_to_eye(x)).numpy()

    skin, globe = both(0.3)
    assert skin == pytest.approx(globe, rel=0.03)
    assert np.all(both(2.0)[1] > 0.7 * globe)


def test_even_light_stays_even_where_tissues_join(renderer):
    import mitsuba as mi

    from eyerender.rendering.transport.diffusion import join_tissues

    bound = job(region=BARE)
    (sheet, _), at, _, on_globe = grids(renderer, bound)
    frame = renderer.bind(bound)[0].frame
    out = join_tissues(frame, sheet, mi.Float(np.ones(at.shape[:2]).ravel()), mi.Float(np.ones(len(on_globe))))
    assert out.numpy() == pytest.approx(1.0, abs=1e-6)
