"""Effect of glasses on a tracker: people with and without lenses, every estimator, three ways of calibration.

A person sits before a screen with a lamp at each corner, two cameras below it and a lamp at the first of them. All
lenses sit in the same frame on the same person, so differences are paired by person. Estimators are calibrated on nine
targets and tested on the sixteen between them, of which images show four.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import Bools, Floats
from ...base.errors import FitWarning, InputError
from ...gaze.crossratio import CrossRatio
from ...gaze.determined import UndeterminedWarning
from ...gaze.directions import DirectionRegression
from ...gaze.estimate import GazeEstimator, GazePoints
from ...gaze.guestrin import GuestrinEizenman
from ...gaze.hennessey import Hennessey
from ...gaze.homography import Homography
from ...gaze.likelihood import MaximumLikelihood
from ...gaze.regression import Regression
from ...gaze.twocamera import ShihWuLiu
from ...population.correction import fitting
from ...rig.rig import RigGeometry
from ...scene import Frames, Scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .results import ModelResults, mean_row
from .study import EstimatorErrors, changed, errors_of, of_person

NONE, PLANO, CUT = "none", "plano", "infrared cut"
WORN: Mapping[str, dict[str, Any] | None] = {
    NONE: None,
    PLANO: {},
    "-6 D": {"sphere_d": -6.0},
    "-3 D": {"sphere_d": -3.0},
    "+3 D": {"sphere_d": 3.0},
    "+6 D": {"sphere_d": 6.0},
    # Its power acts from left to right, along which targets spread most.
    "cylinder -2 D": {"cylinder_d": -2.0, "axis_deg": 90.0},
    "-3 D, tilted": {"sphere_d": -3.0, "pantoscopic_deg": 20.0, "wrap_deg": 15.0},
    CUT: {"reflectance": 0.3},
}
"""Condition -> keys of both lenses; the person's own fit (vertex distance, tilt, wrap) is added."""
IMAGED = (NONE, PLANO, "-6 D", "+6 D", "cylinder -2 D", CUT)
WITHOUT, SAME, OFFSET = "without glasses", "same glasses", "without, one offset"
CALIBRATIONS = (WITHOUT, SAME, OFFSET)
SIDE = 5
CENTRE = SIDE * SIDE // 2
LEARNT = tuple(SIDE * i + j for i in (0, 2, 4) for j in (0, 2, 4))
"""Targets of the calibration; the offset is taken at the one in the middle, `CENTRE`."""
IN_IMAGES = (*LEARNT, 6, 8, 16, 18)
"""Targets of images: those of the calibration, and four between them."""
POLYNOMIAL, GEOMETRIC = "polynomial R3", "Guestrin-Eizenman"
ESTIMATORS: Mapping[str, GazeEstimator] = {
    POLYNOMIAL: Regression("R3", light=4, normalised=False),
    "polynomial of directions": DirectionRegression("R3", lights=(4,)),
    "homography": Homography(),
    "cross ratio": CrossRatio(),
    "Hennessey": Hennessey(),
    GEOMETRIC: GuestrinEizenman(),
    "Shih-Wu-Liu": ShihWuLiu(),
    "maximum likelihood": MaximumLikelihood(),
}
TWO_CAMERAS = ("Shih-Wu-Liu",)
WRONG_PX = 2.0
"""A feature of an image farther than this from its true place counts as wrong (chosen)."""
_SCREEN = (650.0, 440.0, 250.0)  # distance, width and height, mm
_LAMP = {"radius_mm": 2.5, "aim_mm": [0.0, -31.5, 0.0], "intensity_mw_sr": 160.0}
_CAMERA = {
    "look_at_mm": [0.0, -31.5, 0.0], "focal_length_mm": 25.0, "sensor_mm": [9.6, 6.0], "resolution_px": [1920, 1200],
}  # fmt: skip


def scene_before(person: Mapping[str, Any], *, imaged: bool) -> Scene:
    """Build the scene of a person who wears nothing; for images with lids and one camera."""
    away, width, height = _SCREEN
    corners = [(-width / 2, height / 2), (width / 2, height / 2), (width / 2, -height / 2), (-width / 2, -height / 2)]
    cameras = [{**_CAMERA, "position_mm": [600.0, y, -180.0]} for y in ((0.0,) if imaged else (0.0, 180.0))]
    places = [[away, y, z] for y, z in corners] + [[600.0, 12.0, -180.0]]
    spec = {
        "format": 2,
        "name": "glasses",
        "eye": {"model": "adult", "pupil_diameter_mm": 4.0},
        # One state of accommodation for all lenses, that of the screen's distance, so that only the lenses differ.
        "subject": {"eyes": ["right"], "accommodation_d": 1.5},
        "rig": {
            "cameras": cameras,
            "lights": [{**_LAMP, "position_mm": place} for place in places],
            "screen": {"centre_mm": [away, 0.0, 0.0], "size_mm": [width, height]},
        },
        "targets": {"grid": [SIDE, SIDE]},
        "image": {"window_px": [240, 180], "spp": 4},
        "sensor": {
            "f_number": 2.4, "exposure_ms": 8.0, "psf_sigma_px": 0.75, "pixel_pitch_um": 5.0, "full_well_e": 15000,
            "read_noise_e": 6.0, "black_level_dn": 2560,
        },
        "lens": {"glare": 0.07},
    }  # fmt: skip
    own = of_person(Scene.of(SceneSpec.from_mapping(spec)), person)
    return changed(own, {"region": {"seed": person["subject"]}, "seed": person["subject"]}) if imaged else own


def worn_by(person: Mapping[str, Any], *, imaged: bool) -> dict[str, Scene]:
    """Build the scene of each condition, with the person's fit of the frame."""
    bare = scene_before(person, imaged=imaged)
    fit = fitting(np.random.default_rng([person["seed"], person["subject"]]))
    out = {}
    for name in IMAGED if imaged else [name for name in WORN if name != CUT]:  # a coating moves no ray
        lens = WORN[name]
        out[name] = bare if lens is None else changed(bare, {"subject": {"spectacles": {**fit, **lens}}})
    return out


def glasses_part(who: str, person: Mapping[str, Any], observer: str) -> ModelResults:
    """Observe a person in each condition and estimate gaze, by rays or from images."""
    out, imaged = ModelResults(eye_model=who, person=person), observer != "analytic"
    scenes = worn_by(person, imaged=imaged)
    frames = {name: scene.frames() for name, scene in scenes.items()}
    if imaged:
        frames = {name: some[np.isin(some.index.fixation, IN_IMAGES)] for name, some in frames.items()}
    truth = {name: trace(some) for name, some in frames.items()}
    seen = {name: _extracted(some) for name, some in frames.items()} if imaged else truth
    out.more["features"] = {name: _features(seen[name], truth[name], truth[NONE]) for name in scenes}
    out.done["own", observer] = done = _estimates(seen, scenes[NONE].rig)
    keys = {"protocol": "own", "observer": observer, "eye_model": who, "eye": "right"}
    out.rows = [
        mean_row(one.error_deg, variant=condition, function=name, calibration=how, **keys)
        for (name, condition, how), one in done.items()
    ]
    return out


def _extracted(frames: Frames) -> Observations:
    from ...imaging.imageobserver import ImageObserver

    return ImageObserver(threads=1).observe(frames)


def _estimates(seen: Mapping[str, Observations], rig: RigGeometry) -> dict[tuple[str, str, str], EstimatorErrors]:
    """Compute the errors of the tested targets by estimator, condition and calibration."""
    out = {}
    # Trackers do not know which spots are reflections of lenses.
    seen = {condition: replace(own, lens_glints=None) for condition, own in seen.items()}
    for name, estimator in ESTIMATORS.items():
        if name in TWO_CAMERAS and len(rig.cameras) < 2:
            continue
        rows = {c: o if name in TWO_CAMERAS else o.take(o.index.camera == 0) for c, o in seen.items()}
        bare = _fitted(estimator, rows[NONE], rig)
        for condition, own in rows.items():
            shown = own.take(~_learnt(own) | (own.index.fixation == CENTRE))
            first, middle = shown.index.camera == 0, shown.index.fixation == CENTRE
            before = _predicted(bare, shown, rig)
            fitted = bare if condition == NONE else _fitted(estimator, own, rig)
            offset = np.mean((before.point_mm - shown.index.target_mm)[first & middle], axis=0)
            by = {
                WITHOUT: before,
                SAME: before if fitted is bare else _predicted(fitted, shown, rig),
                OFFSET: GazePoints.of(before.point_mm - offset),
            }
            tested = first & ~middle
            for how, gaze in by.items():
                error = errors_of(shown, gaze)
                out[name, condition, how] = EstimatorErrors(
                    error_deg=error.error_deg[tested], vector_deg=error.vector_deg[tested]
                )
    return out


def _learnt(seen: Observations) -> Bools:
    return np.isin(seen.index.fixation, LEARNT)


def _fitted(estimator: GazeEstimator, seen: Observations, rig: RigGeometry) -> GazeEstimator | None:
    """Calibrate an estimator; None where too little is seen."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UndeterminedWarning)
        warnings.simplefilter("ignore", FitWarning)
        try:
            return estimator.fit(seen.take(_learnt(seen)), rig)
        except InputError:
            return None


def _predicted(fitted: GazeEstimator | None, seen: Observations, rig: RigGeometry) -> GazePoints:
    if fitted is None:
        return GazePoints.of(np.full((len(seen), 3), np.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        return fitted.predict(seen, rig)


def _features(seen: Observations, truth: Observations, bare: Observations) -> dict[str, float]:
    """Compare the features of the first camera with those of the bare eye, and with the truth."""
    seen, truth, bare = (one.take(one.index.camera == 0) for one in (seen, truth, bare))
    count = len(truth.glints.light[0])
    off = np.linalg.norm(seen.pupil.centre_px - truth.pupil.centre_px, axis=1)
    found = _by_light(seen, count)
    wrong = np.linalg.norm(found - _by_light(truth, count), axis=2)
    outer = np.abs(bare.pose.azimuth_rad - np.median(bare.pose.azimuth_rad)) > 0.1
    turned, turn = (p.azimuth_rad - np.median(p.azimuth_rad) for p in (truth.pose, bare.pose))
    return {
        "rotation": float(np.mean(turned[outer] / turn[outer])),
        "pupil_size": _mean(truth.pupil.semi_axes_px[:, 0] / bare.pupil.semi_axes_px[:, 0]),
        "pupil_px": _mean(np.linalg.norm(truth.pupil.centre_px - bare.pupil.centre_px, axis=1)),
        "glint_px": _mean(np.linalg.norm(truth.glints.xy_px - bare.glints.xy_px, axis=2)[:, -1]),
        "pupils_lost": float(np.mean(~seen.pupil.ok)),
        "pupils_wrong": float(np.mean(off > WRONG_PX)),
        "glints_lost": float(np.mean(np.isnan(found[..., 0]))),
        "glints_wrong": float(np.mean(wrong > WRONG_PX)),
    }


def _by_light(seen: Observations, count: int) -> Floats:
    """Arrange glints by lamp, (n, count, 2) px; NaN where none is assigned."""
    out = np.full((len(seen), count, 2), np.nan)
    rows, columns = np.nonzero(seen.glints.ok & (seen.glints.light >= 0))
    out[rows, seen.glints.light[rows, columns]] = seen.glints.xy_px[rows, columns]
    return out


def _mean(values: Floats) -> float:
    good = values[np.isfinite(values)]
    return float(good.mean()) if len(good) else np.nan
