"""A surrounding given as an HDR map, and the light of panels: each against its own law in float64."""

from __future__ import annotations

import os
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.rig.imaging import Ambient, Panel, RadianceMap
from tests.support.render_oracles import corneal_share, mirror_pixel
from tests.support.render_rigs import BLACK, LampRig, eye_of, job_of, remote_rig

WINDOW = (120, 120)


def unit(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def directions(height: int) -> np.ndarray:
    """Directions (h, 2 h, 3) of a map's texels in its own frame, written out anew."""
    polar = np.pi * (np.arange(height) + 0.5) / height
    turn = np.pi - 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    return np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], axis=-1)


def patch(height: int, centre_deg: tuple[float, float], radius_deg: float, value: float) -> np.ndarray:
    near = directions(height) @ unit(*centre_deg) > np.cos(np.radians(radius_deg))
    return np.where(near, value, 0.0)


def ambient_of(path, values, **more) -> Ambient:
    np.save(path, values.astype(np.float32))
    return Ambient(map=RadianceMap(file=str(path), **more))


def dark_rig() -> LampRig:
    """The remote camera without lamps."""
    return LampRig(remote_rig().camera, ())


def radiance(renderer, ambient, spp=16, **more):
    job = job_of(eye_of("E2"), dark_rig(), dark_rig().window(*WINDOW), ambient=ambient, **more)
    return job, renderer.radiance(job, spp=spp)


def test_an_even_map_is_even_light(renderer, tmp_path):
    # E = pi L: the same picture as that of the irradiance itself, mirror, sclera, iris and surround.
    _, even = radiance(renderer, Ambient(irradiance_w_m2=np.pi * 2.5))
    ambient = ambient_of(tmp_path / "even.npy", np.full((16, 32), 0.5), scale_w_m2_sr=5.0, azimuth_deg=33.0)
    _, mapped = radiance(renderer, ambient)
    assert even.min() > 0
    np.testing.assert_allclose(mapped, even, rtol=2e-4)


def test_the_apex_mirrors_the_map_by_fresnel(renderer, tmp_path):
    # A black eye shows nothing but the mirror: L F at normal incidence where the camera looks along the normal.
    look = {"look": BLACK}
    ambient = ambient_of(tmp_path / "even.npy", np.full((16, 32), 3.0))
    job, seen = radiance(renderer, ambient, **look)
    F = corneal_share(np.array(1.0), job.eye)
    # The point whose normal goes through the nodal point mirrors the camera into itself.
    u, v = mirror_pixel(job.eye, job, job.camera.nodal_point_mm)[0]
    column, row = round(u) - job.window[0], round(v) - job.window[1]
    ray = job.camera.rays(np.array([[float(round(u)), float(round(v))]]))[0]
    cosine = float(ray @ job.camera.axis)
    assert seen[row, column] == pytest.approx(3e-3 * F * cosine**4, rel=1e-3)


@pytest.mark.parametrize(
    ("patch_deg", "turn"),
    [
        ((20.0, 10.0), {}),
        pytest.param((-25.0, -5.0), {}, marks=pytest.mark.slow),
        ((0.0, 0.0), {"azimuth_deg": 20.0, "elevation_deg": 10.0}),
    ],
)
def test_a_bright_patch_is_seen_where_a_far_lamp_is(renderer, tmp_path, patch_deg, turn):
    bright = patch(256, patch_deg, radius_deg=4.0, value=100.0)
    ambient = ambient_of(tmp_path / "patch.npy", bright, **turn)
    job, seen = radiance(renderer, ambient, spp=64, look=BLACK)
    where = unit(20.0, 10.0) if turn else unit(*patch_deg)
    # The image of an extended patch is mirrored point by point; its middle by radiance is compared with the same mean
    # over the patch's own directions, each traced by Fermat's principle as a lamp a kilometre away.
    helper = np.cross(where, [0.3, 0.2, 1.0])
    e1 = helper / np.linalg.norm(helper)
    e2 = np.cross(where, e1)
    rim = np.array(
        [
            mirror_pixel(job.eye, job, 1e6 * (where * np.cos(r) + np.sin(r) * (np.cos(a) * e1 + np.sin(a) * e2)))[0]
            for r, a in [(np.radians(4.0), a) for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)]
        ]
    )
    x, y = rim.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    centre = np.array([np.sum((x + np.roll(x, -1)) * cross), np.sum((y + np.roll(y, -1)) * cross)]) / (3 * cross.sum())
    v, u = np.mgrid[: seen.shape[0], : seen.shape[1]]
    lit = np.where(seen > 0.02 * seen.max(), seen, 0)
    measured = np.array([np.sum(lit * u), np.sum(lit * v)]) / lit.sum() + job.window[:2]
    assert np.hypot(*(measured - centre)) < 0.1
    # And it is as large as the mirror makes it.
    assert np.sqrt(lit.sum() / lit.max() * 4 / np.pi) == pytest.approx(
        np.sqrt(abs(cross.sum()) / 2 * 4 / np.pi), rel=0.05
    )


def test_brow_and_lids_hide_what_lies_behind_them(renderer, tmp_path):
    from eyerender.region.anatomy import Region

    region = Region.from_mapping({"lashes": {"upper_count": 0, "lower_count": 0}, "brow": {"count": 0}})
    sums = {}
    for elevation in (5.0, 70.0):
        ambient = ambient_of(tmp_path / f"{elevation}.npy", patch(128, (10, elevation), 6, 50.0))
        job, bare = radiance(renderer, ambient, look=BLACK)
        _, between = radiance(renderer, ambient, look=BLACK, region=region, interreflection=False)
        # The part of the clear cornea that is seen in both, away from the lids, which the map lights.
        seen = ndimage.binary_erosion(renderer.labels(replace(job, region=region)).part >= 2, iterations=2)
        sums[elevation] = between[seen].sum() / bare[seen].sum()
        assert bare[seen].sum() > 0
    assert sums[5.0] == pytest.approx(1, abs=0.02)
    assert sums[70.0] < 0.02


def test_roll_turns_the_map_about_its_middle(renderer, tmp_path):
    # Rolled clockwise by 90 degrees, as the subject sees it, what lies to the left comes up.
    _, left = radiance(renderer, ambient_of(tmp_path / "a.npy", patch(128, (20, 0), 4, 9.0), roll_deg=90.0), look=BLACK)
    _, above = radiance(renderer, ambient_of(tmp_path / "b.npy", patch(128, (0, 20), 4, 9.0)), look=BLACK)
    v, u = np.mgrid[: left.shape[0], : left.shape[1]]
    a, b = (np.array([np.sum(s * u), np.sum(s * v)]) / s.sum() for s in (left, above))
    assert np.hypot(*(a - b)) < 0.2


def test_irradiance_against_the_integral(renderer, tmp_path):
    """Matte surfaces against the sum over the map, with a window and a sun of two degrees in it."""
    import mitsuba as mi

    from eyerender.rendering.transport.environment import Ambience, Maps
    from eyerender.rendering.transport.environmentmap import map_rotation

    rng = np.random.default_rng(5)
    spec = RadianceMap(file=str(tmp_path / "m.npy"), azimuth_deg=40.0, elevation_deg=-20.0, roll_deg=65.0)
    w = directions(64)
    values = 1 + w[..., 2] + 0.5 * (w[..., 1] > 0.3) * (w[..., 2] > 0) + 2e3 * (w @ unit(30.0, 20.0) > np.cos(0.02))
    np.save(tmp_path / "m.npy", values)
    n = rng.normal(size=(40, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    edges = np.cos(np.pi * np.arange(65) / 64)
    weight = (edges[:-1] - edges[1:])[:, None, None] * (np.pi / 64)
    world = w @ map_rotation(spec).T
    expected = np.array([np.sum(weight[..., 0] * values * np.maximum(world @ k, 0)) for k in n]) * 1e-3
    ambience = Ambience.build(0.0, np.zeros((0, 13)), spec, Maps())
    seen = ambience.at(mi.Vector3f(0), mi.Vector3f(*n.T.astype(np.float32))).numpy()
    # The table's cells are 3.75 degrees large: cosines between them are good to 5e-4, and where the sun sets to .01.
    np.testing.assert_allclose(seen, expected, atol=0.01 * expected.max())
    assert np.abs(seen - expected).mean() < 5e-4 * expected.max()


@pytest.mark.parametrize(
    ("point", "normal"),
    [((0, 0, 0), (1, 0, 0)), ((-3, 8, -20), (0.6, 0.8, 0)), ((0, 0, 0), (0.05, 0, 1)), ((0, 0, 0), (-0.2, -1, 0.1)),
     ((0, 0, 0), (-1, 0.1, 0))],
)  # fmt: skip
def test_a_panels_irradiance_against_the_integral(renderer, point, normal):
    import mitsuba as mi

    from eyerender.rendering.records.job import panel_table
    from eyerender.rendering.transport.environment import Ambience, Maps

    panel = Panel(centre_mm=(500.0, 60.0, 90.0), size_mm=(520.0, 290.0), radiance_w_m2_sr=2.0)
    table = panel_table(Ambient(panels=(panel,)), np.zeros(3))
    # E = integral of L cos cos' / r^2 dA over 600 x 600 pieces of the panel, those below the horizon dark.
    centre, front = table[0, 0:3], table[0, 3:6]
    right, up = (v / (v @ v) for v in (table[0, 6:9], table[0, 9:12]))
    s = (np.arange(600) + 0.5) / 300 - 1
    a, b = np.meshgrid(s, s)
    q = centre + a[..., None] * right + b[..., None] * up - np.array(point)
    r = np.linalg.norm(q, axis=-1)
    n = np.array(normal) / np.linalg.norm(normal)
    area = 4 * np.linalg.norm(right) * np.linalg.norm(up) / s.size**2
    expected = 2e-3 * np.sum(np.maximum(q @ n, 0) * np.maximum(-q @ front, 0) / r**4) * area
    ambience = Ambience.build(0.0, table, None, Maps())
    seen = float(ambience.at(mi.Vector3f(*map(float, point)), mi.Vector3f(*map(float, n))).numpy()[0])
    assert seen == pytest.approx(expected, rel=2e-3, abs=1e-9)


def test_a_panel_is_the_same_rectangle_for_both_eyes():
    from eyerender.rendering.records.job import panel_lamps, panel_table

    near = Panel(centre_mm=(40.0, 0.0, 30.0), size_mm=(50.0, 20.0), radiance_w_m2_sr=2.0)
    wall = near.model_copy(update={"aim_mm": (40.0, -100.0, 30.0)})
    ambient = Ambient(panels=(near, wall))
    anchors = [np.array([0.0, y, 5.0]) for y in (-31.5, 31.5)]
    one, other = panel_table(ambient, anchors[0]), panel_table(ambient, anchors[1])
    lamps = [panel_lamps(ambient, anchor) for anchor in anchors]
    np.testing.assert_allclose(one[:, :3] + anchors[0], other[:, :3] + anchors[1])
    np.testing.assert_array_equal(one[:, 3:], other[:, 3:])
    np.testing.assert_allclose(one[:, 3:6], [[-0.8, 0.0, -0.6], [0.0, -1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(one[1, 9:12], [0, 0, 1 / 10])  # upright, 20 mm high
    places = np.array([[lamp.position_mm for lamp in part] for part in lamps])
    np.testing.assert_allclose(places[0], places[1])
    # Straight below there is no level direction but a chosen one; on its own aim there is no panel.
    assert np.all(
        np.isfinite(
            panel_table(Ambient(panels=(Panel(centre_mm=(0, 0, -40), size_mm=(9, 9), radiance_w_m2_sr=1),)), anchors[0])
        )
    )
    with pytest.raises(InputError, match="aim_mm is the panel's own centre"):
        Panel(centre_mm=(0, 0, 0), size_mm=(1, 1), radiance_w_m2_sr=1)


def test_maps_strength_and_turn_compile_nothing_and_send_nothing_anew(renderer, tmp_path):
    import drjit as dr

    def kernels(*ambients):
        """Hashes of the kernels that pictures launch, compiled in this process or kept on the disk."""
        dr.kernel_history_clear()
        for ambient in ambients:
            radiance(renderer, ambient)
        return {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}

    first = ambient_of(tmp_path / "a.npy", patch(64, (20, 10), 10, 5.0))
    other = ambient_of(tmp_path / "b.npy", patch(100, (-20, 10), 10, 5.0), scale_w_m2_sr=0.3, azimuth_deg=12.0)
    # Panels have kernels of their own, which one more panel or another place does not change.
    some = Panel(centre_mm=(450.0, 0.0, 40.0), size_mm=(200.0, 100.0), radiance_w_m2_sr=1.0)
    panel = Panel(centre_mm=(500.0, 60.0, 90.0), size_mm=(520.0, 290.0), radiance_w_m2_sr=2.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        known = kernels(first, Ambient(irradiance_w_m2=1.0), first.model_copy(update={"panels": (some, some)}))
        again = kernels(other, first, first.model_copy(update={"panels": (panel,)}))
    assert again
    assert again <= known
    sent = renderer._builder._maps.of(first.map)[0]
    radiance(renderer, first)
    assert renderer._builder._maps.of(first.map)[0] is sent


def test_kernels_do_not_depend_on_where_the_memory_of_a_map_lies(renderer):
    """Tables of maps are made again and again, with other memory taken in between."""
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.transport.environment import Maps

    found, taken = set(), []
    where = mi.Point2f(dr.opaque(mi.Float, 0.3, 64), dr.opaque(mi.Float, 0.6, 64))
    dr.eval(where)
    for k in range(12):
        taken.append(np.empty(25600 + 16 * k, np.uint8))  # NumPy's memory lies at multiples of 16 bytes
        table = Maps().of(None)[1]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(table.eval(where))
            found |= {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
    assert len(found) == 1


@pytest.mark.parametrize("ending", ["hdr", "exr", "pfm"])
def test_formats_and_channels(renderer, tmp_path, ending):
    import mitsuba as mi

    from eyerender.rendering.scene.exr import second_thread
    from eyerender.rendering.transport.environmentmap import read_map

    colours = np.random.default_rng(3).uniform(0.1, 40.0, (8, 16, 3)).astype(np.float32)
    path = tmp_path / f"map.{ending}"
    with second_thread():
        mi.Bitmap(colours).write(str(path))
    tolerance = 0.01 if ending == "hdr" else 1e-6  # shared exponents keep eight bits
    largest = colours.max(axis=2)
    for channel, expected in (("red", colours[..., 0]), ("luminance", colours @ np.array([0.2126, 0.7152, 0.0722]))):
        assert np.abs((read_map(path, channel) - expected) / largest).max() < tolerance


def test_a_large_map_is_averaged_not_sampled(renderer):
    from eyerender.rendering.transport.environmentmap import environment_map

    rng = np.random.default_rng(2)
    values = rng.exponential(size=(1200, 2400)) ** 4
    made = environment_map(values)
    assert made.values.shape == (512, 1024)
    assert made.values.mean() == pytest.approx(values.mean(), rel=1e-6)


def test_files_that_are_no_maps_are_refused(renderer, tmp_path):
    from eyerender.rendering.transport.environment import Maps
    from eyerender.rendering.transport.environmentmap import read_map

    (tmp_path / "cut.hdr").write_bytes(b"#?RADIANCE\n")
    (tmp_path / "text.exr").write_text("hello")
    np.save(tmp_path / "square.npy", np.ones((8, 8)))
    np.save(tmp_path / "negative.npy", np.full((8, 16), -1.0))
    np.save(tmp_path / "hole.npy", np.full((8, 16), np.nan))
    np.save(tmp_path / "good.npy", np.ones((8, 16)))
    np.savez(tmp_path / "pair.npz", np.ones((8, 16)))
    (tmp_path / "pair.npz").rename(tmp_path / "pair.npy")
    # Files of a few bytes that claim to be 10^11 pixels large: a reader would allocate them first.
    header = str({"descr": "<f8", "fortran_order": False, "shape": (400_000, 800_000)}).encode().ljust(118)
    (tmp_path / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    (tmp_path / "huge.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 400000 +X 800000\n")
    (tmp_path / "huge.pfm").write_bytes(b"Pf\n800000 400000\n-1.0\n")
    (tmp_path / "empty.pfm").write_bytes(b"Pf\n0f\n0 4!\n-\n\0?\0\0")  # Mitsuba divides by its width
    window = struct.pack("<4i", 0, 0, 799_999, 399_999)
    (tmp_path / "huge.exr").write_bytes(b"v/1\x01\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0" + window)
    os.mkfifo(tmp_path / "pipe.exr")
    for name, words in (
        ("cut.hdr", "not a readable map"),
        ("text.exr", "not a readable map"),
        ("square.npy", "8 x 8; a map of all directions must be twice as wide"),
        ("negative.npy", "negative"),
        ("hole.npy", "not finite"),
        ("none.exr", "no such file"),
        ("pair.npy", "not a readable map"),
        *((f"huge.{kind}", "has 320000000000 pixels; at most") for kind in ("npy", "hdr", "pfm", "exr")),
        ("empty.pfm", "its header names no size"),
        ("pipe.exr", "is a pipe, not a file"),
        ("room.jpg", "must end with"),
    ):
        with pytest.raises(InputError, match=words):
            read_map(tmp_path / name)
    with pytest.raises(InputError, match="sha256"):
        Maps().of(RadianceMap(file=str(tmp_path / "good.npy"), sha256="0" * 64))


def test_a_scene_with_a_bad_map_ends_in_one_line(renderer, tmp_path, capsys, monkeypatch):
    import yaml

    from eyerender.scene import load_scene, shipped_scenes

    monkeypatch.chdir(tmp_path)
    data = yaml.safe_load(shipped_scenes()["quickstart"].read_text(encoding="utf-8"))
    (tmp_path / "rooms").mkdir()
    for file in ("none.exr", "text.exr"):
        data["ambient"] = {"map": {"file": file}}
        (tmp_path / "rooms" / "scene.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
        (tmp_path / "rooms" / "text.exr").write_text("hello")
        assert run(["render", "rooms/scene.yaml", "-o", "out"]) == 2
        error = capsys.readouterr().err.strip()
        assert error.count("\n") == 0
        assert file in error
        assert not (tmp_path / "out").exists()
    # Another file's content makes another scene; the record keeps the path as it was written.
    one = load_scene("rooms/scene.yaml")
    before = one.digest()
    (tmp_path / "rooms" / "text.exr").write_text("other")
    assert one.digest() != before
    assert one.spec.to_mapping()["ambient"]["map"]["file"] == "text.exr"
