"""Patches of a frame on the device, and the numbers of lanes of the kernels that read them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..records.frame import upload_array
from ..records.job import LampTable
from .chamber import PATCHES
from .chamber import TURNS as IRIS_TURNS
from .framepatches import LANES, RAYS, FramePatches, round_up

_PATCHES = 256  # lanes for patches in multiples of this, so that recordings serve many subjects and poses
_SMALL, _SPOTS = 0.02, 16  # radius over distance of lamps of which one point is enough; points of larger ones


def gather_rows(buffer: mi.Float, width: int, i: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.Float]:
    """Read rows i of a table with `width` columns."""
    return [dr.gather(mi.Float, buffer, i * width + k, active) for k in range(width)]


@dataclass(kw_only=True)
class PatchTables:
    """The patches of a frame on the device.

    Attributes:
        outer: points and normals of patches outside the eye (scene's frame).
        inside: points and normals of patches of the chamber, as in `Interior`.
        near_cornea: patches on skin onto which the cornea mirrors lamps, padded; None for none.
        leaving: rays that leave the eye.
        of_patch: the patch of each ray outside the eye.
        stands_for: the patches that represent both sides of each vertex.
        on_globe: number of patches on the globe.
        on_skin: number of patches on skin.
        before_limbus: number of patches outside the eye that are not on the limbus.
        outside: number of patches outside the eye.
        rays_outside: number of their rays.
        rays: number of all rays.
        outer_spots: first numbers of the points on the lamps' discs, for patches outside the eye.
        mirrored_spots: the same for patches near the cornea.
        inside_spots: the same for patches of the chamber.
    """

    outer: mi.Float
    inside: mi.Float
    near_cornea: mi.Float | None
    leaving: mi.Float
    of_patch: mi.UInt32
    stands_for: mi.Int32
    on_globe: mi.UInt32
    on_skin: mi.UInt32
    before_limbus: mi.UInt32
    outside: mi.UInt32
    rays_outside: mi.UInt32
    rays: mi.UInt32
    outer_spots: tuple[mi.UInt32, ...]
    mirrored_spots: tuple[mi.UInt32, ...]
    inside_spots: tuple[mi.UInt32, ...]

    @classmethod
    def upload(cls, patches: FramePatches, lamps: LampTable, lanes: Lanes) -> PatchTables:
        """Copy the patches of a frame to the device."""
        plan, interior, near = patches.plan, patches.interior, patches.near_cornea
        rows = None
        if lanes.near_cornea:
            padded = np.append(near, np.full(lanes.near_cornea - len(near), near[0]))
            rows = upload_array(np.column_stack([patches.points[padded], patches.normals[padded]]))
        outside, rays = patches.outside, plan.rays
        counts = patches.on_globe, patches.on_skin, outside - IRIS_TURNS, outside, rays, rays + patches.bundles
        on_globe, on_skin, before_limbus, outside, rays_outside, rays = (dr.opaque(mi.UInt32, n) for n in counts)
        each = 1 if lamps.widest < _SMALL else _SPOTS
        spots = [
            tuple(dr.opaque(mi.UInt32, k * width) for k in range(each))
            for width in (2 * patches.outside, lanes.near_cornea, PATCHES)
        ]
        return cls(
            outer=upload_array(np.resize(patches.outer, (lanes.outside, 6))), inside=interior.rows, near_cornea=rows,
            leaving=interior.leaving, of_patch=plan.of_patch, stands_for=plan.stands_for, on_globe=on_globe,
            on_skin=on_skin, before_limbus=before_limbus, outside=outside, rays_outside=rays_outside, rays=rays,
            outer_spots=spots[0], mirrored_spots=spots[1], inside_spots=spots[2],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Lanes:
    """Numbers of lanes of a frame's kernels, rounded up so that recordings serve many frames.

    Attributes:
        outside: lanes for patches outside the eye.
        near_cornea: lanes for patches onto which the cornea mirrors lamps.
        rays: lanes for rays.
        at_hits: lanes for rays that compute the light at the point of the skin that they hit.
        lamps: whether there are lamps.
        panels: whether there are parts of panels or bright parts of a map.
    """

    outside: int
    near_cornea: int
    rays: int
    at_hits: int
    lamps: bool
    panels: bool

    @classmethod
    def of(cls, patches: FramePatches, lamps: LampTable, panels: LampTable) -> Lanes:
        """Count the lanes of a frame."""
        bundles, lit = patches.bundles, len(lamps) > 0
        return cls(
            outside=round_up(patches.outside, _PATCHES),
            near_cornea=round_up(len(patches.near_cornea), _PATCHES) if lit else 0,
            rays=round_up(patches.plan.rays + bundles, LANES),
            at_hits=patches.on_globe * RAYS + bundles if patches.plan.skin is not None and lit else 0,
            lamps=lit,
            panels=len(panels) > 0,
        )
