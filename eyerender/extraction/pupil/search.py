"""Search for the pupil boundary: hypotheses in the order of their cost, until one is certain.

A hypothesis is a dark blob with the boundary through the edges around it. Its steps are

1. `find_candidates`: dark elliptical blobs
2. `find_boundary`: glints inpainted, edges detected, an ellipse fitted to them
3. `score`: calibrated confidence of the boundary, from its edges
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ...optics.ellipse import Ellipse, iou
from ..preprocessing import Prepared, invert
from ..result import PupilResult
from ..settings import LEAST_PX, Shape
from .boundary import PupilCandidate, find_boundary
from .candidates import Candidate, candidate_at, find_candidates, find_inside
from .glare import around
from .scoring import ScoredCandidate, score

SURE = 0.9  # a hypothesis of this confidence ends the search
LATE_CONFIDENCE = 0.5  # least confidence of a hypothesis of a later pass
LARGE_PX = 14.0  # pupils from this semi-axis on are found at a quarter of the scale, in a quarter of the time
SCALES = (1, 2, 4)  # pixels of the image per pixel of the image searched
LEAST_SIDE = 32  # px of a reduced image
FEW = 9  # thresholds of the first pass; the edges decide, and later passes use all
USUAL_PX = 7.0  # smaller pupils are looked for at full resolution and last; lashes and shadows are as small
# Between two frames a pupil moves by up to a few of its own sizes (a saccade of 500 deg/s covers 4 mm in 1/30 s). Its
# size changes by less than a third.
MOVED, GROWN = 4.0, 0.7
SAME = 0.95  # candidates of at least this overlap have the same boundary
LIKELY = 0.5  # share of the best candidate's score below which no later look starts from a candidate
# Work after which a search ends: boundaries, and the pixels about each in units of this many. That is about 0.1 s on a
# quiet core. In 1,697 development images, 2 of the right boundaries came after more than 50, none after 60.
MOST_WORK, PIXELS_OF_UNIT = 60.0, 40_000.0
FLAT = 0.8  # ratio of axes below which a blob may be a pupil that lids cut


def find_pupil(
    prepared: Prepared, shape: Shape, polarity: Literal["auto", "dark", "bright"], prior: PupilResult | None
) -> ScoredCandidate | PupilResult:
    """Return the most likely boundary of a dark or a bright pupil, or the reason why there is none.

    If the middle of a dark pupil is bright, it may be an iris with a bright pupil.

    Args:
        prepared: the image.
        shape: accepted sizes and shapes.
        polarity: whether the pupil is darker or brighter than the iris; auto: the image decides.
        prior: the pupil of the previous frame, which only decides where the search starts.
    """
    before = None if prior is None else prior.ellipse
    if prior is not None and prior.bright and polarity == "auto":
        found = _search(invert(prepared), shape, before)
        if isinstance(found, ScoredCandidate) and found.confidence >= SURE:
            return found
    if polarity == "bright":
        return _search(invert(prepared), shape, before)
    dark = _search(prepared, shape, before)
    if polarity == "dark" or not isinstance(dark, ScoredCandidate) or dark.candidate.core_dn >= 0.0:
        return dark
    bright = _search(invert(prepared), shape, before)
    if not isinstance(bright, ScoredCandidate) or bright.confidence < SURE:
        return dark
    large, small = dark.candidate.boundary.ellipse, bright.candidate.boundary.ellipse
    apart = float(np.hypot(*(large.centre_px - small.centre_px)))
    return bright if small.area_px2 < large.area_px2 and apart < float(large.semi_axes_px[1]) else dark


def _search(work: Prepared, shape: Shape, prior: Ellipse | None) -> ScoredCandidate | PupilResult:
    """Return the most likely boundary in an image with a dark pupil.

    The first certain one ends the search. Otherwise the likeliest one of the first pass is returned, unless a later
    pass finds a likelier one of at least `LATE_CONFIDENCE`.
    """
    if prior is not None:
        for near in _near(work, shape, prior):
            if isinstance(near, PupilCandidate) and near.core_dn <= 0.0:
                scored = score(near)
                if scored.confidence >= SURE:
                    return scored
    return _likeliest(work, shape)


def _likeliest(work: Prepared, shape: Shape) -> ScoredCandidate | PupilResult:
    best: ScoredCandidate | None = None
    reason, spent = "", 0.0
    for late, found in hypotheses(work, shape):
        spent += 1.0
        if spent > MOST_WORK:
            break
        if isinstance(found, str):
            reason = reason or found
            continue
        spent += found.reach_px**2 / PIXELS_OF_UNIT
        scored = score(found)
        late |= found.core_dn > 0.0  # an iris, or a pupil with a reflection in it
        least = LATE_CONFIDENCE if late else 0.0
        if scored.confidence > (0.0 if best is None else best.confidence) and scored.confidence >= least:
            best = scored
        if scored.confidence >= SURE and not found.core_dn > 0.0:
            return _at_full_scale(work, scored, shape)
    if best is not None:
        return _at_full_scale(work, best, shape)
    if not reason:
        return PupilResult.missing("coarse search", "no dark round region stands out of its surroundings")
    return PupilResult.missing("edges", reason)


def hypotheses(work: Prepared, shape: Shape) -> Iterator[tuple[bool, PupilCandidate | str]]:
    """Yield boundaries, or why a candidate has none, and whether they come from a later pass.

    1. the best candidate at a quarter of the scale, then those of a less reduced image, and those inside each that has
       a dark core
    2. the same in the image at half and at a quarter of the scale, where texture, block compression and sharpening are
       finer than the edges, and the spots of a ring light small
    3. pupils that lids cut: circles as wide as flat blobs
    4. pupils smaller than USUAL_PX

    A boundary is in pixels of the scale at which it was found.
    """
    whole: list[Candidate] = []
    for image, limits in _pyramid(work, shape):
        tried = whole if image is work else []
        usual = replace(limits, least_px=max(limits.least_px, min(USUAL_PX / image.scale, 0.5 * limits.most_px)))
        for candidates in (_large, find_candidates):
            yield from ((image is not work, one) for one in _bounded(image, candidates(image, usual), limits, tried))
    yield from ((True, one) for one in _bounded(work, list(_rounder(whole, shape)), shape, whole))
    if shape.least_px < USUAL_PX:
        small = replace(shape, most_px=2.0 * USUAL_PX)
        yield from ((True, one) for one in _bounded(work, find_candidates(work, small), shape, whole))


def _bounded(
    work: Prepared, candidates: Sequence[Candidate], shape: Shape, tried: list[Candidate]
) -> Iterator[PupilCandidate | str]:
    """Yield boundaries around candidates that were not tried before, and inside those with a darker core."""
    for candidate in candidates:
        if any(_same(candidate.ellipse, one.ellipse) for one in tried):
            continue
        tried.append(candidate)
        found = find_boundary(work, candidate, shape)
        yield found
        if isinstance(found, PupilCandidate) and found.core_dn > 0.0:
            for inner in find_inside(work, found.inpainted, found.boundary.ellipse, shape):
                yield find_boundary(work, inner, shape)


def _pyramid(work: Prepared, shape: Shape) -> Iterator[tuple[Prepared, Shape]]:
    """Return the image at full, half and quarter scale, and the sizes to search for there."""
    for scale in SCALES:
        if min(work.linear.shape) >= LEAST_SIDE * scale:
            least = max(shape.least_px / scale, LEAST_PX)
            yield work.reduced(scale), replace(shape, least_px=least, most_px=shape.most_px / scale)


def _at_full_scale(work: Prepared, scored: ScoredCandidate, shape: Shape) -> ScoredCandidate:
    """Refit a boundary of a reduced image to the edges of the whole image, if the result is as likely."""
    if scored.candidate.image is work:
        return scored
    coarse = scored.enlarged(work)
    near = candidate_at(work, coarse.candidate.boundary.ellipse)
    fine = "" if near is None else find_boundary(work, near, shape)
    if isinstance(fine, PupilCandidate):
        again = score(fine)
        if again.confidence >= min(coarse.confidence, SURE):
            return again
    return coarse


def _large(work: Prepared, shape: Shape) -> list[Candidate]:
    """Return the best candidate of at least LARGE_PX, with the levels of the image at full scale."""
    if not shape.least_px < LARGE_PX < 0.5 * shape.most_px:
        return []
    found = find_candidates(work, replace(shape, least_px=LARGE_PX), 1, levels=FEW)
    places = (candidate_at(work, one.ellipse) for one in found)
    return [replace(one, rough=True) for one in places if one is not None]


def _near(work: Prepared, shape: Shape, prior: Ellipse) -> Iterator[PupilCandidate | str]:
    """Yield boundaries around the previous pupil, then those of dark blobs of its size in the neighbourhood."""
    candidate = candidate_at(work, prior)
    if candidate is not None:
        yield find_boundary(work, candidate, shape)
    a, b = prior.semi_axes_px.tolist()
    columns, rows = around(prior.centre_px, MOVED * a + 8.0, work.linear.shape)
    crop = replace(work, linear=np.ascontiguousarray(work.linear[rows, columns]))
    if min(crop.linear.shape) < 16:
        return
    alike = replace(shape, least_px=max(shape.least_px, GROWN * b), most_px=min(shape.most_px, a / GROWN))
    for found in find_candidates(crop, alike):
        yield find_boundary(work, replace(found, ellipse=found.ellipse.shifted((columns.start, rows.start))), shape)


def _same(first: Ellipse, second: Ellipse) -> bool:
    """Return whether two ellipses overlap by SAME; a quick test of size and position excludes most pairs."""
    ratio = first.area_px2 / second.area_px2
    apart = float(np.abs(first.centre_px - second.centre_px).max())
    near = apart < (1.0 - SAME) * math.pi * float(first.semi_axes_px[0])
    return near and SAME <= ratio <= 1.0 / SAME and iou(first, second) >= SAME


def _rounder(candidates: Sequence[Candidate], shape: Shape) -> Iterator[Candidate]:
    """Compute circles as wide as each likely flat blob, about its middle and to either side of it.

    Half a disc of radius r has the second moments of an ellipse of semi-axes r and 0.53 r, 0.42 r from the middle of
    the disc: 0.9 of the difference. If two lids cut a disc equally, its middle is that of the blob.
    """
    least = LIKELY * max((one.score for one in candidates), default=0.0)
    for candidate in candidates:
        a, b = candidate.ellipse.semi_axes_px.tolist()
        if candidate.score < least or b > FLAT * a or a > shape.most_px:
            continue
        across = np.array([-math.sin(candidate.ellipse.angle_rad), math.cos(candidate.ellipse.angle_rad)])
        for side in (0.0, 1.0, -1.0):
            centre = candidate.ellipse.centre_px + side * 0.9 * (a - b) * across
            yield replace(candidate, ellipse=Ellipse(centre, np.array([a, a]), 0.0))
