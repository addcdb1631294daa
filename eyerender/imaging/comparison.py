"""Comparison of the two observers: errors of image-derived features against the analytic ones, and the gaze of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import ArrayValue, Bools, Floats, frozen
from ..errors import InputError
from ..gaze.estimate import GazeEstimator
from ..gaze.regression import Regression
from ..gaze.validation import GazeErrors, leave_one_target_out
from ..observation import Observations
from ..rig.rig import RigLike

SCHEMA = "eyerender/compare/1"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FeatureErrors(ArrayValue):
    """Image-derived minus analytic features, NaN where one of the two has none.

    Attributes:
        centre_px: (n, 2).
        semi_axes_px: (n, 2).
        glint_px: (n, m, 2), in the order of the analytic glints.
        pupil_expected: (n,) whether the analytic observer sees the pupil on the sensor.
        pupil_found: (n,) whether it was also found in the image.
        glint_expected: (n, m) the same for glints.
        glint_found: (n, m).
    """

    centre_px: Floats
    semi_axes_px: Floats
    glint_px: Floats
    pupil_expected: Bools
    pupil_found: Bools
    glint_expected: Bools
    glint_found: Bools

    def summary(self) -> dict[str, Any]:
        """Summarise medians, 95th percentiles, maxima and mean vectors in px, and the counts."""
        return {
            "pupils": {"expected": int(self.pupil_expected.sum()), "found": int(self.pupil_found.sum())},
            "glints": {"expected": int(self.glint_expected.sum()), "found": int(self.glint_found.sum())},
            "pupil_centre_px": _distances(self.centre_px),
            "semi_axes_px": _distances(self.semi_axes_px),
            "glint_px": _distances(self.glint_px.reshape(-1, 2)),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Analytic and image-derived observations of the same frames, with feature errors and gaze errors of both.

    The gaze errors are None where the scene allows none; `gaze_reason` is then the reason.
    """

    truth: Observations
    found: Observations
    features: FeatureErrors
    estimator: str
    gaze_truth: GazeErrors | None
    gaze_found: GazeErrors | None
    gaze_reason: str | None

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the JSON of `compare` (schema eyerender/compare/1)."""
        return {
            "schema": SCHEMA,
            "features": self.features.summary(),
            "gaze": None
            if self.gaze_truth is None and self.gaze_found is None
            else {
                "estimator": self.estimator,
                "protocol": "leave one target out, mean of both eyes, angle at their mid-point",
                "analytic": _gaze_summary(self.gaze_truth),
                "image": _gaze_summary(self.gaze_found),
            },
            "gaze_reason": self.gaze_reason,
        }

    def to_text(self) -> str:
        """Format the comparison as a few lines of text."""
        data = self.to_mapping()
        f, gaze = data["features"], data["gaze"]
        lines = [
            f"pupils found   {f['pupils']['found']} of {f['pupils']['expected']}",
            f"glints found   {f['glints']['found']} of {f['glints']['expected']}",
        ]
        kinds = (("pupil_centre_px", "pupil centre"), ("semi_axes_px", "semi-axes"), ("glint_px", "glint"))
        rows = [
            f"  {name:<56} {d['median']:>9.4f} {d['p95']:>8.4f} {d['max']:>8.4f}"
            for key, name in kinds
            if (d := f[key])["n"]
        ]
        if rows:
            lines += ["error of the image observer against the analytic one, px     median      p95      max", *rows]
        else:
            lines.append("no pupil and no glint was found in the images, so there is nothing to compare")
        if gaze is None:
            lines.append(f"gaze: none ({data['gaze_reason']})")
        else:
            lines.append(f"gaze error, degrees ({gaze['estimator']}, {gaze['protocol']})     mean      max     n")
            for key in ("analytic", "image"):
                d = gaze[key]
                if d is None:
                    lines.append(f"  {key:<10} none ({data['gaze_reason']})")
                elif d["n"]:
                    lines.append(f"  {key:<10} {d['mean_deg']:>8.4f} {d['max_deg']:>8.4f} {d['n']:>5}")
                else:
                    lines.append(f"  {key:<10} no frame has an estimate")
        return "\n".join(lines)


def feature_errors(truth: Observations, found: Observations) -> FeatureErrors:
    """Compute the errors of `found` against `truth`, row by row.

    Raises:
        InputError: the two are not of the same frames and eyes.
    """
    same = len(truth) == len(found) and np.array_equal(truth.index.frame, found.index.frame)
    if not same or not np.array_equal(truth.index.eye, found.index.eye):
        raise InputError("the two sets of observations have different frames or eyes")
    pupil_expected = truth.pupil.ok & truth.pupil.in_image
    both = pupil_expected & found.pupil.ok
    m = truth.glints.light.shape[1]
    glint = np.full((len(truth), m, 2), np.nan)
    expected = truth.glints.ok & truth.glints.in_image
    for light in np.unique(truth.glints.light[truth.glints.light >= 0]):
        place, seen = found.glints.of_light(int(light))
        rows, columns = np.nonzero((truth.glints.light == light) & expected)
        glint[rows, columns] = np.where(seen[rows, None], place[rows], np.nan) - truth.glints.xy_px[rows, columns]
    return FeatureErrors(
        centre_px=frozen(np.where(both[:, None], found.pupil.centre_px - truth.pupil.centre_px, np.nan)),
        semi_axes_px=frozen(np.where(both[:, None], found.pupil.semi_axes_px - truth.pupil.semi_axes_px, np.nan)),
        glint_px=frozen(glint),
        pupil_expected=frozen(pupil_expected, bool),
        pupil_found=frozen(both, bool),
        glint_expected=frozen(expected, bool),
        glint_found=frozen(np.isfinite(glint).all(axis=-1), bool),
    )


def compare(
    truth: Observations, found: Observations, rig: RigLike, estimator: GazeEstimator, name: str = ""
) -> Comparison:
    """Compare two observers' reports of the same frames, in features and in gaze.

    Args:
        truth: the reference, such as the analytic observer's report.
        found: report of the same frames and eyes, row by row, such as that of the image observer.
        rig: the rig of both.
        estimator: gaze estimator for both; every target is estimated by a calibration on the others.
        name: name of the estimator in the result; default: its class, and a regression's function.

    Returns:
        The comparison. Where gaze cannot be estimated it contains the reason.

    Raises:
        InputError: the two are not of the same frames and eyes.
    """
    if not name:
        name = f"regression {estimator.function}" if isinstance(estimator, Regression) else type(estimator).__name__
    gaze: list[GazeErrors | None] = []
    reason = None
    for observations in (truth, found):
        try:
            gaze.append(leave_one_target_out(estimator, observations, rig))
        except InputError as error:
            gaze.append(None)
            reason = str(error)
    return Comparison(
        truth=truth,
        found=found,
        features=feature_errors(truth, found),
        estimator=name,
        gaze_truth=gaze[0],
        gaze_found=gaze[1],
        gaze_reason=reason,
    )


def _distances(errors: Floats) -> dict[str, Any]:
    good = errors[np.isfinite(errors).all(axis=-1)]
    if not len(good):
        return {"n": 0, "median": None, "p95": None, "max": None, "mean_vector": None}
    size = np.linalg.norm(good, axis=-1)
    return {
        "n": len(good),
        "median": float(np.median(size)),
        "p95": float(np.percentile(size, 95)),
        "max": float(size.max()),
        "mean_vector": good.mean(axis=0).tolist(),
    }


def _gaze_summary(errors: GazeErrors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {
        "n": int(errors.ok.sum()),
        "missing": int((~errors.ok).sum()),
        "mean_deg": errors.mean_deg,
        "max_deg": errors.max_deg,
    }
