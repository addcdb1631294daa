"""Compare the two observers: errors of image-derived features against analytic ones, and the gaze of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints, frozen, join_rows
from ..base.errors import InputError
from ..gaze.estimate import GazeEstimator
from ..gaze.regression import Regression
from ..gaze.validation import GazeErrors, leave_one_target_out
from ..rig.rig import RigLike
from ..scene.observation import Observations

SCHEMA = "eyerender/compare/2"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FeatureErrors(ArrayValue):
    """Image-derived minus analytic features, NaN if one of the two is missing."""

    centre_px: Floats  # (n, 2) errors of the pupil's centre
    semi_axes_px: Floats  # (n, 2) errors of the semi-axes
    glint_px: Floats  # (n, m, 2) errors of glints, in the order of the analytic glints
    pupil_expected: Bools  # (n,) whether the analytic observer sees the pupil on the sensor
    pupil_found: Bools  # (n,) whether it was also detected in the image
    glint_expected: Bools  # (n, m) the same for glints
    glint_found: Bools  # (n, m) the same for glints

    def summary(self) -> dict[str, Any]:
        """Return medians, 95th percentiles, maxima and mean vectors in px, and the counts."""
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

    The gaze errors are None if the scene allows none, for the reason `gaze_reason`. With several subjects, each is
    calibrated separately: `subjects` are their numbers, `subject_errors` the errors of each, by observer, and
    `gaze_truth` and `gaze_found` those of all who can be calibrated.

    >>> frames = er.load_scene("guestrin2006").frames()[:18]
    >>> seen = er.trace(frames)
    >>> er.compare(seen, seen, frames.scene.rig, er.gaze.Regression("R3")).gaze_found.mean_deg < 1
    True
    """

    truth: Observations
    found: Observations
    features: FeatureErrors
    estimator: str
    gaze_truth: GazeErrors | None
    gaze_found: GazeErrors | None
    gaze_reason: str | None
    subjects: tuple[int, ...] = ()
    subject_errors: tuple[tuple[GazeErrors | None, GazeErrors | None], ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the JSON of `compare` (schema eyerender/compare/2)."""
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
            "subjects": self._by_subject(),
        }

    def _by_subject(self) -> dict[str, Any] | None:
        """Average the errors of each subject; add median and 95th percentile over them. None for one subject."""
        if len(self.subjects) < 2:
            return None
        found: dict[str, Any] = {"n": len(self.subjects)}
        for k, name in enumerate(("analytic", "image")):
            errors = [pair[k] for pair in self.subject_errors]
            means = [None if one is None else one.mean_deg for one in errors]
            known = [mean for mean in means if mean is not None]
            found[name] = {
                "n": len(known),
                "median_deg": float(np.median(known)) if known else None,
                "p95_deg": float(np.percentile(known, 95)) if known else None,
                "mean_deg": {str(subject): mean for subject, mean in zip(self.subjects, means, strict=True)},
            }
        return found

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
            lines.append(f"gaze error, degrees ({gaze['estimator']}, {gaze['protocol']})")
            lines.append(f"  {'observer':<10} {'mean':>8} {'max':>8} {'n':>5}")
            for key in ("analytic", "image"):
                d = gaze[key]
                if d is None:
                    lines.append(f"  {key:<10} none ({data['gaze_reason']})")
                elif d["n"]:
                    lines.append(f"  {key:<10} {d['mean_deg']:>8.4f} {d['max_deg']:>8.4f} {d['n']:>5}")
                else:
                    lines.append(f"  {key:<10} no frame has an estimate")
        if (people := data["subjects"]) is not None:
            lines.append(
                f"gaze error of {people['n']} subjects, each calibrated alone, degrees   median      p95     n"
            )
            rows = [
                f"  {key:<56} {d['median_deg']:>9.4f} {d['p95_deg']:>8.4f} {d['n']:>5}"
                for key in ("analytic", "image")
                if (d := people[key])["n"]
            ]
            lines += rows or [f"  none ({data['gaze_reason'] or 'no frame has an estimate'})"]
        return "\n".join(lines)


def feature_errors(truth: Observations, found: Observations) -> FeatureErrors:
    """Compute the errors of `found` against `truth`, row by row.

    Raises:
        InputError: the frames and eyes of the two differ.
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
    truth: Observations,
    found: Observations,
    rig: RigLike | Sequence[RigLike],
    estimator: GazeEstimator,
    name: str = "",
    *,
    subjects: Ints | None = None,
) -> Comparison:
    """Compare two observers on the same frames, in features and in gaze.

    >>> frames = er.load_scene("guestrin2006").frames()[:18]
    >>> seen = er.trace(frames)
    >>> er.compare(seen, seen, frames.scene.rig, er.gaze.Regression("R3")).gaze_truth.mean_deg < 1
    True

    Args:
        truth: the reference, such as observations of the analytic observer.
        found: observations of the same frames and eyes, row by row, such as those of the image observer.
        rig: the rig of both, or that of each row. If the rig differs between rows of a subject, gaze is not estimated.
        estimator: gaze estimator for both; every target is estimated by a calibration on the others.
        name: name of the estimator in the result; default: its class, and a regression's function.
        subjects: (n,) subject of each row, if there are several or targets are drawn: each subject is then calibrated
            separately, and each of its targets counts as a fixation.

    Returns:
        The comparison. If gaze cannot be estimated, it contains the reason.

    Raises:
        InputError: the frames and eyes of the two differ.
    """
    if not name:
        name = f"regression {estimator.function}" if isinstance(estimator, Regression) else type(estimator).__name__
    features = feature_errors(truth, found)
    if subjects is None:
        subjects = np.zeros(len(truth), dtype=np.int64)
    else:
        truth, found = _with_fixations(truth), _with_fixations(found)
    people = np.unique(subjects)
    reason = None
    pairs: list[list[GazeErrors | None]] = []
    for person in people:
        own: list[GazeErrors | None] = []
        rows = np.flatnonzero(subjects == person)
        for observations in (truth, found):
            try:
                own.append(leave_one_target_out(estimator, observations.take(rows), _common_rig(rig, rows)))
            except InputError as error:
                own.append(None)
                reason = str(error)
        pairs.append(own)
    gaze = [_joined([own[k] for own in pairs]) for k in range(2)]
    return Comparison(
        truth=truth,
        found=found,
        features=features,
        estimator=name,
        gaze_truth=gaze[0],
        gaze_found=gaze[1],
        gaze_reason=reason,
        subjects=tuple(map(int, people)),
        subject_errors=tuple((own[0], own[1]) for own in pairs),
    )


def _common_rig(rig: RigLike | Sequence[RigLike], rows: Ints) -> RigLike:
    """Return the rig of some rows. Raises InputError if they have different rigs."""
    if not isinstance(rig, Sequence):
        return rig
    first: RigLike = rig[rows[0]]
    if any(rig[row] is not first and rig[row] != first for row in rows):
        raise InputError("the rig differs from image to image, so no calibration is possible")
    return first


def _with_fixations(observations: Observations) -> Observations:
    """Number drawn targets as fixations, so that the cameras of one instant share a fixation."""
    index = observations.index
    _, fixation = np.unique(index.target_mm, axis=0, return_inverse=True)
    return replace(observations, index=replace(index, fixation=fixation.reshape(-1).astype(np.int64)))


def _joined(errors: Sequence[GazeErrors | None]) -> GazeErrors | None:
    """Join the errors of several subjects, skipping those that have none."""
    known = [one for one in errors if one is not None]
    return join_rows(known) if known else None


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
