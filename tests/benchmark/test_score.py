"""Scores and figures against values worked out by hand or by simulation."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import make_ideal_images as ideal
from eyerender.apps.benchmark.bound import Edge, edge_of, is_bounded, measure_edge
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.glintlabels import GlintLook, TrueGlint
from eyerender.apps.benchmark.labelled import BenchImage
from eyerender.apps.benchmark.protocol import Reply
from eyerender.apps.benchmark.score import GlintScore, Score, score, score_glints
from eyerender.apps.benchmark.summary import bins, breakdown, efficiency, failures, summarise
from eyerender.base.errors import InputError
from eyerender.folders.imagefile import read_image
from eyerender.optics.ellipse import Ellipse, signed_distance

PUPIL = Ellipse(np.array([50.0, 40.0]), np.array([20.0, 16.0]), 0.4)
IMAGE = BenchImage(
    name="a.png", path=Path("a.png"), bit_depth=8, size=(100, 80), pupil=PUPIL, outline_px=PUPIL.points(120),
    glints=(TrueGlint(0, (45.0, 40.0)), TrueGlint(1, (55.0, 40.0)), TrueGlint(2, (50.0, 30.0))),
)  # fmt: skip


def found(ellipse, glints=(), **more):
    return Reply(ellipse=ellipse, reason=None, confidence=None, glints=tuple(glints), cpu_s=None, wall_s=None, **more)


def test_outcomes():
    both = ("pupil", "glints")
    assert score(IMAGE, found(PUPIL.shifted((0.1, 0))), 0.1, both).outcome == "right"
    assert score(IMAGE, found(PUPIL.scaled(2.2)), 0.1, both).outcome == "wrong"  # as of one that locked onto the iris
    assert score(IMAGE, found(None), 0.1, both).outcome == "none"
    assert score(IMAGE, found(None, error="broken"), 0.1, both).outcome == "error"
    empty = replace(IMAGE, pupil=None)
    assert score(empty, found(PUPIL), 0.1, both).outcome == "false"
    assert score(empty, found(None), 0.1, both).outcome == "absent"


def test_errors_of_a_known_difference():
    got = score(
        IMAGE, found(Ellipse(np.array([50.3, 39.6]), np.array([20.2, 15.9]), 0.4 + math.pi - 0.01)), 0.1, ("pupil",)
    )
    assert got.offset_px == pytest.approx((0.3, -0.4))
    assert got.centre_px == pytest.approx(0.5)
    assert got.axes_px == pytest.approx((0.2, -0.1))
    assert got.angle_deg == pytest.approx(math.degrees(-0.01))
    assert got.glints is None


def test_boundary_error_is_that_of_a_grown_circle():
    circle = Ellipse(np.array([50.0, 40.0]), np.array([20.0, 20.0]), 0.0)
    image = replace(IMAGE, pupil=circle, outline_px=circle.points(100))
    got = score(image, found(circle.scaled(1.01)), 0.1, ("pupil",))
    assert got.boundary_px == pytest.approx(0.2)
    assert got.iou == pytest.approx(1 / 1.01**2, abs=1e-4)  # of the numeric IoU


def test_glints_are_matched_one_to_one_and_swaps_are_counted():
    reported = [((45.5, 40.0), 1), ((55.0, 40.2), 0), ((80.0, 70.0), None), ((45.0, 40.9), None)]
    got = score_glints(IMAGE, found(PUPIL, reported))
    assert (got.true, got.reported, len(got.errors_px)) == (3, 4, 2)
    assert np.allclose(sorted(got.errors_px), [(0.0, 0.2), (0.5, 0.0)])  # the nearer of the two near the first
    assert (got.named, got.swapped) == (2, 2)
    right = score_glints(IMAGE, found(PUPIL, [((50.0, 30.0), 2), ((45.0, 40.0), None)]))
    assert (right.named, right.swapped, len(right.errors_px)) == (1, 0, 2)
    none = score_glints(IMAGE, found(PUPIL))
    assert none == GlintScore(true=3, reported=0, matches=tuple((False, glint) for glint in IMAGE.glints))


def test_false_and_unnamed_glints_are_counted():
    reported = [((45.5, 40.0), 1), ((55.0, 40.2), None), ((80.0, 70.0), None), ((45.0, 40.9), None)]
    assert score_glints(IMAGE, found(PUPIL, reported)).unnamed == 0  # nobody could name them without a rig
    got = score_glints(replace(IMAGE, hints={"rig": {}}), found(PUPIL, reported))
    assert (got.named, got.unnamed) == (1, 1)
    assert got.false_kinds == ("elsewhere", "repeated")
    assert [matched for matched, _ in got.matches] == [True, True, False]
    scores = [Score("right", offset_px=(0, 0), axes_px=(0, 0), iou=0.98, boundary_px=0.2, glints=got)]
    recall = summarise(scores)["glints"]["recall_by"]
    assert recall["visible"] == {"whole": {"true": 3, "matched": 2, "recall": 2 / 3}}


def test_a_large_glint_matches_within_its_radius():
    far = [((45.0, 43.5), 0)]
    assert len(score_glints(IMAGE, found(PUPIL, far)).errors_px) == 0
    large = replace(IMAGE, glints=(replace(IMAGE.glints[0], look=GlintLook(radius_px=3.0)), *IMAGE.glints[1:]))
    assert len(score_glints(large, found(PUPIL, far)).errors_px) == 1


def test_rates_are_over_the_images_that_show_a_pupil():
    scores = [Score("right", offset_px=(0.3, 0.4), axes_px=(0.1, -0.2), iou=0.98, boundary_px=0.2)] * 3
    scores += [Score("wrong", "IoU", offset_px=(9, 12), axes_px=(3, 3), iou=0.3)]
    scores += [
        Score("none", "dark"),
        Score("error", "crash"),
        Score("absent", with_pupil=False),
        Score("false", with_pupil=False),
    ]
    got = summarise(scores)
    assert got["rates"] == {"right": 0.5, "wrong": 1 / 6, "none": 1 / 6, "error": 1 / 6, "false": 0.5}
    assert (got["without_pupil"], got["false"]) == (2, 1)
    assert got["centre_px"] == {"n": 3, "median": 0.5, "p95": 0.5, "worst": 0.5}
    assert got["centre_px_of_all_found"]["worst"] == 15.0
    assert got["centre_bias_px"] == pytest.approx([0.3, 0.4])
    assert got["semi_axes_bias_px"] == pytest.approx([0.1, -0.2])
    named = [replace(s, image=f"{k}.png") for k, s in enumerate(scores)]
    listed = {f["outcome"]: (f["count"], f["first"]) for f in failures(named)}
    assert listed == {"wrong": (1, "3.png"), "none": (1, "4.png"), "error": (1, "5.png"), "false": (1, "7.png")}


def test_an_extractor_at_the_bound_has_efficiency_one():
    rng = np.random.default_rng(3)
    sigmas = rng.uniform(0.005, 0.05, 4000)
    scores = [Score("right", offset_px=tuple(rng.normal(0.0, s, 2)), sigma_px=s) for s in sigmas.tolist()]
    value = efficiency(scores)["value"]
    # The median of 4000 Rayleigh draws scatters by 1 / (2 f sqrt(n)) = 1.3 %, f the density at it.
    assert value == pytest.approx(1.0, abs=0.05)
    far = [replace(s, offset_px=(2 * s.offset_px[0], 2 * s.offset_px[1])) for s in scores]
    assert efficiency(far)["value"] == pytest.approx(0.5 * value)
    assert efficiency([Score("none", sigma_px=0.01)])["value"] is None


def test_under_a_lid_the_edge_is_measured_where_it_is_visible():
    """A drawn pupil whose upper half a bright bar hides: without the mask, the bar would count as well."""
    condition = ideal.Condition(size=(240, 200), blur=(1.0, 1.0), noise=(2.0, 2.0), semi_axis=(30, 30), glints="none")
    drawing = ideal.draw(condition, 10_000)
    label = drawing.label["pupil"]
    pupil = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
    row = int(pupil.centre_px[1]) - 5
    grey = drawing.image.astype(float)
    grey[:row] = 150.0
    shows = np.ones(grey.shape, dtype=bool)
    shows[:row] = False
    edge = edge_of(grey, 8, pupil, np.zeros((0, 2)), {}, shows)
    # As for a whole outline, with half as many pixels.
    assert edge.step_dn == pytest.approx(55.0, rel=0.05)
    assert edge.sigma_px == pytest.approx(math.sqrt(1 + 1 / 12), rel=0.12)
    assert edge.noise_dn == pytest.approx(math.sqrt(4 + 1 / 12), rel=0.2)
    blind = edge_of(grey, 8, pupil, np.zeros((0, 2)), {})
    assert blind.noise_dn < 1.5  # the bar has no noise


def arc_of_a_pupil(seed, rows):
    """Grey levels, outline and visible pixels of a drawn pupil that shows some rows between two bright lids."""
    condition = ideal.Condition(size=(160, 140), blur=(1.0, 1.0), noise=(2.0, 2.0), semi_axis=(30, 30), glints="none")
    drawing = ideal.draw(condition, seed)
    label = drawing.label["pupil"]
    pupil = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
    grey, first = drawing.image.astype(float), int(pupil.centre_px[1]) + 12
    shows = np.zeros(grey.shape, dtype=bool)
    shows[first : first + rows] = True
    grey[~shows] = 180.0
    return grey, pupil, shows


@pytest.mark.parametrize(("rows", "arc_deg"), [(3, 5), (7, 16)])
def test_the_edge_of_a_short_arc_is_measured_with_its_error(rows, arc_deg):
    """Of 3 rows, only one is clear of the lids by a pixel, and of 7 rows three by two pixels."""
    found = []
    for seed in range(10_000, 10_020):
        grey, pupil, shows = arc_of_a_pupil(seed, rows)
        found.append(edge_of(grey, 8, pupil, np.zeros((0, 2)), {}, shows))
    assert np.mean([edge.arc_deg for edge in found]) == pytest.approx(arc_deg, rel=0.15)
    # The rms of 20 standard normal numbers lies within 0.65 and 1.4 in 99 % of the cases; a robust fit of a few pixels
    # states its errors within a fifth.
    for miss in (
        [(e.step_dn - 55.0) / e.step_sd_dn for e in found],
        [(e.sigma_px - math.sqrt(1 + 1 / 12)) / e.sigma_sd_px for e in found],
    ):
        assert 0.55 < np.sqrt(np.mean(np.square(miss))) < 1.7
    assert np.median([edge.noise_dn for edge in found]) == pytest.approx(math.sqrt(4 + 1 / 12), rel=0.2)


@pytest.mark.parametrize(("radius", "blur", "noise"), [(17.0, 1.0, 2.0), (40.0, 0.8, 1.0), (30.0, 2.5, 8.0)])
def test_the_bound_is_the_inverse_of_the_fisher_information(radius, blur, noise):
    """Of a blurred disc's x: sum over pixels of (dI/dx)^2 / s^2, the pixel's own extent by a difference of 0.01 px."""
    step, x0, y0 = 55.0, 60.3, 60.6
    y, x = np.mgrid[:121, :121].astype(float)
    sigma = math.sqrt(blur**2 + 1 / 12)

    def disc(cx):
        return step * norm.cdf((np.hypot(x - cx, y - y0) - radius) / sigma)

    slope = (disc(x0 + 0.01) - disc(x0 - 0.01)) / 0.02
    exact = noise / math.sqrt(float(np.sum(slope**2)))
    got = Edge(noise_dn=noise, step_dn=step, sigma_px=sigma).centre_sigma_px(
        Ellipse(np.array([x0, y0]), np.array([radius, radius]), 0.0)
    )
    assert got == pytest.approx(exact, rel=0.01)  # the formula neglects (sigma / R)^2


@pytest.mark.parametrize(("blur", "noise", "a"), [(0.8, 1.0, 13.0), (1.0, 2.0, 30.0), (2.0, 4.0, 40.0)])
def test_an_edge_is_measured_as_it_was_drawn(blur, noise, a):
    condition = ideal.Condition(
        size=(240, 200), blur=(blur, blur), noise=(noise, noise), semi_axis=(a, a), glints="isolated"
    )
    for seed in range(10_000, 10_003):
        drawing = ideal.draw(condition, seed)
        label = drawing.label["pupil"]
        pupil = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
        spots = np.array([g["xy_px"] for g in drawing.label["glints"]])
        edge = measure_edge(drawing.image.astype(float), pupil, spots, 1.0)
        assert edge.step_dn == pytest.approx(55.0, rel=0.03)
        # The outline's curvature and the noise; the bound takes its square root.
        assert edge.sigma_px == pytest.approx(math.sqrt(blur**2 + 1 / 12), rel=0.08)
        # The root mean square of a few hundred differences at least; rounding adds 1/12.
        assert edge.noise_dn == pytest.approx(math.sqrt(noise**2 + 1 / 12), rel=0.12)


def test_the_bound_leaves_out_what_it_does_not_cover():
    known = {"noise_dn": 0.0, "blur_px": 1.0, "step_dn": 55.0}
    none = np.zeros((0, 2))
    grey = np.zeros((80, 100))
    assert edge_of(grey, 8, PUPIL, none, known).noise_dn == pytest.approx(1 / math.sqrt(12))  # rounding
    assert edge_of(grey, 8, None, none, known) is None
    assert is_bounded(1.0, known)
    assert is_bounded(None, {})
    assert not is_bounded(0.7, known)
    assert not is_bounded(None, known)  # a drawn lid of unknown extent
    assert measure_edge(grey, PUPIL, none) is None  # an even image has no edge


def test_bins():
    assert bins([1.0, 2.0, 1.0, None], "noise_dn") == [(1.0, 1.0, [0, 2]), (2.0, 2.0, [1])]
    assert bins([1.0] * 5, "noise_dn") == []
    assert bins([], "noise_dn") == []
    values = np.random.default_rng(0).uniform(1, 9, 101)
    parts = bins(values.tolist(), "noise_dn")
    assert sorted(i for _, _, members in parts for i in members) == list(range(101))
    for low, high, members in parts:
        assert 24 <= len(members) <= 27
        assert all(low <= values[i] <= high for i in members)
    phases = bins([0.1, 0.3, 0.99, 0.6, 0.0], "phase_x")
    assert [members for _, _, members in phases] == [[0, 4], [1], [3], [2]]


def test_a_breakdown_holds_every_image_with_a_pupil_once():
    scores = [Score("right", offset_px=(0.1 * k, 0.0), axes_px=(0, 0), iou=1.0, boundary_px=0.0) for k in range(8)]
    scores += [Score("absent", with_pupil=False), Score("none", "dark")]
    got = breakdown([replace(s, factors={"noise_dn": float(k % 2)} if k < 9 else {}) for k, s in enumerate(scores)])
    assert list(got) == ["noise_dn"]
    assert [b["with_pupil"] for b in got["noise_dn"]] == [4, 4]
    assert [b["centre_px"]["median"] for b in got["noise_dn"]] == pytest.approx([0.3, 0.4])


def test_an_ideal_folder_is_read_as_it_was_drawn(drawn):
    images = load_labelled(drawn)
    assert len(images) == 6
    for image in images:
        assert image.visible == 1.0
        assert image.hints == {"polarity": "dark", "gamma": 1.0, "radius_px": None, "rig": None, "prior": None}
        grey, _ = read_image(image.path)
        y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
        inside = signed_distance(image.pupil, np.stack([x, y], axis=-1)) < -3.0
        assert np.median(grey[inside]) == pytest.approx(20, abs=1)  # as drawn
        assert set(image.factors) == {"pupil_px", "aspect", "phase_x", "phase_y", "occlusion"}


def test_a_lid_s_occlusion_is_what_it_covers():
    condition = ideal.Condition(size=(200, 160), semi_axis=(30, 30), lid=(0.2, 1.2), glints="none")
    for seed in range(10_000, 10_004):
        drawing = ideal.draw(condition, seed)
        dark = int(np.count_nonzero(drawing.image < 47))  # pupil 20, iris 75, lid 67 or more
        a, b = drawing.label["pupil"]["semi_axes_px"]
        # Pixels on the outline count whole or not at all.
        assert drawing.parameters["visible_fraction"] == pytest.approx(dark / (math.pi * a * b), abs=0.02)


@pytest.mark.render
def test_a_rendered_folder_s_labels_and_hints_are_in_image_coordinates(rendered):
    images = load_labelled(rendered, eye_error_mm=0.0)
    assert len(images) == 4
    for image in images:
        grey = np.asarray(read_image(image.path)[0], dtype=float)
        assert len(image.glints) == 2
        for glint in image.glints:
            x, y = np.rint(glint.xy_px).astype(int)
            window = grey[y - 3 : y + 4, x - 3 : x + 4]
            row, column = np.unravel_index(window.argmax(), window.shape)
            # Clipped spots are flat; a wrong window would be off by hundreds of pixels.
            assert math.hypot(x - 3 + column - glint.xy_px[0], y - 3 + row - glint.xy_px[1]) < 2.0
        # The rough place of the eye, projected with the camera of the hints, is near the pupil: a typical radius away.
        rig = {k: np.array(v) for k, v in image.hints["rig"].items()}
        seen = rig["K"] @ (rig["R"] @ rig["eye_mm"] + rig["t_mm"])
        low, high = image.hints["radius_px"]
        assert low < image.pupil.semi_axes_px[1] < image.pupil.semi_axes_px[0] < high
        assert np.hypot(*(seen[:2] / seen[2] - image.pupil.centre_px)) < 2 * high
        assert image.visible == 1.0
        assert 0 < image.factors["gaze_deg"] < 30


@pytest.mark.render
def test_the_hinted_eye_is_off_by_a_stated_and_repeatable_error(rendered):
    exact, off, again = (load_labelled(rendered, eye_error_mm=sd) for sd in (0.0, 5.0, 5.0))
    place = [np.array([i.hints["rig"]["eye_mm"] for i in images]) for images in (exact, off, again)]
    assert np.array_equal(place[1], place[2])
    error = (place[1] - place[0]).ravel()
    # The root mean square of twelve draws has a standard error of a fifth.
    assert 2.5 < np.sqrt(np.mean(error**2)) < 7.5
    assert len(np.unique(error)) == 12
    assert {i.hints["rig"]["eye_sd_mm"] for i in off} == {5.0}


def test_images_of_two_eyes_and_damaged_folders_are_refused(drawn, tmp_path):
    (tmp_path / "dataset.json").write_text((drawn / "dataset.json").read_text())
    (tmp_path / "metadata.jsonl").write_text("{}\n")
    with pytest.raises(InputError, match="line 1: is not an image record"):
        load_labelled(tmp_path)
    (tmp_path / "metadata.jsonl").write_text((drawn / "metadata.jsonl").read_text())
    with pytest.raises(InputError, match="no such file"):
        load_labelled(tmp_path)
    (tmp_path / "metadata.jsonl").write_text("")
    with pytest.raises(InputError, match="holds no images"):
        load_labelled(tmp_path)


@pytest.mark.parametrize("name", ["/etc/passwd", "../x.png", "images/link.png", "images", 3])
def test_images_outside_of_a_folder_of_ideal_images_are_refused(drawn, tmp_path, name):
    shutil.copytree(drawn, tmp_path / "copy")
    folder = tmp_path / "copy"
    line = json.loads((folder / "metadata.jsonl").read_text().splitlines()[0])
    (tmp_path / "x.png").write_bytes((folder / line["file_name"]).read_bytes())
    (folder / "images" / "link.png").symlink_to(tmp_path / "x.png")
    (folder / "metadata.jsonl").write_text(json.dumps(line | {"file_name": name}))
    with pytest.raises(InputError, match=r"metadata\.jsonl: line 1\.file_name: "):
        load_labelled(folder)
