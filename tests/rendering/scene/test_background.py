"""What frames the camera's view, in pictures, masks, labels and folders; exposure, codes, painted surroundings."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.folders.imagefolder import IMAGE_SCHEMA, ImageFolder
from eyerender.imaging.autoexposure import auto_exposed
from eyerender.imaging.capture import noiseless, render_job, render_windows
from eyerender.imaging.folder import render_folder
from eyerender.imaging.imageobserver import ImageObserver
from eyerender.imaging.images import render
from eyerender.rig.surroundings import paint
from eyerender.scene import Scene
from eyerender.scene.parts import FRAME, PUPIL
from eyerender.scene.spec import SceneSpec

pytestmark = pytest.mark.render
# A straight edge that covers the left part of the picture up to 4 px right of its middle.
EDGE = {"centre": [10.04, 0.0], "half_size": [10.0, 10.0], "power": 50, "edge_px": 2}


def scene(poses=((0.0, 0.0),), **fields):
    return Scene.of(
        SceneSpec.from_mapping(
            {
                "format": 2,
                "name": "framed",
                "subject": {"eyes": ["right"], "ipd_mm": 63.0},
                "rig": {
                    "cameras": [
                        {"position_mm": [600, -31.5, -60], "look_at_mm": [0, -31.5, 0], "focal_length_px": 3000,
                         "resolution_px": [200, 160]}
                    ],
                    "lights": [
                        {"position_mm": [600, x, 0], "radius_mm": 2.5, "aim_mm": [0, 0, 0], "intensity_mw_sr": 60}
                        for x in (-331.5, 268.5)
                    ],
                },
                "poses": [{"azimuth_deg": a, "elevation_deg": e} for a, e in poses],
                "image": {"spp": 4},
                **fields,
            }
        )
    )  # fmt: skip


def picture(renderer, **fields):
    (image,) = render_windows(scene(**fields).frames(), renderer=renderer)
    return image


def test_windows_that_overlap_are_those_rendered_one_by_one(renderer, monkeypatch):
    from eyerender.region.mesh import region_mesh

    fields = {"region": {"seed": 3}, "lens": {"glare": 0.02}}
    frames = scene([(0.0, 0.0), (9.0, -4.0), (-6.0, 5.0)], **fields).frames()
    threads: list[threading.Thread] = []

    def mesh_by(*what):
        threads.append(threading.current_thread())
        return region_mesh(*what)

    monkeypatch.setattr("eyerender.rendering.integrator.framebuilder.region_mesh", mesh_by)
    together = list(render_windows(frames, renderer=renderer))
    assert len(threads) == 2  # those of the second and the third frame
    assert threading.main_thread() not in threads
    for image in together:
        alone = renderer.render(render_job(frames, image.row), spp=4)
        assert np.array_equal(image.rendered.dn, alone.dn)
        assert np.array_equal(image.parts, alone.labels.part)
        np.testing.assert_array_equal(image.rendered.glints.xy_px, alone.glints.xy_px)


def test_an_image_before_one_that_fails_is_still_given(renderer, monkeypatch):
    frames, trace, traced = scene([(0.0, 0.0), (9.0, -4.0)]).frames(), renderer._traced, list[object]()

    def failing(job, *rest):
        if traced:
            raise InputError("broken")
        traced.append(job)
        return trace(job, *rest)

    monkeypatch.setattr(renderer, "_traced", failing)
    images = render_windows(frames, renderer=renderer)
    assert next(images).row == 0
    with pytest.raises(InputError, match="broken"):
        next(images)


def test_an_edge_darkens_the_picture_and_has_its_own_class(renderer):
    bare, cut = picture(renderer), picture(renderer, lens={"openings": [EDGE]})
    covered = np.arange(200) < 104
    assert (cut.parts[:, covered] == FRAME).all()
    assert np.array_equal(cut.parts[:, ~covered], bare.parts[:, ~covered])
    assert np.array_equal(cut.rendered.labels.amodal, bare.rendered.labels.amodal)  # as if the eye stood alone
    assert cut.irradiance[:, :90].max() < 1e-6 * bare.irradiance.max()
    assert np.allclose(cut.irradiance[:, 125:], bare.irradiance[:, 125:], rtol=1e-4)


def test_labels_say_what_a_frame_hides():
    image = render(scene(lens={"openings": [EDGE]}).frames()[0], backend="auto", threads=1)
    pupil, hidden = image.labels["pupil"], image.parts == FRAME
    whole = image.rendered.labels.amodal == PUPIL
    assert pupil["visible_fraction"] == pytest.approx(np.sum(whole & ~hidden) / np.sum(whole))
    assert 0 < pupil["visible_fraction"] < 0.5
    (arc,) = pupil["visible_arcs_deg"]
    assert arc[1] - arc[0] < 180
    left, right = sorted(image.labels["glints"], key=lambda glint: glint["xy_px"][0])
    assert (left["hidden_by"], left["visible"], left["visible_share"]) == ("occluded by frame", False, 0.0)
    assert (right["hidden_by"], right["visible"]) == ("visible", True)


def test_a_folder_says_its_classes_and_its_gamma(tmp_path):
    sensor = {"bit_depth": 8, "gamma": 2.2, "jpeg_quality": 80, "border_px": [0, 12, 0, 12]}
    given = scene(sensor=sensor, lens={"glare": 0.02})
    given = auto_exposed(given, 0.8, threads=1)
    render_folder(given, tmp_path / "out", threads=1)
    folder = ImageFolder.load(tmp_path / "out")
    (entry,) = folder
    assert (entry.line["schema"], entry.gamma) == (IMAGE_SCHEMA, 2.2)
    mask = entry.mask()
    assert (mask[:12] == FRAME).all()
    assert (mask[-12:] == FRAME).all()
    assert FRAME not in mask[12:-12]
    assert run(["validate", str(tmp_path / "out")]) == 0
    # The extractor undoes the gamma.
    found = ImageObserver().observe_folder(folder, given)
    truth = folder.truth()
    assert np.abs(found.pupil.centre_px - truth.pupil.centre_px).max() < 0.5
    metadata = tmp_path / "out" / "metadata.jsonl"
    line = json.loads(metadata.read_text())
    for wrong in ({"gamma": "2"}, {"gamma": 0.0}, {"schema": "eyerender/image/3"}, {"schema": "eyerender/image/4"}):
        metadata.write_text(json.dumps({**line, **wrong}) + "\n")
        with pytest.raises(InputError, match=next(iter(wrong))):
            ImageFolder.load(tmp_path / "out")


def test_jpeg_changes_codes_but_not_the_noiseless_ones(renderer):
    plain = picture(renderer, sensor={"bit_depth": 8, "exposure_ms": 15})
    coarse = picture(renderer, sensor={"bit_depth": 8, "jpeg_quality": 20, "exposure_ms": 15})
    assert not np.array_equal(plain.counts, coarse.counts)
    assert np.abs(plain.counts.astype(int) - coarse.counts).mean() < 3
    assert np.array_equal(noiseless(plain), noiseless(coarse))


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_one_exposure_for_a_run(level):
    given = scene(poses=((0.0, 0.0), (15.0, 0.0)), sensor={"exposure_ms": 0.3, "f_number": 2.0, "full_well_e": 20000})
    exposed = auto_exposed(given, level, threads=1)
    levels = [i.counts / 65535 for i in render_windows(exposed.frames(), threads=1)]
    # 4 samples a pixel and the sensor's noise scatter the brightest pixels by a few per cent.
    assert np.quantile(np.concatenate(levels), 0.98) == pytest.approx(level, rel=0.05)
    assert exposed.spec.sensor.f_number == 2.0


def test_a_dark_run_cannot_be_exposed():
    with pytest.raises(InputError, match="too dark"):
        auto_exposed(scene(lens={"openings": [{"centre": [30.0, 0.0], "half_size": [0.1, 0.1]}]}), 0.7, threads=1)


@pytest.mark.parametrize("place", ["office", *(pytest.param(p, marks=pytest.mark.slow) for p in ("car", "outdoors"))])
def test_painted_surroundings_are_mirrored_by_the_cornea(place, renderer):
    # The map's values are W/m^2/sr; the pupil shows their mirror image at 2 to 3 % of their radiance.
    dark = picture(renderer)
    lit = picture(renderer, ambient={"map": {"place": place, "place_seed": 3}})
    values = paint(place, 3, 64)
    assert (values.shape, values.min() > 0, values.max() < 8) == ((64, 128), True, True)
    assert not np.array_equal(values, paint(place, 4, 64))
    gained = (lit.irradiance - dark.irradiance)[dark.parts == PUPIL]
    unit = np.pi * 0.9 / 4 / 2.0**2  # irradiance of a radiance of 1 at f/2
    assert 0 < gained.mean() / unit < 0.05 * values.max()
    assert gained.std() > 0


def test_a_map_is_a_file_or_a_place():
    for both in ({}, {"place": "office", "file": "x.npy"}):
        with pytest.raises(InputError, match="give either file or place"):
            SceneSpec.from_mapping({**scene().spec.to_mapping(), "ambient": {"map": both}})
