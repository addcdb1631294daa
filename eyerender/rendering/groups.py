"""Before an eye region, a pixel's samples in groups: what they see of the skin is shaded once for all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .lighting import lamp_blocked, straight, through_cornea
from .shading import direct, indirect
from .values import Lamp, Lights, Values
from .view import Textures, look_at_skin, meet, outer_albedo

_LIDS_MM = 18.0  # about the axis of the unrotated eye: the lids, and where lashes cast shadows


@dataclass(frozen=True, slots=True)
class Group:
    """The samples of a lane, numbered from 0 to `count`; which lamps they look at, and how often each then counts.

    Attributes:
        ray: origin, direction (scene's frame) and weight of sample j.
        spot: place of sample j on the lamps' discs, [0, 1)^2.
        lamp: the lamp that sample j looks at where it meets the globe, and how much that counts.
        lamps: how many the group looks at together where it meets the region.
        shared: the k-th of these, and how much it counts.
        fine: whether, about the lids and on hairs, where lashes cast shadows finer than a pixel, pairs of samples send
            rays of their own to the lamp. There is one, then.
        plain: nothing but the sheet of skin is to be seen in the samples' pixel.
    """

    count: Any
    ray: Callable[[Any], tuple[Any, Any, Any]]
    spot: Callable[[Any], Any]
    lamp: Callable[[Any], tuple[Lamp, Any]]
    lamps: Any
    shared: Callable[[Any], tuple[Lamp, Any]]
    fine: Any
    plain: Any


def shade_group(values: Values, lights: Lights, textures: Textures, scene: Any, group: Group) -> tuple[Any, Any]:
    """Sums over a group's samples before an eye region: radiance, and failed light paths.

    Every sample has a ray of its own, and the globe is shaded for each. What the region shows of a group is shaded once
    for the sheet of skin and once for all that stands before it (hairs, tears), at the sample that comes first, and
    counts as often as it was hit. In a plain pixel the first sample that meets the sheet says what all would.
    """
    skin = textures.region
    middle = group.count >> 1

    def number(i: Any) -> Any:
        """The middle sample first, then the others in turn."""
        return dr.select(i == 0, middle, dr.select(i <= middle, i - 1, i))

    def place(lamp: Lamp, j: Any) -> Any:
        u, v = group.spot(j)
        return lamp.point(u, *dr.sincos(v * (2 * dr.pi)))

    def going(i: Any, settled: Any, *_: Any) -> Any:
        return (i < group.count) & ~settled

    def one(
        i: Any, settled: Any, total: Any, sheet: Kept, before: Kept, known: Any, blocked: Any, failures: Any
    ) -> Any:
        j = number(i)
        o, d, weight = group.ray(j)
        view, hit = meet(values, scene, o, d, True)

        def globe(total: Any, failures: Any) -> tuple[Any, Any]:
            seen = replace(view, other=mi.Bool(False))
            lamp, share = group.lamp(j)
            source = place(lamp, j)
            outer, shine = straight(lamp, source, seen, -values.vector_to_eye(d))
            inner, missed = through_cornea(values, lights, scene, seen.inner, seen.lit_inside, *group.spot(j))
            albedo = outer_albedo(values, textures, seen, True)
            lit = direct(seen, albedo, outer, shine)
            barred = lamp_blocked(values, scene, seen.point, source, False, ~seen.cornea, lit > 0)
            rest = indirect(values, textures, scene, seen, d, albedo, inner)
            return total + (rest + dr.select(barred, 0, lit * share)) * weight, failures + missed

        total, failures = dr.if_stmt((total, failures), view.cornea | view.sclera, globe, lambda *unchanged: unchanged)
        face = skin.face(hit)
        on_sheet = skin.on_sheet(face)
        at = o + hit.t * d
        alone = view.other & group.fine & (~on_sheet | (at.y * at.y + at.z * at.z < _LIDS_MM * _LIDS_MM))

        # Two samples share the ray.
        known &= (i & 1) == 1
        asked = alone & ~known

        def own_ray(_: Any) -> Any:
            source = place(group.shared(mi.UInt32(0))[0], j)
            return lamp_blocked(values, scene, values.point_to_eye(at), source, True, True, asked)

        blocked = dr.if_stmt((blocked,), asked, own_ray, lambda blocked: blocked)
        known |= asked
        sheet = sheet.with_(view.other & on_sheet, j, face, hit.prim_uv, weight, alone, blocked)
        before = before.with_(view.other & ~on_sheet, j, face, hit.prim_uv, weight, alone, blocked)
        settled = group.plain & view.other & on_sheet & ~alone
        return i + 1, settled, total, sheet, before, known, blocked, failures

    no = mi.Bool(False)
    state = (mi.UInt32(0), no, mi.Float(0), Kept.none(), Kept.none(), no, no, mi.UInt32(0))
    names = ("i", "settled", "total", "sheet", "before", "known", "blocked", "failures")
    i, settled, total, sheet, before, _, _, failures = dr.while_loop(state, going, one, labels=names, label="group")

    def left(i: Any, *_: Any) -> Any:
        return settled & (i < group.count)

    def weigh(i: Any, weight: Any, shared: Any) -> Any:
        rest = group.ray(number(i))[2]
        return i + 1, weight + rest, shared + rest

    weights = (i, sheet.weight, sheet.shared)
    _, weight, shared = dr.while_loop(weights, left, weigh, labels=("i", "weight", "shared"), label="settled")
    sheet = replace(sheet, weight=weight, shared=shared)

    for kept in (sheet, before):

        def surface(total: Any, kept: Kept = kept) -> tuple[Any]:
            _, d, _ = group.ray(kept.j)
            view = look_at_skin(values, skin, kept.face, kept.uv, d, kept.weight > 0)
            total += indirect(values, textures, scene, view, d, view.albedo, mi.Float(0)) * kept.weight

            def more(k: Any, *_: Any) -> Any:
                return k < group.lamps

            def lamp_light(k: Any, total: Any) -> Any:
                lamp, share = group.shared(k)
                source = place(lamp, kept.j)
                outer, shine = straight(lamp, source, view, -values.vector_to_eye(d))
                lit = direct(view, view.albedo, outer, shine) * share
                asked = (kept.shared > 0) & (lit > 0)
                blocked = lamp_blocked(values, scene, view.point, source, True, True, asked)
                return k + 1, total + lit * (kept.clear + dr.select(blocked, 0, kept.shared))

            total = dr.while_loop((mi.UInt32(0), total), more, lamp_light, labels=("k", "total"), label="its lamps")[1]
            return (total,)

        (total,) = dr.if_stmt((total,), kept.weight > 0, surface, lambda total: (total,))
    return total, failures


@dataclass
class Kept:
    """The hit of a group's samples that stands for all on one kind of surface, its number, and what all weigh: those
    without a ray of their own to the lamp (`shared`), and those of the others that see it (`clear`)."""

    j: Any = None
    face: Any = None
    uv: Any = None
    weight: Any = None
    shared: Any = None
    clear: Any = None

    @classmethod
    def none(cls) -> Kept:
        """No hit yet."""
        return cls(mi.UInt32(0), mi.UInt32(0), mi.Point2f(0), mi.Float(0), mi.Float(0), mi.Float(0))

    def with_(self, met: Any, j: Any, face: Any, uv: Any, weight: Any, alone: Any, blocked: Any) -> Kept:
        """With sample `j` where it has `met` the surface; the first stands for all."""
        taken = met & (self.weight == 0)
        weight = dr.select(met, weight, 0)
        return Kept(
            dr.select(taken, j, self.j),
            dr.select(taken, face, self.face),
            dr.select(taken, uv, self.uv),
            self.weight + weight,
            self.shared + dr.select(alone, 0, weight),
            self.clear + dr.select(alone & ~blocked, weight, 0),
        )
