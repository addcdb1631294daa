"""Spectacle lenses in front of an eye: two more surfaces with a frame of their own, which rays pass in turn.

A ray passes a lens inside its outline and runs beside it outside. So a leg of a path (from a camera, a lamp or a target
to the eye) is solved for each choice of the lenses that it may pass, and checked: it must cross every lens of the
choice inside the outline, and must not touch the remaining ones there. A point that is reached both ways counts once,
through the lens, because choices with more lenses come first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, Indices, Statuses
from ..base.status import Status, mark
from ..optics.interface import dot, fresnel, minus, moved
from ..optics.shooting import taken
from ..optics.surfaces import Surface, Xyz, components, join, shift, turn_back
from ..optics.trace import Crossing, Traced, trace

_REACH = 1.5
"""A leg whose straight line passes the lens's plane farther out than this part of the outline cannot pass the lens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameShape:
    """Frame around a lens: the values of `frames.SpectacleFrame`, and the sign of y towards the nose."""

    rims: bool
    bridge: bool
    temples: bool
    round: bool
    rim_mm: float
    depth_mm: float
    albedo: float
    nasal: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WornLens(ArrayValue):
    """A lens in the frame of the unrotated eye or, `turned`, in the frames of n turned eyes; arrays may be batches."""

    front: Surface  # the surface on the world's side
    back: Surface  # the surface on the eye's side
    index: float  # index of refraction
    centre_mm: Floats  # (3,) centre of the outline
    rotation: Floats  # (3, 3) lens to eye frame; its x axis points out of the face
    half_mm: tuple[float, float]  # (2,) half axes of the elliptical outline along the lens's y and z
    reflectances: tuple[float, float] | None  # of front and back at every angle; None: Fresnel's
    transmission: float  # of the material
    frame: FrameShape | None = None  # what holds the lens, which pictures show; None: nothing

    def turned(self, turn: Floats, shift_mm: Floats) -> WornLens:
        """Express the lens in frames of turned eyes, x = turn x' + shift_mm, with turn (n, 3, 3) and shift (n, 3)."""
        back = np.swapaxes(turn, -1, -2)
        return replace(
            self,
            front=self.front.seen_from(shift_mm, turn),
            back=self.back.seen_from(shift_mm, turn),
            centre_mm=(back @ (self.centre_mm - shift_mm)[..., None])[..., 0],
            rotation=back @ self.rotation,
        )

    def behind(self, M: Floats, shift_mm: Floats) -> WornLens:
        """Express the lens in the frame of one turned eye, x = M x' + shift_mm."""
        return self.turned(M[None], shift_mm[None]).take(0)

    def take(self, rows: Indices | int | None) -> WornLens:
        """Select lenses of a batch; None makes a batch of one."""
        centre, rotation = self.centre_mm[rows], self.rotation[rows]
        return replace(
            self, front=self.front.take(rows), back=self.back.take(rows), centre_mm=centre, rotation=rotation
        )

    def inward(self) -> tuple[Crossing, ...]:
        """Return the two refractions of light that comes from the world."""
        return (Crossing(surface=self.front, n_after=self.index), Crossing(surface=self.back, n_after=1.0))

    def outward(self) -> tuple[Crossing, ...]:
        """Return the two refractions of light that comes from the eye."""
        return (
            Crossing(surface=self.back, n_after=self.index, inward=False),
            Crossing(surface=self.front, n_after=1.0, inward=False),
        )

    def local(self, point: Xyz) -> Xyz:
        """Transform points to the lens's axes, with the centre of the outline as origin."""
        return turn_back(self.rotation, shift(point, self.centre_mm, -1.0))

    @property
    def outline(self) -> Floats:
        """Centre of the outline, and both its axes over their lengths, (..., 3, 3), for the compiled solver."""
        y, z = (self.rotation[..., :, k] / half for k, half in zip((1, 2), self.half_mm, strict=True))
        return np.stack([self.centre_mm, y, z], axis=-2)

    def inside(self, point: Xyz) -> Bools:
        """Return whether points lie inside the outline, seen along the lens's x axis."""
        _, y, z = self.local(point)
        with np.errstate(invalid="ignore"):
            return np.asarray((y / self.half_mm[0]) ** 2 + (z / self.half_mm[1]) ** 2 <= 1.0)

    def faces(self, point: Xyz) -> Bools:
        """Return whether points lie on the world's side of the lens."""
        return np.asarray(self.local(point)[0] > 0.0)

    def reachable(self, end: Xyz, towards: Xyz) -> Bools:
        """Return where a leg from points towards others may pass the lens: from its front, not far beside it."""
        x, y, z = self.local(end)
        own_x, own_y, own_z = self.local(towards)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = x / (x - own_x)
            y, z = y + part * (own_y - y), z + part * (own_z - z)
            near = (y / self.half_mm[0]) ** 2 + (z / self.half_mm[1]) ** 2 <= _REACH**2
        return np.asarray((x > 0.0) & (own_x < 0.0) & near)

    def touches(self, start: Xyz, end: Xyz) -> Bools:
        """Return whether straight lines from start to end meet a surface inside the outline."""
        gap = minus(end, start)
        length = np.sqrt(dot(gap, gap))
        way = (gap[0] / length, gap[1] / length, gap[2] / length)
        found = np.zeros(length.shape, dtype=bool)
        for surface in (self.front, self.back):
            for inward in (True, False):
                hit = surface.hit(start, way, inward)
                ahead = hit.ok & (hit.distance > 0.0) & (hit.distance < length)
                found |= ahead & self.inside(moved(start, way, hit.distance))
        return found


Choice = tuple[int, ...]
"""Numbers of the lenses that a leg passes, in order from the eye."""


def choices(count: int) -> list[Choice]:
    """Return all choices among `count` lenses, those with most lenses first."""
    return [choice for size in range(count, -1, -1) for choice in combinations(range(count), size)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """A path past worn lenses: its crossings from the viewpoint, and the lens that each belongs to (None: the eye)."""

    path: tuple[Crossing, ...]
    owners: tuple[int | None, ...]
    lenses: tuple[WornLens, ...]

    @classmethod
    def of(
        cls,
        lenses: Sequence[WornLens],  # all worn lenses, in order from the eye
        before: Choice,  # those passed on the way from the viewpoint, in the order in which they are passed
        middle: Sequence[Crossing],  # the crossings of the eye, or those of lens `own` if that is given
        after: Choice = (),  # those passed on the way to the target, in the order in which they are passed
        own: int | None = None,  # number of a lens that reflects the ray
    ) -> Course:
        """Join what the lenses before and after do to the crossings in the middle."""
        inwards = own is None or all(k > own for k in (*before, *after))
        steps = [(c, k) for k in before for c in (lenses[k].inward() if inwards else lenses[k].outward())]
        back = [(c, k) for k in after for c in (lenses[k].outward() if inwards else lenses[k].inward())]
        whole = [*steps, *((c, own) for c in middle), *back]
        return cls(path=tuple(c for c, _ in whole), owners=tuple(k for _, k in whole), lenses=tuple(lenses))

    @property
    def first_of_eye(self) -> int | None:
        """Number of the first crossing that belongs to the eye; None without any."""
        return self.owners.index(None) if None in self.owners else None

    def share(self, traced: Traced) -> Floats:
        """Compute the share of the light that the lenses pass or mirror along traced rays.

        A lens passes (1 - R1) (1 - R2) / (1 - R1 R2) times the transmission of its material, with the light that goes
        to and fro inside. A reflection is R, times (1 - R)^2 if it is behind a surface.
        """
        whole, known = np.ones(traced.status.shape), np.ones(traced.status.shape)
        for k, (crossing, owner) in enumerate(zip(self.path, self.owners, strict=True)):
            if owner is None:
                continue
            lens = self.lenses[owner]
            if lens.reflectances is None:
                normal = join(crossing.surface.gradient_at(components(traced.points_mm[k + 1])))
                cosine = np.sum(normal * traced.directions[k], axis=-1) / np.linalg.norm(normal, axis=-1)
                outer = (1.0, lens.index)
                facing = crossing.inward == (crossing.surface is lens.front)
                reflected = fresnel(np.abs(cosine), *(outer if facing else outer[::-1])).unpolarized
            else:
                reflected = np.full(whole.shape, lens.reflectances[crossing.surface is lens.back])
            whole = whole * (reflected if crossing.reflects else 1.0 - reflected)
            if k > 0 and self.owners[k - 1] == owner and not crossing.reflects:
                with np.errstate(invalid="ignore"):  # both are 1 on rays that do not exist
                    whole = whole * lens.transmission / (1.0 if self.path[k - 1].reflects else 1.0 - known * reflected)
            known = reflected
        return whole

    def follow(self, viewpoint: Xyz, way: Xyz, target: Xyz) -> tuple[Traced, Statuses]:
        """Trace rays from the viewpoint; the status is AT_LENS_EDGE where a lens lies in the way or ends too early."""
        traced = trace(self.path, 1.0, join(viewpoint), join(way))
        status = np.array(traced.status)
        points = [viewpoint, *(components(p) for p in traced.points_mm[1:]), target]
        with np.errstate(invalid="ignore"):
            for k, owner in enumerate(self.owners):
                if owner is not None:
                    mark(status, ~self.lenses[owner].inside(points[k + 1]), Status.AT_LENS_EDGE)
            for k, lens in self.beside():
                mark(status, lens.touches(points[k], points[k + 1]), Status.AT_LENS_EDGE)
        return traced, status

    def outlines(self) -> Floats:
        """Return the outline of each crossing, (..., s, 3, 3), with axes of 0 at those of the eye."""
        owned = [np.zeros((3, 3)) if k is None else self.lenses[k].outline for k in self.owners]
        return np.stack(np.broadcast_arrays(*owned), axis=-3)

    def beside(self) -> list[tuple[int, WornLens]]:
        """Return the segments in air and the lenses that they must not touch; segment k ends at crossing k."""
        out = []
        for k in self._in_air():
            ends = {self.owners[i] for i in (k - 1, k) if 0 <= i < len(self.owners)}
            out += [(k, lens) for j, lens in enumerate(self.lenses) if j not in ends]
        return out

    def take(self, rows: Indices) -> Course:
        """Select rows of a batch."""
        path, lenses = tuple(taken(c, rows) for c in self.path), tuple(lens.take(rows) for lens in self.lenses)
        return replace(self, path=path, lenses=lenses)

    def _in_air(self) -> list[int]:
        """Return the numbers of the segments in air; segment k ends at crossing k."""
        last, found = len(self.path), [0]
        for k in range(1, last + 1):
            inside_lens = k < last and self.owners[k - 1] is not None and self.owners[k - 1] == self.owners[k]
            inside_eye = self.owners[k - 1] is None and not self.path[k - 1].reflects
            if not inside_lens and not inside_eye:
                found.append(k)
        return found


def reachable_by(lenses: Sequence[WornLens], choice: Choice, end: Xyz, towards: Xyz | None = None) -> Bools:
    """Return where a leg from points towards others, by default the eye's apex, may pass all lenses of a choice."""
    found = np.ones(np.shape(end[0]), dtype=bool)
    nothing = np.zeros(found.shape)
    for k in choice:
        found = found & lenses[k].reachable(end, towards or (nothing, nothing, nothing))
    return found


def more_telling(old: Statuses, new: Statuses) -> Statuses:
    """Choose between failures of two attempts: no attempt, no such ray, a lens's edge, or a reason of the eye."""

    def rank(status: Statuses) -> Floats:
        lost = (status == Status.MISSED) | (status == Status.NOT_CONVERGED)
        return np.select([status == Status.NONE, lost, status == Status.AT_LENS_EDGE], [0.0, 1.0, 2.0], 3.0)

    return np.where(rank(new) > rank(old), new, old).astype(np.int8)
