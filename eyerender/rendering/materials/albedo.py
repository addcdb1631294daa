"""Albedo and relief of iris and sclera from maps in their own coordinates, and opacity of the cornea's rim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...region.iris import WIDTH_MM, DrawnPattern, iris_maps
from ...region.look import LIMBAL_RING, Look
from ...region.mapcache import kept
from ...region.texture import sclera_texture
from ..records.frame import DeviceFrame

GLOBE_EDGE = 0.6 * float(np.pi)  # polar angle at the edge of the globe's maps
_WIDE_MM = 2.5  # width of an iris whose relief has its full height
STEEPEST = 1.5  # slope of the opacity of the cornea's rim where it is steepest, times the width of the rim


@dataclass(kw_only=True)
class Textures:
    """Maps of the eye."""

    iris: mi.Texture2f  # relative albedo (mean 1) of the iris over (angle, pupil to root)
    heights: mi.Texture2f  # height (mm) of the iris over the same coordinates
    raised: bool  # whether the iris has any heights
    sclera: mi.Texture2f  # relative albedo of the sclera

    @classmethod
    def of(cls, look: Look) -> Textures:
        """Create the textures of one eye."""
        maps = kept(iris_maps, DrawnPattern.of(look.iris_seed, look.iris))
        # The texture repeats so that the angle wraps. Additional rows separate the ends along the radius.
        maps = np.concatenate([maps[:, :1], maps, maps[:, -1:]], axis=1)
        texture: Any = mi.Texture2f
        iris, heights = (
            texture(mi.TensorXf(rows[..., None]), use_accel=False, wrap_mode=dr.WrapMode.Repeat) for rows in maps
        )
        sclera = texture(mi.TensorXf(kept(sclera_texture, look.iris_seed)[..., None]), use_accel=False)
        raised = look.iris.relief > 0 or look.iris.convexity_mm > 0
        return cls(iris=iris, heights=heights, raised=raised, sclera=sclera)


def limbal_radius(frame: DeviceFrame, local: mi.Vector3f) -> mi.Float:
    """Compute the radius (mm) of points (front cornea's frame) about its axis, heights divided by the limbus' aspect.

    All points of the visible limbus then have the radius of the limbus.
    """
    up = local.y * frame.limbus.up[0] + local.z * frame.limbus.up[1]
    return dr.sqrt(local.y * local.y + local.z * local.z + frame.limbus.lowering * up * up)


def opacity(frame: DeviceFrame, rho: mi.Float) -> mi.Float:
    """Compute the opacity of the cornea's rim at a `limbal_radius`: a smooth step up to the limbus."""
    s = dr.clip((rho - frame.limbus.radius) * frame.limbus.gain + 1, 0, 1)
    return s * s * (3 - 2 * s)


def stop_coordinates(frame: DeviceFrame, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Compute coordinates of points of the stop's plane along its semi-axes, in units of their lengths."""
    q = x - frame.stop.centre
    a, b = frame.stop.axes
    return dr.dot(q, frame.stop.u) / a, dr.dot(q, frame.stop.v) / b


def _iris_place(frame: DeviceFrame, x: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
    """Compute polar coordinates on the iris: share of the way margin to root, turn, distance to the root, width."""
    pu, pv = stop_coordinates(frame, x)
    a, b = frame.stop.axes
    beyond = (dr.sqrt(pu * pu + pv * pv) - frame.boundary.radius(pu, pv)) * dr.sqrt(a * b)
    left = frame.iris.root_radius - dr.sqrt(x.y * x.y + x.z * x.z)
    width = dr.maximum(beyond + dr.maximum(left, 0), 1e-4)
    return dr.clip(beyond / width, 0, 1), dr.atan2(pv, pu) / (2 * dr.pi), left, width


def _on_iris(texture: mi.Texture2f, s: mi.Float, turn: mi.Float) -> mi.Float:
    rows = texture.shape[0]
    return texture.eval(mi.Point2f(turn, (1 + s * (rows - 2)) / rows))[0]


def iris_height(frame: DeviceFrame, heights: mi.Texture2f, x: mi.Vector3f) -> mi.Float:
    """Compute the iris height (mm) above points of its plane from the height map; 0 in the pupil and beyond the root.

    The pattern stretches with the iris. A narrow iris is as steep as a wide one, so its heights are smaller.
    """
    s, turn, left, width = _iris_place(frame, x)
    bulge = frame.iris.convexity * dr.minimum(width / WIDTH_MM, 1) * 4 * s * (1 - s)
    pattern = frame.iris.relief * dr.minimum(width / _WIDE_MM, 1) * _on_iris(heights, s, turn)
    return dr.select((s > 0) & (left > 0), bulge + pattern, 0)


def iris_albedo(frame: DeviceFrame, x: mi.Vector3f) -> mi.Float:
    """Compute the albedo in the plane of the iris outside the pupil: texture to the root, limbal tissue beyond it."""
    s, turn, left, _ = _iris_place(frame, x)
    texture = _on_iris(frame.textures.iris, s, turn)
    albedo = frame.iris.albedo * dr.maximum(1 + frame.iris.contrast * (texture - 1), 0.02)
    edge = dr.clip((s - LIMBAL_RING[0]) / (LIMBAL_RING[1] - LIMBAL_RING[0]), 0, 1)
    albedo *= 1 - frame.iris.ring * edge * edge * (3 - 2 * edge)
    return dr.select(left > 0, albedo, frame.limbus.albedo)


def globe_map(frame: DeviceFrame, point: mi.Vector3f) -> mi.Point2f:
    """Map points of the globe (eye frame) to [0, 1]^2, in the azimuthal equidistant map of its front."""
    r = point - frame.sclera.centre
    polar = dr.acos(dr.clip(dr.normalize(r).x, -1, 1)) / GLOBE_EDGE
    inv = dr.rcp(dr.maximum(dr.sqrt(r.y * r.y + r.z * r.z), 1e-6))
    return mi.Point2f(0.5 + 0.5 * polar * r.y * inv, 0.5 + 0.5 * polar * r.z * inv)


def sclera_albedo(frame: DeviceFrame, point: mi.Vector3f) -> mi.Float:
    """Compute the albedo of the sclera at points of the globe (eye frame), with the grey ring of the limbus."""
    texture = frame.textures.sclera.eval(globe_map(frame, point))[0]
    sclera = frame.sclera.albedo * dr.maximum(1 + frame.sclera.contrast * (texture - 1), 0.02)
    # The grey ring of the limbus fades into the white over its width, on the side of the sclera.
    away = limbal_radius(frame, frame.surfaces[0].point_in(point)) - frame.limbus.radius
    s = dr.clip(0.5 + 0.5 * away * frame.limbus.gain, 0, 1)
    s = s * s * (3 - 2 * s)
    return frame.limbus.albedo + s * (sclera - frame.limbus.albedo)
