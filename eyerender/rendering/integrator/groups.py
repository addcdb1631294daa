"""Groups of samples in front of an eye region, and how they take turns at the lamps.

A group is a few samples of one pixel, each with its own camera ray. The group's hits on the region are merged
(`merging`) and shaded once; hits on the globe are shaded sample by sample (`groupshading`).

The groups of a pixel take turns at the lamps, and so do the samples on the globe. A lamp used by c of n users is
weighted n / c, so that every lamp has its exact share in every pixel. The sun, whose shadows are dark and sharp, is
used by all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..hits.primary import TriangleHit, region_hit
from ..records.frame import DeviceFrame, DeviceLamp, Lights, quotient
from ..records.recording import syntax
from .sampling import Samples
from .visibility import HitTable


@dataclass(kw_only=True)
class LampShare:
    """A lamp, and its weight: the number of users for which the ray of one user stands."""

    lamp: DeviceLamp
    weight: mi.Float


@dataclass(kw_only=True)
class LampTurns:
    """Assignment of lamps to `users`, such as the groups of a pixel, in turn. The sun, the last lamp, has no turns."""

    lights: Lights
    users: mi.UInt32

    @property
    def others(self) -> mi.UInt32:
        """Number of lamps except the sun. A frame without lamps has a dark one."""
        return dr.maximum(self.lights.count, 1) - self.lights.suns

    def count(self, user: mi.UInt32) -> mi.UInt32:
        """Return the number of lamps of a user."""
        several = quotient(self.users + self.others - 1 - user, self.users)
        return dr.select(self.users < self.others, several, dr.minimum(self.others, 1)) + self.lights.suns

    def share(self, user: mi.UInt32, k: mi.UInt32) -> LampShare:
        """Return the k-th lamp of a user."""
        sun, lamps = k < self.lights.suns, dr.maximum(self.others, 1)
        which = user - quotient(user, lamps) * lamps + (k - self.lights.suns) * self.users
        weight = mi.Float(self.users) / mi.Float(dr.maximum(quotient(self.users + lamps - 1 - which, lamps), 1))
        lamp = self.lights[dr.select(sun, self.lights.count - 1, which)]
        return LampShare(lamp=lamp, weight=dr.select(sun, 1, weight))


@dataclass(kw_only=True)
class PixelGroup:
    """A group of samples of a pixel, one per lane; j numbers them from 0 to `count`."""

    samples: Samples  # all samples of the pixel
    number: mi.UInt32  # number of the group within its pixel
    count: mi.UInt32  # number of samples in the group
    hits: HitTable  # hits on the region
    first_hit: mi.UInt32  # index of the first of these hits
    plain: mi.Bool  # whether the pixel shows only the sheet of skin, and the group has one hit
    wet: mi.Bool  # whether the pixel may show menisci
    halved: mi.Bool  # whether only half of the samples on the globe are shaded, on behalf of all
    turns: LampTurns  # turns of the pixel's groups, for light on the region
    sample_turns: LampTurns  # turns of the pixel's samples, for light on the globe
    # whether pairs of samples trace their own ray to the group's first lamp near the lids and on hairs, where lashes
    # cast shadows finer than a pixel
    own_shadows: mi.Bool
    sharp: mi.Bool  # whether every sample does so everywhere, because the lamp is the sun
    layered: bool  # whether to sum the depths of the parts

    def in_order(self, i: mi.UInt32) -> mi.UInt32:
        """Return the i-th sample to examine: the middle one first, then the others in order."""
        middle = self.count >> 1
        return dr.select(i == 0, middle, dr.select(i <= middle, i - 1, i))

    def of_pixel(self, j: mi.UInt32) -> mi.UInt32:
        """Return the number of sample j within its pixel."""
        return self.number * self.count + j

    def ray(self, frame: DeviceFrame, j: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        """Return origin and direction (scene's frame) of sample j, and its weight, cos^4(theta) / D of `camera_ray`."""
        o, d, root = self.samples.ray(frame, self.of_pixel(j))
        return o, d, root * root

    @syntax
    def hit(self, frame: DeviceFrame, j: mi.UInt32) -> TriangleHit:
        """Return the hit of sample j on the region."""
        hit = self.hits.at(self.first_hit + dr.select(self.plain, 0, j))
        # Occasionally a ray slips between two triangles. Then the sample stands for itself only.
        if dr.hint(self.plain & ~hit.is_valid(), exclude=[self, frame, j]):
            hit = region_hit(frame, *self.ray(frame, j)[:2])
        return hit

    def spot(self, j: mi.UInt32) -> mi.Point2f:
        """Return the position of sample j on the lamps' discs, [0, 1)^2."""
        return self.samples.pair(self.of_pixel(j), 0)

    @property
    def shared_spot(self) -> mi.Point2f:
        """Return the group's position on the lamps' discs; groups that share a lamp have consecutive positions."""
        lamps = dr.maximum(self.turns.others, 1)
        several = self.turns.users < self.turns.others
        return self.samples.pair(dr.select(several, self.number, self.number // lamps), 0)
