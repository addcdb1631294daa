"""Small results that stand for all: what `tests/test_results_version.py` compares with the stored ones.

`python -m tests.support.golden` writes them for the version that `eyerender.folders.imagefolder.RESULTS` says.
"""

from __future__ import annotations

import json
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

STORED = DATA / f"results_{RESULTS}.json"
BLOCK = 16  # px
EYES = ("E1", "E2", "E3", "E4", "E5")
SCENE = {
    "format": 1,
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
    found = {}
    for name in ("dataset_quick", "dataset_region"):
        plan = Plan.load(name, count=1)
        made = Maker(plan, frames_of(plan), backend="llvm").make(0).images[0]
        found[name] = {kind: _blocks(made.pictures[kind]) for kind in ("images", "masks")}
    return found


def _blocks(picture: np.ndarray) -> list[list[float]]:
    h, w = (size // BLOCK * BLOCK for size in picture.shape)
    blocks = picture[:h, :w].reshape(h // BLOCK, BLOCK, w // BLOCK, BLOCK)
    return np.round(blocks.mean(axis=(1, 3)), 4).tolist()


if __name__ == "__main__":
    STORED.write_text(json.dumps({"analytic": analytic(), "images": images()}) + "\n", encoding="utf-8")
    print(STORED)
