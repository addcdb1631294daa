"""Search for the pupil boundary: which candidate is the pupil, judged by its edges at full resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...arrays import Bools, Floats
from ..preprocessing import Prepared
from ..result import PupilResult
from ..settings import ExtractionSettings
from .candidates import Candidate, Interior, find_candidates, find_inside, inspect_interior
from .consensus import BoundaryFit, fit_boundary
from .covariance import edge_covariance
from .edge_model import SECTORS, EdgeModel, Place, sector_of
from .edges import EdgePoints, edge_noise_px, filter_sigma, find_edges


@dataclass(frozen=True, eq=False)
class Found:
    """A candidate, the edge points around it, and the boundary through them; derived values are computed on demand.

    `quality` combines how much of the boundary is visible and how well the candidate was ranked.
    """

    image: Prepared
    candidate: Candidate
    edges: EdgePoints
    boundary: BoundaryFit
    quality: float

    @cached_property
    def model(self) -> EdgeModel:
        """Pixel model, as far as the edges determine it."""
        candidate = self.candidate
        sigma = math.sqrt(max(self.edges.sigma_px**2 - self.edges.filter_px**2, 0.25))
        outer = np.array([candidate.inside_dn + candidate.step_dn])
        return EdgeModel(ellipse=self.boundary.ellipse, inner_dn=candidate.inside_dn, outer=outer, sigma_px=sigma)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (5, 5) of centre, semi-axes and angle, from the scatter of the edge points."""
        return edge_covariance(self.boundary.ellipse, self.boundary.points_px, self.boundary.residual_px)

    @cached_property
    def interior(self) -> Interior:
        """Statistics of the pixels inside the boundary."""
        return inspect_interior(self.image.linear, self.boundary.ellipse, self.model.sigma_px, self.image.noise_dn)

    @cached_property
    def sectors(self) -> Bools:
        """Sectors (SECTORS,) with an edge point, and gaps of up to two sectors between them."""
        hit = np.bincount(sector_of(Place.of(self.boundary.ellipse, *self.edges.points_px[self.boundary.inliers].T)),
                          minlength=SECTORS) > 0  # fmt: skip
        grown = hit | np.roll(hit, 1) | np.roll(hit, -1)
        return np.asarray(grown & np.roll(grown, 1) & np.roll(grown, -1) | hit)

    @property
    def has_core(self) -> bool:
        """Whether the middle is darker than the outer part, as inside the outline of an iris."""
        inside = self.interior
        return not inside.darker_dn < max(4.0 * inside.error_dn, 0.15 * self.candidate.step_dn)


def search(work: Prepared, settings: ExtractionSettings) -> Found | PupilResult:
    """Find the best candidate, judged by its edges; if there is none, the search repeats without dark lines."""
    found = _searched(work, settings, without_lines=False)
    if isinstance(found, Found) or work.inverted:
        return found
    again = _searched(work, settings, without_lines=True)
    return again if isinstance(again, Found) and again.boundary.support > 0.5 else found


def _searched(work: Prepared, settings: ExtractionSettings, *, without_lines: bool) -> Found | PupilResult:
    candidates = find_candidates(work, settings, without_lines=without_lines)
    if not candidates:
        return PupilResult.missing("coarse search", "no dark round region stands out of its surroundings")
    found, reason = _first_good(work, candidates, settings)
    if found is None:
        return PupilResult.missing("edges", reason)
    return _without_core(work, found, settings)


def _first_good(work: Prepared, candidates: list[Candidate], settings: ExtractionSettings) -> tuple[Found | None, str]:
    """First candidate whose boundary is well visible, else the most visible one; and why the first one failed."""
    poor: list[Found] = []
    reason = ""
    for candidate in candidates:
        found = boundary_about(work, candidate, settings)
        if isinstance(found, str):
            reason = reason or found
            continue
        # The ranking considers nesting, so a later candidate only replaces one that failed.
        if found.boundary.support > 0.45:
            return next((earlier for earlier in poor if _holds(found, earlier)), found), reason
        poor.append(found)
    return max(poor, key=lambda one: one.quality, default=None), reason


def _holds(outer: Found, inner: Found) -> bool:
    """Whether a smaller boundary that was found earlier lies inside, even if little of it is visible."""
    ratio = inner.boundary.ellipse.area_px2 / outer.boundary.ellipse.area_px2
    apart = math.dist(inner.boundary.ellipse.centre_px, outer.boundary.ellipse.centre_px)
    return ratio < 0.7 and apart < 0.7 * float(outer.boundary.ellipse.semi_axes_px[1])


def _without_core(work: Prepared, found: Found, settings: ExtractionSettings) -> Found | PupilResult:
    """Boundary itself if its interior is even; the boundary inside it if it has a darker core, as an iris has."""
    for _ in range(2):
        if not found.has_core:
            return found
        inner, _ = _first_good(work, find_inside(work, found.boundary.ellipse, settings), settings)
        if inner is None or inner.boundary.ellipse.area_px2 > 0.8 * found.boundary.ellipse.area_px2:
            reason = "the dark region has a darker core, as an iris has, but no boundary was found in it"
            return PupilResult.missing("edges", reason)
        found = inner
    return found


def boundary_about(work: Prepared, candidate: Candidate, settings: ExtractionSettings) -> Found | str:
    """Find the boundary around a candidate, or give the reason why there is none."""
    bright = candidate.inside_dn + 4.0 * candidate.step_dn
    b = float(candidate.ellipse.semi_axes_px[1])
    sigma = filter_sigma(candidate.step_dn, work.noise_dn, b)
    edges = find_edges(work.linear, candidate, work.noise_dn, bright, sigma, band=0.4)
    blur = math.sqrt(max(edges.sigma_px**2 - sigma**2, 0.0))
    if blur > 1.7 * sigma:  # a filter much sharper than the image only adds noise
        sigma = min(blur, max(1.0, 0.2 * b))
        edges = find_edges(work.linear, candidate, work.noise_dn, bright, sigma, band=0.4)
    expected = edge_noise_px(candidate.step_dn, noise_dn=work.noise_dn, sigma_filter=sigma, sigma_total=edges.sigma_px)
    boundary = fit_boundary(edges, candidate, settings, expected)
    if isinstance(boundary, str):
        return boundary
    return Found(work, candidate, edges, boundary, boundary.support * min(1.0, 4.0 * candidate.score))
