"""Classification of fitted spots: which are glints, and the reasons why other reflections are not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Bools, Floats, frozen
from ...status import Status
from ..compiled import twin
from ..preprocessing import DN, Image, Prepared
from ..result import GlintResult
from ..settings import ExtractionSettings
from ..statistics import median, quantile
from .bloomed import Patch
from .detection import Spots, optics_sigma, widest
from .fits import SpotFit

# Largest ratio of length to width of a glint's bright patch, and largest product of that ratio and the fit's. True
# glints of the development images are below 1.99 and 2.2.
LONG, LONG_TWICE = 2.0, 2.4
# The cornea mirrors 2 % of a lamp, a point; wet lid margins and skin spread it. Lamps of one rig differ less than this:
# of rendered eyes in lids, all 1,436 glints but one are above 0.3 of the brightest.
FAINTEST = 0.2
# Height in full scales up to which that of a single clipped glint is trusted.
TALL = 2.5
# What lies around a glint is not brighter than the iris by more than LIT steps from pupil to iris, except where the
# glint is near the sclera. There it is still SHINING times as high: 19 such glints of rendered eyes are above 3.4, and
# 110 highlights of skin and lid margins below 1.8.
LIT, SHINING = 0.9, 2.5

_PIXEL = 1.0 / 12.0  # variance of a pixel; without it a spot of one row of pixels would be a line


def classify_spots(
    spots: Spots,
    fit: SpotFit,
    prepared: Prepared,
    step_dn: float,
    blur_px: float,
    iris_dn: float,
    settings: ExtractionSettings,
    large: Sequence[Patch] = (),
) -> tuple[tuple[GlintResult, ...], tuple[GlintResult, ...]]:
    """Divide spots into (accepted, rejected), brightest first; spots of `large` patches are part of those."""
    lit_dn = iris_dn + LIT * step_dn
    accepted: list[GlintResult] = [patch.glint for patch in large]
    rejected: list[GlintResult] = []
    looks = _Look.of_all(spots, fit)
    for i in np.argsort(-fit.amplitude_dn, kind="stable").tolist():
        look = looks[i]
        if any(_in_patch(patch, spots.xy_px[i]) for patch in large):
            continue
        reason = _objection(look, fit, i, prepared, step_dn, blur_px, lit_dn)
        result = GlintResult(
            status=Status.OK if reason is None else Status.REJECTED,
            reason=reason,
            xy_px=frozen(fit.xy_px[i]) if look.converged else frozen(spots.xy_px[i]),
            covariance=frozen(fit.covariance[i]) if look.converged else None,
            amplitude=look.height / DN,
            sigma_px=math.sqrt(look.wide * look.narrow),
            saturated=bool(fit.clipped[i] > 0),
        )
        (accepted if reason is None else rejected).append(result)
    faint = "much fainter than the brightest glint, as highlights of skin and lid margins are"
    least = FAINTEST * _height([glint.amplitude for glint in accepted])
    kept = len(large)  # the height of a large patch is not known, only where it is cut
    bright = accepted[:kept] + [glint for glint in accepted[kept:] if glint.amplitude >= least]
    rejected += [
        replace(glint, status=Status.REJECTED, reason=faint) for glint in accepted[kept:] if glint.amplitude < least
    ]
    accepted = bright
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


def _height(amplitudes: list[float]) -> float:
    """Height of the brightest glint, as far as it is known.

    The fitted height of a strongly clipped glint may be many times too large. So it counts as TALL only, unless the
    next one is higher than that.
    """
    first, second = [0.0, 0.0, *sorted(amplitudes)][:-3:-1]
    return max(min(first, TALL), second)


def _in_patch(patch: Patch, xy: Floats) -> bool:
    """Whether a bright pixel belongs to a large glint."""
    height, width = patch.pixels.shape
    column, row = (int(v) for v in np.rint(xy))
    return 0 <= row < height and 0 <= column < width and bool(patch.pixels[row, column])


@dataclass(frozen=True, slots=True)
class _Look:
    """Appearance of a fitted spot.

    It holds sigma across and along, height and residual in DN, the distance from the bright pixel, and the standard
    deviations of the bright patch across and along.
    """

    converged: bool
    narrow: float
    wide: float
    height: float
    residual: float
    moved: float
    short: float
    long: float

    @staticmethod
    def of_all(spots: Spots, fit: SpotFit) -> list[_Look]:
        gap = fit.xy_px - spots.xy_px
        (xx, xy), (_, yy) = fit.moments_px2.transpose(1, 2, 0)
        mean, apart = 0.5 * (xx + yy) + _PIXEL, np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        columns = (
            fit.converged, fit.sigma_px.min(axis=1), fit.sigma_px.max(axis=1), fit.amplitude_dn, fit.residual_dn,
            np.sqrt((gap * gap).sum(axis=1)), np.sqrt(np.maximum(mean - apart, 0.0)), np.sqrt(mean + apart),
        )  # fmt: skip
        return [_Look(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


def _objection(
    look: _Look, fit: SpotFit, i: int, prepared: Prepared, step_dn: float, blur_px: float, lit_dn: float
) -> str | None:
    """Reason why spot i is not a glint, or None."""
    if not look.converged:
        return "the spot's fit did not converge"
    if look.moved > max(2.5, 2.0 * look.wide):
        return f"no spot: the fit moved {look.moved:.1f} px from the bright pixel"
    if look.wide < 0.5 * optics_sigma(blur_px):
        return f"sharper than the optics (sigma {look.wide:.1f} px): a bad pixel"
    ratio, fitted = look.long / look.short, math.sqrt((look.wide**2 + _PIXEL) / (look.narrow**2 + _PIXEL))
    if ratio > LONG or ratio * fitted > LONG_TWICE:
        return f"elongated {max(ratio, fitted):.1f} : 1, as reflections off the sclera and wet lid margins are"
    wide = max(look.wide, look.long)
    if wide > widest(blur_px):
        return f"too wide for a glint: sigma {wide:.1f} px"
    if look.height < max(5.0 * prepared.noise_dn, 0.4 * step_dn):
        return "too faint for a glint"
    beside = _ring(prepared.linear, fit.xy_px, fit.sigma_px.max(axis=1), fit.converged, i)
    if beside[1] > max(lit_dn, look.height / SHINING):
        return "before something much brighter than the iris, as highlights of skin are"
    if wide > 2.5 and not _outshines(fit, i, beside):
        return "no brighter than what lies beside it, as a corner of sclera between lid and iris is"
    if look.residual > max(0.3 * min(look.height, DN), 3.0 * prepared.noise_dn):
        return "no spot: the bright patch is not bell-shaped"
    return None


@twin
def _ring(linear: Image, xy: Floats, wide: Floats, converged: Bools, i: int) -> tuple[int, float, float]:
    """Number, median and 97 % quantile of the levels in a ring around spot i, without other spots.

    The spots are at xy (n, 2) and have sigma `wide` (n,). The levels are NaN where there is no pixel.
    """
    x, y = xy[i]
    reach = 3.5 * wide[i] + 1.0
    x0, x1 = max(0, math.floor(x - reach)), min(linear.shape[1], math.ceil(x + reach) + 1)
    y0, y1 = max(0, math.floor(y - reach)), min(linear.shape[0], math.ceil(y + reach) + 1)
    columns, rows = np.arange(x0, x1), np.arange(y0, y1)[:, None]
    ring = (columns - x) ** 2 + (rows - y) ** 2 > (2.2 * wide[i]) ** 2
    apart2 = ((xy - xy[i]) ** 2).sum(axis=1)
    near = converged & (apart2 < (1.5 * reach + 3.0 * wide + 1.0) ** 2) & (np.arange(wide.size) != i)
    for k in np.flatnonzero(near):
        ring &= (columns - xy[k, 0]) ** 2 + (rows - xy[k, 1]) ** 2 > (3.0 * wide[k]) ** 2
    levels = linear[y0:y1, x0:x1][ring]
    return levels.size, median(levels), quantile(levels, 0.97)


def _outshines(fit: SpotFit, i: int, beside: tuple[int, float, float]) -> bool:
    """Whether a spot's peak is above the brightest surroundings (without other spots) by half its own height.

    This test is for wide spots only, because a narrow spot cannot be anything but a glint.
    """
    count, _, brightest = beside
    if count < 8:
        return True
    height = min(float(fit.amplitude_dn[i]), DN)
    return float(fit.background_dn[i]) + height - brightest > 0.5 * height
