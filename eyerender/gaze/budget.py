"""The error budget of gaze: the error added by eye model, features, image, noise and estimator, one by one.

A chain of observations of the same frames, each with one cause of error more than the one before, gives a chain of gaze
estimates. With e the error of an estimate as a vector (horizontal, vertical) in degrees, a cause moves gaze by

    d_is = e_after(i, s) - e_before(i)          frame i, noise seed s,

and these displacements add up to the whole error in every frame. Their mean square has three parts:

    rms^2 = shift^2 + pattern^2 + scatter^2
    shift     the mean of all d of an eye: common to all its frames (rms over the eyes)
    pattern   what differs between frames and repeats with every seed
    scatter   what differs between seeds (unbiased: over seeds - 1)

Noise alone has neither shift nor pattern, yet means over few seeds are not 0. With r independent repetitions x_s of a
vector of mean m and covariance V, the squares are therefore estimated without bias,

    U = |mean x|^2 - tr V / r,      var U = 4 m^T V m / r + 2 tr V^2 / (r (r - 1))                                  (9)

(Bai and Saranadasa 1996, Statistica Sinica 6, 311-329; tr V^2 by their estimate), and U +- t sd(U) gives the 95 %
interval. The vector of the shift is the mean over an eye's frames, that of the pattern all frames less this mean, so
frames of one seed may depend on each other, as they do by a noisy calibration. A step that was observed once has no
seeds: its intervals are those over frames, and its pattern includes any noise.

Squares of causes add up to the square of the total only if the causes are uncorrelated. `net_deg` is the change of the
mean |error|. It is nearly zero where a displacement is perpendicular to the existing error, and may be negative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from ..base.arrays import Bools, Floats, Ints
from ..base.errors import InputError
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import EYES, Observations
from .estimate import GazeEstimator, GazePoints, RayEstimator, angular_error_deg, binocular_average

ESTIMATOR = "estimator"
BUDGET_SCHEMA = "eyerender/gaze-budget/1"
_BOTH = 2
_EYES = {-1: "unknown", **dict(enumerate(EYES)), _BOTH: "both"}
Steps = Mapping[str, Observations | Sequence[Observations]]
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """Gaze error added by one cause, in degrees.

    Attributes:
        name: name of the cause.
        frames: number of frames with an estimate before and after (each eye counts, unless both are averaged).
        seeds: number of repetitions with other noise, 1 where nothing is random.
        rms_deg: rms angle between the paired estimates.
        shift_deg: the part common to all frames of an eye; rms over the eyes.
        shift_by_eye_deg: the mean displacement of each eye ("right", "left", "both"), to the subject's right and up.
        pattern_deg: the part that differs between frames, but not between seeds.
        scatter_deg: the part that differs between seeds; 0 for one seed.
        net_deg: change of the mean error.
        rms_interval_deg: 95 % interval over seeds, or over frames for one seed; None for fewer than two frames.
        shift_interval_deg: the same of the shift; it begins at 0 where noise may be all.
        pattern_interval_deg: the same of the pattern.
        scatter_interval_deg: the same of the scatter; None for one seed.
        net_low_deg: lower end of its 95 % interval (Student's t over the frames); None for fewer than two.
        net_high_deg: upper end.
    """

    name: str
    frames: int
    seeds: int
    rms_deg: float
    shift_deg: float
    shift_by_eye_deg: dict[str, tuple[float, float]]
    pattern_deg: float
    scatter_deg: float
    net_deg: float
    rms_interval_deg: Interval | None
    shift_interval_deg: Interval | None
    pattern_interval_deg: Interval | None
    scatter_interval_deg: Interval | None
    net_low_deg: float | None
    net_high_deg: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorBudget:
    """The error of gaze, cause by cause.

    Attributes:
        causes: with the estimator calibrated on the features of each step. The first is the estimator's own error.
        transferred: the same causes with the estimator calibrated once, on the features of `calibrated_on`, and tested
            on those of the later steps.
        calibrated_on: step whose features calibrate the estimator for `transferred`; None where there is no later step.
        total_deg: rms error of the last step, calibrated on its own features.
        mean_deg: its mean error.
        transferred_total_deg: rms error of the last step, calibrated on `calibrated_on`; None without later steps.
        transferred_mean_deg: its mean error.
        frames: frames used: those with an estimate in every step and for every seed.
        frames_missing: frames left out.
    """

    causes: tuple[Cause, ...]
    transferred: tuple[Cause, ...]
    calibrated_on: str | None
    total_deg: float
    mean_deg: float
    transferred_total_deg: float | None
    transferred_mean_deg: float | None
    frames: int
    frames_missing: int

    def cause(self, name: str, *, transferred: bool = False) -> Cause:
        """Return a cause by its name; InputError if there is no such cause."""
        for cause in self.transferred if transferred else self.causes:
            if cause.name == name:
                return cause
        raise InputError(f"has no cause {name!r}", path="causes")

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON (schema eyerender/gaze-budget/1)."""
        return {"schema": BUDGET_SCHEMA, **asdict(self)}

    def __str__(self) -> str:
        """Format both tables as text, in degrees."""
        lines = _table("calibrated anew on each step's features", self.causes, self.total_deg, self.mean_deg)
        if self.transferred and self.transferred_total_deg is not None and self.transferred_mean_deg is not None:
            title = f"calibrated on the features of '{self.calibrated_on}', tested on the images"
            lines += ["", *_table(title, self.transferred, self.transferred_total_deg, self.transferred_mean_deg)]
        missing = f", {self.frames_missing} left out" if self.frames_missing else ""
        return "\n".join([*lines, f"{self.frames} frames{missing}"])


def budget(
    steps: Steps,
    rig: RigLike,
    estimator: GazeEstimator,
    *,
    calibration: Sequence[int] | None = None,
    transfer_from: str | None = None,
    binocular: bool = False,
) -> ErrorBudget:
    """Split the gaze error by cause.

    >>> scene = er.load_scene("guestrin2006")
    >>> steps = er.budget_steps(scene.frames()[:18], images=False)
    >>> len(er.gaze.budget(steps, scene.rig, er.gaze.Regression("R3")).causes)
    3

    Args:
        steps: cause -> observations of the same frames with this cause and all earlier ones, or several observations
            that differ by random noise alone. The first step's name is that of its features; its cause is the
            estimator. See `er.budget_steps` for the steps of a scene.
        rig: their rig.
        estimator: a gaze estimator, not calibrated.
        calibration: fixations to calibrate on, counted from 0; the remaining ones are tested. None: each fixation is
            tested with a calibration on all others.
        transfer_from: step whose features calibrate the estimator for the second reading. None: the last step before
            the first one of images, which is the last whose name is not among `er.gaze.IMAGE_CAUSES`.
        binocular: use the mean of both eyes' estimates of a frame. It hides horizontal errors of eyes that are mirror
            images of each other, because they cancel.

    Raises:
        InputError: the steps do not show the same frames and targets, or a calibration is impossible.
    """
    built = rig.build()
    chain = [(name, [found] if isinstance(found, Observations) else list(found)) for name, found in steps.items()]
    _check(chain)
    task = _Task(built, estimator, calibration, binocular)
    anew = [np.stack([task.errors(task.fits(one), one) for one in found]) for _, found in chain]
    names = [name for name, _ in chain]
    exact = (k for k, name in enumerate(names) if name not in IMAGE_CAUSES)
    base = max(exact, default=0) if transfer_from is None else names.index(transfer_from)
    fits = task.fits(chain[base][1][0])
    kept = [np.stack([task.errors(fits, one) for one in found]) for _, found in chain[base:]]
    usable: Bools = np.all([np.isfinite(e).all(axis=(0, 2)) for e in (*anew, *kept)], axis=0)
    tested = task.tested(chain[0][1][0])
    if usable.sum() < 2:
        raise InputError("fewer than two frames have an estimate in every step")
    anew, kept = ([e[:, usable] for e in part] for part in (anew, kept))
    eye = task.eyes(chain[0][1][0])[usable]
    causes = [_cause(ESTIMATOR, np.zeros_like(anew[0][:1]), anew[0], eye)]
    causes += [_cause(name, a, b, eye) for name, a, b in zip(names[1:], anew, anew[1:], strict=False)]
    moved = [_cause(name, a, b, eye) for name, a, b in zip(names[base + 1 :], kept, kept[1:], strict=False)]
    return ErrorBudget(
        causes=tuple(causes),
        transferred=tuple(moved),
        calibrated_on=names[base] if moved else None,
        total_deg=_rms(anew[-1]),
        mean_deg=float(_size(anew[-1]).mean()),
        transferred_total_deg=_rms(kept[-1]) if moved else None,
        transferred_mean_deg=float(_size(kept[-1]).mean()) if moved else None,
        frames=int(usable.sum()),
        frames_missing=int((tested & ~usable).sum()),
    )


IMAGE_CAUSES = ("extraction", "image formation", "image", "noise")
"""Names of steps whose features come from images."""


def error_vectors_deg(direction: Floats, wanted: Floats) -> Floats:
    """Compute error vectors (n, 2), to the subject's right and up in degrees, from directions (n, 3) and true ones.

    The length is the angle between the two; the direction is that of the great circle from `wanted`.
    """
    wanted = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
    right = np.cross(wanted, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, wanted)
    flat = np.stack([np.sum(direction * right, axis=1), np.sum(direction * up, axis=1)], axis=1)
    angle = angular_error_deg(direction, wanted, np.zeros(3))[:, None]
    across = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.asarray(np.where(across > 0, flat / np.where(across > 0, across, 1.0), 0.0) * angle)


def mean_interval(values: Floats) -> tuple[float, float, float]:
    """Compute the mean of values (n,), n >= 2, such as paired differences, and its 95 % confidence interval."""
    n, mean = len(values), float(values.mean())
    half = float(student.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n))
    return mean, mean - half, mean + half


@dataclass(frozen=True, slots=True, kw_only=True)
class Displacement:
    """The parts of a displacement of gaze: squares (deg^2) with their 95 % intervals, and the mean (2,) of each eye."""

    rms: tuple[float, Interval | None]
    shift: tuple[float, Interval | None]
    pattern: tuple[float, Interval | None]
    scatter: tuple[float, Interval | None]
    by_eye: dict[int, Floats]


def displacement(before: Floats, after: Floats, eye: Ints) -> Displacement:
    """Split gaze displacements into shift, pattern and scatter, equation (9).

    `before` and `after` are error vectors (s, n, 2) of n frames in degrees, with s seeds; s may be 1 for `before`.
    """
    moved = after - before
    seeds, frames = moved.shape[:2]
    by_eye = {int(k): np.asarray(moved[:, eye == k].mean(axis=(0, 1))) for k in np.unique(eye)}
    if seeds == 1:
        return _of_frames(moved[0], eye, by_eye)
    each = np.stack([moved[:, eye == k].mean(axis=1) for k in by_eye], axis=1)  # (seeds, eyes, 2)
    share = np.array([np.mean(eye == k) for k in by_eye])
    rest = moved - each[:, np.searchsorted(list(by_eye), eye)]
    size = np.sum(moved**2, axis=2).mean(axis=1)
    everything = moved.reshape(seeds, -1) / np.sqrt(frames)
    total, second = _traces(everything)
    return Displacement(
        rms=(float(size.mean()), mean_interval(size)[1:]),
        shift=_squared_mean([(each * np.sqrt(share)[:, None]).reshape(seeds, -1)]),
        pattern=_squared_mean([rest.reshape(seeds, -1) / np.sqrt(frames)]),
        scatter=(total, _variance_interval(total, (seeds - 1) * total**2 / second if second > 0 else 1.0)),
        by_eye=by_eye,
    )


def _of_frames(moved: Floats, eye: Ints, by_eye: dict[int, Floats]) -> Displacement:
    """Split displacements (n, 2) that were observed once; their intervals are those of a sample of frames."""
    eyes = [moved[eye == k] for k in by_eye]
    size = np.sum(moved**2, axis=1)
    shift = float(sum(len(one) * v @ v for one, v in zip(eyes, by_eye.values(), strict=True)) / len(moved))
    pattern = max(float(size.mean()) - shift, 0.0)
    enough = min(map(len, eyes)) > 1
    rest = np.concatenate([one - one.mean(axis=0) for one in eyes])
    second = float(np.sum((rest.T @ rest / len(rest)) ** 2))
    degrees = (len(moved) - len(eyes)) * (pattern**2 / second if second > 0 else 1.0)
    scaled = [one * np.sqrt(len(one) / len(moved)) for one in eyes]
    return Displacement(
        rms=(float(size.mean()), mean_interval(size)[1:] if len(size) > 1 else None),
        shift=(shift, _squared_mean(scaled)[1] if enough else None),
        pattern=(pattern, _variance_interval(pattern, degrees) if enough else None),
        scatter=(0.0, None),
        by_eye=by_eye,
    )


def _traces(x: Floats) -> tuple[float, float]:
    """Estimate tr V and tr V^2 without bias from r >= 2 repetitions (r, k) of a vector with covariance V."""
    count, away = len(x), x - x.mean(axis=0)
    products = away @ away.T / (count - 1)
    total, square = float(np.trace(products)), float(np.sum(products**2))
    if count == 2:
        return total, square
    scale = (count - 1) ** 2 / ((count - 2) * (count + 1))
    return total, max(scale * (square - total**2 / (count - 1)), 0.0)


def _squared_mean(groups: Sequence[Floats]) -> tuple[float, Interval]:
    """Estimate the sum of |mean|^2 of independent groups of repetitions (r, k), equation (9), with its interval."""
    square, variance = 0.0, 0.0
    for x in groups:
        count, mean = len(x), x.mean(axis=0)
        total, second = _traces(x)
        along = max(float(np.sum(((x - mean) @ mean) ** 2)) / (count - 1) - second / count, 0.0)
        square += float(mean @ mean) - total / count
        variance += 4.0 * along / count + 2.0 * second / (count * (count - 1))
    half = float(student.ppf(0.975, min(map(len, groups)) - 1)) * np.sqrt(variance)
    return square, (square - half, square + half)


def _variance_interval(variance: float, degrees: float) -> Interval:
    """Compute the interval of a variance with (Satterthwaite's) degrees of freedom."""
    low, high = (variance * degrees / float(chi2.ppf(q, degrees)) for q in (0.975, 0.025))
    return low, high


@dataclass(frozen=True, slots=True)
class _Task:
    """Calibration of an estimator and error vectors of its estimates, per row or per frame."""

    rig: RigGeometry
    estimator: GazeEstimator
    calibration: Sequence[int] | None
    binocular: bool

    def fits(self, learnt: Observations) -> list[tuple[Bools, GazeEstimator]]:
        """Calibrate on observations; return each calibration with the rows to test it on."""
        fixation = learnt.index.fixation
        if self.calibration is not None:
            tests = [~np.isin(fixation, self.calibration)]
        else:
            tests = [fixation == k for k in np.unique(fixation)]
        return [(np.asarray(test), self.estimator.fit(learnt.take(~test), self.rig)) for test in tests]

    def errors(self, fits: Sequence[tuple[Bools, GazeEstimator]], seen: Observations) -> Floats:
        """Compute error vectors (n, 2) of observations; NaN where there is no estimate."""
        out = np.full((len(seen), 2), np.nan)
        for test, fitted in fits:
            out[test] = self._predicted(fitted, seen.take(test))
        return self._of_frames(seen, out) if self.binocular else out

    def tested(self, seen: Observations) -> Bools:
        """Return whether each row (or frame) is tested."""
        rows = ~np.isin(seen.index.fixation, [] if self.calibration is None else self.calibration)
        if self.binocular:
            _, first = np.unique(seen.index.moment, return_index=True)
            rows = rows[first]
        return np.asarray(rows)

    def eyes(self, seen: Observations) -> Ints:
        """Return the eye of each row, or `_BOTH` for each frame."""
        if self.binocular:
            return np.full(len(np.unique(seen.index.moment)), _BOTH)
        return np.asarray(seen.index.eye)

    def _predicted(self, fitted: GazeEstimator, seen: Observations) -> Floats:
        index = seen.index
        if self.rig.screen is None and isinstance(fitted, RayEstimator):
            rays = fitted.predict_rays(seen, self.rig)
            return error_vectors_deg(rays.direction, index.target_mm - rays.origin_mm)
        gaze: GazePoints = fitted.predict(seen, self.rig)
        eye = index.eye_position_mm + index.head_mm
        return error_vectors_deg(gaze.point_mm - eye, index.target_mm - eye)

    @staticmethod
    def _of_frames(seen: Observations, errors: Floats) -> Floats:
        """Average both eyes' error vectors of each frame, as points on a screen."""
        points = GazePoints.of(np.concatenate([errors, np.where(np.isnan(errors[:, :1]), np.nan, 0.0)], axis=1))
        return np.asarray(binocular_average(seen, points)[1].point_mm[:, :2])


def _check(chain: Sequence[tuple[str, list[Observations]]]) -> None:
    if not chain or any(not found for _, found in chain):
        raise InputError("needs observations for every step")
    first = chain[0][1][0].index
    if not np.isfinite(first.target_mm).all():
        raise InputError("there are no targets to compare the gaze with; use a scene with targets")
    for name, found in chain:
        for one in found:
            same = len(one) == len(first) and all(
                np.array_equal(getattr(one.index, key), getattr(first, key), equal_nan=True)
                for key in ("frame", "fixation", "eye", "target_mm")
            )
            if not same:
                raise InputError("its observations are not of the frames of the first step", path=name)


def _cause(name: str, before: Floats, after: Floats, eye: Ints) -> Cause:
    # The mean over the seeds of a noisy step is what the next one is compared with.
    paired = before if len(before) in (1, len(after)) else before.mean(axis=0, keepdims=True)
    parts = displacement(paired, after, eye)
    net = (_size(after).mean(axis=0) - _size(before).mean(axis=0)).ravel()
    mean, low, high = mean_interval(net)
    squares: dict[str, Any] = {name: getattr(parts, name) for name in ("rms", "shift", "pattern", "scatter")}
    figures: dict[str, Any] = {f"{part}_deg": root(square) for part, (square, _) in squares.items()}
    for part, (_, ends) in squares.items():
        figures[f"{part}_interval_deg"] = None if ends is None else (root(ends[0]), root(ends[1]))
    return Cause(
        name=name,
        frames=len(net),
        seeds=len(after),
        shift_by_eye_deg={_EYES[k]: (float(v[0]), float(v[1])) for k, v in parts.by_eye.items()},
        net_deg=mean,
        net_low_deg=low,
        net_high_deg=high,
        **figures,
    )


def root(square: float) -> float:
    """Return the root of a square, 0 if its estimate is negative."""
    return float(np.sqrt(max(square, 0.0)))


def _size(errors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(errors, axis=-1))


def _rms(errors: Floats) -> float:
    return float(np.sqrt(np.mean(_size(errors) ** 2)))


def _table(title: str, causes: Sequence[Cause], total: float, mean: float) -> list[str]:
    width = max(len("95 %"), *(len(c.name) for c in causes))
    parts = ("rms", "shift", "pattern", "scatter")
    heads = "".join(f"{name + ' deg':>19}" for name in (*parts, "net"))
    lines = [title, f"{'cause':<{width}}{heads}"]
    for c in causes:
        values = [getattr(c, f"{part}_deg") for part in parts]
        ends = [getattr(c, f"{part}_interval_deg") for part in parts]
        lines.append(f"{c.name:<{width}}" + "".join(f"{v:>19.4f}" for v in values) + f"{c.net_deg:>+19.4f}")
        cells = ["" if e is None else f"{e[0]:.4f} to {e[1]:.4f}" for e in ends]
        cells.append("" if c.net_low_deg is None else f"{c.net_low_deg:+.4f} to {c.net_high_deg:+.4f}")
        lines.append(f"{'95 %':<{width}}" + "".join(f"{cell:>19}" for cell in cells))
    return [*lines, f"{'total':<{width}}{total:>19.4f}   mean error {mean:.4f} deg"]
