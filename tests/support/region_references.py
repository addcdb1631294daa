"""Reference images of skin, lids and lashes, with the variance of each pixel.

`python -m tests.support.region_references` renders them for the version `RESULTS` of `folders/imagefolder.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import stats

from eyerender.folders.imagefolder import RESULTS
from eyerender.imaging.capture import make_renderer, render_job
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.paths import DATA

if TYPE_CHECKING:
    from eyerender.rendering.renderer import Renderer

STORED = DATA / f"region_{RESULTS}.npz"
SPP = 4
REFERENCE_SEEDS = range(64)
TEST_SEEDS = range(1000, 1008)
# One in a hundred correct pictures may be refused, before the allowance below. As in Mitsuba's own tests of its
# integrators, Šidák's correction gives each pixel its share of that.
LEVEL = 0.01
# Mitsuba's allowance, too: pixels that a hair's highlight meets once in a hundred samples are not normally distributed.
ALLOWED = 0.0025
# Other processors and other versions of LLVM round differently: far less than this share of a pixel's value.
ROUNDING = 1e-3

_REMOTE = {"position_mm": [600, 0, -120], "look_at_mm": [0, -31.5, 0], "focal_length_px": 1800}
_NEAR = {"position_mm": [45, -45, -30], "look_at_mm": [0, -31.5, 0], "focal_length_px": 130}
SCENES: dict[str, dict[str, Any]] = {
    "open": {"camera": _REMOTE, "light": [600, 60, -60], "pose": (5.0, 3.0), "region": {"seed": 3}},
    "shut": {"camera": _REMOTE, "light": [600, -60, -60], "pose": (0.0, 0.0), "region": {"seed": 8, "blink": 1.0}},
    "near": {"camera": _NEAR, "light": [45, -25, -30], "pose": (-12.0, 8.0), "region": {"seed": 5}},
}


class Reference(NamedTuple):
    """Mean over many seeds and standard deviation of one render, (height, width) mW/mm^2."""

    mean: np.ndarray
    deviation: np.ndarray


def rendered(renderer: Renderer, name: str, seeds: range, region: Mapping[str, Any] | None = None) -> np.ndarray:
    """Irradiance of a scene with each seed, (seeds, height, width) mW/mm^2; `region` changes its lids and skin."""
    chosen = SCENES[name]
    azimuth, elevation = chosen["pose"]
    spec = {
        "format": 2,
        "name": name,
        "subject": {"eyes": ["right"]},
        "rig": {
            "cameras": [{**chosen["camera"], "resolution_px": [640, 480]}],
            "lights": [{"position_mm": chosen["light"], "radius_mm": 2.0, "aim_mm": [0, 0, 0], "intensity_mw_sr": 100}],
        },
        "poses": [{"azimuth_deg": azimuth, "elevation_deg": elevation}],
        "image": {"window_px": [80, 60]},
        "region": {**chosen["region"], **(region or {})},
    }
    job = render_job(Scene.of(SceneSpec.from_mapping(spec)).frames(), 0)
    return np.stack([renderer.render(replace(job, seed=s), spp=SPP).irradiance.astype(np.float64) for s in seeds])


def stored() -> dict[str, Reference]:
    """The references of this version of the results."""
    with np.load(STORED) as file:
        return {name: Reference(file[f"{name}_mean"], file[f"{name}_deviation"].astype(np.float64)) for name in SCENES}


def refused_share(images: np.ndarray, reference: Reference) -> float:
    """Share of the pixels whose mean differs from the reference's, by a z-test at the corrected level."""
    mean = reference.mean.astype(np.float64)
    error = reference.deviation * np.sqrt(1 / len(images) + 1 / len(REFERENCE_SEEDS))
    z = np.abs(images.mean(axis=0) - mean) / np.hypot(error, ROUNDING * mean)
    level = 1 - (1 - LEVEL) ** (1 / mean.size)
    return float(np.mean(2 * stats.norm.sf(z) < level))


def main() -> None:
    """Write the references."""
    renderer = make_renderer("llvm", 1)
    arrays: dict[str, np.ndarray] = {}
    for name in SCENES:
        images = rendered(renderer, name, REFERENCE_SEEDS)
        arrays[f"{name}_mean"] = images.mean(axis=0).astype(np.float32)
        arrays[f"{name}_deviation"] = images.std(axis=0, ddof=1).astype(np.float32)
    np.savez_compressed(STORED, allow_pickle=False, **arrays)
    print(STORED)


if __name__ == "__main__":
    main()
