"""The eye region in the picture: what it hides and shades, that labels say so, and that the bare eye stays itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from eyerender.imaging.capture import make_renderer, render_job, render_windows
from eyerender.imaging.labels import visible_arcs_deg
from eyerender.region.anatomy import Region
from eyerender.rendering.glints.splatting import glint_reason
from eyerender.rendering.integrator import sampling
from eyerender.rendering.integrator.hostdata import FINE, PLAIN, WET
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.labels import labels_of

pytestmark = pytest.mark.render


def scene(eyes=("right",), poses=((0.0, 0.0),), look=None, region=None, spp=4, interreflection=True):
    return Scene.of(
        SceneSpec.from_mapping(
            {
                "format": 2,
                "name": "region",
                "subject": {"eyes": list(eyes), "ipd_mm": 63.0},
                "rig": {
                    "cameras": [
                        {"position_mm": [600, 0, -120], "look_at_mm": [0, 0, 0], "focal_length_px": 4000,
                         "resolution_px": [640, 320]}
                    ],
                    "lights": [{"position_mm": [600, 0, -60], "radius_mm": 2.5, "intensity_mw_sr": 100}],
                },
                "poses": [{"azimuth_deg": a, "elevation_deg": e} for a, e in poses],
                "image": {"spp": spp, "window_px": [200, 160], "interreflection": interreflection},
                **({"look": look} if look else {}),
                **({"region": region} if region is not None else {}),
            }
        )
    )  # fmt: skip


def images(renderer, *args, **kwargs):
    s = scene(*args, **kwargs)
    return list(render_windows(s.frames(), renderer=renderer))


def test_the_eye_between_open_lids_is_the_bare_eye(renderer):
    # Lids, lashes and skin send light to the eye, which is another matter.
    (bare,) = images(renderer, interreflection=False)
    (whole,) = images(renderer, region={"lashes": {"upper_count": 0, "lower_count": 0}}, interreflection=False)
    a, b = bare.rendered.labels, whole.rendered.labels
    assert np.array_equal(a.amodal, b.amodal)  # as if the eye stood alone
    seen = b.part > 0
    assert np.array_equal(b.part[seen], b.amodal[seen])
    # The pupil and the iris well inside the opening are lit as without lids, which only take light away.
    clear = ndimage.binary_erosion((b.part == 3) | ((b.part == 2) & (b.amodal == 2)), iterations=5)
    assert np.count_nonzero(clear) > 1000
    ratio = whole.irradiance[clear] / bare.irradiance[clear]
    assert np.median(ratio) == pytest.approx(1.0, abs=2e-3)
    assert np.percentile(ratio, 99) < 1.01
    assert labels_of(whole)["pupil"]["visible_fraction"] == 1.0
    assert 0.7 < labels_of(whole)["iris"]["visible_fraction"] < 1.0


def test_a_shut_lid_hides_pupil_and_glint_and_says_so(renderer):
    open_, half, shut = (
        images(renderer, region={"blink": b, "lashes": {"upper_count": 0}})[0] for b in (0.0, 0.5, 1.0)
    )
    shares = [labels_of(i)["pupil"]["visible_fraction"] for i in (open_, half, shut)]
    assert shares[0] == 1.0
    assert 0.0 < shares[1] < 1.0
    assert shares[2] == 0.0
    assert [labels_of(i)["glints"][0]["hidden_by"] for i in (open_, shut)] == ["visible", "occluded by lid"]
    assert not shut.rendered.glints.visible.any()
    assert open_.rendered.glints.visible.all()
    assert labels_of(open_)["pupil"]["visible_arcs_deg"] == [[0.0, 360.0]]
    assert labels_of(shut)["pupil"]["visible_arcs_deg"] == []
    # What is left of a half hidden pupil is its lower part: image y runs down, so angles from 0 to 180.
    ((start, end),) = labels_of(half)["pupil"]["visible_arcs_deg"]
    middle = (start + ((end - start) % 360) / 2) % 360
    assert abs(middle - 90) < 25


def test_left_is_the_mirror_image_of_right(renderer):
    right, left = images(renderer, ("right", "left"), region={}, look={"iris_contrast": 0.0, "sclera_contrast": 0.0})
    assert right.rendered.labels.visible_fraction(2) == pytest.approx(
        left.rendered.labels.visible_fraction(2), abs=0.01
    )
    # The rig is symmetric about the middle of the face, so are the pictures, but for the lattice of samples.
    a, b = right.irradiance, left.irradiance[:, ::-1]
    shift = min(range(-2, 3), key=lambda k: float(np.abs(a - np.roll(b, k, axis=1))[:, 4:-4].mean()))
    difference = np.abs(a - np.roll(b, shift, axis=1))[:, 4:-4]
    assert np.median(difference) < 0.04 * np.median(a)


def test_lid_margins_follow_the_blink(renderer):
    open_, shut = (labels_of(images(renderer, region={"blink": b})[0])["lid_margins_px"] for b in (0.0, 1.0))
    height = [np.array(m["lower"])[8, 1] - np.array(m["upper"])[8, 1] for m in (open_, shut)]
    assert height[0] > 8 * 4000 / 612 * 0.8  # about 9 mm at 6.5 px/mm
    assert abs(height[1]) < 1.0


def test_moving_lids_need_no_new_kernel(renderer):
    """Neither compiled nor read from the disk: every kernel of another pose is in memory after three frames."""
    import drjit as dr

    list(images(renderer, poses=((0, 0), (5, 5), (3, -4)), region={}))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        list(images(renderer, poses=((10, -12), (-14, 8)), region={"blink": 0.3}))
        kernels = [k for k in dr.kernel_history() if k.get("type") == dr.KernelType.JIT]
    assert len(kernels) > 5
    assert not [k for k in kernels if not k["cache_hit"] or k["cache_disk"]]


def test_two_runs_are_the_same(renderer):
    a, b = (images(renderer, region={})[0] for _ in range(2))
    assert np.array_equal(a.counts, b.counts)
    assert labels_of(a) == labels_of(b)


def test_subjects_share_a_scene_and_its_recordings(renderer):
    """A subject with other numbers of hairs is shown as by a renderer that has seen none before it."""
    from eyerender.rendering.records import recording as recorded

    few = {"seed": 2, "lashes": {"upper_count": 70, "lower_count": 20}, "brow": {"count": 150}}

    def jobs(region):
        s = scene(poses=((4, 2), (-6, 3)), region=region)
        return [replace(render_job(s.frames(), row), window=(300, 144, 40, 32), labels=False) for row in (0, 1)]

    def pictures(by, region):
        return [by.render(job, spp=2).irradiance for job in jobs(region)]

    recorded.forget()
    by = make_renderer("auto", 1)
    one = pictures(by, {})
    known = [(variants, key) for variants in recorded._played for key in variants]
    place = by.bind(jobs({})[0], lit=False)[1]
    found = pictures(by, few)
    assert by.bind(jobs(few)[0], lit=False)[1] is place
    assert known
    assert all(key in variants for variants, key in known)
    assert np.array_equal(pictures(by, {}), one)
    assert by.bind(jobs(few)[0], lit=False)[1] is not by.bind(jobs({})[0], lit=False)[1]  # they take turns
    assert np.array_equal(pictures(make_renderer("auto", 1), few), found)


@pytest.mark.parametrize("place", [pytest.param((600.0, 0.0, -120.0), marks=pytest.mark.slow), (42.0, -38.0, -16.0)])
def test_tiles_said_to_be_plain_show_nothing_but_skin_and_thin_hairs(renderer, monkeypatch, place):
    """Rays through their pixels without hairs meet the sheet, and the picture is what it is without them."""
    import drjit as dr
    import mitsuba as mi

    from eyerender.imaging.capture import render_job
    from eyerender.rendering.hits.primary import intersect
    from eyerender.rendering.integrator.sampling import Pixels, camera_ray

    s = scene(poses=((9.0, -6.0),), region={"seed": 3})
    focal = 4000 if place[0] > 100 else 600
    data = s.spec.to_mapping()
    data["rig"]["cameras"][0].update(position_mm=list(place), look_at_mm=[-4, -31, 0], focal_length_px=focal)
    # Three lamps: with one or two, samples near the lids have rays of their own to them, wherever they lie.
    lamp = data["rig"]["lights"][0]
    data["rig"]["lights"] = [{**lamp, "position_mm": [500, 60.0 * k, -60]} for k in (-1, 0, 1)]
    s = Scene.of(SceneSpec.from_mapping(data))
    camera = s.rig.cameras[0]
    job = replace(render_job(s.frames(), 0), window=(0, 0, *camera.resolution_px))
    shown, _ = renderer.bind(job)
    width, height = job.window[2:]
    plain = (shown.host.marks(job.window) & PLAIN) > 0
    assert 0.3 < plain.mean() < 0.95
    u, v = Pixels.of(job.window).at(dr.arange(mi.UInt32, width * height))
    for du, dv in ((-0.45, -0.45), (0.45, -0.1), (0.0, 0.45)):
        o, d, _ = camera_ray(shown.frame, mi.Float(u) + du, mi.Float(v) + dv)
        _, hit = intersect(shown.frame, o, d, True)
        on_sheet = hit.is_valid() & shown.frame.region.on_sheet(shown.frame.region.face(hit))
        # A ray in a million or so slips between two triangles: Embree's test is not watertight.
        assert np.count_nonzero(~on_sheet.numpy().astype(bool)[plain]) <= 3
    quick = renderer.radiance(job)
    monkeypatch.setattr(
        "eyerender.rendering.integrator.hostdata.skin_only_tiles", lambda *_: (np.zeros((1, 1), bool), 1000)
    )
    slow = renderer.radiance(job)
    # And that pixel then lacks a sample, where each is asked.
    assert np.count_nonzero(quick != slow) < 1e-4 * plain.size
    assert np.all(quick >= slow)


@pytest.mark.parametrize("lamps", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_plain_tiles_leave_no_seam_where_fine_shadows_begin(renderer, monkeypatch, lamps):
    """With few lamps the samples of a group about the lids have rays of their own; one group may have both kinds."""
    from eyerender.imaging.capture import render_job

    data = scene(region={"seed": 100}).spec.to_mapping()
    lamp = data["rig"]["lights"][0]
    data["rig"]["lights"] = [{**lamp, "position_mm": [600, 40.0 * k, -60]} for k in range(lamps)]
    s = Scene.of(SceneSpec.from_mapping(data))
    job = replace(render_job(s.frames(), 0), window=(0, 0, 640, 320))
    quick = renderer.radiance(job)
    monkeypatch.setattr(
        "eyerender.rendering.integrator.hostdata.skin_only_tiles", lambda *_: (np.zeros((1, 1), bool), 1000)
    )
    slow = renderer.radiance(job)
    # Some pixels lack a sample without plain tiles, as above.
    assert np.count_nonzero(np.abs(quick - slow) > 0.01 * np.median(slow)) < 1e-4 * slow.size


def test_reasons_are_told_apart():
    yes, no = np.array([True, True]), np.array([False, False])
    assert glint_reason(~yes, yes, [None, None]) == "off the cornea"
    assert glint_reason(yes, yes, [None, None]) == "visible"
    assert glint_reason(yes, no, ["lashes", "lashes"]) == "occluded by lash"
    assert glint_reason(yes, np.array([True, False]), [None, "skin"]) == "partly occluded by lid"


def test_arcs_of_a_half_hidden_disc():
    y, x = np.mgrid[:100, :100]
    part = np.where(np.hypot(x - 50, y - 50) < 20, 3, 2).astype(np.uint8)
    part[:50] = 0
    angle = 2 * np.pi * np.arange(72) / 72
    points = np.stack([50 + 20 * np.cos(angle), 50 + 20 * np.sin(angle)], axis=1)
    ((start, end),) = visible_arcs_deg(part, 3, points, (0, 0))
    # Reaching 1.5 px beyond the edge of what hides it: asin(1.5 / 20), about one step of 5 degrees.
    assert start > 350 or start <= 5
    assert 175 <= end <= 190


def test_drawn_subjects_are_valid_and_differ():
    a, b, again = Region.drawn(1), Region.drawn(2), Region.drawn(1)
    assert a == again
    assert a != b
    assert a.digest() == again.digest()


def test_hairs_are_sampled_more_finely(renderer, monkeypatch):
    """Pixels at thin hairs have less noise than with the samples of the others, against a picture of many samples."""
    spec = {"skin": {"relief_mm": 0.0, "sheen": 0.0, "pores": 0.0}}
    (many,) = images(renderer, region=spec, spp=256)
    (few,) = images(renderer, region=spec, spp=8)
    monkeypatch.setattr(sampling, "_TIMES", 1)
    (plain,) = images(renderer, region=spec, spp=8)
    job = render_job(scene(region=spec).frames(), 0)
    fine = (renderer.bind(job)[0].host.marks(job.window).reshape(few.irradiance.shape) & FINE) > 0
    assert 0.02 < fine.mean() < 0.4
    # Not the standard deviation: a mirror image of the lamp in a drop of water outweighs all hairs.
    error = [np.percentile(np.abs(p.irradiance - many.irradiance)[fine], 90) for p in (few, plain)]
    assert error[0] < 0.75 * error[1]
    same = ~ndimage.binary_dilation(fine, iterations=5)  # the lens blurs over a few pixels
    assert np.allclose(few.irradiance[same], plain.irradiance[same], rtol=1e-4)


def test_fine_pixels_are_those_that_hairs_touch(renderer):
    import mitsuba as mi

    from eyerender.rendering.integrator.sampling import camera_ray

    job = render_job(scene(region={}).frames(), 0)
    x0, y0, width, height = job.window
    shown, place = renderer.bind(job)
    marks = shown.host.marks(job.window).reshape(height, width)
    fine, wet = (marks & FINE) > 0, (marks & WET) > 0
    row, column = np.mgrid[y0 : y0 + height, x0 : x0 + width].reshape(2, -1)
    hairs = np.zeros(height * width, dtype=bool)
    for k in range(36):
        right, down = (k % 6 + 0.5) / 6 - 0.5, (k // 6 + 0.5) / 6 - 0.5
        o, d, _ = camera_ray(shown.frame, *(mi.Float(x.astype(np.float32)) for x in (column + right, row + down)))
        hit = shown.frame.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), d), coherent=True, active=True)
        hairs |= (hit.is_valid() & ~place.skin.on_sheet(place.skin.face(hit))).numpy()
    hairs = hairs.reshape(fine.shape)
    assert 0.02 < hairs.mean() < 0.2
    assert not np.any(hairs & ~fine)
    assert np.mean(hairs[fine & ~wet]) > 0.6  # others are touched between these rays, or by what skin hides


def test_which_pixels_are_fine_does_not_depend_on_the_window(renderer):
    job = render_job(scene(region={}).frames(), 0)
    x0, y0 = job.window[:2]
    host = renderer.bind(job)[0].host
    whole = host.marks(job.window).reshape(job.window[:1:-1]) & (FINE | WET)
    part = host.marks((x0 + 30, y0 + 20, 90, 70)).reshape(70, 90) & (FINE | WET)
    for mark in (FINE, WET):
        assert 0 < np.mean((whole & mark) > 0) < 0.4
    assert np.array_equal(part, whole[20:90, 30:120])
