"""The radiosity field: light received by the patches, interpolated for kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Floats
from ..records.frame import upload_array, upload_scalars
from .chamber import IRIS_RINGS, ROOT_RINGS, Chamber
from .chamber import TURNS as IRIS_TURNS
from .patches import GLOBE_COLUMNS, MAP_SIDE, PLANE_FIRST_MM, PLANE_MM, RINGS, TURNS, WIDEST, GlobePatches
from .tissuegrids import Bilinear


@dataclass(kw_only=True)
class RadiosityField:
    """Irradiance of surfaces from other surfaces, and the visible share of the sky.

    Patches of globe and background have four numbers each: irradiance from other surfaces, visible share of the sky,
    total irradiance (for mirror images of the patch), and 0. Without interreflection, surfaces give no light and the
    whole sky is visible. The numbers of the skin are stored at its vertices (`SkinGeometry.received`).
    """

    on: mi.Bool  # whether there is interreflection
    between: bool  # whether the grid of patches on the globe lies between lids
    columns: int  # columns of that grid
    rows: int  # rows of that grid
    centre: mi.Vector3f  # centre of the globe (scene's frame, mm)
    first: mi.Float  # y (mm) of the first column between lids
    per_mm: mi.Float  # columns per mm
    ends: mi.Float  # lower and upper end of each column (mm)
    root2: mi.Float  # squared radius of the root of the iris, mm^2
    reach2: mi.Float  # squared reach of the chamber, mm^2
    # y and z of the centre of the background's rings, and the radius of the first (mm)
    plane: tuple[mi.Float, mi.Float, mi.Float]
    globe: mi.Float  # four numbers for each patch of the globe
    background: mi.Float  # four numbers for each patch of the background's plane
    iris: mi.Float  # one number for each patch of the iris

    @classmethod
    def dark(cls, on: bool, chamber: Chamber, globe: GlobePatches, plane: tuple[float, float, float]) -> RadiosityField:
        """Copy the patches to the device, without any light.

        Args:
            on: whether there is interreflection.
            chamber: the chamber of the eye.
            globe: the patches of the globe.
            plane: as the attribute.
        """
        rim = [chamber.root_mm**2, chamber.reach_mm**2]
        n = upload_scalars(np.array([*globe.table[:5], *rim, *plane], dtype=np.float32))
        none = upload_array(np.zeros(4))
        return cls(
            on=dr.opaque(mi.Bool, on), between=globe.columns == GLOBE_COLUMNS, columns=globe.columns, rows=globe.rows,
            centre=mi.Vector3f(*n[:3]), first=n[3], per_mm=n[4], root2=n[5], reach2=n[6], plane=(n[7], n[8], n[9]),
            ends=upload_array(globe.table[5:]), globe=none, background=none, iris=none,
        )  # fmt: skip

    def with_light(self, globe: Floats, background: Floats, iris: Floats) -> RadiosityField:
        """Return the same patches with the light that they receive."""
        return replace(self, globe=upload_array(globe), background=upload_array(background), iris=upload_array(iris))

    def at_globe(self, x: mi.Vector3f) -> mi.Vector4f:
        """Interpolate the patches' numbers at points of the globe, given in the scene's frame."""
        beyond = 0.5 if self.between else 0.0  # the last rows are half a row from the lids, where light varies fast
        return _bilinear(self.globe, *self.globe_place(x), self.columns, self.rows, beyond)

    def globe_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Compute column and row, in the patch grid, of points of the globe."""
        if self.between:
            column = dr.clip((x.y - self.first) * self.per_mm, 0, GLOBE_COLUMNS - 1)
            i = mi.UInt32(dr.minimum(column, GLOBE_COLUMNS - 1.001))
            w = column - mi.Float(i)
            a, b = (dr.gather(mi.Vector2f, self.ends, i + k) for k in (0, 1))
            low, high = a.x + w * (b.x - a.x), a.y + w * (b.y - a.y)
            return column, (x.z - low) / (high - low) * self.rows - 0.5
        r = dr.normalize(x - self.centre)
        polar = dr.acos(dr.clip(r.x, -1, 1)) / WIDEST
        inv = dr.rcp(dr.maximum(dr.sqrt(r.y * r.y + r.z * r.z), 1e-6))
        middle = 0.5 * (MAP_SIDE - 1)
        return middle * (1 + polar * r.y * inv), middle * (1 + polar * r.z * inv)

    def at_iris(self, x: mi.Vector3f) -> mi.Float:
        """Interpolate the indirect irradiance at points in the plane of the iris (eye frame)."""
        return _around(self.iris, *self.iris_place(x), IRIS_RINGS, IRIS_TURNS, mi.Float)

    def iris_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Compute ring and turn, among the chamber's patches, of points in the plane of the iris."""
        turn = dr.atan2(x.z, x.y) * (IRIS_TURNS * 0.5 * dr.inv_pi) - 0.5
        r2 = x.y * x.y + x.z * x.z
        beyond = dr.maximum(r2 - self.root2, 0) * ((IRIS_RINGS - ROOT_RINGS) / (self.reach2 - self.root2))
        ring = dr.minimum(r2 / self.root2, 1) * ROOT_RINGS + beyond - 0.5
        return ring, dr.select(turn < 0, turn + IRIS_TURNS, turn)

    def at_background(self, x: mi.Vector3f) -> mi.Vector4f:
        """Interpolate the patches' numbers at points of the background's plane, given in the scene's frame."""
        return _around(self.background, *self.background_place(x), RINGS, TURNS, mi.Vector4f)

    def background_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Compute ring and turn, among its patches, of points of the background's plane."""
        y, z, inner = self.plane
        dy, dz = x.y - y, x.z - z
        out = dr.maximum(dr.sqrt(dy * dy + dz * dz) - inner, 0) / PLANE_FIRST_MM
        ring = dr.log(1 + out) * ((RINGS - 1) / float(np.log1p(PLANE_MM / PLANE_FIRST_MM)))
        turn = dr.atan2(dz, dy) * (TURNS * 0.5 * dr.inv_pi)
        return ring, dr.select(turn < 0, turn + TURNS, turn)


def _bilinear(buffer: mi.Float, column: mi.Float, row: mi.Float, columns: int, rows: int, beyond: float) -> mi.Vector4f:
    """Interpolate bilinearly between columns and rows; extrapolate by up to `beyond` rows."""
    column, row = dr.clip(column, 0, columns - 1.001), dr.clip(row, -beyond, rows - 1.001 + beyond)
    i, j = mi.UInt32(column), mi.UInt32(dr.clip(row, 0, rows - 1.001))
    place = j * columns + i
    cells = Bilinear((place, place + 1, place + columns, place + columns + 1), column - mi.Float(i), row - mi.Float(j))
    return dr.maximum(cells.interpolate(mi.Vector4f, buffer), 0)


def _around(buffer: mi.Float, ring: mi.Float, turn: mi.Float, rings: int, turns: int, kind: Any) -> Any:
    """Interpolate between rings, and between the nodes around a ring, whose last node neighbours the first."""
    ring, turn = dr.clip(ring, 0, rings - 1.001), dr.clip(turn, 0, turns - 0.001)
    i, j = mi.UInt32(ring), mi.UInt32(turn)
    beside = j, dr.select(j + 1 < turns, j + 1, 0)
    numbers = tuple(p * turns + q for p in (i, i + 1) for q in beside)
    return Bilinear(numbers, turn - mi.Float(j), ring - mi.Float(i)).interpolate(kind, buffer)
