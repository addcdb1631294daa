"""Reflections of panels, maps, uniform light and skin in worn lenses, in a picture of their own.

Both surfaces of each lens mirror camera rays exactly. Reflections of the lamps and of the sun are splatted instead
(`glints.lensglints`). Of several lenses, the outer ones are passed on the way in and out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ...base.arrays import Singles
from ...rig.camera import Window
from ..hits.primary import ray_blocked, segment
from ..records.frame import DeviceFrame
from ..records.recording import recorded, syntax
from ..records.surfaces import Reflection
from .hostdata import BoundFrame
from .sampling import Pattern, Pixels, Samples
from .shading import mirror_of_scene


def mirrored_surroundings(bound: BoundFrame, window: Window, spp: int, seed: int) -> Callable[[], Singles] | None:
    """Start rendering what lenses mirror of ambient light: mean weighted radiance as in `film.mean_radiance`.

    None without lenses or without ambient light.
    """
    frame, (_, _, width, height) = bound.frame, window
    if not (frame.lenses and frame.structure.ambient):
        return None
    mean = _mean(frame, Pixels.of(window), Pattern.of(spp, seed), width * height)
    return lambda: mean.numpy().reshape(height, width)


@recorded
def _mean(frame: DeviceFrame, pixels: Pixels, pattern: Pattern, count: int) -> mi.Float:
    samples = Samples.of(*pixels.at(dr.arange(mi.UInt32, count)), pattern)
    mean = _sum(frame, replace(frame, lenses=()), samples) / mi.Float(samples.count)
    dr.eval(mean)
    return mean


@syntax
def _sum(frame: DeviceFrame, bare: DeviceFrame, samples: Samples) -> mi.Float:
    """Sum over all samples of pixels; `bare` is the frame without lenses."""
    total, k = mi.Float(0), mi.UInt32(0)
    while dr.hint(k < samples.count, label="lens mirror", exclude=[frame, bare, samples]):
        total += _sample(frame, *samples.ray(bare, k))
        k += 1
    return total


def _sample(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, root: mi.Float) -> mi.Float:
    """Compute what all lenses mirror along a camera ray, with its weight."""
    total = mi.Float(0)
    for number, lens in enumerate(frame.lenses):
        for ray in lens.mirror_rays(o, d):
            for outer in frame.lenses[:number][::-1]:
                ray = outer.release(ray)
            total += root * root * _radiance(frame, ray, o, d)
        o, d, root = lens.pass_ray(o, d, root)
    return total


def _radiance(frame: DeviceFrame, ray: Reflection, o: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """Compute the radiance that arrives by a mirrored ray, if nothing hides the lens."""
    wanted = ray.share > 0
    seen = frame.ambient_irradiance * dr.inv_pi + frame.caches.ambience.radiance(ray.leaves, ray.way, wanted)
    if frame.structure.obstacles:
        seen = mirror_of_scene(frame, ray.leaves, ray.way, wanted, mi.Bool(False), seen)
        wanted &= ~ray_blocked(frame.scene, segment(o, d, dr.norm(ray.met - o)), wanted)
    return dr.select(wanted, ray.share * seen, 0)
