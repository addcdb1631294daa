"""Fit eyes to features: Gauss-Newton through the analytic observer, maximum likelihood for Gaussian noise.

    minimise  sum_b w_b |W_b (y_b - h_b(theta))|^2 + |(theta - theta_0) / sigma|^2                                  (4)

over the unknowns of all frames and of the person. The blocks b are whole outlines, single glints, and the angles
between line of sight and known targets; W_b whitens them. Let t be the rms of a block's whitened residuals, divided by
the median of its kind if that is above 1. The weights w_b are 1 for t <= 3, and above that 3 / t (Huber) or (18 / (9 +
t^2))^2 (Geman and McClure with a flat core). While all blocks of an instant are far off, t is taken relative to their
median, by a factor of at most 1000 in the first step and half as much in each following one. Steps are damped by
Levenberg's rule. The normal equations are arrow-shaped: frames are coupled only through the person's unknowns.

Each instant starts from the best of a grid of directions. Those that remain worse than most are started again from
other directions, before the person is fitted and afterwards. If chi^2 exceeds its degrees of freedom, the noise was
larger than stated: covariances are those of noise that is larger by the square root of their ratio (Birge 1932).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Ints, finite_or_none
from ..base.errors import FitWarning, InputError
from ..eye.catalogue import load_eye
from ..eye.spec import EyeSpec
from ..rig.rig import RigGeometry, RigLike
from ..scene.observation import EYES, Observations
from .eyefile import changed_file
from .features import MeasuredFeatures, Residuals, measured, residuals, sized
from .information import EyeInformation, eye_information, roots_of
from .noise import FeatureNoise
from .unknowns import ANGLES, AZIMUTH, COUNT, ELEVATION, KAPPA, LOCAL, NAMES, PERSON, PUPIL, SLIPPAGE, UNITS, Unknowns
from .varied import (
    Views,
    diameters_mm,
    gaze_slopes,
    images_of,
    lines_of_sight,
    slopes_of,
    stacked_eyes,
    target_misses,
    target_slopes,
)

Robust = Literal["geman-mcclure", "huber", "none"]
CORE = 3.0
"""Rms of a block's whitened residuals up to which the block has full weight."""
LEARNED = 0.9
"""A parameter whose deviation is not below this share of its prior's was not learned."""
_STEPS, _SETTLED = 40, 1e-10
_POINTS = 30
_START_AZIMUTH, _START_ELEVATION = np.radians(np.linspace(-36, 36, 9)), np.radians(np.linspace(-24, 24, 7))
_FAR_PX, _SHIFT_SHARE = 60.0, 0.1
_STARTS, _START_STEPS, _APART_RAD, _WORSE = 3, 12, np.radians(15.0), 3.0
MOST_CHI2, MOST_DEVIATIONS = 2.0, 5.0
"""Largest chi^2 per degree of freedom without a warning, and distance from a prior's mean without a refusal."""
_PUPIL_MM = (0.5, 9.5)
_FIRST_SCALE = 1000.0
_MOST_RAD, _MOST_STEP, _STUCK, _RELATIVE, _TINY = 0.25, 2.0, 1e12, 1e-10, 1e-16
DEFAULT_OUTLINE_PX, DEFAULT_GLINT_PX = 0.1, 0.05


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Problem:
    """A fit to solve: the views of one eye with their features."""

    views: Views  # n views
    seen: MeasuredFeatures  # features of the views
    instant: Ints  # (n,) instant of each view
    instants: Views  # one view for each of i instants
    target_mm: Floats  # (i, 3) known targets; NaN where there is none
    fixation_rad: float  # noise of fixation per axis
    centre: Floats  # (i, 35) means of the priors
    precision: Floats  # (35,) inverse variances of the priors
    free: Bools  # (35,) which unknowns are fitted
    robust: Robust  # the weights

    @property
    def shared(self) -> bool:
        """Whether any unknown of the person is fitted."""
        return bool(self.free[LOCAL:].any())

    def take(self, instants: Ints) -> Problem:
        """Select instants."""
        place = np.full(len(self.centre), -1)
        place[instants] = np.arange(len(instants))
        rows = np.flatnonzero(place[self.instant] >= 0)
        return replace(
            self,
            views=self.views.take(rows),
            seen=self.seen.take(rows),
            instant=place[self.instant[rows]],
            instants=self.instants.take(instants),
            target_mm=self.target_mm[instants],
            centre=self.centre[instants],
        )

    @property
    def has_target(self) -> Bools:
        """Whether each instant has a known target, (i,)."""
        return np.asarray(np.isfinite(self.target_mm).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EyeFit(ArrayValue):
    """Result of the fit of one eye.

    Attributes:
        eye: right or left.
        rows: (n,) rows of the observations.
        instant: (n,) instant of each row.
        theta: (i, 35) unknowns of each instant (`design.unknowns`), rad and mm; those of the frame are NaN where its
            slippage is more than 5 standard deviations of the prior, which no eye explains.
        origin_mm: (i, 3) where the line of sight leaves the cornea.
        direction: (i, 3) unit direction of the line of sight.
        known: covariances, and combinations that are not determined.
        chi2: (i,) squared whitened residuals with the weights of each instant, priors included.
        dof: degrees of freedom of the sum of `chi2`.
        outline_weight: (n,) robust weight of each outline; NaN without one.
        glint_weight: (n, m) robust weight of each glint.
        converged: (i,) whether the steps settled.
        prior: the eye at the start of the fit.
        unknowns: the priors of the unknowns.
        targets: number of frames with a known target.
    """

    eye: str
    rows: Ints
    instant: Ints
    theta: Floats
    origin_mm: Floats
    direction: Floats
    known: EyeInformation
    chi2: Floats
    dof: int
    outline_weight: Floats
    glint_weight: Floats
    converged: Bools
    prior: EyeSpec
    unknowns: Unknowns
    targets: int

    @property
    def spec(self) -> EyeSpec:
        """Convert the fitted eye to an eye file.

        Raises:
            InputError: the eye is physically impossible, for instance with a pupil in front of the cornea.
        """
        return changed_file(self.prior.of_side("left" if self.eye == "left" else "right"), self.theta[0])

    @property
    def chi2_per_degree(self) -> float:
        """Compute chi^2 per degree of freedom; about 1 if the features are as good as stated and the model holds."""
        return float(self.chi2.sum() / max(self.dof, 1))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Say in words why the fit may be wrong; empty if nothing suggests it."""
        lost, slow = int(np.isnan(self.theta[:, 0]).sum()), int((~self.converged).sum())
        out = []
        if self.chi2_per_degree > MOST_CHI2:
            out.append(
                f"chi^2 is {self.chi2_per_degree:.3g} per degree of freedom: the features are worse than stated, or "
                "the eye differs from the model"
            )
        if slow:
            out.append(f"{slow} of {len(self.converged)} frames did not converge")
        if lost:
            out.append(
                f"{lost} of {len(self.converged)} frames need an eye further from its place than the prior allows"
            )
        kappa = self.known.person_deviation[KAPPA.start - LOCAL : KAPPA.stop - LOCAL]
        if self.targets and (kappa > LEARNED * self.unknowns.deviations()[KAPPA]).any():
            out.append("the targets do not determine kappa, the angle between line of sight and optic axis")
        if self.known.unseen:
            out.append(f"the features do not determine {', '.join(self.known.unseen)}")
        return tuple(out)

    def to_mapping(self) -> dict[str, Any]:
        """Convert to JSON values; angles in degrees.

        A parameter of the person is learned if its standard deviation is below 0.9 of its prior's.
        """
        degrees = np.where(ANGLES, np.degrees(1.0), 1.0)
        shared, spread = self.theta[0, LOCAL:] * degrees[LOCAL:], self.known.person_deviation * degrees[LOCAL:]
        prior = self.unknowns.deviations()[LOCAL:] * degrees[LOCAL:]
        return {
            "eye": self.eye,
            "chi2": float(self.chi2.sum()),
            "degrees_of_freedom": self.dof,
            "converged": bool(self.converged.all()),
            "warnings": list(self.doubts),
            "not_seen": list(self.known.unseen),
            "person": {
                name: {
                    "unit": unit,
                    "change": float(value),
                    "deviation": finite_or_none(sd),
                    "prior_deviation": finite_or_none(before),
                    "learned": bool(np.isfinite(sd) and sd < LEARNED * before),
                }
                for name, unit, value, sd, before in zip(PERSON, UNITS[LOCAL:], shared, spread, prior, strict=True)
            },
            "frames": [
                {
                    "rows": self.rows[self.instant == k].tolist(),
                    "converged": bool(self.converged[k]),
                    "azimuth_deg": finite_or_none(np.degrees(self.theta[k, AZIMUTH])),
                    "elevation_deg": finite_or_none(np.degrees(self.theta[k, ELEVATION])),
                    "pupil_mm": finite_or_none(self.theta[k, PUPIL]),
                    "slippage_mm": [finite_or_none(v) for v in self.theta[k, 3:6]],
                    "origin_mm": [finite_or_none(v) for v in self.origin_mm[k]],
                    "direction": [finite_or_none(v) for v in self.direction[k]],
                    "gaze_deviation_deg": finite_or_none(self.known.gaze_deg[k]),
                    "chi2": float(self.chi2[k]),
                }
                for k in range(len(self.theta))
            ],
        }


_FARTHEST_PX = 1e6  # the largest sensor has 65,536 columns


def fit_eye(
    observations: Observations,
    rig: RigLike,
    unknowns: Unknowns | None = None,
    *,
    prior: EyeSpec | str = "adult",
    noise: FeatureNoise | None = None,
    targets: bool = True,
    robust: Robust = "geman-mcclure",
    start: Floats | None = None,
) -> tuple[EyeFit, ...]:
    """Fit the gaze of every frame, and the eye, to features; one fit for each observed eye.

    >>> scene = er.load_scene("guestrin2006")
    >>> right, left = er.fit_eye(er.trace(scene.frames()[:18]), scene.rig)
    >>> right.eye, right.doubts
    ('right', ())

    Args:
        observations: observations of any observer, or of a table, each with the approximate position of its eye.
        rig: the rig that observed them.
        unknowns: the fitted unknowns and their priors; default: `Unknowns.population()`.
        prior: start of the fit, and mean of the person's priors; default: the mean eye of adults.
        noise: noise of features without covariance; default: 0.1 px for one px of outline, 0.05 px for a glint.
        targets: use the known targets, with the noise of fixation.
        robust: the weights against wrong features.
        start: (i, 35) start of the unknowns, for one eye; default: a search.

    Warns:
        FitWarning: the fit may be wrong, for one of the reasons in `EyeFit.doubts`.

    Raises:
        InputError: the eyes wear spectacles, there is nothing to fit, an eye has no position, a feature lies a million
            pixels away, or the features lead to an eye that is physically impossible or 5 standard deviations from a
            prior.
    """
    if observations.lens_glints is not None and observations.lens_glints.ok.any():
        raise InputError("the eyes are behind spectacles, which fits of eyes do not follow so far")
    pupils, glints = observations.pupil.centre_px, observations.glints.xy_px
    far = (np.abs(pupils) > _FARTHEST_PX).any(axis=-1) | (np.abs(glints) > _FARTHEST_PX).any(axis=(-2, -1))
    if far.any():
        frame = int(observations.index.frame[far.argmax()])
        raise InputError(f"has features more than {_FARTHEST_PX:g} px away", path=f"frame {frame}")
    unknowns = Unknowns.population() if unknowns is None else unknowns
    spec = load_eye(prior) if isinstance(prior, str) else prior
    built = rig.build()
    noise = FeatureNoise.of(DEFAULT_OUTLINE_PX, DEFAULT_GLINT_PX, rig=built) if noise is None else noise
    options = Options(targets=targets, robust=robust, start=start)
    fits = tuple(
        fit_one(observations, np.flatnonzero(observations.index.eye == eye), built, spec, unknowns, noise, options)
        for eye in np.unique(observations.index.eye)
    )
    for fit in fits:
        warn_of(fit, stacklevel=3)
    return fits


def warn_of(fit: EyeFit, *, stacklevel: int = 2) -> None:
    """Issue a `FitWarning` for each of a fit's doubts."""
    for doubt in fit.doubts:
        warnings.warn(f"{fit.eye} eye: {doubt}", FitWarning, stacklevel=stacklevel)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Options of a fit, see `fit_eye`; `person` (29,) fixes the person's unknowns instead of the prior."""

    targets: bool = True
    robust: Robust = "geman-mcclure"
    start: Floats | None = None
    person: Floats | None = None


def instants_of(observations: Observations) -> Ints:
    """Number the instants (n,) of one eye; the k-th frames of all cameras of a fixation are one instant."""
    index = observations.index
    place = np.stack([index.head, index.fixation, index.camera], axis=-1)
    group = np.unique(place, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(group, kind="stable")
    turn = np.empty(len(group), dtype=np.int64)
    turn[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order])
    keys = np.stack([index.head, index.fixation, turn], axis=-1)
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1]).reshape(-1)


def fit_one(
    observations: Observations,
    rows: Ints,
    rig: RigGeometry,
    spec: EyeSpec,
    unknowns: Unknowns,
    noise: FeatureNoise,
    options: Options,
) -> EyeFit:
    """Fit one eye."""
    mine = observations.take(rows)
    if not sized(mine).any():
        unknowns = unknowns.model_copy(update={"pupil_mm": "known"})  # centres alone do not show it
    problem = problem_of(mine, rig, spec, unknowns, noise, options)
    theta = start_of(problem) if options.start is None else np.array(options.start)
    theta, converged = solve(problem, theta)
    if options.robust != "none" and (other := without_wrong_outlines(problem, theta)) is not None:
        theta, converged = solve(problem, other)
    if options.start is None and (other := restarted(problem, theta)) is not None:
        theta, converged = solve(problem, other)
    if problem.shared and problem.free[SLIPPAGE].any():
        theta = theta + marginal_step(problem, theta)
    _refuse_strange(problem, theta)
    found = _result(mine, rows, problem, (theta, converged), (spec, unknowns))
    if options.person is None:
        try:
            _ = found.spec
        except InputError as error:
            raise InputError(f"the {found.eye} eye's features lead to an eye that cannot exist ({error})") from None
    return found


def _refuse_strange(problem: Problem, theta: Floats) -> None:
    """Raise `InputError` if a number of the person is further than `MOST_DEVIATIONS` from its prior's mean."""
    off = np.abs(theta - problem.centre)[0] * np.sqrt(problem.precision)
    off[:LOCAL] = 0.0
    worst = int(np.argmax(off))
    if off[worst] > MOST_DEVIATIONS:
        raise InputError(
            f"the {problem.views.eyes.side} eye's features lead to a {NAMES[worst]} that is {off[worst]:.1f} standard "
            "deviations of its prior off; the rig, the places of the eyes, the noise or the priors are wrong"
        )


def problem_of(
    mine: Observations, rig: RigGeometry, spec: EyeSpec, unknowns: Unknowns, noise: FeatureNoise, options: Options
) -> Problem:
    """Set up the fit of one eye. Raises InputError if there is nothing to fit, or the eye has no position."""
    index = mine.index
    side = EYES[max(int(index.eye[0]), 0)] if len(index) else "right"
    seen = measured(mine, noise, len(rig.lights))
    if not seen.count:
        raise InputError(f"hold neither a pupil nor a glint with a known light of the {side} eye", path="observations")
    position = index.eye_position_mm + np.nan_to_num(index.head_mm)
    if not np.isfinite(position).all():
        raise InputError(
            "is needed, at least roughly: extract with --scene, or give a scene as the rig", path="eye_position_mm"
        )
    eyes = stacked_eyes([spec.build(eye="left" if side == "left" else "right")])
    instant = instants_of(mine)
    first = np.unique(instant, return_index=True)[1]
    camera = np.maximum(index.camera, 0)
    views = Views(eyes=eyes, person=np.zeros(len(mine), np.int64), position_mm=position, camera=camera, rig=rig)
    centre = np.zeros((len(first), COUNT))
    centre[:, PUPIL] = diameters_mm(eyes)[0]
    if options.person is not None:
        centre[:, LOCAL:] = options.person
    target = np.array(index.target_mm[first]) if options.targets else np.full((len(first), 3), np.nan)
    return Problem(
        views=views,
        seen=seen,
        instant=instant,
        instants=views.take(first),
        target_mm=target,
        fixation_rad=float(np.radians(noise.fixation_deg)),
        centre=centre,
        precision=unknowns.precision(),
        free=unknowns.free(),
        robust=options.robust,
    )


def start_of(problem: Problem) -> Floats:
    """Compute the start (i, 35): frames are fitted alone, from the best directions of a grid."""
    theta = problem.centre.copy()
    theta[:, [AZIMUTH, ELEVATION]] = directions_of(problem, theta)[0]
    theta, _ = solve(_alone(problem), theta, _START_STEPS)
    other = restarted(problem, theta)
    return theta if other is None else other


def _alone(problem: Problem) -> Problem:
    """Return the same fit with a known person."""
    return replace(problem, free=problem.free & (np.arange(COUNT) < LOCAL))


def restarted(problem: Problem, theta: Floats) -> Floats | None:
    """Fit instants that are worse than most again, from other directions of a grid; None if nothing improves."""
    cost = badness(problem, theta)
    worse = np.flatnonzero(cost > _WORSE * np.maximum(np.median(cost), 1.0))
    if not len(worse):
        return None
    part, best = _alone(problem.take(worse)), theta[worse]
    least = cost[worse]
    for directions in directions_of(part, best):
        trial = best.copy()
        trial[:, PUPIL] = part.centre[:, PUPIL]
        trial[:, 3:LOCAL] = 0.0
        trial[:, [AZIMUTH, ELEVATION]] = directions
        trial, _ = solve(part, trial, _START_STEPS)
        now = badness(part, trial)
        best = np.where((now < 0.9 * least)[:, None], trial, best)
        least = np.minimum(now, least)
    if np.array_equal(best, theta[worse]):
        return None
    out = theta.copy()
    out[worse] = best
    return out


def badness(problem: Problem, theta: Floats) -> Floats:
    """Sum the unexplained part of each instant's features and its distance from the priors, (i,)."""
    off = (theta - problem.centre)[:, :LOCAL] ** 2 * problem.precision[:LOCAL]
    return np.asarray(unexplained(problem, theta) + off.sum(axis=1))


def directions_of(problem: Problem, theta: Floats) -> Floats:
    """Search a grid for the best directions (3, i, 2) rad of each instant, 15 degrees apart, best first.

    The misfit is that of the pupil's centre and the glints about their common shift, which counts less, since
    slippage explains it.
    """
    seen, n = problem.seen, len(problem.views)
    grid = np.stack([a.ravel() for a in np.meshgrid(_START_AZIMUTH, _START_ELEVATION)], axis=-1)
    tried = np.tile(theta[problem.instant], (len(grid), 1))
    tried[:, [AZIMUTH, ELEVATION]] = np.repeat(grid, n, axis=0)
    images = images_of(problem.views.take(np.tile(np.arange(n), len(grid))), tried, 6)
    has: Bools = np.any(seen.outline_white, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = np.sum(seen.outline_px * has[..., None], axis=1) / has.sum(axis=1)[:, None]
    seen_px = np.concatenate([own[:, None], np.where(seen.has_glint[..., None], seen.glints_px, np.nan)], axis=1)
    centre = images.outline_px.mean(axis=1)[:, None]
    gaps = np.concatenate([centre, images.glints_px], axis=1).reshape(len(grid), n, -1, 2) - seen_px
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no feature at all in some direction
        common = np.nan_to_num(np.nanmedian(gaps, axis=2), nan=_FAR_PX)
    miss = np.minimum(np.nan_to_num(np.linalg.norm(gaps - common[:, :, None], axis=-1), nan=_FAR_PX), _FAR_PX)
    used = np.concatenate([np.any(has, axis=1)[:, None], seen.has_glint], axis=1)
    each = np.sum(miss * used, axis=2) + _SHIFT_SHARE * np.linalg.norm(common, axis=-1)
    cost = np.zeros((len(grid), len(problem.centre)))
    np.add.at(cost.T, problem.instant, each.T)
    out = np.zeros((_STARTS, len(problem.centre), 2))
    for start in out:
        start[:] = grid[np.argmin(cost, axis=0)]
        cost[np.linalg.norm(grid[:, None] - start, axis=-1) < _APART_RAD] = np.inf
    return out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Weights:
    """Robust weights of outlines (n,) and of glints (n, m)."""

    outline: Floats
    glints: Floats


def block_sizes(found: Residuals) -> tuple[Floats, Floats]:
    """Compute the rms of whitened residuals of outlines (n,) and glints (n, m), over their median if above 1.

    If the eye differs from the model, all outlines or all glints are off; only those that are off by more are outliers.
    """
    outline = np.sqrt(np.sum(found.outline**2, axis=1) / np.maximum(found.outline_size, 1))
    glints = np.sqrt(np.sum(found.glints**2, axis=2) / 2.0)
    usual = [
        max(1.0, float(np.median(sizes[there]))) if there.any() else 1.0
        for sizes, there in ((outline, found.outline_size > 0), (glints, found.glint_ok))
    ]
    return outline / usual[0], glints / usual[1]


def weights_of(problem: Problem, found: Residuals, most: float = 1.0) -> Weights:
    """Compute the weights of all blocks; residuals are relative to their instant's median, at most `most` times."""
    outline, glints = block_sizes(found)
    if problem.robust == "none":
        return Weights(outline=np.ones_like(outline), glints=np.ones_like(glints))
    at = np.concatenate([problem.instant, np.repeat(problem.instant, glints.shape[1])])
    there = np.concatenate([found.outline_size > 0, found.glint_ok.ravel()])
    middle = _medians(at[there], np.concatenate([outline, glints.ravel()])[there], len(problem.centre))
    by_view = np.clip(middle, 1.0, most)[problem.instant]
    weigh = _huber if problem.robust == "huber" else _geman_mcclure
    return Weights(outline=weigh(outline / by_view), glints=weigh(glints / by_view[:, None]))


def _medians(group: Ints, values: Floats, count: int) -> Floats:
    """Compute the median (count,) of each group's values; 0 for an empty group."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group, minlength=count)
    middle = np.cumsum(sizes) - sizes + sizes // 2
    some = sizes > 0
    out = np.zeros(count)
    out[some] = values[order][middle[some]]
    return out


def _huber(t: Floats) -> Floats:
    """Return Huber's weight: 1 in the core, CORE / t outside."""
    return np.asarray(CORE / np.maximum(t, CORE))


def _geman_mcclure(t: Floats) -> Floats:
    """Return the Geman-McClure weight with a flat core: 1 inside, (2 CORE^2 / (CORE^2 + t^2))^2 outside."""
    return np.asarray((2.0 * CORE**2 / (CORE**2 + np.maximum(t, CORE) ** 2)) ** 2)


def costs_of(problem: Problem, theta: Floats, found: Residuals, weights: Weights) -> tuple[Floats, Floats]:
    """Compute the cost (i,) of each instant, equation (4), and that of the person's prior."""
    own = weights.outline * np.sum(found.outline**2, axis=1)
    own = own + np.sum(weights.glints * np.sum(found.glints**2, axis=2), axis=1)
    cost = np.zeros(len(theta))
    np.add.at(cost, problem.instant, own)
    rows = np.flatnonzero(problem.has_target)
    if len(rows):
        miss = target_misses(problem.instants.take(rows), theta[rows], problem.target_mm[rows])
        cost[rows] += np.sum(miss**2, axis=1) / problem.fixation_rad**2
    off = (theta - problem.centre) ** 2 * problem.precision
    return cost + off[:, :LOCAL].sum(axis=1), off[0, LOCAL:].sum()


def equations_of(problem: Problem, theta: Floats, found: Residuals, weights: Weights) -> tuple[Floats, Floats]:
    """Compute the information (i, 35, 35) of each instant without priors, and half of the negative gradient (i, 35)."""
    n = len(problem.views)
    roots = np.sqrt(weights.outline)[:, None], np.sqrt(weights.glints)[..., None]
    slopes = np.concatenate(
        [found.outline_slopes * roots[0][..., None], (found.glint_slopes * roots[1][..., None]).reshape(n, -1, COUNT)],
        axis=1,
    )
    values = np.concatenate([found.outline * roots[0], (found.glints * roots[1]).reshape(n, -1)], axis=1)
    matrix, vector = np.zeros((len(theta), COUNT, COUNT)), np.zeros((len(theta), COUNT))
    np.add.at(matrix, problem.instant, np.swapaxes(slopes, 1, 2) @ slopes)
    np.add.at(vector, problem.instant, -np.einsum("nka,nk->na", slopes, values))
    rows = np.flatnonzero(problem.has_target)
    if len(rows):
        at = problem.instants.take(rows)
        miss = target_misses(at, theta[rows], problem.target_mm[rows]) / problem.fixation_rad
        by = target_slopes(at, theta[rows], problem.target_mm[rows]) / problem.fixation_rad
        matrix[rows] += np.swapaxes(by, 1, 2) @ by
        vector[rows] -= np.einsum("nca,nc->na", by, miss)
    return matrix, vector


def arrow_step(problem: Problem, matrix: Floats, vector: Floats, theta: Floats, damping: Floats) -> Floats:
    """Solve the arrow-shaped normal equations for the damped Gauss-Newton step (i, 35).

    With blocks A_i of the frames, B_i to the person and C of the person, the person's step is that of the Schur
    complement C - sum B_i^T A_i^-1 B_i, and A_i x_i = a_i - B_i y gives the frames'.

    Args:
        problem: the fit.
        matrix: (i, 35, 35) information without priors.
        vector: (i, 35) half of the negative gradient.
        theta: (i, 35) current unknowns.
        damping: (i,) Levenberg's factors.
    """
    off = (problem.centre - theta) * problem.precision
    local, person = np.flatnonzero(problem.free[:LOCAL]), LOCAL + np.flatnonzero(problem.free[LOCAL:])
    step = np.zeros_like(theta)
    a = matrix[:, local[:, None], local] + np.diag(problem.precision[local])
    lift = np.einsum("iaa->ia", a) * damping[:, None]
    a = a + (lift + 1e-12 * np.einsum("iaa->ia", a).max(axis=1, initial=1.0)[:, None])[:, None] * np.eye(len(local))
    right = vector[:, local] + off[:, local]
    if not len(person):
        step[:, local] = np.linalg.solve(a, right[..., None])[..., 0]
        return step
    b = matrix[:, local[:, None], person]
    c = matrix[:, person[:, None], person].sum(axis=0) + np.diag(problem.precision[person])
    c = c + np.diag(np.diag(c) * damping.max() + 1e-12 * max(np.diag(c).max(), 1.0))
    inner = np.linalg.solve(a, np.concatenate([b, right[..., None]], axis=2))
    schur = c - np.einsum("iab,iac->bc", b, inner[..., :-1])
    shared = np.linalg.lstsq(schur, vector[:, person].sum(axis=0) + off[0, person] - np.einsum(
        "iab,ia->b", b, inner[..., -1]
    ), rcond=1e-13)[0]  # fmt: skip
    step[:, person] = shared
    step[:, local] = inner[..., -1] - inner[..., :-1] @ shared
    return step


def solve(problem: Problem, theta: Floats, steps: int = _STEPS) -> tuple[Floats, Bools]:
    """Minimise equation (4) from `theta` (i, 35); return the unknowns, and which instants settled."""
    theta, settled = theta.copy(), np.zeros(len(theta), dtype=bool)
    damping = np.full(len(theta), 1e-3)
    for count in range(steps):
        most = max(1.0, _FIRST_SCALE * 0.5**count)
        found = residuals(problem.seen, slopes_of(problem.views, theta[problem.instant], _POINTS, problem.free))
        weights = weights_of(problem, found, most)
        matrix, vector = equations_of(problem, theta, found, weights)
        step = _limited(problem, arrow_step(problem, matrix, vector, theta, damping))
        trial = theta + step
        trial[:, PUPIL] = np.clip(trial[:, PUPIL], *_PUPIL_MM)
        good, gain = _improves(problem, (theta, found), trial, weights)
        theta = np.where(good[:, None], trial, theta)
        damping = np.where(good, damping / 10.0, damping * 10.0)
        settled |= (good & gain) | (np.abs(step).max(axis=1) < _SETTLED) | (damping > _STUCK)
        if problem.robust != "none" and most > 1.0:
            outside = (weights.outline < 1.0) | (weights.glints < 1.0).any(axis=1)
            settled[problem.instant[outside]] = False
            settled &= settled.all() | (not problem.shared)
        if settled.all():
            break
    return theta, settled


def marginal_step(problem: Problem, theta: Floats) -> Floats:
    """Compute the step (i, 35) from the joint mode of all unknowns to the mode of the person's, frames integrated out.

    Frames have unknowns of their own, so the joint mode is biased however many there are (Neyman and Scott 1948): the
    slippage of every frame is smaller for a smaller eye, nearer to the camera. By Fisher's identity the gradient of the
    person's likelihood is the mean of the joint gradient g over a frame's unknowns,

        E[g(x)] = g(x) + 1/2 sum_k (g(x + v_k) + g(x - v_k) - 2 g(x))                                             (4b)

    with the columns v_k of a root of their covariance A^-1. The frames move to their means. Instants that lose a
    feature at one of these points add nothing.
    """
    found = residuals(problem.seen, slopes_of(problem.views, theta[problem.instant], _POINTS, problem.free))
    weights = weights_of(problem, found)
    matrix, vector = equations_of(problem, theta, found, weights)
    local = np.flatnonzero(problem.free[:LOCAL])
    root = roots_of(matrix[:, local[:, None], local] + np.diag(problem.precision[local]))
    bend = np.zeros_like(vector)
    for shift in np.concatenate([root, -root], axis=2).transpose(2, 0, 1):
        moved = theta.copy()
        moved[:, local] += shift
        at = residuals(problem.seen, slopes_of(problem.views, moved[problem.instant], _POINTS, problem.free))
        bend += (equations_of(problem, moved, at, weights)[1] - vector) / 2.0
        lost = (at.outline_size != found.outline_size) | (at.glint_ok != found.glint_ok).any(axis=1)
        bend[problem.instant[lost]] = np.nan
    step = arrow_step(replace(problem, centre=theta), matrix, np.nan_to_num(bend), theta, np.zeros(len(theta)))
    return _limited(problem, step)


def without_wrong_outlines(problem: Problem, theta: Floats) -> Floats | None:
    """Return another start that ignores outlines in instants whose glints agree; None if there are none.

    A wrong outline has many points, so it can pull the gaze away and make all glints look wrong. The caller keeps the
    solution that leaves fewer blocks unexplained.
    """
    now = unexplained(problem, theta)
    if not (now > CORE**2).any():
        return None
    seen = problem.seen
    blind = replace(seen, outline_white=0.0 * seen.outline_white, outline_size=0 * seen.outline_size)
    other, _ = solve(replace(_alone(problem), seen=blind), theta)
    better = unexplained(problem, other) < now - CORE
    return np.where(better[:, None], other, theta) if better.any() else None


def unexplained(problem: Problem, theta: Floats) -> Floats:
    """Sum the mean squared residuals of each instant's blocks, each at most CORE^2, (i,); that for one not modelled."""
    found = residuals(problem.seen, images_of(problem.views, theta[problem.instant], _POINTS))
    outline, glints = block_sizes(found)
    gone = (problem.seen.outline_size > found.outline_size) + (problem.seen.has_glint & ~found.glint_ok).sum(axis=1)
    own = np.minimum(outline**2, CORE**2) + np.minimum(glints**2, CORE**2).sum(axis=1) + CORE**2 * gone
    out = np.zeros(len(theta))
    np.add.at(out, problem.instant, own)
    return out


def _limited(problem: Problem, step: Floats) -> Floats:
    """Shorten steps (i, 35) that would turn a direction by `_MOST_RAD`, or change a person by `_MOST_STEP` deviations.

    The first steps of a person would lead to eyes that cannot exist; their rays take minutes to trace.
    """
    share = np.minimum(1.0, _MOST_RAD / np.maximum(np.abs(step[:, :2]).max(axis=1), 1e-12))
    if not problem.shared:
        return np.asarray(step * share[:, None])
    person = np.abs(step[0, LOCAL:]) * np.sqrt(problem.precision[LOCAL:])
    return np.asarray(step * min(share.min(), _MOST_STEP / max(person.max(), 1e-12)))


def _improves(problem: Problem, now: tuple[Floats, Residuals], trial: Floats, weights: Weights) -> tuple[Bools, Bools]:
    """Return which instants (i,) a step does not worsen without losing features, and whether the gain is negligible.

    An instant may lose half of its outlines and of its glints. If instants share a person, the result is the same for
    all, and a quarter of them may lose more.
    """
    theta, found = now
    new = residuals(problem.seen, images_of(problem.views, trial[problem.instant], _POINTS))
    before, prior = costs_of(problem, theta, found, weights)
    after, prior_after = costs_of(problem, trial, _comparable(found, new), weights)
    kept = np.zeros((2, 2, len(theta)))
    for at, one in enumerate((found, new)):
        np.add.at(kept[at, 0], problem.instant, one.outline_size > 0)
        np.add.at(kept[at, 1], problem.instant, one.glint_ok.sum(axis=1))
    lost = np.asarray((2 * kept[1] < kept[0]).any(axis=0))
    if problem.shared:
        before, after = (np.full(len(theta), total) for total in (before.sum() + prior, after.sum() + prior_after))
        lost[:] = 4 * lost.sum() > len(lost)
    limit = _RELATIVE * before + _TINY
    return np.asarray((after <= before + limit) & ~lost), np.asarray(np.abs(after - before) <= limit)


def _comparable(before: Residuals, after: Residuals) -> Residuals:
    """Return the residuals `after` a step; features that only one of the two models has count as `before`."""
    both = (before.glint_ok & after.glint_ok)[..., None]
    whole = ((before.outline_size > 0) & (after.outline_size > 0))[:, None]
    return replace(
        after,
        glints=np.where(both, after.glints, before.glints),
        outline=np.where(whole, after.outline, before.outline),
    )


def _result(
    mine: Observations, rows: Ints, problem: Problem, state: tuple[Floats, Bools], made: tuple[EyeSpec, Unknowns]
) -> EyeFit:
    """Assemble the fit with its covariances and its eye file."""
    (theta, converged), (spec, unknowns) = state, made
    found = residuals(problem.seen, slopes_of(problem.views, theta[problem.instant], _POINTS, problem.free))
    weights = weights_of(problem, found)
    matrix, _ = equations_of(problem, theta, found, weights)
    first = np.unique(problem.instant, return_index=True)[1]
    index = mine.index.take(first)
    side = EYES[max(int(index.eye[0]), 0)]
    gaze = gaze_slopes(problem.instants, theta)
    cost, prior = costs_of(problem, theta, found, weights)
    measures = int(found.outline_size.sum() + 2 * found.glint_ok.sum() + 2 * problem.has_target.sum())
    flat = int((problem.free & (problem.precision == 0))[:LOCAL].sum()) * len(theta)
    flat += int((problem.free & (problem.precision == 0))[LOCAL:].sum())
    excess = max(1.0, float(cost.sum() + prior) / max(measures - flat, 1))
    known = eye_information(side, (index.fixation, index.head), matrix / excess, gaze, unknowns)
    point, way = lines_of_sight(problem.instants, theta)
    far = (np.abs(theta - problem.centre) * np.sqrt(problem.precision))[:, :LOCAL].max(axis=1) > MOST_DEVIATIONS
    theta = np.where(far[:, None] & (np.arange(COUNT) < LOCAL), np.nan, theta)
    point[far], way[far] = np.nan, np.nan
    return EyeFit(
        eye=side,
        rows=rows,
        instant=problem.instant,
        theta=theta,
        origin_mm=point,
        direction=way,
        known=known,
        chi2=cost + prior / len(cost),
        dof=measures - flat,
        outline_weight=np.where(found.outline_size > 0, weights.outline, np.nan),
        glint_weight=np.where(found.glint_ok, weights.glints, np.nan),
        converged=converged & ~far,
        prior=spec,
        unknowns=unknowns,
        targets=int(problem.has_target.sum()),
    )
