"""Another look where the first answer was none: every candidate, with and without dark lines, and cut rims."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from ...geometry.ellipse import Ellipse, iou
from ..preprocessing import Prepared
from ..settings import ExtractionSettings
from .candidates import find_candidates
from .consensus import RimFit, rims_without_stretch
from .edges import edge_noise_px
from .scoring import pupil_of
from .search import Found, rim_about

SURE = 0.8  # confidence asked of the best of many: the likeliest of several wrong ones looks better than any one does
LEAST_SUPPORT = 0.4
LARGEST_GAP = 0.56  # an arc of less than 160 deg leaves the opposite side to the noise
MOST_SPREAD = 0.8  # of the levels inside, in steps: lids and lashes in what would be the pupil
UNCERTAIN = 0.015  # standard deviation of the rim over b: an arc that fits a lid's margin as well is less certain
CANDIDATES = 3  # each way


def second_look(work: Prepared, refused: Found, settings: ExtractionSettings) -> Found | None:
    """The likeliest rim of all candidates, by the edges alone; None where none is likely enough.

    A lid that crosses the pupil gives its blob a straight side, and an ellipse through all of its outline is refused;
    a lid's shadow or lashes that touch it make it one blob with them. So the rims looked at are those of the candidates
    of both searches, as they are and without the stretch of outline that lies inside the ellipse through the rest. What
    holds the rim that was refused, or has a dark core, is an iris.
    """
    choice = settings.model_copy(update={"method": "fast", "min_confidence": SURE})
    best: Found | None = None
    most = 0.0
    for found in _rims(work, settings):
        if found.rim.support < LEAST_SUPPORT or found.rim.gap > LARGEST_GAP or _holds(found.rim, refused.rim):
            continue
        pupil = pupil_of(found, None, choice)
        good = pupil.goodness
        if good is None or good.spread > MOST_SPREAD:
            continue
        if good.rim_sd_px > UNCERTAIN * float(found.rim.ellipse.semi_axes_px[1]):
            continue
        if pupil.confidence > most and not found.has_core:
            best, most = found, pupil.confidence
    return best


def _holds(outer: RimFit, inner: RimFit) -> bool:
    """Whether a rim of less than half the area lies inside."""
    apart = math.dist(outer.ellipse.centre_px, inner.ellipse.centre_px)
    return 2.0 * inner.ellipse.area_px2 < outer.ellipse.area_px2 and apart < 0.7 * float(outer.ellipse.semi_axes_px[1])


def _rims(work: Prepared, settings: ExtractionSettings) -> Iterator[Found]:
    """Different rims of all candidates."""
    tried: list[Ellipse] = []
    seen: list[RimFit] = []
    for without_lines in (False, True):
        for candidate in find_candidates(work, settings, CANDIDATES, without_lines=without_lines):
            if any(iou(candidate.ellipse, one) > 0.95 for one in tried):
                continue
            tried.append(candidate.ellipse)
            found = rim_about(work, candidate, settings)
            if isinstance(found, str):
                continue
            expected = edge_noise_px(candidate.step_dn, work.noise_dn, found.edges.filter_px, found.edges.sigma_px)
            for rim in (found.rim, *rims_without_stretch(found.edges, found.rim, settings, expected)):
                if all(iou(rim.ellipse, one.ellipse) < 0.99 for one in seen):
                    seen.append(rim)
                    yield replace(found, rim=rim)
