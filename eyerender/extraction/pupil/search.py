"""Search for the pupil boundary: hypotheses in the order of their cost, until one is certain.

A hypothesis is a dark blob with the boundary through the edges around it. Its steps are

1. `find_candidates`: dark elliptical blobs
2. `find_boundary`: glints inpainted, edges detected, an ellipse fitted to them
3. `score`: calibrated confidence of the boundary, from its edges
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ...optics.ellipse import Ellipse, iou
from ..preprocessing import Prepared, invert
from ..result import PupilResult
from ..settings import LEAST_PX, Shape
from .boundary import PupilCandidate, enlarged, find_boundary
from .candidates import Candidate, candidate_at, find_candidates, find_inside, levels_about, lies_inside
from .glare import around
from .scoring import ScoredCandidate, score

SURE = 0.9  # a hypothesis of this confidence ends the search
LATE_CONFIDENCE = 0.5  # least confidence of a hypothesis of a later pass
LARGE_PX = 14.0  # pupils from this semi-axis on are found at a quarter of the scale, in a quarter of the time
SCALES = (2, 4)  # pixels of the image per pixel of the reduced images
SMOOTH_PX = 1.2  # blur of the smoothed image: that of compression, and little for a pupil of 7 px
# Seen share of an outline from which on it may be the pupil in an iris, and its largest share of the iris' area (that
# of a pupil of 8.5 mm).
SEEN, WIDEST = 1 / 3, 0.5
LEAST_SIDE = 32  # px of a reduced image
FEW = 9  # thresholds of the first pass; the edges decide, and later passes use all
USUAL_PX = 7.0  # smaller pupils are looked for at full resolution and last; lashes and shadows are as small
# Between two frames a pupil moves by up to a few of its own sizes (a saccade of 500 deg/s covers 4 mm in 1/30 s). Its
# size changes by less than a third.
MOVED, GROWN, SPARE_PX = 4.0, 0.7, 8.0
SAME = 0.95  # candidates of at least this overlap have the same boundary
LIKELY = 0.5  # share of the best candidate's score below which no later look starts from a candidate
# Work after which a search ends: boundaries, and the pixels about each in units of this many. That is about 0.1 s on a
# quiet core. In 1,697 development images, 2 of the right boundaries came after more than 50, none after 60.
MOST_WORK, PIXELS_OF_UNIT = 60.0, 40_000.0
# A pupil has more than a fifth of the iris' diameter (2.4 of 12 mm as the cornea shows it) and lies in its middle.
LEAST_OF_IRIS, CENTRED = 0.2, 0.35
WHITE = 0.9  # share of the clip level from which on a disc is a reflection
FLAT = 0.8  # ratio of axes below which a blob may be a pupil that lids cut


def find_pupil(
    prepared: Prepared, shape: Shape, polarity: Literal["auto", "dark", "bright"], prior: PupilResult | None
) -> ScoredCandidate | PupilResult:
    """Return the most likely boundary of a dark or a bright pupil, or the reason why there is none.

    If the middle of a dark pupil is bright, it may be an iris with a bright pupil. `prior`, the pupil of the previous
    frame, only decides where the search starts.
    """
    before = None if prior is None else prior.ellipse
    if polarity == "bright":
        return _search(invert(prepared), shape, before)
    dark = _search(prepared, shape, None if prior is not None and prior.bright else before)
    if polarity == "dark" or not isinstance(dark, ScoredCandidate) or dark.candidate.core_dn >= 0.0:
        return dark
    bright = _search(invert(prepared), shape, before)
    return bright if isinstance(bright, ScoredCandidate) and _is_bright_pupil(prepared, bright, dark) else dark


def _is_bright_pupil(prepared: Prepared, bright: ScoredCandidate, dark: ScoredCandidate) -> bool:
    """Return whether a bright disc in a dark one is a pupil in its iris, and not a lamp's reflection in a pupil.

    Reflections are smaller than pupils, anywhere in the dark disc, and as bright as the sensor can tell.
    """
    iris, pupil = dark.candidate.boundary.ellipse, bright.candidate.boundary.ellipse
    share = math.sqrt(pupil.area_px2 / iris.area_px2)
    apart = float(np.hypot(*(iris.centre_px - pupil.centre_px)))
    level, _ = levels_about(prepared.linear, pupil.numbers())
    fits = LEAST_OF_IRIS < share < 1.0 and apart < CENTRED * float(iris.semi_axes_px[1])
    return bright.confidence >= SURE and fits and level < WHITE * prepared.clip_dn


def _search(work: Prepared, shape: Shape, prior: Ellipse | None) -> ScoredCandidate | PupilResult:
    """Return the most likely boundary in an image with a dark pupil: a certain one near the prior, or the likeliest."""
    if prior is not None:
        for near in _near(work, shape, prior):
            if isinstance(near, PupilCandidate) and near.core_dn <= 0.0 and continues(prior, near.outline):
                scored = score(near)
                if scored.confidence >= SURE:
                    return scored
    return _likeliest(work, shape)


def continues(before: Ellipse, found: Ellipse) -> bool:
    """Return whether a pupil is where an eye may have turned it since the frame before, with about the same size."""
    apart = math.dist(before.centre_px, found.centre_px)
    near = apart < MOVED * float(before.semi_axes_px[0]) + SPARE_PX
    return near and GROWN**2 < found.area_px2 / before.area_px2 < GROWN**-2


@dataclass(slots=True)
class _Outlines:
    """What a search has found: boundaries to choose from, and outlines in pixels of the whole image."""

    choices: list[ScoredCandidate] = field(default_factory=list)  # boundaries that may be the answer
    # outlines with a darker middle, of an iris, or of a pupil with reflections near its rim
    cored: list[Ellipse] = field(default_factory=list)
    # outlines of which a part is seen, which may be the pupil in an iris
    seen: list[Ellipse] = field(default_factory=list)

    def add(self, scored: ScoredCandidate, late: bool) -> bool:
        """Add a boundary; return whether it is certain."""
        found, outline = scored.candidate, scored.candidate.outline
        if found.core_dn > 0.0:
            self.cored.append(outline)
        if found.boundary.support >= SEEN:
            self.seen.append(outline)
        has_core = self._has_core(outline)
        if scored.confidence >= (LATE_CONFIDENCE if late or has_core else 0.0):
            self.choices.append(scored)
        return scored.confidence >= SURE and not has_core

    def best(self) -> ScoredCandidate | None:
        """Return the likeliest boundary that is not an iris: one with a dark middle that has an outline itself."""
        for one in sorted(self.choices, key=lambda scored: -scored.confidence):
            outline = one.candidate.outline
            if not (self._has_core(outline) and any(lies_inside(other, outline, WIDEST) for other in self.seen)):
                return one
        return None

    def _has_core(self, outline: Ellipse) -> bool:
        return any(_same(outline, one) for one in self.cored)  # a reduced image shows less of the middle


def _likeliest(work: Prepared, shape: Shape) -> ScoredCandidate | PupilResult:
    """Return the first certain boundary, else the likeliest one; of later passes it needs `LATE_CONFIDENCE`."""
    outlines, reason, spent = _Outlines(), "", 0.0
    for late, found in hypotheses(work, shape):
        spent += 1.0
        if spent > MOST_WORK:
            break
        if isinstance(found, str):
            reason = reason or found
            continue
        spent += found.reach_px**2 / PIXELS_OF_UNIT
        # A pupil in the enlarged image is as small as the blocks of compression, so its step must be twice as large.
        if found.candidate.step_dn < work.least_dn / min(found.image.scale, 1.0):
            reason = reason or "the dark region is as faint as what compression changes"
            continue
        scored = score(found)
        if outlines.add(scored, late):
            return _at_best_scale(work, scored, shape)
    best = outlines.best()
    if best is not None:
        return _at_best_scale(work, best, shape)
    if outlines.choices:
        return PupilResult.missing("edges", "only an iris was found, and no certain pupil in it")
    if not reason:
        return PupilResult.missing("coarse search", "no dark round region stands out of its surroundings")
    return PupilResult.missing("edges", reason)


def hypotheses(work: Prepared, shape: Shape) -> Iterator[tuple[bool, PupilCandidate | str]]:
    """Yield boundaries, or why a candidate has none, and whether they come from a later pass.

    1. the best candidate at a quarter of the scale, in the image and in the smoothed image
    2. candidates of a less reduced image, and those inside each that has a dark core
    3. the same in the smoothed image and at half and a quarter of the scale, where noise, texture, block compression
       and sharpening are finer than the edges, and the spots of a ring light small
    4. pupils that lids cut: circles as wide as flat blobs
    5. pupils smaller than USUAL_PX, in the image enlarged twice, where a glint leaves some of their edge

    A boundary is in pixels of the scale at which it was found.
    """
    whole: list[Candidate] = []
    soft: list[Candidate] = []
    yield from ((False, one) for one in _look(work, _large, shape, whole))
    smooth = work.smoothed(SMOOTH_PX)
    yield from ((True, one) for one in _look(smooth, _large, shape, soft))
    yield from ((False, one) for one in _look(work, find_candidates, shape, whole))
    yield from ((True, one) for one in _look(smooth, find_candidates, shape, soft))
    for scale in SCALES:
        if min(work.linear.shape) >= LEAST_SIDE * scale:
            reduced, limits, tried = work.rescaled(scale), _at_scale(shape, scale), list[Candidate]()
            for search in (_large, find_candidates):
                yield from ((True, one) for one in _look(reduced, search, limits, tried))
    yield from ((True, one) for one in _bounded(work, list(_rounder(whole, shape)), shape, whole))
    if shape.least_px < USUAL_PX:
        large, small = work.rescaled(0.5), _at_scale(replace(shape, most_px=2.0 * USUAL_PX), 0.5)
        yield from ((True, one) for one in _bounded(large, find_candidates(large, small), small, []))


def _look(
    image: Prepared, search: Callable[[Prepared, Shape], list[Candidate]], shape: Shape, tried: list[Candidate]
) -> Iterator[PupilCandidate | str]:
    """Yield boundaries around the candidates of a search for pupils of at least USUAL_PX."""
    usual = replace(shape, least_px=max(shape.least_px, min(USUAL_PX / image.scale, 0.5 * shape.most_px)))
    return _bounded(image, search(image, usual), shape, tried)


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


def _at_scale(shape: Shape, scale: float) -> Shape:
    return replace(shape, least_px=max(shape.least_px / scale, LEAST_PX), most_px=shape.most_px / scale)


def _at_best_scale(work: Prepared, scored: ScoredCandidate, shape: Shape) -> ScoredCandidate:
    """Refit a boundary of a reduced image, or a small one, to finer edges, if the result is as likely.

    Those are the edges of the whole image, or for pupils below USUAL_PX of the enlarged one.
    """
    scale = scored.candidate.image.scale
    coarse = scored if scored.candidate.image is work else scored.enlarged(work)
    ellipse = coarse.candidate.boundary.ellipse
    small = float(ellipse.semi_axes_px[1]) < USUAL_PX
    if scale <= (0.5 if small else 1.0):
        return coarse
    fine, limits = (work.rescaled(0.5), _at_scale(shape, 0.5)) if small else (work, shape)
    near = candidate_at(fine, enlarged(ellipse, 1.0 / fine.scale))
    found = "" if near is None else find_boundary(fine, near, limits)
    if isinstance(found, PupilCandidate):
        again = score(found)
        if again.confidence >= min(coarse.confidence, SURE):
            return again if fine is work else again.enlarged(work)
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
    columns, rows = around(prior.centre_px, MOVED * a + SPARE_PX, work.linear.shape)
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
