"""Light other than that of the lamps: uniform light, emitting panels, and an environment map.

The front cornea mirrors it along the integrator's exact rays. Matte surfaces receive its irradiance, from which
`radiosity` subtracts what is hidden. A map is infinitely far away.

The irradiance of a panel, an emitting rectangle, is Lambert's formula for a polygon, cut at the horizon of the lit
surface,

    E(n) = L / 2 sum_k theta_k n . g_k,

where theta_k is the angle that edge k subtends and g_k the unit normal of the plane of edge and lit point (Lambert
1760; Arvo 1995, equation 2.9).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Cache, Floats, frozen
from ...base.errors import InputError
from ...rig.imaging import RadianceMap
from ...rig.light import Lamp
from ..records.frame import aligned_copy, upload_array, upload_scalars
from ..records.recording import syntax
from .environmentmap import NORMALS, EnvironmentMap, environment_map, map_rotation, map_values

_FAR_MM = 1e6
_PANEL = 13  # centre 3, normal 3, right 3 and up 3 over half sizes, radiance


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A rectangle in the scene's frame; `right` and `up` are divided by the half sizes, so |q . right| < 1 inside."""

    centre: mi.Vector3f
    normal: mi.Vector3f
    right: mi.Vector3f
    up: mi.Vector3f
    radiance: mi.Float


@dataclass(kw_only=True)
class Panels:
    """The rectangles of a frame, in one buffer, so kernels do not depend on their number."""

    count: mi.UInt32  # number of rectangles
    rows: mi.Float  # 13 numbers per rectangle, as in `job.panel_table`

    @classmethod
    def upload(cls, table: Floats) -> Panels:
        """Copy rectangles (n, 13) to the device."""
        return cls(count=dr.opaque(mi.UInt32, len(table)), rows=upload_array(table if len(table) else np.zeros(_PANEL)))

    def __getitem__(self, i: mi.UInt32) -> Rectangle:
        row = [dr.gather(mi.Float, self.rows, i * _PANEL + k) for k in range(_PANEL)]
        centre, normal, right, up = (mi.Vector3f(*row[k : k + 3]) for k in (0, 3, 6, 9))
        return Rectangle(centre=centre, normal=normal, right=right, up=up, radiance=row[12])

    @syntax
    def radiance(self, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Compute the radiance (mW/mm^2/sr) along rays of the scene's frame; overlapping panels add up."""
        i, total = mi.UInt32(0), mi.Float(0) * d.x
        while dr.hint(i < self.count, label="panels", exclude=[self]):
            panel = self[i]
            facing = -dr.dot(d, panel.normal)
            t = dr.dot(o - panel.centre, panel.normal) / dr.select(dr.abs(facing) > 1e-6, facing, 1)
            q = o + t * d - panel.centre
            inside = (dr.abs(dr.dot(q, panel.right)) < 1) & (dr.abs(dr.dot(q, panel.up)) < 1)
            total += dr.select(active & (facing > 1e-6) & (t > 0) & inside, panel.radiance, 0)
            i += 1
        return total

    @syntax
    def irradiance(self, x: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """Compute the unshadowed irradiance (mW/mm^2) at points x with unit normals n of the scene's frame."""
        i, total = mi.UInt32(0), mi.Float(0) * n.x
        while dr.hint(i < self.count, label="panel light", exclude=[self]):
            panel = self[i]
            right, up = panel.right / dr.squared_norm(panel.right), panel.up / dr.squared_norm(panel.up)
            middle = panel.centre - x
            corners = [middle - right - up, middle + right - up, middle + right + up, middle - right + up]
            seen = polygon_irradiance(corners, n)
            total += dr.select(dr.dot(middle, panel.normal) < 0, panel.radiance * seen, 0)
            i += 1
        return total


def polygon_irradiance(corners: list[mi.Vector3f], n: mi.Vector3f) -> mi.Float:
    """Compute the irradiance per radiance from a convex polygon, corners relative to the lit point of normal n.

    The polygon is clipped at the horizon: only the edges above it and the arc of the horizon between them contribute.
    """
    total = mi.Float(0)
    leave, enter = mi.Vector3f(0), mi.Vector3f(0)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        ha, hb = dr.dot(n, a), dr.dot(n, b)
        above_a, above_b = ha > 0, hb > 0
        crossing = above_a != above_b
        cut = a + dr.select(crossing, ha / dr.select(crossing, ha - hb, 1), 0) * (b - a)
        leave = dr.select(above_a & ~above_b, cut, leave)
        enter = dr.select(above_b & ~above_a, cut, enter)
        total += dr.select(above_a | above_b, _arc(dr.select(above_a, a, cut), dr.select(above_b, b, cut), n), 0)
    total += dr.select(dr.squared_norm(leave) > 0, _arc(leave, enter, n), 0)
    return 0.5 * dr.abs(total)


def _arc(a: mi.Vector3f, b: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
    """Compute the angle between two directions times n . unit(a x b)."""
    c = dr.cross(a, b)
    s = dr.norm(c)
    return dr.atan2(s, dr.dot(a, b)) * dr.dot(n, c) / dr.maximum(s, 1e-20)


class Maps:
    """Environment maps on the device; each is read and copied once."""

    def __init__(self) -> None:
        self._kept: Cache[tuple[Any, Any, EnvironmentMap]] = Cache()
        self._none = self._upload(environment_map(np.zeros((2, 4))))

    def of(self, spec: RadianceMap | None) -> tuple[Any, Any, EnvironmentMap]:
        """Return the textures of radiance and irradiance, and the map, of a spec whose path is absolute or local."""
        if spec is None:
            return self._none
        key: tuple[Any, ...] = (spec.place, spec.place_seed)
        if spec.file is not None:
            try:
                state = Path(spec.file).stat()
            except OSError:
                raise InputError("no such file", source=spec.file) from None
            key = (spec.file, spec.channel, spec.sha256, state.st_mtime_ns, state.st_size)
        return self._kept.get(key, lambda: self._upload(environment_map(map_values(spec))))

    @staticmethod
    def _upload(made: EnvironmentMap) -> tuple[Any, Any, EnvironmentMap]:
        return _texture(made.values[..., None]), _texture(made.irradiance), made


def _texture(values: NDArray[np.float32]) -> Any:
    # The texture repeats so that the columns wrap. Additional rows separate the poles.
    rows = np.concatenate([values[:1], values, values[-1:]])
    texture: Any = mi.Texture2f
    return texture(mi.TensorXf(aligned_copy(rows)), use_accel=False, wrap_mode=dr.WrapMode.Repeat)


@dataclass(kw_only=True)
class Ambience:
    """Uniform light, panels and surroundings for the integrator; kernels do not depend on their number."""

    panels: Panels
    texture: Any  # radiance of the map
    table: Any  # irradiance of its soft part and of the rest, by normal
    even: mi.Float  # irradiance of uniform light, mW/mm^2
    scale: mi.Float  # radiance (mW/mm^2/sr) per value of the map
    rows: mi.Float  # number of rows of the map
    ceiling: mi.Float  # largest value of its soft part
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]  # axes of the map's frame in the scene's frame

    @classmethod
    def build(cls, even_mw_mm2: float, panels: Floats, spec: RadianceMap | None, maps: Maps) -> Ambience:
        """Copy the light to the device; it does not depend on the frame.

        Args:
            even_mw_mm2: irradiance of uniform light.
            panels: (n, 13) as from `frame.panel_table`.
            spec: the map, whose rays are in the world's axes; None for none.
            maps: cache of maps.
        """
        texture, table, made = maps.of(spec)
        scale = 0.0 if spec is None else spec.scale_w_m2_sr * 1e-3
        M = np.eye(3) if spec is None else map_rotation(spec)
        n = upload_scalars(
            np.array([even_mw_mm2, scale, len(made.values), made.ceiling, *M.T.ravel()], dtype=np.float32)
        )
        a, b, c = (mi.Vector3f(*n[k : k + 3]) for k in (4, 7, 10))
        return cls(
            panels=Panels.upload(panels), texture=texture, table=table, even=n[0], scale=n[1], rows=n[2], ceiling=n[3],
            axes=(a, b, c),
        )  # fmt: skip

    def radiance(self, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Compute the radiance (mW/mm^2/sr) along rays of the scene's frame, without the uniform light.

        Overlapping panels add up, and they do not hide the map behind them.
        """
        mapped = self.scale * self.texture.eval(self._place(d, self.rows), active)[0]
        return self.panels.radiance(o, d, active) + mapped

    def soft(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Compute the radiance (mW/mm^2/sr) of uniform light and the map's soft part in directions (scene's frame)."""
        value = self.texture.eval(self._place(d, self.rows), active)[0]
        return self.even * dr.inv_pi + self.scale * dr.minimum(value, self.ceiling)

    def _place(self, v: mi.Vector3f, rows: mi.Float | float) -> mi.Point2f:
        """Map directions (scene's frame) to a texture with `rows` rows, and one additional row at both ends."""
        w = mi.Vector3f(*(dr.dot(axis, v) for axis in self.axes))
        polar = dr.acos(dr.clip(w.z, -1, 1)) * dr.inv_pi
        return mi.Point2f(0.5 - dr.atan2(w.y, w.x) * (0.5 * dr.inv_pi), (1 + polar * rows) / (rows + 2))

    def at(self, x: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """Compute the unshadowed irradiance (mW/mm^2) of matte points x with unit normals n of the scene's frame."""
        soft, hard = self.soft_and_hard(x, n)
        return soft + hard

    def soft_and_hard(self, x: mi.Vector3f, n: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Compute irradiances: of uniform light and the map's soft part, and of the rest of the map and panels."""
        soft, rest = self.table.eval(self._place(n, float(NORMALS)))
        return self.even + self.scale * soft, self.scale * rest + self.panels.irradiance(x, n)


def bright_lamps(spec: RadianceMap | None, maps: Maps, anchor_mm: Floats) -> tuple[Lamp, ...]:
    """Return the light of a map above its soft part, as distant lamps.

    `spec`: the map; `maps`: cache of maps; `anchor_mm`: origin of the scene's frame in the world.
    """
    if spec is None:
        return ()
    bright = maps.of(spec)[2].bright @ map_rotation(spec).T * (spec.scale_w_m2_sr * 1e-3)
    size = np.linalg.norm(bright, axis=1)
    return tuple(
        Lamp(
            position_mm=frozen(anchor_mm + _FAR_MM * flux / one),
            axis=frozen(-flux / one),
            radius_mm=0.0,
            intensity_mw_sr=float(one * _FAR_MM**2),
            lobe_exponent=0.0,
        )
        for flux, one in zip(bright, size, strict=True)
        if one > 0
    )
