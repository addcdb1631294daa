"""Classification of fitted spots: which are glints, and why other reflections are not.

A spot's features (its surroundings, distance from the pupil, shape and height) give a first logit of the probability
that it is a glint of the cornea. The others are then compared with the brightest likely one: reflections of one rig's
lamps are about equally high and wide, and those in the tear menisci are smaller. The weights of both steps are maximum
a-posteriori estimates (logistic regression) from development images; `scripts/tools/fit_glints.py` fits them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...base.arrays import Floats, frozen
from ...base.status import Status
from ...optics.ellipse import Ellipse, signed_distance
from ..preprocessing import DN, Image
from ..result import GlintResult
from ..settings import ExtractionSettings
from ..weights import glint_weights
from .detection import optics_sigma
from .fitting import SpotFit

# Largest counted steps by which the background is brighter than the iris; more is not worse, because the sclera is as
# bright.
BRIGHTEST = 1.4
SIZES = -4.0, -2.0  # logarithms of the width over the pupil's semi-axis b between which wider is likelier
ROUND = math.log(2.0)  # elongation that LEDs have; it counts twice, so this is an oval of 1.4 : 1
# A spot is accepted if it is a glint with at least these odds.
LEAST_ODDS = 2.0
WIDER = 0.5  # largest difference of the logarithms of widths that counts; bright glints are clipped far out
LIKELIEST = 12.0  # largest logit that counts
# Glints of one rig are alike: largest differences of the logarithms of light, width and form; how many of them count.
ALIKE, MOST_ALIKE = (1.0, 0.3, 0.3), 3.0
# Reasons for which a spot is rejected, in the order of the features.
GROUNDS = (
    "before something brighter than the iris, as highlights of skin are",
    "far from the pupil, as highlights of skin are",
    "smaller than images of lamps in this eye are",
    "elongated, as reflections off the sclera and wet lid margins are",
    "too faint for a glint",
    "dimmer than reflections of lamps are",
    "beside something darker than the iris, as spots between lashes are",
    "behind a lid or lashes, seen from the pupil",
    "much fainter than the brightest glint, as highlights of skin and lid margins are",
    "not as wide as the brightest glint",
)
# Features of an unambiguous glint, in the order of the reasons.
USUAL = (0.0, 0.0, SIZES[1], 0.0, math.log(10.0), 1.0, 0.0, 0.0)
PIXEL = 1.0 / 12.0  # variance of a pixel, px^2; without it a spot of one row of pixels would be a line
_TURN = np.arange(24) * (np.pi / 12.0)
_CIRCLE, _LINE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1), np.linspace(0.0, 1.0, 16)

FIRST, SECOND = glint_weights()  # of the features, and of the comparison


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeContext:
    """Properties of the eye by which spots are judged."""

    ellipse: Ellipse  # the pupil
    blur_px: float  # blur of the pupil's edge
    pupil_dn: float  # level inside the pupil
    iris_dn: float  # level just outside the pupil
    support: float  # visible share of its boundary
    clip_dn: float  # level at which the sensor clips
    linear: Image  # the image

    @property
    def step_dn(self) -> float:
        """Step between pupil and iris."""
        return abs(self.iris_dn - self.pupil_dn)

    def expected_dn(self, depth: Floats) -> Floats:
        """Compute the level (...) expected at a depth: 0 in the iris, 1 in the pupil."""
        return self.iris_dn + (self.pupil_dn - self.iris_dn) * np.clip(depth, 0.0, 1.0)

    def levels_dn(self, places_px: Floats) -> Floats:
        """Return the levels (...) of the pixels nearest to places (..., 2), the border's outside the image."""
        column, row = np.rint(places_px).astype(np.intp).T
        height, width = self.linear.shape
        return self.linear[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].T.astype(np.float64)


def classify_spots(
    fit: SpotFit, patches_px: Floats, eye: EyeContext, settings: ExtractionSettings
) -> tuple[tuple[GlintResult, ...], tuple[GlintResult, ...]]:
    """Divide spots into (accepted, rejected), brightest first; `patches_px` (k, 2) are bright patches, not spots."""
    accepted: list[GlintResult] = []
    rejected: list[GlintResult] = []
    reasons = _objections(fit, eye)
    sigma = np.sqrt(fit.sigma_px.prod(axis=1))
    for i in np.argsort(-fit.amplitude_dn, kind="stable").tolist():
        reason = reasons[i]
        result = GlintResult(
            status=Status.OK if reason is None else Status.REJECTED,
            reason=reason,
            xy_px=frozen(fit.xy_px[i]),
            covariance=frozen(fit.covariance[i]) if fit.converged[i] else None,
            amplitude=float(fit.amplitude_dn[i]) / DN,
            sigma_px=float(sigma[i]),
            saturated=bool(fit.clipped[i] > 0),
        )
        (accepted if reason is None else rejected).append(result)
    reason = f"beyond the {settings.max_glints} brightest glints that the settings allow"
    surplus = [replace(glint, status=Status.REJECTED, reason=reason) for glint in accepted[settings.max_glints :]]
    strip = "a strip or a broad patch, as reflections off the sclera and wet lid margins are"
    far = (((patches_px[:, None] - fit.xy_px) ** 2).sum(axis=-1) > 4.0**2).all(axis=1)
    patches = [GlintResult(status=Status.REJECTED, reason=strip, xy_px=frozen(xy)) for xy in patches_px[far]]
    return tuple(accepted[: settings.max_glints]), tuple(rejected + surplus + patches)


def features(fit: SpotFit, eye: EyeContext) -> Floats:
    """Compute the features (n, 10) of spots for the first logit.

    They are: how much the background is brighter than the pupil or iris expected there, in steps from pupil to iris;
    the distance outside the pupil in semi-axes a; the logarithms of the width over the semi-axis b, of the elongation
    (of the fit and of the bright patch) beyond ROUND and of the height in steps; the fourth power of the peak's level
    over the clip level, which hardly anything but lamps reaches; how much darker than expected the darkest surroundings
    are and how much the level varies between pupil and spot, in steps; the visible share of the pupil boundary; and 1.
    """
    wide2 = fit.sigma_px**2 + PIXEL
    width = wide2.prod(axis=1) ** 0.25
    (xx, xy), (_, yy) = fit.moments_px2.transpose(1, 2, 0)
    mean, apart = 0.5 * (xx + yy) + PIXEL, np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    stretch = (mean + apart) / np.maximum(mean - apart, 1e-3) * wide2.max(axis=1) / wide2.min(axis=1)
    beyond, (a, b) = signed_distance(eye.ellipse, fit.xy_px), eye.ellipse.semi_axes_px
    darker, uneven = _surroundings(fit, beyond, eye)
    columns = (
        np.clip((fit.background_dn - eye.expected_dn(-beyond / (2.0 * width + 1.0))) / eye.step_dn, 0.0, BRIGHTEST),
        np.clip(beyond / a, 0.0, 4.0),
        np.clip(np.log(width / b), *SIZES),
        np.clip(0.5 * np.log(stretch) - ROUND, 0.0, 2.0),
        np.log(np.clip(fit.amplitude_dn / eye.step_dn, 0.2, 60.0)),
        np.clip((fit.background_dn + fit.amplitude_dn) / min(eye.clip_dn, DN), 0.0, 1.0) ** 4,
        np.clip(darker / eye.step_dn, 0.0, 1.2),
        np.minimum(uneven / eye.step_dn, 0.8),
        np.full(width.size, eye.support),
        np.ones(width.size),
    )
    return np.stack(columns, axis=1)


def _surroundings(fit: SpotFit, beyond: Floats, eye: EyeContext) -> tuple[Floats, Floats]:
    """Compute how much darker than expected it is beside spots, and how much the level varies towards them, DN (n,).

    A glint lies before iris and pupil. Lashes beside a spot are darker than these, and between the pupil and a spot on
    a lid, its margin and its lashes change the level. The fourth lowest of 24 levels on a circle around the spot
    counts, and the standard deviation of 16 levels between the edge of the pupil and that circle. `beyond` (n,) is the
    distance of the spots from that edge, px.
    """
    radius = 2.2 * fit.sigma_px.max(axis=1) + 1.5 * eye.blur_px + 3.0
    circle = fit.xy_px[:, None] + radius[:, None, None] * _CIRCLE
    depth = 0.5 - signed_distance(eye.ellipse, circle) / (3.0 * eye.blur_px)
    darker = np.sort(eye.expected_dn(depth) - eye.levels_dn(circle), axis=1)[:, -4]
    offset = fit.xy_px - eye.ellipse.centre_px
    distance = np.maximum(np.hypot(*offset.T), 1e-6)
    first, last = 1.0 - (beyond - 2.0 * eye.blur_px - 1.0) / distance, 1.0 - radius / distance
    along = first[:, None] + (last - first)[:, None] * _LINE
    levels = eye.levels_dn(eye.ellipse.centre_px + along[..., None] * offset[:, None])
    return darker, np.where(first < last, levels.std(axis=1), 0.0)


def compared(fit: SpotFit, logit: Floats, top_dn: float, second: Floats | None = None) -> Floats:
    """Compute the features (n, 6) of n spots for the second logit.

    They are the first logit (n,); whether the spot is not the reference, and if so, the logarithms of its visible light
    (height times width) and of its visible width over those of the reference; the expected number of glints among other
    similar spots; and 1. The reference is the brightest of the spots that are rather glints than not: it is brighter
    than ghosts of the lens and the lamps' images in the tear menisci. Similar spots count by the first logit, or once
    more by the second, if its weights `second` (6,) are given.

    The flanks of a clipped spot determine its height badly, so only the visible part counts: the height up to `top_dn`,
    and the width from the area above half of it, 2 pi sigma^2 ln(A / (h / 2)) for a Gaussian.
    """
    visible = np.minimum(fit.amplitude_dn, np.maximum(top_dn - fit.background_dn, 1.0))
    wide2 = (fit.sigma_px**2 + PIXEL).prod(axis=1) ** 0.5 * (1.0 + np.log2(fit.amplitude_dn / visible))
    light, width = np.log(np.maximum(visible * np.sqrt(wide2), 1e-3)), 0.5 * np.log(wide2)
    form = 0.5 * np.log((fit.sigma_px[:, 0] ** 2 + PIXEL) / (fit.sigma_px[:, 1] ** 2 + PIXEL))
    near = (np.abs(one[:, None] - one) < most for one, most in zip((light, width, form), ALIKE, strict=True))
    alike = np.logical_and.reduce(list(near)) & ~np.eye(logit.size, dtype=bool)
    best = int(np.argmax(np.where(logit >= min(0.0, logit.max()), light, -np.inf)))
    other = (np.arange(logit.size) != best) * _probability(logit[best])
    columns = (
        np.clip(logit, -LIKELIEST, LIKELIEST),
        other,
        other * np.clip(light - light[best], -4.0, 0.0),
        other * np.minimum(np.abs(width - width[best]), WIDER),
        np.minimum(alike @ _probability(logit), MOST_ALIKE),
        np.ones(logit.size),
    )
    out = np.stack(columns, axis=1)
    if second is not None:
        out[:, 4] = np.minimum(alike @ _probability(out @ second), MOST_ALIKE)
    return out


def _probability(logit: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logit, -30.0, 30.0))))


def _objections(fit: SpotFit, eye: EyeContext) -> list[str | None]:
    """Return reasons (n,) why spots are not glints, None for glints."""
    reasons: list[str | None] = ["the spot's fit did not converge"] * fit.converged.size
    index = np.flatnonzero(fit.converged)
    if index.size == 0:
        return reasons
    fit = fit.taken(index)
    first = features(fit, eye)
    logit = first @ FIRST
    second = compared(fit, logit, eye.clip_dn, SECOND)
    glint = second @ SECOND > math.log(LEAST_ODDS)
    against = np.concatenate([(first[:, :8] - USUAL) * FIRST[:8] * SECOND[0], second[:, 2:4] * SECOND[2:4]], axis=1)
    sharp = fit.sigma_px.max(axis=1) < 0.5 * optics_sigma(eye.blur_px)
    for k, i in enumerate(index.tolist()):
        reasons[i] = None if glint[k] else GROUNDS[int(np.argmin(against[k]))]
        if sharp[k]:
            reasons[i] = f"sharper than the optics (sigma {fit.sigma_px[k].max():.1f} px): a bad pixel"
    return reasons
