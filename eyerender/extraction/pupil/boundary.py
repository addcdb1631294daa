"""The pupil boundary around one dark blob: inpaint glints, detect edges, and fit an ellipse to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...base.arrays import Bools
from ...optics.ellipse import Ellipse, iou
from ..preprocessing import Prepared
from ..settings import Shape
from .candidates import BlobInterior, Candidate, candidate_at, inspect_interior
from .consensus import BoundaryFit, fit_boundary
from .edge_model import EdgeModel
from .edges import EdgePoints, edge_noise_px, filter_sigma, find_edges, is_repeated
from .glare import Inpainted, inpaint_glints
from .places import holding

SPOT = 0.4  # share of the step by which a spot in the middle is darker where it may be a small pupil in an iris
RINGING_DN = 12.0  # darker spots beside a glint than this are not made by compression
# Unevenness at which the pixel model has half the weight, and its weight below which it is not fitted. Drawn ellipses
# scatter by up to 0.003 of the radius, also in textured irises; nearly all recorded pupils by 0.005 to 0.016.
UNEVEN, LEAST_SHARE = 0.004, 0.05
LID = 0.3  # share of the outline in a gap between edge points that only a lid makes
ROUGH = 0.8  # overlap with its boundary below which a rough candidate's edges are detected again, around the boundary


@dataclass(frozen=True, eq=False, kw_only=True)
class PupilCandidate:
    """A dark blob, the edge points around it, and the boundary through them; derived values are computed on first use.

    `inpainted` is the image without glints near the blob.
    """

    image: Prepared
    inpainted: Inpainted
    candidate: Candidate
    edges: EdgePoints
    boundary: BoundaryFit

    @cached_property
    def model(self) -> EdgeModel:
        """Pixel model as far as the edges determine it."""
        candidate = self.candidate
        sigma = math.sqrt(max(self.edges.sigma_px**2 - self.edges.filter_px**2, 0.25))
        outer = np.array([candidate.inside_dn + candidate.step_dn])
        return EdgeModel(ellipse=self.boundary.ellipse, inner_dn=candidate.inside_dn, outer=outer, sigma_px=sigma)

    @cached_property
    def interior(self) -> BlobInterior:
        """Statistics of the pixels inside the boundary."""
        return self.inside(self.boundary.ellipse, self.model.sigma_px)

    def inside(self, ellipse: Ellipse, blur_px: float) -> BlobInterior:
        """Compute statistics of the pixels inside an ellipse around the blob."""
        return inspect_interior(self.inpainted, ellipse, blur_px, self.image.noise_dn)

    @cached_property
    def sectors(self) -> Bools:
        """Whether each sector (SECTORS,) has an edge point or lies in a gap of up to two sectors."""
        hit = holding(self.boundary.ellipse.numbers(), self.edges.points_px[self.boundary.inliers])
        grown = hit | np.roll(hit, 1) | np.roll(hit, -1)
        return np.asarray(grown & np.roll(grown, 1) & np.roll(grown, -1) | hit)

    @property
    def reach_px(self) -> float:
        """Side of the square around the blob in which edges were searched, px."""
        return 2.8 * float(self.candidate.ellipse.semi_axes_px[0]) + 16.0

    @property
    def regularity(self) -> float:
        """How regular the boundary is, from 1 (an ellipse to within the noise) to 0; the pixel model's weight.

        It is 1 / (1 + (u / UNEVEN)^6) with the scatter u of the edge points beyond noise, in radii, and falls
        to 0 where a gap nears LID: the shadow of a lid looks like a shaded iris, which the model follows.
        """
        boundary = self.boundary
        excess = max(boundary.residual_px**2 - 1.3 * boundary.noise_px**2, 0.0)
        uneven2 = excess / float(boundary.ellipse.semi_axes_px.prod())
        share = 1.0 / (1.0 + (uneven2 / UNEVEN**2) ** 3)
        share *= min(max((LID - boundary.gap) / 0.1, 0.0), 1.0)
        return max(share - LEAST_SHARE, 0.0) / (1.0 - LEAST_SHARE)

    @property
    def core_dn(self) -> float:
        """How much darker the middle is than the outer part, DN; 0 if that is not significant.

        Positive if the outline is that of an iris; negative if the pupil in that iris is bright.
        """
        inside, step = self.interior, self.candidate.step_dn
        if abs(inside.darker_dn) > max(4.0 * inside.error_dn, 0.15 * step):
            return inside.darker_dn
        return inside.spot_dn if inside.spot_dn > max(6.0 * self.image.noise_dn, SPOT * step, RINGING_DN) else 0.0

    @cached_property
    def is_double(self) -> bool:
        """Whether nearly all of the boundary recurs beside it, as in an exposure across a saccade."""
        found = self.boundary
        return is_repeated(self.inpainted, found.ellipse, self.edges, found.inliers, self.model.sigma_px)

    @property
    def outline(self) -> Ellipse:
        """The boundary in pixels of the whole image."""
        return enlarged(self.boundary.ellipse, self.image.scale)

    def enlarged(self, work: Prepared) -> PupilCandidate:
        """Convert the candidate to pixels of the whole image."""
        edges, boundary, scale = self.edges, self.boundary, self.image.scale
        lengths = np.array([scale, scale, scale, scale, 1.0])
        candidate = replace(self.candidate, ellipse=enlarged(self.candidate.ellipse, scale))
        return PupilCandidate(
            image=work,
            inpainted=_inpainted(work, candidate),
            candidate=candidate,
            edges=replace(
                edges,
                points_px=scale * (edges.points_px + 0.5) - 0.5,
                sigma_px=scale * edges.sigma_px,
                filter_px=scale * edges.filter_px,
            ),
            boundary=replace(
                boundary,
                ellipse=self.outline,
                points_px=scale * (boundary.points_px + 0.5) - 0.5,
                residual_px=scale * boundary.residual_px,
                noise_px=scale * boundary.noise_px,
                covariance=boundary.covariance * np.outer(lengths, lengths),
            ),
        )


def enlarged(ellipse: Ellipse, scale: float) -> Ellipse:
    """Convert an ellipse to pixels of which `scale` are one pixel of its image."""
    return Ellipse(scale * (ellipse.centre_px + 0.5) - 0.5, scale * ellipse.semi_axes_px, ellipse.angle_rad)


def find_boundary(work: Prepared, candidate: Candidate, shape: Shape) -> PupilCandidate | str:
    """Fit the boundary around a dark blob, or return the reason why there is none.

    If the blob is rough and its boundary differs from it, edges are detected again around that boundary.
    """
    found = _find_boundary(work, candidate, shape)
    if isinstance(found, str) or not candidate.rough:
        return found
    if iou(candidate.ellipse, found.boundary.ellipse, nodes=128) >= ROUGH:
        return found
    near = candidate_at(work, found.boundary.ellipse)
    again = found if near is None else _find_boundary(work, near, shape)
    return found if isinstance(again, str) else again


def _find_boundary(work: Prepared, candidate: Candidate, shape: Shape) -> PupilCandidate | str:
    inpainted = _inpainted(work, candidate)
    b = float(candidate.ellipse.semi_axes_px[1])
    sigma = filter_sigma(candidate.step_dn, work.noise_dn, b)
    edges = find_edges(inpainted, candidate, work.noise_dn, sigma, band=0.4)
    blur = math.sqrt(max(edges.sigma_px**2 - sigma**2, 0.0))
    if blur > 1.7 * sigma:  # a filter much sharper than the image only adds noise
        sigma = min(blur, max(1.0, 0.2 * b))
        edges = find_edges(inpainted, candidate, work.noise_dn, sigma, band=0.4)
    expected = edge_noise_px(candidate.step_dn, noise_dn=work.noise_dn, sigma_filter=sigma, sigma_total=edges.sigma_px)
    boundary = fit_boundary(edges, candidate, shape, expected)
    if isinstance(boundary, str):
        return boundary
    return PupilCandidate(image=work, inpainted=inpainted, candidate=candidate, edges=edges, boundary=boundary)


def _inpainted(work: Prepared, candidate: Candidate) -> Inpainted:
    if work.inverted:
        return Inpainted(work.linear)
    return inpaint_glints(work.linear, candidate.ellipse, candidate.inside_dn, candidate.step_dn, work.noise_dn)
