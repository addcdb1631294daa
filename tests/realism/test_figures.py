"""Folders are read as they are, figures of drawn pictures are those that were drawn, and sets are told apart."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.apps.realism import measure_folder, realism
from eyerender.apps.realism.figures import BANDS_R, FIGURES, Scaled, measure, noise
from eyerender.apps.realism.folder import FolderFigures, Skipped, open_source, pictures
from eyerender.apps.realism.separability import KINDS, patches
from eyerender.cli.main import run
from eyerender.folders.imagefile import write_png
from eyerender.scene.parts import PUPIL as PUPIL_CLASS
from tests.realism import drawn
from tests.realism.drawn import CENTRE, LEVELS, PUPIL, R

WIDTH_OF_SIGMA = 2.563  # 10 to 90 % of a Gaussian's integral


@pytest.mark.parametrize("labelled", [True, False])
def test_ratios_of_levels(labelled):
    found = measure(drawn.picture(drawn.levels(), labelled=labelled))
    assert list(found) == list(FIGURES)
    expected = {
        "pupil : iris": LEVELS["pupil"] / LEVELS["iris"],
        "iris : sclera": LEVELS["iris"] / LEVELS["sclera"],
        "skin : sclera": LEVELS["skin"] / LEVELS["sclera"],
        "limbal ring : mid iris": 1.0,
        "clipped pixels (%)": 0.0,
        "bright points (1/R^2)": 0.0,
    }
    # The levels are flat, so only the blur of the edges and of the resizing reaches into the areas.
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("gamma", [1.6, 2.2])
def test_a_stated_gamma_is_undone(gamma):
    linear = drawn.levels()
    encoded = 255 * (linear / 255) ** (1 / gamma)
    plain, decoded = measure(drawn.picture(linear)), measure(drawn.picture(encoded, gamma))
    wrong = measure(drawn.picture(encoded))
    for name in ("pupil : iris", "iris : sclera", "skin : sclera", "limbus (R)"):
        assert decoded[name] == pytest.approx(plain[name], rel=0.01)
    assert wrong["pupil : iris"] == pytest.approx(plain["pupil : iris"] ** (1 / gamma), rel=0.01)


@pytest.mark.parametrize(("pupil_sigma", "limbus_sigma"), [(2.0, 4.0), (3.0, 6.0), (4.5, 9.0)])
@pytest.mark.parametrize("labelled", [True, False])
def test_edge_widths(pupil_sigma, limbus_sigma, labelled):
    rng = np.random.default_rng(3)
    codes = drawn.levels(pupil_sigma, limbus_sigma) + rng.normal(0, 1.0, (drawn.HIGH, drawn.WIDE))
    found = measure(drawn.picture(codes, labelled=labelled))
    # Halving the picture blurs by half a pixel; the noise moves crossings by a few per cent.
    assert found["pupil edge (R)"] == pytest.approx(WIDTH_OF_SIGMA * pupil_sigma / R, rel=0.1, abs=0.004)
    # The profile ends 4 widths from the edge, but the widest limbus has not reached its end there.
    assert found["limbus (R)"] == pytest.approx(WIDTH_OF_SIGMA * limbus_sigma / R, rel=0.1, abs=0.004)


@pytest.mark.parametrize("band", [1, 2, 3])
def test_texture_is_measured_in_its_band(band):
    fine, coarse = (k * R for k in BANDS_R[band])
    contrast = 0.03
    relative = 1 + contrast * drawn.noise_of_band((drawn.HIGH, drawn.WIDE), fine, coarse, band)
    found = measure(drawn.picture(np.full((drawn.HIGH, drawn.WIDE), 100.0) * relative))
    # The widest grains are few in the area, so their scatter is known to a tenth or two.
    for area in ("iris", "skin"):
        assert found[f"{area} texture {band + 1}"] == pytest.approx(contrast, rel=0.25)
        # Differences of Gaussians are broad, so a band two octaves away still has up to half of the contrast.
        others = [found[f"{area} texture {k + 1}"] for k in range(4) if abs(k - band) > 1]
        assert max(others) < 0.6 * contrast


def test_dark_lashes_and_ring():
    codes = drawn.levels()
    v, u = np.mgrid[: drawn.HIGH, : drawn.WIDE]
    lash = (v < CENTRE[1] - 1.31 * R) & (u % 20 < 2)
    rho = drawn.distance()
    codes[(rho > 0.86 * R) & (rho < 0.96 * R)] *= 0.6
    codes[lash] *= 0.25
    found = measure(drawn.picture(codes))
    # Lashes of 2 px in 20 are one pixel wide when halved, so the resizing leaves some of them whole.
    assert found["lash : lid skin"] == pytest.approx(0.25, abs=0.05)
    assert found["limbal ring : mid iris"] == pytest.approx(0.6, abs=0.02)


def test_highlights_are_counted_outside_the_cornea_only():
    codes = drawn.levels()
    v, u = np.mgrid[: drawn.HIGH, : drawn.WIDE]
    spots = [(-1.5, 0.2), (-1.4, -0.4), (1.6, 0.1), (1.3, 0.7), (0.3, 0.2)]  # the last lies on the cornea
    for x, y in spots:
        codes[np.hypot(u - CENTRE[0] - x * R, v - CENTRE[1] - y * R) < 4] = 230.0
    found = measure(drawn.picture(codes))
    outside = ~np.isin(drawn.parts(), (2, 3)) & (drawn.distance() < 2 * R)
    assert found["bright points (1/R^2)"] == pytest.approx(4 / (outside.sum() / R**2), rel=0.02)


def test_noise_clipping_and_fall_off():
    rng = np.random.default_rng(5)
    flat = 100 + rng.normal(0, 2.5, (300, 400)).astype(np.float32)
    assert noise(flat) == pytest.approx(2.5, rel=0.03)
    v, u = np.mgrid[: drawn.HIGH, : drawn.WIDE]
    assert noise((0.5 * u + 0.2 * v).astype(np.float32)) == pytest.approx(0, abs=1e-4)  # a plane has none
    codes = drawn.levels()
    codes[:51] = 255
    assert measure(drawn.picture(codes))["clipped pixels (%)"] == pytest.approx(100 * 51 / drawn.HIGH)
    # Light that falls off linearly from 200 to 100 across the picture: percentiles of a uniform spread.
    ramp = np.broadcast_to(np.linspace(200, 100, drawn.WIDE), (drawn.HIGH, drawn.WIDE))
    far = drawn.distance() > 1.9 * R
    expected = np.quantile(ramp[far], 0.9) / np.quantile(ramp[far], 0.1)
    assert measure(drawn.picture(ramp))["fall-off"] == pytest.approx(expected, rel=0.02)


def test_what_a_picture_does_not_show_has_no_figure():
    codes = drawn.levels()[: int(CENTRE[1] + 1.2 * R)]
    shown = drawn.picture(drawn.levels())
    mask = drawn.parts()[: len(codes)]
    cut = type(shown)("cut", codes.astype(np.float32), 1.0, shown.pupil, CENTRE[0], R, mask)
    found = measure(cut)
    assert found["skin : sclera"] is None
    assert found["skin texture 1"] is None
    assert found["iris : sclera"] == pytest.approx(0.75, abs=0.01)
    assert np.count_nonzero(mask == PUPIL_CLASS) == pytest.approx(np.pi * PUPIL**2, rel=0.01)


_IMAGES = 14


def _folder(first: int, sigma: float) -> FolderFigures:
    """A folder of pictures with noise of a scale (px of the picture) on them, of which the irises are compared."""
    rows = []
    for seed in range(first, first + _IMAGES):
        grain = drawn.noise_of_band((drawn.HIGH, drawn.WIDE), sigma, 2 * sigma, seed)
        shown = patches(Scaled.of(drawn.picture(drawn.levels() * (1 + 0.12 * grain), labelled=False)), seed)
        rows.append({kind: shown[kind] if kind == "iris" else () for kind in KINDS})
    return FolderFigures(
        path=str(first), images=_IMAGES, gamma=1.0, gamma_from="given", landmarks="masks", rows=(), skipped=(),
        tiles=(), patches=tuple(rows),
    )  # fmt: skip


def test_patches_have_equal_scale_and_exposure():
    levels = drawn.levels()
    bright, dark = (patches(Scaled.of(drawn.picture(levels * k)), 1) for k in (1.0, 0.3))
    assert list(bright) == list(KINDS)
    assert {p.shape for p in bright["iris"]} == {(20, 20)}
    for kind in KINDS:
        for a, b in zip(bright[kind], dark[kind], strict=True):
            assert np.abs(a.astype(int) - b).max() <= 3  # rounding before and after the compression


@pytest.mark.packaging
def test_only_different_folders_are_told_apart():
    pytest.importorskip("sklearn")
    from eyerender.apps.realism.separability import separability

    one, same, other = _folder(0, 8.0), _folder(100, 8.0), _folder(200, 3.5)
    alike, apart = separability(one, same)["iris"], separability(one, other)["iris"]
    assert alike.images == (_IMAGES, _IMAGES)
    assert alike.interval[0] < 0.5 + 0.1  # of fourteen and fourteen images, the area has a standard deviation of .11
    assert alike.auc < 0.8
    assert apart.auc > 0.95
    assert all(len(shown) == 8 for shown in apart.revealing)
    assert separability(one, other)["sclera"] is None


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A folder of four drawn pictures with noise, of which one shows nothing, and one file that is no image."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(1)
    for k in range(4):
        levels = drawn.levels() if k < 3 else np.full((drawn.HIGH, drawn.WIDE), 90.0)
        write_png(folder / f"{k}.png", np.round(levels + rng.normal(0, 1.5, levels.shape)).astype(np.uint8))
    (folder / "broken.png").write_bytes(b"no image")
    (folder / "notes.txt").write_text("not an image by its name")
    return folder


def test_pupil_and_iris_are_found_without_labels(frames):
    found = list(pictures(open_source(frames, 10), 1.0))
    seen = [p for p in found if not isinstance(p, Skipped)]
    assert len(seen) == 3
    for p in seen:
        # The search has steps of 2 % of the radius.
        assert p.radius_px == pytest.approx(drawn.R, rel=0.03)
        assert p.iris_x_px == pytest.approx(drawn.CENTRE[0], abs=0.02 * drawn.R)
    reasons = {p.name: p.reason for p in found if isinstance(p, Skipped)}
    assert reasons["broken.png"] == "is not a readable image"
    assert "no pupil found" in reasons["3.png"]


def test_the_command_compares_two_folders(frames, tmp_path, capsys):
    page, target = tmp_path / "page.html", tmp_path / "out.json"
    argv = ["realism", str(frames), str(frames), "--gamma", "1", "--gamma", "2.2", "-o", str(page)]
    assert run([*argv, "--json", str(target)]) == 0
    data = json.loads(target.read_text())
    assert data["schema"] == "eyerender/realism/2"
    assert list(data["definitions"]) == list(FIGURES)
    first, second = data["folders"]
    assert (first["images"], first["measured"], first["gamma"], second["gamma"]) == (5, 3, 1.0, 2.2)
    level = drawn.LEVELS["iris"] / drawn.LEVELS["sclera"]
    assert first["figures"]["iris : sclera"]["median"] == pytest.approx(level, rel=0.02)
    assert second["figures"]["iris : sclera"]["median"] == pytest.approx(level**2.2, rel=0.04)
    assert data["ratios"]["iris : sclera"] == pytest.approx(level / level**2.2, rel=0.05)
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 2
    assert "not measured" in text.lower()
    assert "A / B" in capsys.readouterr().out


def test_a_limit_takes_images_evenly(frames):
    assert open_source(frames, 2).names == ("0.png", "2.png")
    assert len(open_source(frames, 100).names) == 5


def test_an_export_states_its_encoding(frames, tmp_path):
    for k in range(2):
        (tmp_path / f"{k}.png").write_bytes((frames / f"{k}.png").read_bytes())
    (tmp_path / "export.json").write_text(json.dumps({"image": {"encoding": "gamma", "gamma": 2.2}}))
    assert (found := measure_folder(tmp_path)).gamma == 2.2
    assert "export.json" in found.gamma_from
    (tmp_path / "export.json").write_text(json.dumps({"image": {"gamma": True}}))
    assert measure_folder(tmp_path).gamma_from == "assumed"
    assert measure_folder(tmp_path, gamma=1.5).gamma_from == "given"


def test_links_are_not_followed(frames, tmp_path):
    (tmp_path / "link.png").symlink_to(frames / "0.png")
    (tmp_path / "inner").symlink_to(frames, target_is_directory=True)
    result = realism([tmp_path])
    assert result["folders"][0]["images"] == 1
    assert result["folders"][0]["measured"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["."], "holds no images"),
        (["frames", "--limit", "0"], "--limit: must be 1 to"),
        (["frames", "--gamma", "0"], "--gamma: must be between 0.1 and 10"),
        (["frames", "--gamma", "1", "--gamma", "2"], "--gamma: give one for all folders"),
        (["frames", "-o", "page.png"], "--output: must end with .html"),
    ],
)
def test_bad_input_ends_with_one_line(arguments, message, frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = [str(frames) if a == "frames" else a for a in arguments]
    assert run(["realism", *given]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.packaging
def test_a_folder_is_told_from_a_camera_that_was_left_out_only_where_it_differs_from_all():
    pytest.importorskip("sklearn")
    from eyerender.apps.realism.separability import left_out

    cameras = [_folder(100 * k, 4.0 + k) for k in range(1, 4)]
    like_them, unlike = (left_out(_folder(900, sigma), cameras)["iris"] for sigma in (6.5, 1.5))
    assert unlike.auc > 0.95
    assert unlike.interval[0] > like_them.interval[0]
    assert like_them.auc < 0.85
    assert like_them.cameras == 3
    assert like_them.placebo == unlike.placebo  # it does not depend on the folder
    assert like_them.placebo_interval[0] <= like_them.placebo <= like_them.placebo_interval[1]
    assert left_out(_folder(900, 6.5), cameras[:2])["iris"] is None
