"""Reflections of the lamps in worn lenses: exact in position and energy, as glints are (`tracing`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...base.arrays import Floats, frozen
from ...eye.legs import LensImage, lens_images
from ...eye.worn import WornLens
from ...optics.transforms import normalize
from ...rig.light import Lamp
from .cutdiscs import POINT, quadrature
from .tracing import Emitters, GlintScene, Image, LampSpots, LightPaths

_NODES = quadrature(2, 10)


def lens_reflections(
    scene: GlintScene, lenses: Sequence[WornLens], lamps: Sequence[Lamp], anchor_mm: Floats
) -> list[Image]:
    """Compute the images of lamps in both surfaces of lenses, which are in the frame of the unrotated eye.

    An image is found from the middle of its lamp, and followed to the other points of the lamp.
    """
    still, out = replace(scene, M=np.eye(3), t=anchor_mm), []
    camera = scene.camera.nodal_point_mm - anchor_mm
    middles = np.stack([lamp.position_mm for lamp in lamps]) - anchor_mm
    for found in lens_images(lenses, middles, camera):
        if not np.isfinite(found.share):
            continue
        lamp = lamps[found.lamp]
        emitters = Emitters.of([lamp], [_NODES if lamp.radius_mm > 0 else POINT])
        near = lens_images(lenses, emitters.points - anchor_mm, camera, found.mirror_mm[None])
        rows = [_nearest([one for one in near if one.lamp == k], found) for k in range(len(emitters.points))]
        out += still.pictured(emitters, _paths(rows, camera))
    return out


def _nearest(images: Sequence[LensImage], found: LensImage) -> LensImage:
    """Return the image in the same surface as `found`; of several lenses, the one whose mirror point is nearest."""
    own = [one for one in images if one.surface == found.surface]
    away = [np.linalg.norm(one.mirror_mm - found.mirror_mm) for one in own]
    return own[int(np.argmin(np.nan_to_num(away, nan=np.inf)))]


def defocused(spots: LampSpots, diameter_px: float) -> LampSpots:
    """Spread spots over discs, point by point: the kernel of a disc has ripples, which such bright spots would show."""
    radial = min(int(np.ceil(1.5 + diameter_px)), 8)
    nodes = quadrature(radial, 4 * radial + 2)
    xy = spots.xy_px[:, None] + 0.5 * diameter_px * nodes.point
    return LampSpots(frozen(xy.reshape(-1, 2)), frozen(np.outer(spots.energy, nodes.weight).ravel()))


def _paths(images: Sequence[LensImage], camera_mm: Floats) -> LightPaths:
    """Return the paths of light of the images of a lamp's points."""
    there = np.array([np.isfinite(one.share) for one in images])

    def column(name: str, otherwise: object) -> Floats:
        return np.array([getattr(one, name) if t else otherwise for one, t in zip(images, there, strict=True)], float)

    met, seen, arrives = (column(name, [1.0, 0.0, 0.0]) for name in ("met_mm", "seen_mm", "leaving"))
    return LightPaths(
        entry=met, exit=seen, arrives=arrives, leaves=normalize(camera_mm - seen),
        passed=column("share", 0.0), cross_section=column("cross_section_mm2_sr", 1.0), found=there, there=there,
    )  # fmt: skip
