"""The command on folders: labelled and unlabelled, linear and encoded, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from eyerender.apps.realism import measure_folder, realism
from eyerender.apps.realism.figures import FIGURES
from eyerender.apps.realism.folder import Skipped, open_source, pictures
from eyerender.cli.main import run
from eyerender.folders.imagefile import write_png
from tests.realism import drawn


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
