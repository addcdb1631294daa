#!/usr/bin/env python3
"""Render labelled eyes in lids for testing the extractor: the shipped scenes with eyes, faces and lids of their own.

    hard_eyes.py DIR [--row headset] [--count 40] [--seed 10000] [--processes 1]

Every image is a pure function of (row, seed). Four seeds in a row share a face and an eye, whose maps are made once;
pupil, gaze, blink, head and noise are their own. Rows: `headset`, `desktop`, `subjects` (as in dataset_region),
`stress`, `webcam`, `single` (one lamp and oily skin), `both_lids` (both lids lie over a wide pupil), and eyes without
lids: `eight` (the headset's eight glints on a textured iris) and `texture` (the desktop tracker's small
pupils in a textured iris). Seeds below 10,000 are for development, the others for reports. A file ROW-SEED.npz holds
the image, its bit depth, the pupil, its visible share, and the glints with their visible shares. Files that are there
already are kept.
"""

from __future__ import annotations

import argparse
import zlib
from dataclasses import dataclass
from functools import cache
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from eyerender.base.arrays import Floats
from eyerender.optics.ellipse import Ellipse

SCENES = Path(__file__).resolve().parents[2] / "scenes"
# row -> scene, range of pupil diameters in mm, range of blinks, largest turn of the eye in degrees
ROWS: dict[str, tuple[str, tuple[float, float], tuple[float, float], float]] = {
    "headset": ("headset", (2.5, 6.0), (0.0, 0.35), 18.0),
    "desktop": ("desktop_tracker", (2.5, 6.0), (0.0, 0.3), 18.0),
    "subjects": ("desktop_tracker", (2.2, 6.5), (0.0, 0.25), 18.0),
    "stress": ("stress", (3.0, 6.0), (0.0, 0.3), 15.0),
    "webcam": ("webcam", (2.5, 5.0), (0.0, 0.3), 15.0),
    "single": ("quickstart", (2.5, 6.0), (0.0, 0.3), 18.0),
    "both_lids": ("desktop_tracker", (5.5, 7.5), (0.25, 0.5), 6.0),
    "eight": ("headset", (2.5, 6.0), (0.0, 0.0), 18.0),
    "texture": ("desktop_tracker", (2.5, 6.0), (0.0, 0.0), 18.0),
}
MODELS = ("E1", "E2", "E3", "E4", "E5")
FRAMES_OF_FACE = 4


@dataclass(frozen=True, slots=True, eq=False)
class HardEye:
    """One image; pupil is None where none is seen; glints (n, 2): those at least half visible; `faint`: the others."""

    name: str
    image: NDArray[Any]
    bit_depth: int
    pupil: Ellipse | None
    visible: float
    glints: Floats
    faint: Floats


def mapping_of(row: str, seed: int) -> dict[str, Any]:
    """The scene of one image: one frame of the right eye."""
    scene, pupil_mm, blink, turn = ROWS[row]
    rng = np.random.default_rng([seed, zlib.crc32(row.encode())])
    mapping: dict[str, Any] = yaml.safe_load((SCENES / f"{scene}.yaml").read_text())
    mapping.pop("targets", None)
    azimuth, elevation = rng.uniform(-turn, turn), rng.uniform(-0.8 * turn, 0.8 * turn)
    mapping["poses"] = [{"azimuth_deg": float(azimuth), "elevation_deg": float(elevation)}]
    mapping["subject"] = {"eyes": ["right"], "head_positions_mm": [rng.uniform(-1.0, 1.0, 3).tolist()]}
    mapping["seed"] = seed
    _give_face(mapping, row, seed // FRAMES_OF_FACE)
    mapping["eye"]["pupil_diameter_mm"] = float(rng.uniform(*pupil_mm))
    if row in ("eight", "texture"):
        del mapping["region"]
    else:
        mapping["region"]["blink"] = float(rng.uniform(*blink))
    if row in ("subjects", "both_lids"):
        mapping["image"]["window_px"] = [320, 240]
    if mapping["image"].get("window_px") is None and row == "headset":
        mapping["image"]["spp"] = 8
    return mapping


def _give_face(mapping: dict[str, Any], row: str, face: int) -> None:
    """Write the eye, its looks and its lids into a scene."""
    rng = np.random.default_rng([face, zlib.crc32(row.encode()), 1])
    mapping["eye"] = {"model": str(rng.choice(MODELS)), "margin": {"seed": int(rng.integers(1, 10**6))}}
    mapping["look"] = {
        "iris_seed": int(rng.integers(1, 10**6)),
        "iris_albedo": float(rng.uniform(0.2, 0.45)),
        "sclera_albedo": float(rng.uniform(0.36, 0.5)),
    }
    region = mapping["region"]
    region["seed"] = int(rng.integers(1, 10**6))
    if row in ("subjects", "both_lids"):
        low = row == "both_lids"
        region["fissure"] = {
            "upper_mm": float(rng.uniform(2.2, 2.8) if low else rng.uniform(2.4, 5.0)),
            "lower_mm": float(rng.uniform(4.0, 4.3) if low else rng.uniform(4.5, 6.0)),
        }
        region["lashes"] = {
            "upper_count": int(rng.integers(90, 150)),
            "upper_length_mm": float(rng.uniform(7.0, 10.5)),
            "upper_droop_deg": float(rng.uniform(25.0, 50.0)),
        }


@cache
def _renderer() -> Any:
    from eyerender.imaging.capture import make_renderer

    return make_renderer(threads=1)


def render_one(task: tuple[str, int, Path]) -> Path:
    """Render one image to its file."""
    from eyerender.analytic.observer import trace
    from eyerender.imaging.capture import render_windows
    from eyerender.imaging.labels import image_labels
    from eyerender.scene import Scene
    from eyerender.scene.spec import SceneSpec

    row, seed, folder = task
    path = folder / f"{row}-{seed:06d}.npz"
    if path.exists():
        return path
    frames = Scene.of(SceneSpec.from_mapping(mapping_of(row, seed))).frames()
    truth = trace(frames)
    (shot,) = render_windows(frames, renderer=_renderer())
    labels = image_labels(shot, truth)
    corner = np.array(shot.window[:2], dtype=np.float64)
    pupil = truth.pupil
    visible = labels["pupil"]["visible_fraction"] or 0.0
    seen = [(g["xy_px"], g["visible"], g["visible_share"]) for g in labels["glints"] if g["xy_px"] is not None]
    whole = bool(pupil.ok[0]) and visible > 0.0
    ellipse = [*(pupil.centre_px[0] - corner), *pupil.semi_axes_px[0], float(pupil.angle_rad[0])] if whole else []
    clear = [np.asarray(xy) - corner for xy, lit, share in seen if lit and share >= 0.5]
    faint = [np.asarray(xy) - corner for xy, lit, share in seen if not (lit and share >= 0.5)]
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(
        partial,
        image=shot.counts,
        bit_depth=shot.scene.spec.sensor.bit_depth,
        pupil=np.array(ellipse),
        visible=visible,
        glints=np.array(clear).reshape(-1, 2),
        faint=np.array(faint).reshape(-1, 2),
    )
    partial.rename(path)
    return path


def load(path: Path) -> HardEye:
    """Load one file."""
    with np.load(path) as data:
        pupil = data["pupil"]
        return HardEye(
            path.stem,
            data["image"],
            int(data["bit_depth"]),
            Ellipse(pupil[:2], pupil[2:4], float(pupil[4])) if pupil.size else None,
            float(data["visible"]),
            data["glints"],
            data["faint"],
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--row", choices=sorted(ROWS), action="append")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=10_000, help="first seed; below 10,000 is for development")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    options.directory.mkdir(parents=True, exist_ok=True)
    seeds = range(options.seed, options.seed + options.count)
    # One image of each row after the other, so that a run that is stopped leaves rows of equal length.
    tasks = [(row, seed, options.directory) for seed in seeds for row in options.row or ROWS]
    with Pool(options.processes) as pool:
        for done, _ in enumerate(pool.imap(render_one, tasks), 1):
            print(f"{done} of {len(tasks)}", end="\r", flush=True)
    print()


if __name__ == "__main__":
    main()
