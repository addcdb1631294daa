"""Gaze estimates and their errors, as `gaze predict` reports them.

Errors are distances on the screen's plane in mm and px, and angles at the eye in degrees. The eye's position is taken
from the observations if they state it. Otherwise it is estimated: the origin of the estimator's gaze ray, or the centre
of corneal curvature from two glints and an average cornea. This centre is 8 mm behind the apex, which changes an angle
at 600 mm by 1 %.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Objects, finite_or_none
from ..base.errors import InputError
from ..base.status import Status
from ..base.storage.files import csv_text
from ..rig.rig import RigGeometry
from ..rig.screen import ScreenPlane
from ..scene.events import MOVING, has_event
from ..scene.observation import EVENTS, EYES, Index, Observations
from .cornea import centres_of
from .estimate import GazeEstimator, RayEstimator, angular_error_deg, binocular_average, ray_errors_deg
from .parameters import MEAN_EYE
from .quality import quality
from .rays import NOT_CALIBRATED, feature_rays, is_none, targets_on_screen

POINTS_SCHEMA, RAYS_SCHEMA = "eyerender/gaze/3", "eyerender/gaze/4"
"""Schemas of gaze points on a screen, and of gaze rays of a rig without one."""

GIVEN, RAYS, GLINTS = "given", "rays", "glints"
"""Sources of the eye's position: the observations, the estimator's gaze rays, or the glints."""


def predictions(
    estimator: GazeEstimator, observations: Observations, rig: RigGeometry, screen_px: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Estimate the gaze of every observation, and of every frame with both eyes.

    Schema eyerender/gaze/3 holds gaze points. Errors are null without a target; errors in px also without the screen's
    size in px, and errors in degrees without the eye's position. For a rig without a screen, schema eyerender/gaze/4
    holds gaze rays. Their errors are angles at the rays' origins, and there are no binocular estimates.

    Args:
        estimator: a calibrated estimator.
        observations: features, with targets where they are known.
        rig: the rig that observed them.
        screen_px: width and height of the rig's screen in px.
    """
    if rig.screen is None and isinstance(estimator, RayEstimator):
        return _ray_predictions(estimator, observations, rig)
    index = observations.index
    with np.errstate(all="ignore"):
        gaze = estimator.predict(observations, rig)
        place, source = _eye_places(estimator, observations, rig)
        errors = {"deg": angular_error_deg(gaze.point_mm, index.target_mm, place)}
        errors |= _screen_errors(observations, gaze.point_mm, rig.screen, screen_px)
        angles = _screen_angles(gaze.point_mm, place, rig.screen)
    single = [
        {
            **_identity(observations, i),
            "status": Status(gaze.status[i]).label,
            "reason": gaze.reason[i],
            "point_mm": gaze.point_mm[i].tolist() if gaze.ok[i] else None,
            "target_mm": _numbers(index.target_mm[i]),
            **_errors_of(errors, i),
            "eye_place": source[i],
            "angle_deg": _numbers(angles[i]),
        }
        for i in range(len(observations))
    ]
    summary = _by_eye(observations, gaze.ok, errors, source, (gaze.point_mm, place))
    binocular: list[dict[str, Any]] = []
    if len(np.unique(index.eye[index.eye >= 0])) == 2:
        frames, both = binocular_average(observations, gaze)
        with np.errstate(all="ignore"):
            middle = _middles(observations, place, frames)
            errors = {"deg": angular_error_deg(both.point_mm, frames.index.target_mm, middle)}
            errors |= _screen_errors(frames, both.point_mm, rig.screen, screen_px)
            angles = _screen_angles(both.point_mm, middle, rig.screen)
        binocular = [
            {
                "frame": int(frames.index.frame[i]),
                "status": Status(both.status[i]).label,
                "reason": both.reason[i],
                "point_mm": both.point_mm[i].tolist() if both.ok[i] else None,
                **_errors_of(errors, i),
                "time_s": finite_or_none(frames.index.time_s[i]),
                "angle_deg": _numbers(angles[i]),
            }
            for i in range(len(both))
        ]
        figures = {**_summary(both.ok, errors, source), "quality": _precision(both.point_mm, frames.index, middle)}
        summary.append({"eye": "both", **figures, "by_event": _by_event(frames.index, both.ok, errors["deg"])})
    return {"schema": POINTS_SCHEMA, "gaze": single, "binocular": binocular, "summary": summary}


def _ray_predictions(estimator: RayEstimator, observations: Observations, rig: RigGeometry) -> dict[str, Any]:
    with np.errstate(all="ignore"):
        rays = estimator.predict_rays(observations, rig)
        errors = {"deg": ray_errors_deg(observations, rays)}
        reach = np.linalg.norm(observations.index.target_mm - rays.origin_mm, axis=1)
        aim = rays.origin_mm + reach[:, None] * rays.direction
    status = np.where(rays.ok, Status.OK, Status.NO_ESTIMATE)
    entries = [
        {
            **_identity(observations, i),
            "status": Status(int(status[i])).label,
            "reason": rays.reason[i],
            "origin_mm": _numbers(rays.origin_mm[i]),
            "direction": _numbers(rays.direction[i]),
            "target_mm": _numbers(observations.index.target_mm[i]),
            "error_deg": finite_or_none(errors["deg"][i]),
        }
        for i in range(len(observations))
    ]
    source = np.array([RAYS if ok else None for ok in rays.ok], dtype=object)
    return {
        "schema": RAYS_SCHEMA,
        "gaze": entries,
        "binocular": [],
        "summary": _by_eye(observations, rays.ok, errors, source, (aim, rays.origin_mm)),
    }


def _screen_errors(
    observations: Observations, point_mm: Floats, screen: ScreenPlane | None, screen_px: tuple[float, float] | None
) -> dict[str, Floats]:
    """Compute distances (n,) on the screen's plane from gaze points (n, 3) to targets, by unit; NaN where unknown."""
    unknown = np.full(len(observations), np.nan)
    if screen is None:
        return {"mm": unknown, "px": unknown}
    try:
        miss = screen.flat(point_mm) - targets_on_screen(observations, screen)
    except InputError:  # a target off the plane, for an eye whose position is unknown
        return {"mm": unknown, "px": unknown}
    pixels = np.full(2, np.nan) if screen_px is None else np.array(screen_px) / screen.size_mm
    return {"mm": np.linalg.norm(miss, axis=1), "px": np.linalg.norm(miss * pixels, axis=1)}


def _eye_places(estimator: GazeEstimator, observations: Observations, rig: RigGeometry) -> tuple[Floats, Objects]:
    """Compute the position of each eye (n, 3) mm in the world, NaN where unknown, and its source (n,)."""
    index = observations.index
    place = np.array(index.eye_position_mm + index.head_mm)
    source = np.array([GIVEN if np.isfinite(one).all() else None for one in place], dtype=object)
    for name in (RAYS, GLINTS):
        rows = np.flatnonzero(is_none(source))
        if not len(rows):
            break
        some = observations.take(rows)
        if name == GLINTS:
            found = _corneal_centres(some, rig)
        elif isinstance(estimator, RayEstimator):
            found = estimator.predict_rays(some, rig).origin_mm
        else:
            continue
        known = _plausible(found, rig)
        place[rows[known]], source[rows[known]] = found[known], name
    return place, source


def _plausible(place: Floats, rig: RigGeometry) -> Bools:
    """Return whether estimated places (n, 3) mm can be those of eyes: 10 mm to 3 m from every camera."""
    away = np.array([np.linalg.norm(place - camera.nodal_point_mm, axis=1) for camera in rig.cameras])
    return np.asarray(((away > 10.0) & (away < 3000.0)).all(axis=0))


def _screen_angles(point_mm: Floats, eye_mm: Floats, screen: ScreenPlane | None) -> Floats:
    """Compute visual angles (n, 2) deg of gaze points to the right of the screen's centre and above it.

    They are arctan(offset on the screen / distance of the eye from its plane); NaN without a screen or an eye's place.
    """
    if screen is None:
        return np.full((len(point_mm), 2), np.nan)
    distance = (eye_mm - screen.centre_mm) @ screen.normal
    return np.asarray(np.degrees(np.arctan2(screen.flat(point_mm), distance[:, None])))


def refuse_nothing(data: dict[str, Any], calibrated: Sequence[str], *, source: str) -> None:
    """Raise InputError, with the reason of most records, if `predictions` estimated nothing.

    The message names `source`, and the eyes that the calibration knows (`calibrated`).
    """
    entries = data["gaze"]
    if any(entry["status"] == "ok" for entry in entries):
        return
    named = sorted({entry["eye"] for entry in entries if entry["eye"] is not None})
    reason, count = Counter(str(entry["reason"]) for entry in entries).most_common(1)[0]
    if reason == NOT_CALIBRATED:
        knows, name = (" and ".join(eyes) or "no" for eyes in (calibrated, named))
        reason = f"the calibration knows the {knows} eye; the records name {f'the {name} eye' if named else 'none'}"
        raise InputError(f"no gaze was estimated: {reason}", source=source)
    raise InputError(f"no gaze was estimated: {reason} ({count} of {len(entries)} records)", source=source)


def gaze_csv(data: dict[str, Any], rig: RigGeometry, screen_px: tuple[float, float] | None = None) -> str:
    """Format the result of `predictions` as a table, one row for each eye and one for both at each moment.

    Columns: `time_s`, `frame`, `eye`, `x_px` and `y_px` from the screen's top left (empty without `screen_px`), `x_deg`
    and `y_deg` to the right of the screen's centre and above it, `valid`. Without a screen, `azimuth_deg` and
    `elevation_deg` of the ray stand in place of x and y.
    """
    screen = rig.screen
    names = ("x_px", "y_px", "x_deg", "y_deg") if screen is not None else ("azimuth_deg", "elevation_deg")
    rows = []
    for entry in [*data["gaze"], *({**both, "eye": "both"} for both in data["binocular"])]:
        if screen is None:
            values: list[float | None] = [None, None]
            if entry["direction"] is not None:
                x, y, z = entry["direction"]
                values = [math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))]
        else:
            pixels: list[float | None] = [None, None]
            if entry["point_mm"] is not None and screen_px is not None:
                across, up = screen.flat(entry["point_mm"])
                width, height = screen.size_mm
                pixels = [screen_px[0] * (across / width + 0.5), screen_px[1] * (0.5 - up / height)]
            values = [*pixels, *(entry["angle_deg"] or (None, None))]
        cells = ["" if value is None else f"{value:.6g}" for value in values]
        time_s = "" if entry["time_s"] is None else f"{entry['time_s']:.9g}"
        rows.append([time_s, entry["frame"], entry["eye"] or "", *cells, int(entry["status"] == "ok")])
    return csv_text(["time_s", "frame", "eye", *names, "valid"], sorted(rows, key=lambda row: row[1]))


def _corneal_centres(observations: Observations, rig: RigGeometry) -> Floats:
    """Compute centres of corneal curvature (n, 3) mm from the glints and an average radius; NaN where this fails."""
    centre = np.full((len(observations), 3), np.nan)
    if min(len(rig.lights_of(eye)) for eye in np.unique(observations.index.eye).tolist()) < 2:
        return centre
    rays = feature_rays(observations, rig, None, least=2)
    rows = np.flatnonzero(is_none(rays.reason))
    centre[rows], _ = centres_of(rays, rows, np.full(len(rows), MEAN_EYE.cornea_radius_mm))
    return centre


def _middles(observations: Observations, place: Floats, frames: Observations) -> Floats:
    """Compute the vertex (f, 3) of each frame's binocular error: the head, or the point midway between the eyes."""
    _, which = np.unique(observations.index.moment, return_inverse=True)
    total = np.zeros((len(frames), 3))
    np.add.at(total, which, place)
    middle = total / np.bincount(which, minlength=len(frames))[:, None]
    head = frames.index.head_mm
    return np.where(np.isfinite(head).all(axis=1, keepdims=True), head, middle)


def _by_eye(
    observations: Observations, ok: Bools, errors: dict[str, Floats], source: Objects, gaze: tuple[Floats, Floats]
) -> list[dict[str, Any]]:
    """Summarise the errors and the precision of each eye; `gaze` are gaze points and places of the eye, (n, 3) mm."""
    out = []
    for eye in np.unique(observations.index.eye):
        rows = observations.index.eye == eye
        part = {unit: values[rows] for unit, values in errors.items()}
        index = observations.index.take(rows)
        precision = _precision(gaze[0][rows], index, gaze[1][rows])
        name = EYES[int(eye)] if eye >= 0 else None
        figures = {**_summary(ok[rows], part, source[rows]), "quality": precision}
        out.append({"eye": name, **figures, "by_event": _by_event(index, ok[rows], part["deg"])})
    return out


def _by_event(index: Index, ok: Bools, error_deg: Floats) -> dict[str, Any] | None:
    """Summarise the samples of a sequence by what the eye does: number, loss and errors; None without events."""
    rows = {word: has_event(index.events, word) for word in EVENTS}
    out = {}
    for word, own in rows.items():
        if own.any():
            known = error_deg[own & np.isfinite(error_deg)]
            loss = float(1 - ok[own].mean())
            error = _figures(known) if len(known) else None
            out[word] = {"samples": int(own.sum()), "data_loss": loss, "error_deg": error}
    return out or None


def _precision(point_mm: Floats, index: Index, from_mm: Floats) -> dict[str, Any] | None:
    """Compute the medians of `quality` over runs of at least two samples of one target; None if there are none.

    Samples of a sequence in which the eye moves or blinks belong to no run.
    """
    target_mm, still = index.target_mm, ~has_event(index.events, *MOVING)
    new = np.any(target_mm[1:] != target_mm[:-1], axis=1)
    runs = [run[still[run]] for run in np.split(np.arange(len(target_mm)), np.flatnonzero(new) + 1)]
    known = [run for run in runs if len(run) > 1 and np.isfinite(target_mm[run[0]]).all()]
    if not known:
        return None
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # medians of nothing
        each = [quality(point_mm[r][:, None], target_mm[r[:1]], np.nanmean(from_mm[r], axis=0)) for r in known]
        names = ("accuracy_deg", "rms_s2s_deg", "sd_deg", "s2s_over_sd", "bcea_deg2", "data_loss")
        medians = {name: np.nanmedian([getattr(one, name) for one in each]) for name in names}
    return {"fixations": len(known), **{name: finite_or_none(value) for name, value in medians.items()}}


def _summary(ok: Bools, errors: dict[str, Floats], source: Objects) -> dict[str, Any]:
    """Compute mean, median and 95th percentile of errors, and the share of samples without an estimate."""
    units = ("mm", "px", "deg")
    found = {unit: values[np.isfinite(values)] for unit, values in errors.items()}
    return {
        "samples": len(ok),
        "data_loss": float(1 - ok.mean()),
        "eye_place": sorted({str(one) for one in source if one is not None}),
        **{f"error_{unit}": _figures(found[unit]) if len(found.get(unit, ())) else None for unit in units},
    }


def _figures(values: Floats) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "n": len(values),
    }


def _errors_of(errors: dict[str, Floats], i: int) -> dict[str, float | None]:
    return {f"error_{unit}": finite_or_none(errors[unit][i]) for unit in ("mm", "px", "deg")}


def _identity(observations: Observations, i: int) -> dict[str, Any]:
    """Return the keys that identify the observation of row `i`."""
    index = observations.index
    return {
        "frame": int(index.frame[i]),
        "time_s": finite_or_none(index.time_s[i]),
        "fixation": int(index.fixation[i]) if index.fixation[i] >= 0 else None,
        "camera": int(index.camera[i]) if index.camera[i] >= 0 else None,
        "eye": EYES[int(index.eye[i])] if index.eye[i] >= 0 else None,
    }


def _numbers(values: Floats) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None
