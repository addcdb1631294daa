"""Search for the pupil boundary: hypotheses in the order of their cost, until one is certain.

A hypothesis is a candidate with the boundary through the edges around it. Its certainty is the calibrated confidence of
the boundary from its edges alone (`scoring`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from ...arrays import Bools
from ...geometry.ellipse import Ellipse, iou
from ..preprocessing import Prepared, as_image
from ..result import Goodness, PupilResult
from ..settings import Shape
from .candidates import Candidate, Interior, candidate_at, find_candidates, find_inside, inspect_interior
from .consensus import BoundaryFit, fit_boundary
from .edge_model import EdgeModel
from .edges import EdgePoints, edge_noise_px, filter_sigma, find_edges
from .glare import Cleared, without_glare
from .places import holding
from .scoring import confidence, goodness_of

SURE = 0.9  # a hypothesis of this confidence ends the search
LATE_CONFIDENCE = 0.5  # least confidence of a hypothesis of a later look
LARGE_PX = 14.0  # pupils from this semi-axis on are found at a quarter of the scale, in a quarter of the time
FEW = 9  # thresholds of the first look; the edges decide, and the later looks use all
USUAL_PX = 7.0  # smaller pupils are looked for at full resolution and last; lashes and shadows are as small
# Between two frames a pupil moves by up to a few of its own sizes (a saccade of 500 deg/s covers 4 mm in 1/30 s). Its
# size changes by less than a third.
MOVED, GROWN = 4.0, 0.7
ROUGH = 0.8  # overlap with its boundary below which a rough candidate's edges are found again, about the boundary
SAME = 0.95  # candidates of at least this overlap have the same boundary
LIKELY = 0.5  # share of the best candidate's score below which no later look starts from a candidate
# Work after which a search ends: boundaries, and the pixels about each in units of this many. That is about 0.1 s on a
# quiet core. In 1,697 development images, 2 of the right boundaries came after more than 50, none after 60.
MOST_WORK, PIXELS_OF_UNIT = 60.0, 40_000.0
_TWICE = np.array([2.0, 2.0, 2.0, 2.0, 1.0])
FLAT = 0.8  # ratio of axes below which a blob may be a pupil that lids cut


@dataclass(frozen=True, eq=False)
class Found:
    """A candidate, the edge points around it, and the boundary through them; derived values are computed on demand.

    `cleared` is the image without glints near the candidate.
    """

    image: Prepared
    cleared: Cleared
    candidate: Candidate
    edges: EdgePoints
    boundary: BoundaryFit

    @cached_property
    def model(self) -> EdgeModel:
        """Pixel model, as far as the edges determine it."""
        candidate = self.candidate
        sigma = math.sqrt(max(self.edges.sigma_px**2 - self.edges.filter_px**2, 0.25))
        outer = np.array([candidate.inside_dn + candidate.step_dn])
        return EdgeModel(ellipse=self.boundary.ellipse, inner_dn=candidate.inside_dn, outer=outer, sigma_px=sigma)

    @cached_property
    def interior(self) -> Interior:
        """Statistics of the pixels inside the boundary."""
        return self.inside(self.boundary.ellipse, self.model.sigma_px)

    def inside(self, ellipse: Ellipse, blur_px: float) -> Interior:
        """Statistics of the pixels inside an ellipse about the candidate."""
        return inspect_interior(self.cleared, ellipse, blur_px, self.image.noise_dn)

    @cached_property
    def sectors(self) -> Bools:
        """Sectors (SECTORS,) with an edge point, and gaps of up to two sectors between them."""
        hit = holding(self.boundary.ellipse.numbers(), self.edges.points_px[self.boundary.inliers])
        grown = hit | np.roll(hit, 1) | np.roll(hit, -1)
        return np.asarray(grown & np.roll(grown, 1) & np.roll(grown, -1) | hit)

    @cached_property
    def goodness(self) -> Goodness:
        """How well the boundary explains the image, from its edges."""
        return goodness_of(self, None)

    @cached_property
    def confidence(self) -> float:
        """Probability that this is the pupil, from the edges alone."""
        return confidence(self.boundary.ellipse, self.goodness, "fast")

    @property
    def reach_px(self) -> float:
        """Side of the square of pixels about the candidate in which edges were looked for."""
        return 2.8 * float(self.candidate.ellipse.semi_axes_px[0]) + 16.0

    @property
    def core_dn(self) -> float:
        """How much darker the middle is than the outer part, 0 where that is not significant.

        It is positive inside the outline of an iris, and negative if the pupil in it is bright.
        """
        inside = self.interior
        limit = max(4.0 * inside.error_dn, 0.15 * self.candidate.step_dn)
        return inside.darker_dn if abs(inside.darker_dn) > limit else 0.0


def search(work: Prepared, shape: Shape, prior: Ellipse | None = None) -> Found | PupilResult:
    """Find the most likely boundary.

    The first one that is certain ends the search. Otherwise the likeliest one of the first look is taken, unless a
    later look finds one of `LATE_CONFIDENCE` that is likelier.

    Args:
        work: the image, in which the pupil is dark.
        shape: accepted sizes and shapes.
        prior: where the pupil was before. It only decides where is looked first.
    """
    if prior is not None:
        for near in _near(work, shape, prior):
            if isinstance(near, Found) and near.core_dn <= 0.0 and near.confidence >= SURE:
                return near
    return _likeliest(hypotheses(work, shape))


def _likeliest(looks: Iterator[tuple[bool, Found | str]]) -> Found | PupilResult:
    best: Found | None = None
    reason = ""
    spent = 0.0
    for late, found in looks:
        spent += 1.0
        if spent > MOST_WORK:
            break
        if isinstance(found, str):
            reason = reason or found
            continue
        spent += found.reach_px**2 / PIXELS_OF_UNIT
        if found.core_dn > 0.0:
            late = True  # an iris, or a pupil with a reflection in it
        elif found.confidence >= SURE:
            return found
        if found.confidence > (0.0 if best is None else best.confidence) and not (
            late and found.confidence < LATE_CONFIDENCE
        ):
            best = found
    if best is not None:
        return best
    if not reason:
        return PupilResult.missing("coarse search", "no dark round region stands out of its surroundings")
    return PupilResult.missing("edges", reason)


def hypotheses(work: Prepared, shape: Shape) -> Iterator[tuple[bool, Found | str]]:
    """Boundaries, or why a candidate has none, and whether they are of a later look.

    1. the best candidate at a quarter of the scale, then those of a less reduced image, and those inside each that has
       a dark core
    2. pupils that lids cut: circles as wide as flat blobs
    3. the image at half scale, where block compression and texture are finer than the edges
    4. pupils smaller than USUAL_PX
    """
    usual = replace(shape, least_px=max(shape.least_px, min(USUAL_PX, 0.5 * shape.most_px)))
    tried: list[Candidate] = []

    def bounded(candidates: Sequence[Candidate]) -> Iterator[Found | str]:
        for candidate in candidates:
            if not any(_same(candidate.ellipse, one.ellipse) for one in tried):
                tried.append(candidate)
                yield from _with_inner(work, candidate, shape)

    yield from ((False, one) for one in bounded(_large(work, shape)))
    yield from ((False, one) for one in bounded(find_candidates(work, usual)))
    yield from ((True, one) for one in bounded(list(_rounder(_best(tried), shape))))
    yield from ((True, one) for one in _at_half_scale(work, shape))
    if shape.least_px < usual.least_px:
        small = replace(shape, most_px=2.0 * usual.least_px)
        yield from ((True, one) for one in bounded(find_candidates(work, small)))


def _large(work: Prepared, shape: Shape) -> list[Candidate]:
    """The best candidate of at least LARGE_PX, with the levels of the image at full scale."""
    if not shape.least_px < LARGE_PX < 0.5 * shape.most_px:
        return []
    found = find_candidates(work, replace(shape, least_px=LARGE_PX), 1, levels=FEW)
    places = (candidate_at(work, one.ellipse) for one in found)
    return [replace(one, rough=True) for one in places if one is not None]


def _near(work: Prepared, shape: Shape, prior: Ellipse) -> Iterator[Found | str]:
    """Boundaries where the pupil was before, then those of dark blobs of its size around there."""
    candidate = candidate_at(work, prior)
    if candidate is not None:
        yield boundary_about(work, candidate, shape)
    a, b = prior.semi_axes_px.tolist()
    (cx, cy), (height, width) = prior.centre_px.tolist(), work.linear.shape
    reach = MOVED * a + 8.0
    x0, x1 = max(0, math.floor(cx - reach)), min(width, math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(height, math.ceil(cy + reach) + 1)
    if min(x1 - x0, y1 - y0) < 16:
        return
    alike = replace(shape, least_px=max(shape.least_px, GROWN * b), most_px=min(shape.most_px, a / GROWN))
    crop = replace(work, linear=np.ascontiguousarray(work.linear[y0:y1, x0:x1]))
    for found in find_candidates(crop, alike):
        yield boundary_about(work, replace(found, ellipse=found.ellipse.shifted((x0, y0))), shape)


def _with_inner(work: Prepared, candidate: Candidate, shape: Shape) -> Iterator[Found | str]:
    """The boundary about a candidate, and those inside it if it has a darker core."""
    found = boundary_about(work, candidate, shape)
    yield found
    if isinstance(found, Found) and found.core_dn > 0.0:
        for inner in find_inside(work, found.cleared, found.boundary.ellipse, shape):
            yield boundary_about(work, inner, shape)


def _same(first: Ellipse, second: Ellipse) -> bool:
    """Whether two ellipses overlap by SAME; most pairs differ too much in size or place for a closer look."""
    ratio = first.area_px2 / second.area_px2
    apart = float(np.abs(first.centre_px - second.centre_px).max())
    near = apart < (1.0 - SAME) * math.pi * float(first.semi_axes_px[0])
    return near and SAME <= ratio <= 1.0 / SAME and iou(first, second) >= SAME


def _best(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that are not much worse than the best of them."""
    least = LIKELY * max((one.score for one in candidates), default=0.0)
    return [one for one in candidates if one.score >= least]


def _rounder(candidates: Sequence[Candidate], shape: Shape) -> Iterator[Candidate]:
    """Circles as wide as each flat blob, about its middle and to either side of it.

    Half a disc of radius r has the second moments of an ellipse of semi-axes r and 0.53 r, 0.42 r from the middle of
    the disc: 0.9 of the difference. A disc that two lids cut alike has its middle in the middle of the blob.
    """
    for candidate in candidates:
        a, b = candidate.ellipse.semi_axes_px.tolist()
        if b > FLAT * a or a > shape.most_px:
            continue
        across = np.array([-math.sin(candidate.ellipse.angle_rad), math.cos(candidate.ellipse.angle_rad)])
        for side in (0.0, 1.0, -1.0):
            centre = candidate.ellipse.centre_px + side * 0.9 * (a - b) * across
            yield replace(candidate, ellipse=Ellipse(centre, np.array([a, a]), 0.0))


def _at_half_scale(work: Prepared, shape: Shape) -> Iterator[Found | str]:
    """Boundaries in the image at half scale, in the pixels of the whole image."""
    height, width = work.linear.shape
    if min(height, width) < 64:
        return
    half = as_image(cv2.resize(work.linear[: height // 2 * 2, : width // 2 * 2], None, fx=0.5, fy=0.5,
                               interpolation=cv2.INTER_AREA))  # fmt: skip
    small = replace(work, linear=half, noise_dn=max(0.5 * work.noise_dn, 1e-3))
    limits = replace(shape, least_px=max(0.5 * shape.least_px, 3.0), most_px=0.5 * shape.most_px)
    for candidate in find_candidates(small, replace(limits, least_px=max(limits.least_px, 0.5 * USUAL_PX))):
        for found in _with_inner(small, candidate, limits):
            yield found if isinstance(found, str) else _doubled(found, work)


def _doubled(found: Found, work: Prepared) -> Found:
    """A boundary of the image at half scale in the pixels of the whole one."""
    edges, boundary, candidate = found.edges, found.boundary, found.candidate
    return Found(
        work,
        found.cleared.doubled(work.linear),
        replace(candidate, ellipse=_double(candidate.ellipse)),
        replace(
            edges,
            points_px=2.0 * edges.points_px + 0.5,
            sigma_px=2.0 * edges.sigma_px,
            filter_px=2.0 * edges.filter_px,
        ),
        replace(
            boundary,
            ellipse=_double(boundary.ellipse),
            points_px=2.0 * boundary.points_px + 0.5,
            residual_px=2.0 * boundary.residual_px,
            covariance=boundary.covariance * np.outer(_TWICE, _TWICE),
        ),
    )


def _double(ellipse: Ellipse) -> Ellipse:
    return Ellipse(2.0 * ellipse.centre_px + 0.5, 2.0 * ellipse.semi_axes_px, ellipse.angle_rad)


def boundary_about(work: Prepared, candidate: Candidate, shape: Shape) -> Found | str:
    """Find the boundary around a candidate, or give the reason why there is none."""
    cleared = Cleared(work.linear)
    if not work.inverted:
        cleared = without_glare(work.linear, candidate.ellipse, candidate.inside_dn, candidate.step_dn, work.noise_dn)
    b = float(candidate.ellipse.semi_axes_px[1])
    sigma = filter_sigma(candidate.step_dn, work.noise_dn, b)
    edges = find_edges(cleared, candidate, work.noise_dn, sigma, band=0.4)
    blur = math.sqrt(max(edges.sigma_px**2 - sigma**2, 0.0))
    if blur > 1.7 * sigma:  # a filter much sharper than the image only adds noise
        sigma = min(blur, max(1.0, 0.2 * b))
        edges = find_edges(cleared, candidate, work.noise_dn, sigma, band=0.4)
    expected = edge_noise_px(candidate.step_dn, noise_dn=work.noise_dn, sigma_filter=sigma, sigma_total=edges.sigma_px)
    boundary = fit_boundary(edges, candidate, shape, expected)
    if isinstance(boundary, str):
        return boundary
    if candidate.rough and iou(candidate.ellipse, boundary.ellipse, nodes=128) < ROUGH:
        near = candidate_at(work, boundary.ellipse)
        again = None if near is None else boundary_about(work, near, shape)
        if isinstance(again, Found):
            return again
    return Found(work, cleared, candidate, edges, boundary)
