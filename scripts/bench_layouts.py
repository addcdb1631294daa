"""Does the bound rank layouts as rendered images do? Two LEDs at 42 pairs of twelve places around a headset's lens.

For each layout, nine fixations are rendered and extracted, and calibrate the maximum-likelihood estimator. Test frames
are then exposed again and again with other noise. Their RMS-S2S is compared with the bound of `er.information`, with
slippage of 3 mm in every frame and a known person. The bar is Spearman's correlation of both over the layouts. The
total error of Guestrin and Eizenman's estimator on the same images is stated.

    python scripts/bench_layouts.py [--quick] [--json F]
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import combinations

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

from scipy.stats import spearmanr  # noqa: E402

import eyerender as er  # noqa: E402
from eyerender.gaze.estimate import ray_errors_deg  # noqa: E402
from eyerender.imaging.capture import EyeImage, render_windows  # noqa: E402
from eyerender.observation import Observations, concatenate  # noqa: E402
from eyerender.rig.exposure import recorded  # noqa: E402

LAYOUTS, REPEATS, SEED = 42, 24, 7
CALIBRATION_MM = [[1000.0, y, z] for z in (200.0, 0.0, -200.0) for y in (-280.0, 0.0, 280.0)]
TESTS_MM = [[1000.0, -150.0, 90.0], [1000.0, 160.0, -60.0], [1000.0, 40.0, 140.0]]


def scene_of(pair: tuple[int, int], targets_mm: list[list[float]]) -> er.Scene:
    """A bare eye before the headset's camera, with two of the twelve LEDs."""
    angles = 2 * np.pi * np.array(pair) / 12
    lights = [
        {"position_mm": [24.0, -31.5 + 21 * np.cos(a), 17 * np.sin(a)], "radius_mm": 0.5, "aim_mm": [0, -31.5, 0],
         "intensity_mw_sr": 0.5}
        for a in angles
    ]  # fmt: skip
    changes = {"rig.lights": lights, "poses": None, "targets": {"world_mm": targets_mm}, "image.window_px": [400, 400]}
    return er.load_scene("head_mounted").with_(changes)


def observe(images: list[EyeImage], seed: int) -> Observations:
    """Expose images again with other noise, and extract their features."""
    exposed = []
    for image in images:
        spec = image.scene.spec
        camera = image.scene.rig.cameras[image.camera]
        counts = recorded(spec.sensor, camera, image.window, image.irradiance, spec.wavelength_nm, seed)
        exposed.append(replace(image, counts=counts))
        seed += 1
    return er.ImageObserver(backend="llvm").observe_images(exposed)


def rms_s2s_deg(directions: np.ndarray) -> float:
    """RMS of the angles between successive estimates, (repeats, tests, 3); those without an estimate are left out."""
    between = np.linalg.norm(np.diff(directions, axis=0), axis=-1)
    return float(np.degrees(np.sqrt(np.nanmean(between**2))))


def measured(pair: tuple[int, int], repeats: int) -> tuple[float, float, float]:
    """Bound, RMS-S2S of maximum likelihood, and mean error of Guestrin and Eizenman's estimator, in degrees."""
    known, asked = scene_of(pair, CALIBRATION_MM), scene_of(pair, TESTS_MM)
    bound = er.information(asked.frames(), unknowns=er.Unknowns(slippage_mm=3.0))["right"].gaze_deg
    calibration = observe(list(render_windows(known.frames(), backend="llvm")), SEED)
    shots = list(render_windows(asked.frames(), backend="llvm"))
    seen = concatenate([observe(shots, SEED + 1000 * (k + 1)) for k in range(repeats)])
    rays = er.gaze.MaximumLikelihood().fit(calibration, known.rig).predict_rays(seen, known.rig)
    directions = rays.direction.reshape(repeats, len(TESTS_MM), 3)
    other = er.gaze.GuestrinEizenman().fit(calibration, known.rig).predict_rays(seen, known.rig)
    error = float(np.nanmean(ray_errors_deg(seen, other)))
    return float(np.sqrt(np.mean(bound**2))), rms_s2s_deg(directions), error


def main() -> int:
    """Measure all layouts and print the rows."""
    options = options_of(__doc__, "take 10 layouts and 8 repeats").parse_args()
    count, repeats = (10, 8) if options.quick else (LAYOUTS, REPEATS)
    pairs = list(combinations(range(12), 2))
    chosen = np.random.default_rng(SEED).permutation(len(pairs))[:count]
    report, found = Report(), []
    for k in chosen:
        found.append(measured(pairs[k], repeats))
        report.add(row(f"LEDs {pairs[k]}: RMS-S2S over the bound", found[-1][1] / found[-1][0], "ratio"))
    bound, noise, error = np.array(found).T
    whole = np.isfinite(noise)
    report.add(row("layouts with estimates", float(whole.sum()), "layouts"))
    report.add(
        row("Spearman: bound and RMS-S2S", float(spearmanr(bound[whole], noise[whole])[0]), "", 0.9, at_least=True)
    )
    whole = np.isfinite(error)
    report.add(row("Spearman: bound and total error of G&E", float(spearmanr(bound[whole], error[whole])[0]), ""))
    return report.finish(options.json, ("eyerender", "numpy", "scipy", "mitsuba", "drjit"))


if __name__ == "__main__":
    sys.exit(main())
