"""The parameters of a frame on the device, as opaque Dr.Jit arrays of size one.

A literal that changes between frames would be compiled into the kernel, so everything that can change is stored here.
What determines the kernel (the kinds of surfaces, whether the lens distorts) is the `Structure`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..arrays import Reals
from .parameters import Kind, Parameters, leaves, packed, rebuilt
from .recorded import recorded
from .surfaces import Surface

if TYPE_CHECKING:
    from .irislight import IrisLight
    from .irisrelief import IrisRelief
    from .mattelight import MatteLight

_ALIGNMENT = 64  # bytes; the widest vector of a processor
_POINT_LIKE, _LARGE = 0.015, 0.25  # radius of a lamp over its distance
SMALL = 0.02  # the same of lamps whose shadows of hairs are finer than a pixel
ALL, BITS = 0xFFFFFFFF, 32  # marks of lamps
_LIGHT_ROW = 12  # position 3, axis 3, radius, intensity, lobe exponent, inner radius, 2 unused


def aligned(values: NDArray[Any]) -> NDArray[Any]:
    """Copy an array so that it starts at a multiple of 64 bytes.

    Dr.Jit shares NumPy's memory. It gathers several numbers at once only from aligned memory, so without this the place
    of an allocation would decide which kernel is compiled for a frame.
    """
    memory = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    copy = memory[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy


def sent(numbers: Reals) -> mi.Float:
    """Send numbers to the device, row by row."""
    return mi.Float(aligned(np.asarray(numbers, dtype=np.float32).ravel()))


def one_by_one(numbers: NDArray[np.float32]) -> list[mi.Float]:
    """Send numbers to the device as arrays of size one, in one transfer and one kernel."""
    return _apart(mi.Float(aligned(numbers)), dr.opaque(mi.UInt32, 0), numbers.size)


@recorded
def _apart(buffer: mi.Float, first: mi.UInt32, count: int) -> list[mi.Float]:
    # Places that are known when a kernel is compiled would be copied one by one.
    numbers = [dr.gather(mi.Float, buffer, first + k) for k in range(count)]
    dr.eval(numbers)
    return numbers


def quotient(a: mi.UInt32, b: mi.UInt32) -> mi.UInt32:
    """Whole part of a / b for numbers below a million: processors divide whole numbers one by one."""
    return mi.UInt32((mi.Float(a) + 0.5) / mi.Float(b))


@dataclass(frozen=True, slots=True)
class Structure:
    """What a kernel is compiled for.

    It holds (kind, tilted) of each surface, whether the camera's lens distorts, whether anything can stand in the
    way of light (the surround's plane cannot: it hides no lamp before it), whether the scene is an eye region instead
    of a surround, whether there is other light than that of the lamps, and whether light spreads inside the tissues.
    """

    surfaces: tuple[tuple[Kind, bool], ...]
    distorted: bool = False
    obstacles: bool = True
    region: bool = False
    ambient: bool = False
    scattering: bool = False


class Values:
    """The parameters of a frame on the device, and the shape of the pupil's boundary (`boundary`)."""

    DRJIT_STRUCT = leaves(
        "structure", "boundary", "surfaces", "stop", "iris", "limbus", "sclera", "image", "pose", "camera",
        "inner_index", "pupil_albedo", "globe_reach", "backdrop_x", "ambient_irradiance",
    )  # fmt: skip

    def __init__(
        self,
        structure: Structure,
        parameters: Parameters,
        waves: np.ndarray[Any, np.dtype[np.float64]],
        tables: Sequence[NDArray[np.float32] | None],
    ) -> None:
        """Send the numbers to the device.

        Args:
            structure: what kernels are compiled for.
            parameters: the numbers.
            waves: the pupil's boundary.
            tables: the cells of measured surfaces.
        """
        left = iter(one_by_one(packed(parameters)))

        def leaf(size: int) -> mi.Float | mi.Vector3f | tuple[mi.Float, ...]:
            part = [next(left) for _ in range(size)]
            return part[0] if size == 1 else mi.Vector3f(*part) if size == 3 else tuple(part)

        found = rebuilt(parameters, leaf)
        self.structure = structure
        self.boundary = PupilBoundary(waves)
        buffers = [None if table is None else mi.Float(aligned(table)) for table in tables]
        self.surfaces = tuple(
            Surface(one.origin, one.axes, one.shape, one.eta, kind, table, one.film)
            for one, (kind, _), table in zip(found.surfaces, structure.surfaces, buffers, strict=True)
        )
        self.stop, self.iris, self.limbus, self.sclera = found.stop, found.iris, found.limbus, found.sclera
        self.image, self.pose, self.camera = found.image, found.pose, found.camera
        self.inner_index, self.pupil_albedo = found.inner_index, found.pupil_albedo
        self.globe_reach, self.backdrop_x = found.globe_reach, found.backdrop_x
        self.ambient_irradiance = found.ambient_irradiance

    def point_to_eye(self, x: mi.Vector3f) -> mi.Vector3f:
        """Transform a point from the scene's frame to the eye frame: M^T (x - t)."""
        return self.vector_to_eye(x - self.pose.shift)

    def vector_to_eye(self, v: mi.Vector3f) -> mi.Vector3f:
        """Transform a direction from the scene's frame to the eye frame: M^T v."""
        return mi.Vector3f(*(dr.dot(column, v) for column in self.pose.columns))

    def vector_to_scene(self, v: mi.Vector3f) -> mi.Vector3f:
        """Transform a direction from the eye frame to the scene's frame: M v."""
        a, b, c = self.pose.columns
        return a * v.x + b * v.y + c * v.z

    def point_to_scene(self, x: mi.Vector3f) -> mi.Vector3f:
        """Transform a point from the eye frame to the scene's frame: M x + t."""
        return self.vector_to_scene(x) + self.pose.shift


HARMONICS = 32  # largest number for the pupil's boundary


class PupilBoundary:
    """The pupil's boundary: relative radius r(f) = 1 + Re sum_k z_k e^(i k f), f the angle in the stop's plane.

    `waves` (n, 2) are the z_k = c_k - i s_k, k from 1, as pairs. An ellipse has none and costs nothing.
    """

    DRJIT_STRUCT = leaves("count", "_buffer")

    def __init__(self, waves: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        self.count = dr.opaque(mi.UInt32, len(waves))
        table = np.zeros((HARMONICS, 2), np.float32)
        table[: len(waves)] = waves
        self._buffer = mi.Float(aligned(table.ravel()))

    def radius(self, x: mi.Float, y: mi.Float) -> mi.Float:
        """Radius r in the direction (x, y) from the centre, by Horner's rule in e^(i f)."""
        inv = dr.rsqrt(dr.maximum(x * x + y * y, 1e-12))
        c, s = x * inv, y * inv

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return k > 0

        def body(k: mi.UInt32, re: mi.Float, im: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
            k = k - 1
            re = re + dr.gather(mi.Float, self._buffer, 2 * k)
            im = im + dr.gather(mi.Float, self._buffer, 2 * k + 1)
            return k, re * c - im * s, re * s + im * c

        state = (mi.UInt32(self.count), mi.Float(0), mi.Float(0))
        return 1 + dr.while_loop(state, more, body, labels=("k", "re", "im"), label="margin")[1]


def point_like(table: NDArray[np.float64]) -> bool:
    """Whether all lamps of a table (see `frame.light_table`) are so small that their middles stand for them."""
    return _widest(table) < _POINT_LIKE and not np.any(table[:, 9] > 0)


def _widest(table: NDArray[np.float64]) -> float:
    """Largest radius of lamps over their distance from the eye."""
    away = np.linalg.norm(table[:, :3], axis=1)
    return float(np.max(table[:, 6] / np.maximum(away, 1e-3), initial=0.0))


class Lights:
    """The lamps in the eye frame, (n, 10) numbers in one buffer; kernels do not depend on their number.

    `widest` is the largest radius over the distance from the eye, `points` how many points stand for each lamp at the
    nodes of a grid, and `gridded` whether lamps of that size may have grids. `suns` is 1 if the last lamp is a sun with
    sharp shadows, else 0. `on_iris` and `on_matte` are their light
    in the plane of the iris and on matte surfaces where grids of it are used, and `relief` is the iris' relief in their
    light.
    """

    DRJIT_STRUCT = leaves("count", "suns", "_buffer", "on_iris", "on_matte", "relief")

    def __init__(self, table: np.ndarray[Any, np.dtype[np.float64]], suns: int = 0) -> None:
        self._len = len(table)
        self.on_iris: IrisLight | None = None
        self.on_matte: MatteLight | None = None
        self.relief: IrisRelief | None = None
        away = np.linalg.norm(table[:, :3], axis=1)
        self.widest = _widest(table)
        self.points = 1 if point_like(table) else 4
        self.gridded = self.widest < _LARGE
        self.count = dr.opaque(mi.UInt32, self._len)
        self.suns = dr.opaque(mi.UInt32, suns if self._len and table[-1, 6] < SMALL * away[-1] else 0)
        rows = np.zeros((max(len(table), 1), _LIGHT_ROW), np.float32)
        rows[: len(table), : table.shape[1]] = table
        self._buffer = sent(rows)

    def __len__(self) -> int:
        return self._len

    def __getitem__(self, i: mi.UInt32) -> Lamp:
        # Four numbers are gathered at once.
        a, b, c = (dr.gather(mi.Vector4f, self._buffer, i * (_LIGHT_ROW // 4) + k) for k in range(3))
        return Lamp(mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(a.w, b.x, b.y), b.z, b.w, c.x, c.y, i)


@dataclass(frozen=True, slots=True)
class Lamp:
    """One LED on the device: I(w) = intensity * max(0, cos)^exponent, from an annulus of points across its axis."""

    position: mi.Vector3f
    axis: mi.Vector3f
    radius: mi.Float
    intensity: mi.Float
    exponent: mi.Float
    inner_radius: mi.Float
    number: mi.UInt32

    def point(self, u: mi.Float, sine: mi.Float, cosine: mi.Float) -> mi.Vector3f:
        """Point of the emitting disc or ring, uniform by area: u in [0, 1) and a direction in its plane."""
        e1, e2 = mi.coordinate_system(self.axis)
        inner = self.inner_radius * self.inner_radius
        r = dr.sqrt(inner + u * (self.radius * self.radius - inner))
        return self.position + (r * cosine) * e1 + (r * sine) * e2

    def node(self, k: mi.UInt32, count: mi.UInt32) -> mi.Vector3f:
        """Point k of the `count` that stand for the lamp at the nodes of a grid: its middle, or four about it."""
        turn = (mi.Float(k) + 0.5) * (0.5 * dr.pi)
        return self.point(dr.select(count > 1, 0.5, 0), *dr.sincos(turn))

    def radiant_intensity(self, direction: mi.Vector3f) -> mi.Float:
        """Radiant intensity (mW/sr) into a unit direction that leaves the lamp."""
        c = dr.dot(direction, self.axis)
        # A Lambertian lamp, the usual one, needs no power function.
        lobe = dr.if_stmt(
            (c, self.exponent),
            self.exponent != 1,
            lambda c, m: dr.select(m == 0, 1, dr.select(c > 0, dr.power(dr.maximum(c, 1e-6), m), 0)),
            lambda c, m: dr.maximum(c, 0),
        )
        return self.intensity * lobe
