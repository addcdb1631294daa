"""Numbers and reasons on the page: the feature table and the gaze error."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.errors import InputError
from ...gaze.estimate import angular_error_deg
from ...gaze.regression import Regression, highest_determined, pupil_glint_vectors
from ...scene.observation import EYES, Observations
from .setup import Setup


def calibrated(setup: Setup) -> Regression | None:
    """Calibrate a regression on the scene's targets and current rig, with exact features of the selected eye.

    It uses the vector from the first light's glint, in px, and the function with the most terms that the targets
    determine. None without a screen, without targets, or if the features are visible for too few of them.
    """
    scene = setup.with_all_targets()
    if scene is None or scene.rig.screen is None:
        return None
    frames = scene.frames()
    index = frames.index
    shown = (index.camera == setup.camera) & (index.eye == EYES.index(setup.eye))
    seen = trace(frames.take(np.flatnonzero(shown)))
    vectors, reasons = pupil_glint_vectors(seen, normalised=False, rig=scene.rig)
    function = highest_determined(vectors[[reason is None for reason in reasons]])
    if function is None:
        return None
    try:
        return Regression(function, normalised=False).fit(seen, scene.rig)
    except InputError:
        return None


def gaze_line(setup: Setup, estimator: Regression | None, truth: Observations, found: Observations | None) -> str:
    """Describe the gaze error at the current target for both observers, with a regression calibrated on this rig."""
    if estimator is None:
        return "Gaze error: this scene has no screen with targets that determine a regression."
    if not np.isfinite(truth.index.target_mm).all():
        return "Gaze error: let the eye follow a target to see it."
    parts = []
    for name, features in (("exact features", truth), ("this picture", found)):
        if features is not None:
            point = estimator.predict(features, setup.scene.rig).point_mm
            error = float(angular_error_deg(point, truth.index.target_mm, setup.apex_mm)[0])
            parts.append(f"{name} {error:.2f}°" if np.isfinite(error) else f"{name}: none")
    return f"Gaze error of {estimator.function}, calibrated on this rig with exact features: {', '.join(parts)}"


def feature_table(truth: Observations, found: Observations | None, hidden: tuple[str, ...]) -> str:
    """Build an HTML table of one row's pupil and glints: by ray optics, in the rendered scene, and extracted.

    Args:
        truth: observation of the analytic observer, one row.
        found: observation of the image observer, one row; None if not requested.
        hidden: what hides the glint of each light of this eye in the scene ("" or "visible" if nothing does).
    """
    rows = [_pupil_row(truth, found)]
    for number, k in enumerate(np.flatnonzero(truth.glints.light[0] >= 0)):
        light, hider = int(truth.glints.light[0, k]), hidden[number] if number < len(hidden) else ""
        rows.append(_glint_row(truth, found, int(k), light, hider))
    names = ("px", "analytic", "in the scene", "extracted", "difference")
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
