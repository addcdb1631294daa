"""The numbers of a frame, packed on the host and laid out as opaque Dr.Jit arrays of size one.

A literal that changes between frames would be compiled into the kernel; everything that can change goes through here.
What shapes the kernel (the kinds of surfaces, whether the lens distorts) is the `Structure`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from .surfaces import Surface

LIGHT_WIDTH = 10  # position 3, axis 3, radius, intensity, lobe exponent, inner radius


@dataclass(frozen=True, slots=True)
class Structure:
    """What a kernel is compiled for: (biconic, tilted) of each surface, whether the camera's lens distorts, and whether
    anything but the surround's plane, which hides no lamp before it, can stand in the way of light; whether the scene
    is an eye region instead of a surround; whether there is other light than the lamps'."""

    surfaces: tuple[tuple[bool, bool], ...]
    distorted: bool = False
    obstacles: bool = True
    region: bool = False
    ambient: bool = False

    @property
    def layout(self) -> tuple[tuple[str, int], ...]:
        """Names and sizes of the packed numbers."""
        rows: list[tuple[str, int]] = []
        for i, (_, tilted) in enumerate(self.surfaces):
            rows += [(f"s{i}.origin", 3), (f"s{i}.shape", 5), (f"s{i}.eta", 1)]
            if tilted:
                rows += [(f"s{i}.row{k}", 3) for k in range(3)]
        rows += [
            ("inner_index", 1),
            ("stop.centre", 3),
            ("stop.normal", 3),
            ("stop.u", 3),
            ("stop.v", 3),
            ("stop.axes", 2),
            ("iris_root", 1),
            ("limbus_radius", 1),
            ("limbus_floor", 1),
            ("limbus_width", 1),
            ("limbus_gain", 1),
            ("sclera.centre", 3),
            ("sclera.radius", 1),
            ("globe.reach", 1),
            ("image.scale", 1),
            ("image.shift", 1),
            ("pose.col0", 3),
            ("pose.col1", 3),
            ("pose.col2", 3),
            ("pose.shift", 3),
            ("camera.centre", 3),
            ("camera.right", 3),
            ("camera.down", 3),
            ("camera.forward", 3),
            ("camera.focal", 2),
            ("camera.principal", 2),
            ("camera.distortion", 5),
            ("iris.albedo", 1),
            ("iris.contrast", 1),
            ("pupil.albedo", 1),
            ("sclera.albedo", 1),
            ("sclera.contrast", 1),
            ("limbus.albedo", 1),
            ("backdrop.x", 1),
            ("ambient.irradiance", 1),
        ]
        return tuple(rows)

    def pack(self, numbers: Mapping[str, ArrayLike]) -> np.ndarray[Any, np.dtype[np.float32]]:
        """The numbers as one vector in the order of the layout."""
        parts = []
        for name, size in self.layout:
            part = np.asarray(numbers[name], dtype=np.float64).reshape(-1)
            if part.size != size:
                raise ValueError(f"{name} has {part.size} numbers, not {size}")
            parts.append(part)
        return np.concatenate(parts).astype(np.float32)


class Values:
    """The packed numbers on the device: `values["stop.centre"]` is a Float, a Vector3f or a tuple of Floats; `margin`
    is the pupil's."""

    def __init__(
        self,
        structure: Structure,
        packed: np.ndarray[Any, np.dtype[np.float32]],
        waves: np.ndarray[Any, np.dtype[np.float64]],
    ) -> None:
        buffer = mi.Float(packed)
        scalars = [dr.gather(mi.Float, buffer, mi.UInt32(k)) for k in range(packed.size)]
        dr.eval(scalars)
        self.structure = structure
        self.margin = Margin(waves)
        self._items: dict[str, Any] = {}
        at = 0
        for name, size in structure.layout:
            part = scalars[at : at + size]
            at += size
            self._items[name] = part[0] if size == 1 else mi.Vector3f(*part) if size == 3 else tuple(part)
        self.surfaces = tuple(self._surface(i, *kind) for i, kind in enumerate(structure.surfaces))

    def __getitem__(self, name: str) -> Any:
        return self._items[name]

    def _surface(self, i: int, biconic: bool, tilted: bool) -> Surface:
        rows = (self[f"s{i}.row0"], self[f"s{i}.row1"], self[f"s{i}.row2"]) if tilted else None
        return Surface(self[f"s{i}.origin"], rows, self[f"s{i}.shape"], self[f"s{i}.eta"], biconic)

    def point_to_eye(self, x: Any) -> Any:
        """A point of the scene's frame in the eye frame: M^T (x - t)."""
        return self.vector_to_eye(x - self["pose.shift"])

    def vector_to_eye(self, v: Any) -> Any:
        """A direction of the scene's frame in the eye frame: M^T v."""
        return mi.Vector3f(*(dr.dot(self[f"pose.col{k}"], v) for k in range(3)))

    def vector_to_scene(self, v: Any) -> Any:
        """A direction of the eye frame in the scene's frame: M v."""
        return self["pose.col0"] * v.x + self["pose.col1"] * v.y + self["pose.col2"] * v.z

    def point_to_scene(self, x: Any) -> Any:
        """A point of the eye frame in the scene's frame: M x + t."""
        return self.vector_to_scene(x) + self["pose.shift"]


HARMONICS = 32  # of the pupil's margin at most


class Margin:
    """The pupil's margin: relative radius r(f) = 1 + Re sum_k z_k e^(i k f), f the angle in the stop's plane.

    `waves` (n, 2) are the z_k = c_k - i s_k, k from 1, as pairs. An ellipse has none, and costs nothing.
    """

    def __init__(self, waves: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        self.count = dr.opaque(mi.UInt32, len(waves))
        table = np.zeros((HARMONICS, 2), np.float32)
        table[: len(waves)] = waves
        self._buffer = mi.Float(table.ravel())

    def radius(self, x: Any, y: Any) -> Any:
        """r in the direction (x, y) from the centre, by Horner's rule in e^(i f)."""
        inv = dr.rsqrt(dr.maximum(x * x + y * y, 1e-12))
        c, s = x * inv, y * inv

        def more(k: Any, *_: Any) -> Any:
            return k > 0

        def body(k: Any, re: Any, im: Any) -> Any:
            k = k - 1
            re = re + dr.gather(mi.Float, self._buffer, 2 * k)
            im = im + dr.gather(mi.Float, self._buffer, 2 * k + 1)
            return k, re * c - im * s, re * s + im * c

        state = (mi.UInt32(self.count), mi.Float(0), mi.Float(0))
        return 1 + dr.while_loop(state, more, body, labels=("k", "re", "im"), label="margin")[1]


class Lights:
    """The lamps in the eye frame, (n, 10) numbers in one buffer; kernels do not depend on their number."""

    def __init__(self, table: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        self._len = len(table)
        self.count = dr.opaque(mi.UInt32, len(table))
        self._buffer = mi.Float(np.ascontiguousarray(table, dtype=np.float32).reshape(-1))

    def __len__(self) -> int:
        return self._len

    def __getitem__(self, i: Any) -> Any:
        base = i * LIGHT_WIDTH
        row = [dr.gather(mi.Float, self._buffer, base + k) for k in range(LIGHT_WIDTH)]
        return Lamp(mi.Vector3f(*row[0:3]), mi.Vector3f(*row[3:6]), *row[6:10])


@dataclass(frozen=True, slots=True)
class Lamp:
    """One LED on the device: I(w) = intensity * max(0, cos)^exponent, from an annulus of points across its axis."""

    position: Any
    axis: Any
    radius: Any
    intensity: Any
    exponent: Any
    inner_radius: Any

    def point(self, u: Any, sine: Any, cosine: Any) -> Any:
        """A point of the emitting disc or ring, uniform by area: u in [0, 1) and a direction in its plane."""
        e1, e2 = mi.coordinate_system(self.axis)
        inner = self.inner_radius * self.inner_radius
        r = dr.sqrt(inner + u * (self.radius * self.radius - inner))
        return self.position + (r * cosine) * e1 + (r * sine) * e2

    def radiant_intensity(self, direction: Any) -> Any:
        """Radiant intensity (mW/sr) into a unit direction that leaves the lamp."""
        c = dr.dot(direction, self.axis)
        # A Lambertian lamp, the usual one, is spared the power.
        lobe = dr.if_stmt(
            (c, self.exponent),
            self.exponent != 1,
            lambda c, m: dr.select(m == 0, 1, dr.select(c > 0, dr.power(dr.maximum(c, 1e-6), m), 0)),
            lambda c, m: dr.maximum(c, 0),
        )
        return self.intensity * lobe
