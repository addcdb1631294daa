#!/usr/bin/env python3
"""Bench of fits of eyes to people: do their 95 % intervals cover, and are their stated deviations those achieved?

    bench_fits.py [--quick] [--json F] [--people N] [--seed S] [--priors]

Drawn people of every preset look at 13 targets a metre away, in front of four rigs. Outlines, glints and fixations have
the noise that the fit is told, and in every frame the eye is displaced by the slippage of the priors, which no record
states. Fits start from the default eye and priors, with the targets and without. The person is the unit; presets are
pooled for each rig. A rectangle of two 95 % intervals, or the ellipse of a gaze, covers what it should in 95 %.

Last come the costs of many frames, as the ratio of 1,000 to 250 frames.

With --priors, the rows are the deviations of the default priors over the rms differences of other people from the
default eye; no eye is fitted.
"""

from __future__ import annotations

import argparse
import sys
import time
import tracemalloc
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from _bench import Report, options_of, row, single_threaded

single_threaded()

import numpy as np

import eyerender as er
from eyerender.base.errors import FitWarning
from eyerender.design.fit import LEARNED, MOST_CHI2, EyeFit
from eyerender.design.information import outline_normals
from eyerender.design.unknowns import (
    ASPHERICITY,
    CENTRE,
    COUNT,
    DEPTH,
    ELLIPTICITY,
    GAP,
    KAPPA,
    LOCAL,
    MARGIN,
    PERSON,
    POSITION,
    POSTERIOR,
    POSTERIOR_TORICITY,
    PUPIL,
    RADIUS,
    ROTATION,
    SHIFT,
    TORICITY,
)
from eyerender.design.varied import radius_of, stacked_eyes, tangents, varied_eyes
from eyerender.eye.batch import take_eyes
from eyerender.eye.catalogue import load_eye
from eyerender.eye.model import EyeModel
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.optics.surfaces_graph import Biconic
from eyerender.optics.transforms import direction_of
from eyerender.scene.observation import concatenate

PRESETS = ("adults", "emmetropic_adults", "myopes", "children", "elderly")
SLIPPAGE_MM, FIXATION_DEG, PLACE_MM = 3.0, 0.3, np.array([0.0, -31.5, 0.0])
GRID_DEG = [(a, e) for e in (14.0, 0.0, -14.0) for a in (-18.0, 0.0, 18.0)]
GRID_DEG += [(a, e) for e in (-7.0, 7.0) for a in (-9.0, 9.0)]
ELLIPSE_95, AXIS_95 = 5.991, 1.960  # of a squared length in two dimensions, and of a number
TUNED = 1000  # seeds of people from here on are for choosing priors


@dataclass(frozen=True)
class Outcome:
    """A fit of one person: what it states, and what is true."""

    covered: float  # share of frames whose gaze lies in the 95 % ellipse
    error_deg: float  # rms over the frames
    stated_deg: float
    worst: float  # largest error along an axis, in stated deviations
    learned: np.ndarray  # of each number of the person
    away: np.ndarray  # its error in stated deviations; NaN where it is known or has no truth
    chi2: float
    warned: bool
    refused: bool = False


def rigs() -> dict[str, er.Rig]:
    """A headset with one camera for an eye and with two, a head-mounted and a remote rig."""
    headset = er.load_scene("headset").spec.rig
    nasal = er.Camera(
        name="nasal", position_mm=(40.0, -22.0, -15.0), look_at_mm=(-4.0, -32.0, 0.5), focal_length_px=720.0,
        resolution_px=(640, 480),
    )  # fmt: skip
    return {
        "headset, one camera": headset,
        "headset, two cameras": headset.model_copy(update={"cameras": (*headset.cameras, nasal)}),
        "head-mounted": er.load_scene("head_mounted").spec.rig,
        "remote": er.load_scene("desktop_tracker").spec.rig,
    }


def recording(
    rig: er.Rig, preset: str, subject: int, seed: int, session: int = 0
) -> tuple[er.Observations, EyeModel, np.ndarray, er.Scene]:
    """Features of a person's right eye in a session, the true eye, its lines of sight (i, 3), and the scene."""
    person = er.Population(preset=preset).person(subject, seed)
    rng = np.random.default_rng([seed, subject, PRESETS.index(preset), *([session] if session else [])])
    ways = direction_of(*np.radians(np.array(GRID_DEG, dtype=float)).T)
    slips = SLIPPAGE_MM * rng.standard_normal(ways.shape)
    misses = np.radians(FIXATION_DEG) * rng.standard_normal((len(ways), 2))
    told = PLACE_MM + 1000.0 * ways
    looked = told + 1000.0 * np.einsum("nci,nc->ni", tangents(ways), misses)
    heads = PLACE_MM + slips + [0.0, person.apex_distance_mm / 2.0, 0.0]
    frames = []
    for head, target in zip(heads, looked, strict=True):
        own = er.Subject.of(person, eyes=("right",), head_positions_mm=(tuple(head),), luminance_cd_m2=20.0)
        frames.append(er.Scene(own, rig, targets=er.Targets.at(target[None])).frames())
    parts, sights = [], []
    for k, frame in enumerate(frames):
        seen, eye = er.trace(frame, boundary_points=30), frame.scene.eye("right")
        pose = frame.pose
        turn, _ = rigid_motion(Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad), eye)
        sights.append(turn[0] @ eye.chief_ray.direction)
        n = len(seen)
        index = replace(
            seen.index, frame=np.full(n, k), fixation=np.full(n, k), eye_position_mm=np.tile(PLACE_MM, (n, 1)),
            head_mm=np.zeros((n, 3)), target_mm=np.tile(told[k], (n, 1)),
        )  # fmt: skip
        parts.append(noisy(replace(seen, index=index), rng))
    return concatenate(parts), eye, np.array(sights), frames[0].scene


def noisy(seen: er.Observations, rng: np.random.Generator) -> er.Observations:
    """Add the noise that `fit_eye` assumes by default: 0.1 px for a px of outline, 0.05 px for a glint."""
    points = seen.pupil.points_px
    normal, length = outline_normals(points, np.asarray(np.isfinite(points).all(axis=2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        points = points + (0.1 * rng.standard_normal(length.shape) / np.sqrt(length))[..., None] * normal
    glints = seen.glints.xy_px + 0.05 * rng.standard_normal(seen.glints.xy_px.shape)
    return replace(seen, pupil=replace(seen.pupil, points_px=points), glints=replace(seen.glints, xy_px=glints))


def numbers_of(eye: EyeModel, prior: EyeModel) -> np.ndarray:
    """The unknowns (35,) that lead from one right eye to another one; NaN for those that have no one value."""
    out, (a, b) = np.zeros(COUNT), (eye, prior)

    def between(function: Callable[[Any], Any]) -> Any:
        return function(a) - function(b)

    def sight(one: EyeModel) -> np.ndarray:
        x, y, z = one.chief_ray.direction
        return np.asarray(np.arctan2([y, z], x))

    def ratio(one: EyeModel) -> float:
        return float(radius_of(one.front[1]) / radius_of(one.front[0]))

    turns = (a.rotation, b.rotation)
    azimuth, elevation = (
        getattr(turns[1], name)[0] - getattr(turns[0], name)[0] for name in ("azimuth_centre_mm", "elevation_centre_mm")
    )
    out[RADIUS] = between(lambda e: radius_of(e.front[0]))
    out[ASPHERICITY] = between(lambda e: np.mean(e.front[0].conic_constants))
    out[DEPTH] = -between(lambda e: e.stop.centre_mm[0])
    out[KAPPA] = between(sight)
    out[ROTATION], out[GAP] = (azimuth + elevation) / 2.0, azimuth - elevation
    out[TORICITY] = between(lambda e: toricity(e.front[0]))
    out[POSTERIOR] = ratio(a) / ratio(b) - 1.0
    out[POSTERIOR_TORICITY] = between(lambda e: toricity(e.front[1]))
    out[CENTRE] = out[SHIFT] = np.nan  # at one size of the pupil they are one
    shape = np.zeros(COUNT)
    shape[PUPIL] = 2.0 * np.sqrt(np.prod(a.stop.semi_axes_mm))
    for _ in range(5):  # each harmonic is that of the unknown, but for products of small numbers
        missing = (harmonics(a) - harmonics(take_eyes(varied_eyes(stacked_eyes([b]), shape[None]), np.array(0)))).T
        shape[ELLIPTICITY] += missing[0]
        shape[MARGIN] += missing[1:].ravel()
    out[ELLIPTICITY], out[MARGIN] = shape[ELLIPTICITY], shape[MARGIN]
    out[POSITION] = np.nan
    return out


def toricity(surface: Biconic) -> np.ndarray:
    """Half the difference of a biconic's radii, straight and oblique part."""
    angle = np.arctan2(surface.rotation[2, 1], surface.rotation[1, 1])
    half = 0.5 * (surface.radii_mm[0] - surface.radii_mm[1])
    return np.asarray(half * np.array([np.cos(2 * angle), np.sin(2 * angle)]))


def harmonics(eye: EyeModel) -> np.ndarray:
    """Harmonics 2 to 6 (2, 5) of the radius of a pupil's outline about its centre, over the radius of its size."""
    away = (eye.stop.boundary(3600) - eye.stop.centre_mm)[:, 1:]
    angle = np.arctan2(away[:, 1], away[:, 0])
    even = 2.0 * np.pi * np.arange(720) / 720
    order = np.argsort(angle)
    radius = np.interp(even, angle[order], np.linalg.norm(away, axis=1)[order], period=2.0 * np.pi)
    found = np.fft.rfft(radius / np.sqrt(np.prod(eye.stop.semi_axes_mm)))[2:7] / 360.0
    return np.array([found.real, -found.imag])


def outcome(fit: EyeFit, eye: EyeModel, sights: np.ndarray, warned: bool) -> Outcome:
    """Compare a fit with the truth."""
    error = np.degrees(np.einsum("nci,ni->nc", tangents(sights), fit.direction - sights))
    covariance = fit.known.gaze_covariance_deg2
    square = np.einsum("nc,ncd,nd->n", error, np.linalg.inv(covariance), error)
    axis = np.abs(error) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    stated, before = fit.known.person_deviation, fit.unknowns.deviations()[LOCAL:]
    truth = numbers_of(eye, fit.prior.build(eye="right"))[LOCAL:]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(before > 0, (fit.theta[0, LOCAL:] - truth) / stated, np.nan)
    return Outcome(
        covered=float(np.mean(square <= ELLIPSE_95)), error_deg=float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        stated_deg=float(np.sqrt(np.mean(fit.known.gaze_deg**2))), worst=float(axis.max()),
        learned=stated < LEARNED * before, away=away, chi2=fit.chi2_per_degree, warned=warned,
    )  # fmt: skip


def fitted(rig: er.Rig, preset: str, subject: int, seed: int) -> list[Outcome | None]:
    """The outcomes of one person with targets and without; None for a fit that was refused."""
    seen, eye, sights, scene = recording(rig, preset, subject, seed)
    print(f"{preset} {subject}: {time.process_time():.0f} s", file=sys.stderr, flush=True)
    out: list[Outcome | None] = []
    for targets in (True, False):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                (fit,) = er.fit_eye(seen, scene.rig, targets=targets)
            except er.InputError as error:
                print(f"{preset} {subject}: {error}", file=sys.stderr)
                out.append(None)
                continue
        out.append(outcome(fit, eye, sights, any(issubclass(w.category, FitWarning) for w in caught)))
    return out


def people_rows(report: Report, rig: str, what: str, given: list[Outcome | None]) -> None:
    """Rows of one rig."""
    found = [one for one in given if one is not None]
    if not found:
        return
    report.add(row(f"{rig}, {what}: refused fits", len(given) - len(found), "people"))
    covered = 100 * float(np.mean([one.covered for one in found]))
    report.add(row(f"{rig}, {what}: gaze in the 95 % ellipse, at least", covered, "%", 90.0, at_least=True))
    report.add(row(f"{rig}, {what}: gaze in the 95 % ellipse, at most", covered, "%", 98.0))
    stated, achieved = (float(np.median([getattr(one, k) for one in found])) for k in ("stated_deg", "error_deg"))
    report.add(row(f"{rig}, {what}: error (median person)", achieved, "deg"))
    report.add(row(f"{rig}, {what}: stated over achieved", stated / achieved, "ratio", 1.3))
    report.add(row(f"{rig}, {what}: largest error of an axis", max(one.worst for one in found), "stated", 5.0))
    silent = sum(one.chi2 > MOST_CHI2 and not one.warned for one in found)
    report.add(row(f"{rig}, {what}: chi^2 above 2 without a warning", silent, "people", 0))
    report.add(row(f"{rig}, {what}: chi^2 per degree of freedom", float(np.median([o.chi2 for o in found])), ""))
    learned, away = np.array([one.learned for one in found]), np.array([one.away for one in found])
    for k, name in enumerate(PERSON):
        use = learned[:, k] & np.isfinite(away[:, k])
        if use.sum() >= max(10, len(found) // 2):
            inside = 100 * float(np.mean(np.abs(away[use, k]) <= AXIS_95))
            report.add(row(f"{rig}, {what}: {name} covered ({use.sum()} people)", inside, "%", 90.0, at_least=True))


def cost_rows(report: Report) -> None:
    """CPU time and memory of 1,000 over 250 frames, of the estimator and of the fit of an eye."""
    rig = rigs()["headset, one camera"]
    sessions = [recording(rig, "adults", 0, TUNED, session) for session in range(20)]  # each with its own noise
    seen, scene = concatenate([one[0] for one in sessions]), sessions[0][3]
    calibrated = er.gaze.MaximumLikelihood().fit(seen, scene.rig)
    used: dict[str, list[tuple[float, float]]] = {"predict": [], "fit_eye": []}
    for count in (250, 1000):
        many = seen.take(np.arange(count) % len(seen))
        many = replace(many, index=replace(many.index, frame=np.arange(count), fixation=np.arange(count)))
        work: dict[str, Callable[[], object]] = {
            "predict": partial(calibrated.predict_rays, many, scene.rig),
            "fit_eye": partial(er.fit_eye, many, scene.rig),
        }
        for name, function in work.items():
            start = time.process_time()
            function()
            spent = time.process_time() - start
            tracemalloc.start()
            function()
            used[name].append((spent, float(tracemalloc.get_traced_memory()[1])))
            tracemalloc.stop()
            report.add(row(f"{name}, {count} frames", spent, "s (CPU)"))
    for name, (few, lots) in used.items():
        report.add(row(f"{name}: CPU of 1,000 over 250 frames", lots[0] / few[0], "ratio", 5.0))
        report.add(row(f"{name}: memory of 1,000 over 250 frames", lots[1] / few[1], "ratio", 5.0))


def prior_rows(report: Report, count: int) -> None:
    """Compare the default priors with people of all presets; the pupil's harmonics have wider ones, by 1.5."""
    prior, rig = load_eye("adult").build(eye="right"), rigs()["headset, one camera"]
    found = []
    for k, preset in enumerate(PRESETS):
        for number in range(count):
            person = er.Population(preset=preset).person(number, TUNED + k)
            own = er.Subject.of(person, eyes=("right",), luminance_cd_m2=20.0)
            scene = er.Scene(own, rig, targets=er.Targets.at(PLACE_MM + np.array([[1000.0, 0.0, 0.0]])))
            found.append(numbers_of(scene.eye("right"), prior)[LOCAL:])
    rms = np.sqrt(np.mean(np.array(found) ** 2, axis=0))
    for name, value, stated in zip(PERSON, rms, er.Unknowns.population().deviations()[LOCAL:], strict=True):
        if np.isfinite(value):
            report.add(row(f"{name}: prior over rms of {len(found)} people", stated / value, "ratio"))


def main() -> int:
    """Fit everybody and print the rows."""
    parser: argparse.ArgumentParser = options_of(__doc__, "take two people of each preset, and no costs")
    parser.add_argument("--people", type=int, default=20, help="people of each preset (20)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the people (1)")
    parser.add_argument("--priors", action="store_true", help="compare the default priors with people")
    options = parser.parse_args()
    report, count = Report(), 2 if options.quick else options.people
    if options.priors:
        prior_rows(report, count)
        return report.finish(options.json, ("eyerender", "numpy", "scipy"))
    for name, rig in rigs().items():
        outcomes = [
            fitted(rig, preset, len(PRESETS) * number + k, options.seed)
            for number in range(count)
            for k, preset in enumerate(PRESETS)
        ]
        for which, what in enumerate(("targets", "no targets")):
            people_rows(report, name, what, [both[which] for both in outcomes])
    if not options.quick:
        cost_rows(report)
    return report.finish(options.json, ("eyerender", "numpy", "scipy"))


if __name__ == "__main__":
    sys.exit(main())
