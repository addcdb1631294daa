"""Does the bound rank layouts as rendered images do? Two LEDs at 42 pairs of twelve places around a headset's lens.

Nine fixations and three test frames are rendered for each LED alone; light adds up, so the sum of two pictures is that
of the pair. For each layout, the fixations calibrate the maximum-likelihood estimator. Test frames are then exposed
again and again with other noise. Their RMS-S2S is compared with the bound of `er.information`, with
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

from scipy.stats import spearmanr

import eyerender as er
from eyerender.gaze.estimate import ray_errors_deg
from eyerender.imaging.capture import EyeImage, render_windows
from eyerender.rig.exposure import recorded
from eyerender.scene.observation import Observations, concatenate

LAYOUTS, REPEATS, SEED = 42, 24, 7
FEW = (0, 2, 5, 7, 10)  # places of --quick
CALIBRATION_MM = [[1000.0, y, z] for z in (200.0, 0.0, -200.0) for y in (-280.0, 0.0, 280.0)]
TESTS_MM = [[1000.0, -150.0, 90.0], [1000.0, 160.0, -60.0], [1000.0, 40.0, 140.0]]


def scene_of(places: tuple[int, ...], targets_mm: list[list[float]]) -> er.Scene:
    """A bare eye before the headset's camera, with LEDs at some of the twelve places."""
    angles = 2 * np.pi * np.array(places) / 12
    lights = [
        {"position_mm": [24.0, -31.5 + 21 * np.cos(a), 17 * np.sin(a)], "radius_mm": 0.5, "aim_mm": [0, -31.5, 0],
         "intensity_mw_sr": 0.5}
        for a in angles
    ]  # fmt: skip
    changes = {"rig.lights": lights, "poses": None, "targets": {"world_mm": targets_mm}, "image.window_px": [400, 400]}
    return er.load_scene("head_mounted").with_(changes)


def render(led: int) -> list[EyeImage]:
    """Calibration and test frames in the light of one LED."""
    return list(render_windows(scene_of((led,), CALIBRATION_MM + TESTS_MM).frames(), backend="llvm"))


def lit_by(pair: tuple[int, int], single: dict[int, list[EyeImage]]) -> list[EyeImage]:
    """Frames in the light of two LEDs: the sum of the pictures of each."""
    frames = scene_of(pair, CALIBRATION_MM + TESTS_MM).frames()
    both = zip(single[pair[0]], single[pair[1]], strict=True)
    return [
        replace(a, frame=frames.take([row]), irradiance=a.irradiance + b.irradiance) for row, (a, b) in enumerate(both)
    ]


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


def linearity(pair: tuple[int, int], single: dict[int, list[EyeImage]]) -> float:
    """RMS difference of a frame rendered with both LEDs from the sum of those with one each, over its mean."""
    (direct,) = render_windows(scene_of(pair, TESTS_MM[:1]).frames(), backend="llvm")
    summed = lit_by(pair, single)[len(CALIBRATION_MM)]
    assert direct.window == summed.window
    away = summed.irradiance - direct.irradiance
    return float(np.sqrt(np.mean(away**2)) / np.mean(direct.irradiance))


def rms_s2s_deg(directions: np.ndarray) -> float:
    """RMS of the angles between successive estimates, (repeats, tests, 3); those without an estimate are left out."""
    between = np.linalg.norm(np.diff(directions, axis=0), axis=-1)
    return float(np.degrees(np.sqrt(np.nanmean(between**2))))


def measured(pair: tuple[int, int], images: list[EyeImage], repeats: int) -> tuple[float, float, float]:
    """Bound, RMS-S2S of maximum likelihood, and mean error of Guestrin and Eizenman's estimator, in degrees."""
    known, asked = scene_of(pair, CALIBRATION_MM), scene_of(pair, TESTS_MM)
    fixations, shots = images[: len(CALIBRATION_MM)], images[len(CALIBRATION_MM) :]
    bound = er.information(asked.frames(), unknowns=er.Unknowns(slippage_mm=3.0))["right"].gaze_deg
    calibration = observe(fixations, SEED)
    seen = concatenate([observe(shots, SEED + 1000 * (k + 1)) for k in range(repeats)])
    rays = er.gaze.MaximumLikelihood().fit(calibration, known.rig).predict_rays(seen, known.rig)
    directions = rays.direction.reshape(repeats, len(TESTS_MM), 3)
    other = er.gaze.GuestrinEizenman().fit(calibration, known.rig).predict_rays(seen, known.rig)
    error = float(np.nanmean(ray_errors_deg(seen, other)))
    return float(np.sqrt(np.mean(bound**2))), rms_s2s_deg(directions), error


def main() -> int:
    """Measure all layouts and print the rows."""
    options = options_of(__doc__, "take the 10 pairs of five places and 8 repeats").parse_args()
    repeats, places = (8, FEW) if options.quick else (REPEATS, range(12))
    pairs = list(combinations(places, 2))
    chosen = [pairs[k] for k in np.random.default_rng(SEED).permutation(len(pairs))[:LAYOUTS]]
    single = {led: render(led) for led in sorted({led for pair in chosen for led in pair})}
    report, found = Report(), []
    report.add(row("RMS of both LEDs at once against the sum, over the mean", linearity(chosen[0], single), ""))
    for pair in chosen:
        found.append(measured(pair, lit_by(pair, single), repeats))
        report.add(row(f"LEDs {pair}: RMS-S2S over the bound", found[-1][1] / found[-1][0], "ratio"))
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
