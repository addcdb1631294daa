"""Small results that stand for all: what `tests/test_results_version.py` compares with the stored ones.

`python -m tests.support.golden` writes them for the version that `eyerender.folders.imagefolder.RESULTS` says.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from eyerender.analytic.observer import trace
from eyerender.dataset.maker import Maker
from eyerender.dataset.plan import Plan
from eyerender.dataset.realise import frames_of
from eyerender.folders.imagefolder import RESULTS
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.paths import DATA

SEEDS = {"dataset_quick": 4, "dataset_region": None}  # a sharp limbus, where another width of the iris is seen
STORED = DATA / f"results_{RESULTS}.json"
BLOCK = 16  # px
EYES = ("E1", "E2", "E3", "E4", "E5")
SCENE = {
    "format": 2,
    "name": "golden",
    "rig": {
        "cameras": [{"position_mm": [600, 0, -150], "look_at_mm": [0, 0, 0], "focal_length_px": 4000,
                     "resolution_px": [640, 480]}],
        "lights": [{"position_mm": [600, 120, 0]}, {"position_mm": [600, -120, 0]}],
        "screen": {"centre_mm": [650, 0, 0], "size_mm": [377, 301]},
    },
    "targets": {"grid": [3, 2]},
}  # fmt: skip


def analytic() -> dict[str, Any]:
    """Pupil centre, semi-axes, glints and pose of both eyes for each eye model: numbers in px and rad."""
    found = {}
    for name in EYES:
        seen = trace(Scene.of(SceneSpec.from_mapping({**SCENE, "eye": {"model": name}})))
        numbers = [seen.pupil.centre_px, seen.pupil.semi_axes_px, seen.glints.xy_px.reshape(len(seen), -1)]
        numbers += [seen.pose.azimuth_rad[:, None], seen.pose.elevation_rad[:, None]]
        found[name] = np.concatenate(numbers, axis=1).tolist()
    return found


def images() -> dict[str, Any]:
    """The first image of each shipped dataset: means of its blocks in counts, and of its mask's."""
    return {name: first_image(plan_of(name)) for name in SEEDS}


def plan_of(name: str) -> Plan:
    """The plan of a shipped dataset's first image."""
    return Plan.load(name, count=1, seed=SEEDS[name])


def first_image(plan: Plan) -> dict[str, Any]:
    """Means of the blocks of a plan's first image and its mask."""
    made = Maker(plan, frames_of(plan), backend="llvm").make(0).images[0]
    return {kind: _blocks(made.pictures[kind]) for kind in ("images", "masks")}


def changes(found: Mapping[str, Any], stored: Mapping[str, Any]) -> list[str]:
    """How an image and its mask (`first_image`) differ by more than rounding.

    Other processors round differently. The packets in which Embree traces rays have other widths there too, so that one
    ray in 20,000 meets the neighbour of a triangle at a silhouette, and its pixel gets another value for one of its
    samples. One pixel in 70 differs then, most of them by one step of the sensor.
    """
    away = {kind: np.abs(np.array(found[kind]) - np.array(stored[kind])) for kind in ("images", "masks")}
    level = np.mean(stored["images"])
    found_so = {
        "the mask": away["masks"].max() > 1e-4,  # the stored means have four decimals
        "the mean of the image": abs(np.mean(found["images"]) - level) > 1e-5 * level,  # rounding: 3e-6
        # One sample in eight of one pixel in a block, between black and white: 32 counts. Rounding: 15.
        "a block": away["images"].max() > 65535 / 8 / BLOCK**2,
        "one block in ten": np.quantile(away["images"], 0.9) > 0.25,  # rounding: 0.055 counts
    }
    return [what for what, so in found_so.items() if so]


def _blocks(picture: np.ndarray) -> list[list[float]]:
    h, w = (size // BLOCK * BLOCK for size in picture.shape)
    blocks = picture[:h, :w].reshape(h // BLOCK, BLOCK, w // BLOCK, BLOCK)
    return np.round(blocks.mean(axis=(1, 3)), 4).tolist()


if __name__ == "__main__":
    STORED.write_text(json.dumps({"analytic": analytic(), "images": images()}) + "\n", encoding="utf-8")
    print(STORED)
