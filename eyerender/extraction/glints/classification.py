"""Classification of fitted spots: which are glints, and the reasons why other reflections are not.

A spot's features (what is behind it, how far from the pupil it lies, its shape and height) give a first logit of the
probability that it is a glint of the cornea. The likeliest one is then what the others are compared with: lamps of one
rig are reflected about equally high and wide. The weights of both steps are maximum a-posteriori estimates (logistic
regression) from development images; `scripts/fit_glints.py` makes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Floats, frozen
from ...geometry.ellipse import Ellipse
from ...status import Status
from ..preprocessing import DN
from ..result import GlintResult
from ..settings import ExtractionSettings
from .bloomed import Patch
from .detection import Spots, optics_sigma
from .fits import SpotFit

# Heights in full scales up to which that of a single strongly clipped glint is trusted, and up to which heights are
# compared; clipped pixels of a glint whose flanks still tell its height.
TALL, HIGHEST, CLIPPED = 2.5, 10.0, 12
# Steps by which the ground may be brighter than the iris; more is no worse, because the sclera is as bright.
BRIGHTEST = 1.4
# A large saturated patch is this many times as wide as the spots that are glints, at most.
WIDER = 2.0
# A spot is accepted if it is a glint with at least these odds.
LEAST_ODDS = 2.0
LIKELIEST = 12.0  # largest logit that counts
# Reasons for which a spot is refused, in the order of the features.
GROUNDS = (
    "before something brighter than the iris, as highlights of skin are",
    "far from the pupil, as highlights of skin are",
    "not as wide as the optics' image of a lamp",
    "elongated, as reflections off the sclera and wet lid margins are",
    "too faint for a glint",
    "much fainter than the brightest glint, as highlights of skin and lid margins are",
    "not as wide as the likeliest glint",
)
USUAL = (0.0, 0.0, 0.0, 0.0, math.log(10.0))  # features of a glint that speaks for itself, in the order of the reasons

# Made by scripts/fit_glints.py: weights of the features and 1, and of the comparison.
FIRST = np.array([-5.14, -2.86, -1.46, -5.29, 1.63, 4.18, -0.267])
SECOND = np.array([0.85, 3.32, 3.7, -3.44, 0.798])

_PIXEL = 1.0 / 12.0  # variance of a pixel; without it a spot of one row of pixels would be a line


@dataclass(frozen=True, slots=True, kw_only=True)
class Eye:
    """What spots are judged by.

    Attributes:
        ellipse: the pupil.
        blur_px: blur of its edge.
        pupil_dn: level inside it.
        iris_dn: level just outside it.
        support: share of its boundary that is seen.
    """

    ellipse: Ellipse
    blur_px: float
    pupil_dn: float
    iris_dn: float
    support: float


def classify_spots(
    spots: Spots, fit: SpotFit, eye: Eye, settings: ExtractionSettings, large: Sequence[Patch] = ()
) -> tuple[tuple[GlintResult, ...], tuple[GlintResult, ...]]:
    """Divide spots into (accepted, rejected), brightest first; spots of `large` patches are part of those.

    Args:
        spots: the spots.
        fit: their fits.
        eye: the eye.
        settings: settings of the extractor.
        large: large saturated glints.
    """
    rejected: list[GlintResult] = []
    reasons = _objections(fit, eye, [patch.glint.amplitude for patch in large])
    sigma = np.sqrt(fit.sigma_px.prod(axis=1))
    alone = [not any(_in_patch(patch, xy) for patch in large) for xy in spots.xy_px]
    widths = [width for width, reason, apart in zip(sigma, reasons, alone, strict=True) if reason is None and apart]
    large = [patch for patch in large if patch.glint.sigma_px < WIDER * max(widths, default=math.inf)]
    accepted = [patch.glint for patch in large]
    for i in np.argsort(-fit.amplitude_dn, kind="stable").tolist():
        reason, converged = reasons[i], bool(fit.converged[i])
        if any(_in_patch(patch, spots.xy_px[i]) for patch in large):
            continue
        result = GlintResult(
            status=Status.OK if reason is None else Status.REJECTED,
            reason=reason,
            xy_px=frozen(fit.xy_px[i]) if converged else frozen(spots.xy_px[i]),
            covariance=frozen(fit.covariance[i]) if converged else None,
            amplitude=float(fit.amplitude_dn[i]) / DN,
            sigma_px=float(sigma[i]),
            saturated=bool(fit.clipped[i] > 0),
        )
        (accepted if reason is None else rejected).append(result)
    reason = f"beyond the {settings.max_glints} brightest glints that the settings allow"
    surplus = [replace(glint, status=Status.REJECTED, reason=reason) for glint in accepted[settings.max_glints :]]
    strip = "a strip or a broad patch, as reflections off the sclera and wet lid margins are"
    places = np.array([glint.xy_px for glint in accepted]).reshape(-1, 2)
    far = (((spots.patches_px[:, None] - places) ** 2).sum(axis=-1) > 4.0**2).all(axis=1)
    patches = [
        GlintResult(status=Status.REJECTED, reason=strip, xy_px=frozen(xy))
        for xy in spots.patches_px[far]
        if not any(_in_patch(patch, xy) for patch in large)
    ]
    return tuple(accepted[: settings.max_glints]), tuple(rejected + surplus + patches)


def features(fit: SpotFit, eye: Eye) -> Floats:
    """Features (n, 7) of spots on which the first logit depends.

    They are: by how much the ground is brighter than the pupil or iris that should be there, in steps from pupil to
    iris; the distance outside the pupil in semi-axes a; the logarithms of the width over the blur, of the elongation
    (of the fit and of the bright patch) and of the height in steps; the visible share of the pupil boundary; and 1.
    """
    step, wide2 = abs(eye.iris_dn - eye.pupil_dn), fit.sigma_px**2 + _PIXEL
    width = wide2.prod(axis=1) ** 0.25
    (xx, xy), (_, yy) = fit.moments_px2.transpose(1, 2, 0)
    mean, apart = 0.5 * (xx + yy) + _PIXEL, np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    stretch = (mean + apart) / np.maximum(mean - apart, 1e-3) * wide2.max(axis=1) / wide2.min(axis=1)
    offset = fit.xy_px - eye.ellipse.centre_px
    cos, sin = math.cos(eye.ellipse.angle_rad), math.sin(eye.ellipse.angle_rad)
    scaled = (offset @ np.array([[cos, -sin], [sin, cos]])) / eye.ellipse.semi_axes_px
    beyond = np.hypot(*offset.T) * (1.0 - 1.0 / np.maximum(np.hypot(*scaled.T), 1e-6))
    expected = eye.iris_dn + (eye.pupil_dn - eye.iris_dn) * np.clip(-beyond / (2.0 * width + 1.0), 0.0, 1.0)
    columns = (
        np.clip((fit.background_dn - expected) / step, 0.0, BRIGHTEST),
        np.clip(beyond / eye.ellipse.semi_axes_px[0], 0.0, 4.0),
        np.minimum(np.abs(np.log(width / eye.blur_px)), 1.5),
        np.minimum(0.5 * np.log(stretch), 2.0),
        np.log(np.clip(fit.amplitude_dn / step, 0.2, 60.0)),
        np.full(width.size, eye.support),
        np.ones(width.size),
    )
    return np.stack(columns, axis=1)


def compared(fit: SpotFit, logit: Floats, heights: Sequence[float]) -> Floats:
    """Features (n, 5) on which the second logit depends.

    They are the first logit; whether the spot is another one than the likeliest; and for those, the logarithms of its
    height over that of the brightest glint and of its width over the likeliest one's; and 1.

    Args:
        fit: the n spots.
        logit: (n,) the first logit.
        heights: of large glints, in full scales.
    """
    best = int(np.argmax(logit))
    height, width = np.clip(fit.amplitude_dn / DN, 1e-3, HIGHEST), (fit.sigma_px**2 + _PIXEL).prod(axis=1) ** 0.25
    # The fitted height of a strongly clipped glint may be many times too large. So it counts as TALL only, unless the
    # next one is higher than that.
    sure = np.where(fit.clipped > CLIPPED, np.minimum(height, TALL), height)
    glints = np.flatnonzero(logit > 0.0) if len(heights) or np.any(logit > 0.0) else np.array([best])
    likely = sorted([*heights, *height[glints].tolist()])
    top = max(likely[-2] if len(likely) > 1 else 0.0, *np.minimum(heights, TALL), *sure[glints])
    other = (np.arange(logit.size) != best) / (1.0 + math.exp(-float(np.clip(logit[best], -30.0, 30.0))))
    columns = (
        np.clip(logit, -LIKELIEST, LIKELIEST),
        other,
        other * np.clip(np.log(height / top), -3.0, 0.0),
        other * np.minimum(np.abs(np.log(width / width[best])), 1.0),
        np.ones(logit.size),
    )
    return np.stack(columns, axis=1)


def _objections(fit: SpotFit, eye: Eye, heights: Sequence[float]) -> list[str | None]:
    """Reasons (n,) why spots are not glints, None for glints."""
    reasons: list[str | None] = ["the spot's fit did not converge"] * fit.converged.size
    index = np.flatnonzero(fit.converged)
    if index.size == 0:
        return reasons
    fit = fit.taken(index)
    first = features(fit, eye)
    logit = first @ FIRST
    second = compared(fit, logit, heights)
    glint = second @ SECOND > math.log(LEAST_ODDS)
    against = np.concatenate([(first[:, :5] - USUAL) * FIRST[:5] * SECOND[0], second[:, 2:4] * SECOND[2:4]], axis=1)
    sharp = fit.sigma_px.max(axis=1) < 0.5 * optics_sigma(eye.blur_px)
    for k, i in enumerate(index.tolist()):
        reasons[i] = None if glint[k] else GROUNDS[int(np.argmin(against[k]))]
        if sharp[k]:
            reasons[i] = f"sharper than the optics (sigma {fit.sigma_px[k].max():.1f} px): a bad pixel"
    return reasons


def _in_patch(patch: Patch, xy: Floats) -> bool:
    """Whether a bright pixel belongs to a large glint."""
    height, width = patch.pixels.shape
    column, row = (int(v) for v in np.rint(xy))
    return 0 <= row < height and 0 <= column < width and bool(patch.pixels[row, column])
