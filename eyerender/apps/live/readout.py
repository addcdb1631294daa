"""Numbers and reasons on the page: the feature table, the gaze error, all poses, and the light on the eye."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import Floats
from ...base.errors import InputError
from ...design.information import information
from ...design.safety import NOTE, eye_exposure
from ...gaze.directions import DirectionRegression
from ...gaze.estimate import angular_error_deg
from ...gaze.regression import Regression, highest_determined, pupil_glint_vectors
from ...imaging.moments import eye_motion
from ...scene import Frames
from ...scene.observation import EYES, Observations
from .setup import Setup

Estimator = Regression | DirectionRegression


def calibrated(setup: Setup) -> Estimator | None:
    """Calibrate a regression on the scene's fixations and current rig, with exact features of the selected eye.

    It uses the vector from the first light's glint, in px, and the function with the most terms that the fixations
    determine: to points of the screen, or to directions of the line of sight without a screen. None if the features are
    visible for too few fixations.
    """
    frames = setup.rows
    seen, rig = trace(frames), setup.scene.rig
    vectors, reasons = pupil_glint_vectors(seen, normalised=False, rig=rig)
    function = highest_determined(vectors[[reason is None for reason in reasons]])
    if function is None:
        return None
    try:
        if rig.screen is not None and setup.origin.targets is not None:
            return Regression(function, normalised=False).fit(seen, rig)
        return DirectionRegression(function).fit_directions(seen, rig, lines_of_sight(frames))
    except InputError:
        return None


def lines_of_sight(frames: Frames) -> Floats:
    """Compute the directions (n, 3) of the lines of sight of frames, in the world."""
    ways = [np.asarray(frames.scene.eye(EYES[eye]).chief_ray.direction) for eye in frames.index.eye]
    turned = [eye_motion(frames, row)[0] @ way for row, way in enumerate(ways)]
    return np.array(turned).reshape(-1, 3)


def poses_line(setup: Setup) -> str:
    """Describe what the rig sees of the selected eye in all poses: pupils, glints, and the bound of gaze."""
    frames = setup.rows
    seen = trace(frames)
    glints = seen.glints.ok.sum(axis=1)
    text = f"All {len(frames)} poses: pupil in {int(seen.pupil.ok.sum())}, {_span(glints, '{:.0f}')} glints each"
    try:
        bound = information(frames)[setup.eye].gaze_deg
    except InputError:
        return text
    known = bound[np.isfinite(bound)]
    return f"{text}; noise of gaze at least {_span(known, '{:.2g}')}° for a known eye" if len(known) else text


def exposure_line(setup: Setup) -> str:
    """Describe the light of all LEDs on the selected eye, against the limits of eye safety."""
    try:
        found = eye_exposure(setup.scene.rig, setup.apex_mm, wavelength_nm=setup.scene.spec.wavelength_nm)
    except InputError as error:
        return f"Light on the eye: {error.reason}"
    shares = [f"cornea {100 * found.cornea_share:.2g} % of the limit ({found.cornea_w_m2.sum():.3g} W/m²)"]
    known = found.retina_share[found.retina_known]
    shares.append(f"retina {100 * known.max():.2g} %" if len(known) else "retina not known, because LEDs are points")
    stuck = found.stuck_on.cornea_share
    if stuck > found.cornea_share:
        shares.append(f"with LEDs stuck on, cornea {100 * stuck:.2g} %")
    return f"Light on the eye: {', '.join(shares)}; {NOTE}"


def _span(values: Any, form: str) -> str:
    ends = [form.format(end) for end in (np.min(values), np.max(values))]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def gaze_line(setup: Setup, estimator: Estimator | None, truth: Observations, found: Observations | None) -> str:
    """Describe the gaze error of the current frame for both observers, with a regression calibrated on this rig."""
    if estimator is None:
        return "Gaze error: the fixations of this scene determine no regression."
    if isinstance(estimator, Regression) and not np.isfinite(truth.index.target_mm).all():
        return "Gaze error: let the eye follow a target to see it."
    parts = []
    for name, features in (("exact features", truth), ("this picture", found)):
        if features is not None:
            error = _gaze_error(setup, estimator, features, truth)
            parts.append(f"{name} {error:.2f}°" if np.isfinite(error) else f"{name}: none")
    return f"Gaze error of {estimator.function}, calibrated on this rig with exact features: {', '.join(parts)}"


def _gaze_error(setup: Setup, estimator: Estimator, features: Observations, truth: Observations) -> float:
    """Compute the error of one row in degrees: of the point on the screen, or of the direction without one."""
    apex = setup.apex_mm
    if isinstance(estimator, Regression):
        target, point = truth.index.target_mm, estimator.predict(features, setup.scene.rig).point_mm
    else:
        frames = setup.frames()
        target = apex + lines_of_sight(frames.take([setup.row(frames)]))
        point = apex + estimator.predict_rays(features, setup.scene.rig).direction
    return float(angular_error_deg(point, target, apex)[0])


def feature_table(truth: Observations, found: Observations | None, hidden: tuple[str, ...], coarse: int = 1) -> str:
    """Build an HTML table of one row's pupil and glints: by ray optics, in the rendered scene, and extracted.

    Args:
        truth: observation of the analytic observer, one row.
        found: observation of the image observer, one row; None if not requested.
        hidden: what hides the glint of each light of this eye in the scene ("" or "visible" if nothing does).
        coarse: width of the picture's pixels in pixels of the sensor.
    """
    rows = [_pupil_row(truth, found)]
    for number, k in enumerate(np.flatnonzero(truth.glints.light[0] >= 0)):
        light, hider = int(truth.glints.light[0, k]), hidden[number] if number < len(hidden) else ""
        rows.append(_glint_row(truth, found, int(k), light, hider))
    extracted = "extracted" if coarse == 1 else f"extracted, coarse preview ({coarse} x {coarse})"
    names = ("px", "analytic", "in the scene", extracted, "difference")
    head = "".join(f"<th>{name}</th>" for name in names)
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _pupil_row(truth: Observations, found: Observations | None) -> str:
    exact = truth.pupil.centre_px[0] if truth.pupil.ok[0] else None
    seen = found.pupil.centre_px[0] if found is not None and found.pupil.ok[0] else None
    why = found.pupil.reason[0] if found is not None and seen is None else ""
    return _row("pupil", (exact, truth.pupil.reason[0]), "", (seen, why))


def _glint_row(truth: Observations, found: Observations | None, k: int, light: int, hidden: str) -> str:
    exact = truth.glints.xy_px[0, k] if truth.glints.ok[0, k] else None
    seen, why = None, ""
    if found is not None:
        at = np.flatnonzero(found.glints.ok[0] & (found.glints.light[0] == light))
        seen = found.glints.xy_px[0, at[0]] if len(at) else None
        why = "" if len(at) else "not found"
    return _row(f"glint {light}", (exact, truth.glints.reason[0, k]), hidden, (seen, why))


def _row(name: str, exact: tuple[Any, Any], hidden: str, seen: tuple[Any, Any]) -> str:
    """Build a table row: position and reason by ray optics, occluder in the scene, extracted position and reason."""
    (place, _), (found, _) = exact, seen
    apart = f"{np.hypot(*(np.asarray(found) - place)):.2f}" if place is not None and found is not None else ""
    scene = "" if hidden in ("", "visible") else html.escape(hidden)
    return f'<tr><td>{name}</td>{_cell(*exact)}<td class="none">{scene}</td>{_cell(*seen)}<td>{apart}</td></tr>'


def _cell(place: Any, reason: Any) -> str:
    if place is None:
        return f'<td class="none">{html.escape(str(reason or ""))}</td>'
    return f"<td>{place[0]:.2f}, {place[1]:.2f}</td>"
