"""Fallback search after no pupil was accepted: every candidate, and boundaries with a stretch left out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from ...geometry.ellipse import Ellipse, iou
from ..preprocessing import Prepared
from ..settings import ExtractionSettings
from .candidates import find_candidates
from .consensus import BoundaryFit, boundaries_without_stretch
from .edges import edge_noise_px
from .scoring import pupil_of
from .search import Found, boundary_about

# The best of several wrong candidates looks better than one wrong candidate does, so more confidence is asked of it.
FALLBACK_CONFIDENCE = 0.8
LEAST_SUPPORT = 0.4
LARGEST_GAP = 0.56  # with an arc of less than 160 deg, noise decides where the opposite side lies
MOST_SPREAD = 0.8  # of the levels inside, in steps; more means lids and lashes inside
UNCERTAIN = 0.015  # largest standard deviation of the boundary over b; an arc that also fits a lid margin exceeds it
CANDIDATES = 3  # of each search


def fallback_search(work: Prepared, refused: Found, settings: ExtractionSettings) -> Found | None:
    """Find the most likely boundary among all candidates, judged by its edges alone; None if none is likely enough.

    A lid that crosses the pupil gives the dark region a straight side, so an ellipse through its whole outline is
    rejected. A lid shadow or lashes that touch the pupil merge with it into one region. The fallback therefore tries
    the candidates of both searches (with and without dark lines), each with its whole outline and without the stretch
    that lies inside the ellipse through the rest. A boundary that contains the rejected one, or that has a dark core,
    is an iris.
    """
    choice = settings.model_copy(update={"method": "fast", "min_confidence": FALLBACK_CONFIDENCE})
    best: Found | None = None
    most = 0.0
    for found in _boundaries(work, settings):
        if (
            found.boundary.support < LEAST_SUPPORT
            or found.boundary.gap > LARGEST_GAP
            or _holds(found.boundary, refused.boundary)
        ):
            continue
        pupil = pupil_of(found, None, choice)
        good = pupil.goodness
        if good is None or good.spread > MOST_SPREAD:
            continue
        if good.boundary_sd_px > UNCERTAIN * float(found.boundary.ellipse.semi_axes_px[1]):
            continue
        if pupil.confidence > most and not found.has_core:
            best, most = found, pupil.confidence
    return best


def _holds(outer: BoundaryFit, inner: BoundaryFit) -> bool:
    """Whether `inner` lies inside `outer` and has less than half its area."""
    apart = math.dist(outer.ellipse.centre_px, inner.ellipse.centre_px)
    return 2.0 * inner.ellipse.area_px2 < outer.ellipse.area_px2 and apart < 0.7 * float(outer.ellipse.semi_axes_px[1])


def _boundaries(work: Prepared, settings: ExtractionSettings) -> Iterator[Found]:
    """Distinct boundaries of all candidates."""
    tried: list[Ellipse] = []
    seen: list[BoundaryFit] = []
    for without_lines in (False, True):
        for candidate in find_candidates(work, settings, CANDIDATES, without_lines=without_lines):
            if any(iou(candidate.ellipse, one) > 0.95 for one in tried):
                continue
            tried.append(candidate.ellipse)
            found = boundary_about(work, candidate, settings)
            if isinstance(found, str):
                continue
            expected = edge_noise_px(
                candidate.step_dn,
                noise_dn=work.noise_dn,
                sigma_filter=found.edges.filter_px,
                sigma_total=found.edges.sigma_px,
            )
            for boundary in (
                found.boundary,
                *boundaries_without_stretch(found.edges, found.boundary, settings, expected),
            ):
                if all(iou(boundary.ellipse, one.ellipse) < 0.99 for one in seen):
                    seen.append(boundary)
                    yield replace(found, boundary=boundary)
