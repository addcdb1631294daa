#!/usr/bin/env python3
"""Gaze errors of estimators on recordings of unseen people, traced with noise and rendered, with and without slippage.

    bench_estimators.py [--quick] [--json F] [--people N]

Adults sit in front of `desktop_tracker`. Each looks at nine targets of the screen, which calibrate, and then at five
others: once with the head at rest, and once with the head moved by 1.5 mm per axis (standard deviation) in every frame.
The records do not say so. All frames are rendered with lids and lashes, and the features are extracted. The rows are
the median over people of each one's 95th-percentile error, with frames without an estimate left out. Estimators that
need other rigs (two cameras, or four LEDs around the screen) are left out.

The first rows are of eight of these people without pictures: exact features of 9 x 9 targets, nine of which calibrate,
with noise of 0.2 px on points of the outline, 0.06 px on its centre and 0.1 px on glints, and with an eye that has
moved by 1 mm per axis after the calibration.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

import eyerender as er
from eyerender.gaze.estimate import RayEstimator, angular_error_deg
from eyerender.gaze.store import choose_estimator
from eyerender.population.people import Person
from eyerender.scene.observation import Observations, concatenate

ESTIMATORS = ("maximum-likelihood", "hennessey", "guestrin-eizenman", "direction-regression", "regression")
SEED, SLIPPAGE_MM = 21, 1.5
TRACED_PEOPLE, TRACED_SLIPPAGE_MM, POINT_PX, CENTRE_PX, GLINT_PX = 8, 1.0, 0.2, 0.06, 0.1
GRID = np.array([[620.0, y, z] for z in np.linspace(90, -90, 9) for y in np.linspace(-170, 170, 9)])
CALIBRATION_MM = [[620.0, y, z] for z in (90.0, 0.0, -90.0) for y in (-170.0, 0.0, 170.0)]
TESTS_MM = [[620.0, y, z] for y, z in ((-90.0, 50.0), (110.0, 70.0), (-120.0, -60.0), (85.0, -40.0), (20.0, 30.0))]


def people(count: int) -> Iterator[Person]:
    """The first people whose eye is physically possible."""
    drawn, number = er.Population("adults"), 0
    while count:
        person = drawn.person(number, SEED)
        number += 1
        try:
            person.eye("right")
        except er.InputError:
            continue
        count -= 1
        yield person


def observe(person: Person, targets_mm: list[list[float]], head_mm: np.ndarray) -> Observations:
    """Render a person's fixations with the head at a place, and extract their features; the place is not recorded."""
    spec = er.load_scene("desktop_tracker").spec
    subject = er.Subject.of(person, eyes=("right",), head_positions_mm=(tuple(head_mm.tolist()),), luminance_cd_m2=20.0)
    image = spec.image.model_copy(update={"window_px": (240, 180)})
    scene = er.Scene(
        subject, spec.rig, targets=er.Targets.at(np.array(targets_mm)), sensor=spec.sensor, lens=spec.lens, image=image
    )
    seen = er.ImageObserver().observe(scene.frames())
    return replace(seen, index=replace(seen.index, head_mm=np.zeros((len(seen), 3))))


def traced(person: Person, targets_mm: np.ndarray, head_mm: np.ndarray, rng: np.random.Generator) -> Observations:
    """Trace a person's fixations with the head at a place, which is not recorded, and add noise."""
    rig = er.load_scene("desktop_tracker").spec.rig
    subject = er.Subject.of(person, eyes=("right",), head_positions_mm=(tuple(head_mm.tolist()),), luminance_cd_m2=20.0)
    seen = er.trace(subject.fixating(targets_mm, rig))
    pupil, glints = seen.pupil, seen.glints

    def noisy(values: np.ndarray, size_px: float) -> np.ndarray:
        return values + size_px * rng.standard_normal(values.shape)

    return replace(
        seen,
        index=replace(seen.index, head_mm=np.zeros((len(seen), 3))),
        pupil=replace(pupil, centre_px=noisy(pupil.centre_px, CENTRE_PX), points_px=noisy(pupil.points_px, POINT_PX)),
        glints=replace(glints, xy_px=noisy(glints.xy_px, GLINT_PX)),
    )


def traced_rows(report: Report, count: int, rig: er.Rig) -> None:
    """Add the rows of people without pictures."""
    calibrate = np.isin(np.arange(81), [9 * row + column for row in (0, 4, 8) for column in (0, 4, 8)])
    found: dict[str, list[float]] = {name: [] for name in ESTIMATORS[:4]}
    for number, person in enumerate(people(count)):
        rng = np.random.default_rng((SEED, number, 1))
        calibration = traced(person, GRID[calibrate], np.zeros(3), rng)
        moved = traced(person, GRID[~calibrate], TRACED_SLIPPAGE_MM * rng.standard_normal(3), rng)
        for name, errors in found.items():
            errors.append(float(np.nanquantile(errors_of(name, calibration, moved, rig), 0.95)))
    for name, errors in found.items():
        report.add(row(f"traced: {name}", float(np.median(errors)), "deg"))


def errors_of(name: str, calibration: Observations, tests: Observations, rig: er.Rig) -> np.ndarray:
    """Angles between the estimates and the targets, in degrees; NaN without an estimate."""
    options: dict[str, Any] = {"normalised": False} if name == "regression" else {}  # of one eye
    fitted = choose_estimator(name, **options).fit(calibration, rig)
    if isinstance(fitted, RayEstimator):
        return er.gaze.ray_errors_deg(tests, fitted.predict_rays(tests, rig))
    return angular_error_deg(fitted.predict(tests, rig).point_mm, tests.index.target_mm, tests.index.eye_position_mm)


def main() -> int:
    """Measure and print the rows."""
    parser = options_of(__doc__, "take 2 people")
    parser.add_argument("--people", type=int, default=10)
    options = parser.parse_args()
    rig = er.load_scene("desktop_tracker").spec.rig
    count, report = 2 if options.quick else options.people, Report()
    traced_rows(report, min(count, TRACED_PEOPLE), rig)
    found: dict[tuple[str, str], list[float]] = {}
    for number, person in enumerate(people(count)):
        rng, rest = np.random.default_rng((SEED, number)), np.zeros(3)
        moves = SLIPPAGE_MM * rng.standard_normal((len(TESTS_MM), 3))
        calibration, still = observe(person, CALIBRATION_MM, rest), observe(person, TESTS_MM, rest)
        slipped = concatenate([observe(person, [t], move) for t, move in zip(TESTS_MM, moves, strict=True)])
        for name in ESTIMATORS:
            for case, tests in (("at rest", still), ("slipped", slipped)):
                try:
                    errors = errors_of(name, calibration, tests, rig)
                    found.setdefault((case, name), []).append(float(np.nanquantile(errors, 0.95)))
                except (er.InputError, np.linalg.LinAlgError):
                    found.setdefault((case, name), []).append(np.nan)
        print(f"{number + 1} of {count} people", file=sys.stderr, flush=True)
    for case in ("at rest", "slipped"):
        medians = {name: float(np.nanmedian(found[case, name])) for name in ESTIMATORS}
        for name, value in medians.items():
            report.add(row(f"{case}: {name}", value, "deg"))
        others = min(value for name, value in medians.items() if name != ESTIMATORS[0])
        report.add(row(f"{case}: {ESTIMATORS[0]} over the best other one", medians[ESTIMATORS[0]] / others, "ratio",
                       aim=1.0))  # fmt: skip
    return report.finish(options.json, ("eyerender", "numpy", "mitsuba", "drjit"))


if __name__ == "__main__":
    sys.exit(main())
