"""A frame on the device; its parameters are opaque Dr.Jit arrays of size one.

A literal would be compiled into the kernel, so every number that changes between frames is stored here as an array.
`Structure` holds the plain values that select the kernel (the kinds of surfaces, whether the lens distorts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools, Floats, Reals, Singles
from ...rig.distortion import is_fisheye
from .job import LampTable
from .parameters import FrameParameters, Kind, Parameters, packed, rebuilt
from .recording import recorded, syntax
from .surfaces import DeviceLens, DeviceSurface

_ALIGNMENT = 64  # bytes; the widest vector of a processor
SMALL = 0.02  # radius over distance of lamps whose shadows of hairs are finer than a pixel
ALL, BITS = 0xFFFFFFFF, 32  # marks of lamps
_ALPHA = tuple(round(1.324717957244746 ** -(k + 1) * 2**32) for k in range(2))
_LIGHT_ROW = 12  # position 3, axis 3, radius, intensity, lobe exponent, inner radius, 2 unused


def aligned_copy(values: NDArray[Any]) -> NDArray[Any]:
    """Copy an array so that it starts at a multiple of 64 bytes.

    Dr.Jit shares NumPy's memory and gathers several numbers at once only from aligned memory. Without alignment, the
    address of an allocation would decide which kernel is compiled.
    """
    memory = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    copy = memory[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy


def upload_array(numbers: Reals) -> mi.Float:
    """Copy numbers to the device, row by row."""
    return mi.Float(aligned_copy(np.asarray(numbers, dtype=np.float32).ravel()))


def upload_scalars(numbers: NDArray[np.float32]) -> list[mi.Float]:
    """Copy numbers to the device as arrays of size one, in one transfer and one kernel."""
    return _apart(mi.Float(aligned_copy(numbers)), dr.opaque(mi.UInt32, 0), numbers.size)


@recorded
def _apart(buffer: mi.Float, first: mi.UInt32, count: int) -> list[mi.Float]:
    # Constants known at compile time would be copied one by one.
    numbers = [dr.gather(mi.Float, buffer, first + k) for k in range(count)]
    dr.eval(numbers)
    return numbers


def quotient(a: mi.UInt32, b: mi.UInt32) -> mi.UInt32:
    """Compute floor(a / b) of numbers below a million in floating point; integer division does not vectorise."""
    return mi.UInt32((mi.Float(a) + 0.5) / mi.Float(b))


def sequence(k: mi.UInt32, shift: tuple[Any, Any] = (0, 0)) -> tuple[mi.Float, mi.Float]:
    """Return points k of a sequence that fills [0, 1)^2 evenly (Roberts 2018); `shift` is in units of 2^-32.

    Point k is at frac(shift + k alpha), alpha = (phi^-1, phi^-2), phi^3 = phi + 1.
    """
    u, v = (mi.Float((s + k * mi.UInt32(a)) >> 8) * 2.0**-24 for s, a in zip(shift, _ALPHA, strict=True))
    return u, v


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Plain values that select the compiled kernels."""

    surfaces: tuple[tuple[Kind, bool], ...]  # (kind, tilted) of each refracting surface
    distorted: bool = False  # whether the camera's lens distorts
    measured_falloff: bool = False  # whether the lens' fall-off is measured, so that rays have no weights
    obstacles: bool = True  # whether anything can block light; the background's plane alone cannot
    region: bool = False  # whether the eye has a region instead of a background
    ambient: bool = False  # whether there is light other than that of the lamps
    scattering: bool = False  # whether skin and sclera have subsurface scattering
    lenses: tuple[tuple[Kind, Kind], ...] = ()  # kinds of front and back of the lenses worn, from outside inwards
    lit_through: bool | None = False  # whether the lamps light the eye through the lenses; None if some do


@dataclass(kw_only=True)
class Caches:
    """Caches of light, computed once per frame before its samples; None where a frame has none.

    Every cache has the same two functions: `build(frame, ...)` computes it, and `at(...)` looks it up at points. A
    cache for several surfaces has one lookup per surface: `at_skin`, `at_globe`, `at_iris`, `at_background`. The
    radiosity field takes two steps instead of `build`, because the device computes other caches between them (`gather`
    and `solve` of `radiosity`).

    Their classes are in `transport/`. `FrameBuilder` builds them in this order, because later ones use earlier ones.
    Only the frame refers to them, so their modules do not depend on each other.
    """

    shadow_maps: Any = None  # where a lamp certainly reaches skin (`shadowmaps.ShadowMaps`)
    diffusion: Any = None  # subsurface light of skin and sclera (`diffusion.DiffusedLight`)
    ambience: Any = None  # light from the panels and the environment map (`environment.Ambience`)
    iris: Any = None  # irradiance of the lamps in the plane of the iris (`irisirradiance.IrisIrradiance`)
    relief: Any = None  # relief mapping of the iris in the light of the lamps (`reliefmapping.IrisRelief`)
    fundus: Any = None  # lamp light returned by the fundus (`fundusirradiance.FundusIrradiance`)
    radiosity: Any = None  # irradiance from other surfaces (`radiosityfield.RadiosityField`)
    # irradiance of the lamps on a bare globe and the plane around it (`globeirradiance.GlobeIrradiance`)
    globe: Any = None


@dataclass(kw_only=True)
class DeviceFrame(FrameParameters):
    """A frame on the device: its parameters, and everything else that kernels read."""

    structure: Structure  # selects the kernels
    boundary: PupilBoundary  # the shape of the pupil's boundary
    surfaces: tuple[DeviceSurface, ...]
    caches: Caches  # light computed before the samples
    lights: Any = None  # the lamps (`Lights`)
    textures: Any = None  # the maps of the eye (`albedo.Textures`)
    region: Any = None  # the eye region (`region.SkinGeometry`), if there is one
    background: Any = None  # surroundings of an eye without a region (`background.BackgroundGeometry`)
    scene: Any = None  # Mitsuba scene of everything except the eye
    lenses: tuple[DeviceLens, ...] = ()  # worn lenses in the scene's frame, from outside inwards
    turned_lenses: tuple[DeviceLens, ...] = ()  # the same in the eye's frame

    @classmethod
    def upload(
        cls, structure: Structure, parameters: Parameters, waves: Floats, tables: Sequence[Singles | None]
    ) -> DeviceFrame:
        """Copy the numbers of a frame to the device; its other parts are set afterwards.

        Args:
            structure: selects the kernels.
            parameters: the numbers.
            waves: the pupil's boundary.
            tables: the cells of measured surfaces.
        """
        left = iter(upload_scalars(packed(parameters)))

        def leaf(size: int) -> mi.Float | mi.Vector3f | tuple[mi.Float, ...]:
            part = [next(left) for _ in range(size)]
            return part[0] if size == 1 else mi.Vector3f(*part) if size == 3 else tuple(part)

        sent_parameters = rebuilt(parameters, leaf)
        others = {f.name: getattr(sent_parameters, f.name) for f in fields(Parameters)}
        surfaces = tuple(
            DeviceSurface(
                s.origin, s.axes, s.shape, s.eta, kind, None if table is None else mi.Float(aligned_copy(table)), s.film
            )
            for s, (kind, _), table in zip(others.pop("surfaces"), structure.surfaces, tables, strict=True)
        )
        for name in ("lenses", "turned_lenses"):
            others[name] = tuple(map(_device_lens, others[name], structure.lenses))
        boundary = PupilBoundary.upload(waves)
        return cls(structure=structure, boundary=boundary, surfaces=surfaces, **others, caches=Caches())

    def bare(self) -> DeviceFrame:
        """Return the frame without lamps, textures and light, for recordings that remain valid when these change."""
        return replace(self, lights=None, textures=None, caches=Caches())

    def axis_cosine(self, d: mi.Vector3f) -> mi.Float:
        """Compute depth per distance along a camera ray d: its cosine to the axis; 1 for a fisheye."""
        return mi.Float(1) if is_fisheye(self.camera.distortion) else dr.dot(d, self.camera.forward)

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


def _device_lens(lens: Any, kinds: tuple[Kind, Kind]) -> DeviceLens:
    front, back = (
        DeviceSurface(s.origin, s.axes, s.shape, s.eta, kind)
        for s, kind in zip((lens.front, lens.back), kinds, strict=True)
    )
    rest = {f.name: getattr(lens, f.name) for f in fields(lens) if f.name not in ("front", "back")}
    return DeviceLens(front=front, back=back, **rest)


HARMONICS = 32  # largest number of coefficients of the pupil's boundary


@dataclass(kw_only=True)
class PupilBoundary:
    """The pupil's boundary: relative radius r(f) = 1 + Re sum_k z_k e^(i k f), with f the angle in the stop's plane."""

    count: mi.UInt32  # number of coefficients z_k; 0 for an ellipse, which costs no time
    waves: mi.Float  # the real and imaginary parts of the z_k, k from 1

    @classmethod
    def upload(cls, waves: Floats) -> PupilBoundary:
        """Copy z_k = c_k - i s_k, (n, 2), to the device."""
        table = np.zeros((HARMONICS, 2), np.float32)
        table[: len(waves)] = waves
        return cls(count=dr.opaque(mi.UInt32, len(waves)), waves=mi.Float(aligned_copy(table.ravel())))

    @syntax
    def radius(self, x: mi.Float, y: mi.Float) -> mi.Float:
        """Compute the radius r in the direction (x, y) from the centre, by Horner's rule in e^(i f)."""
        inv = dr.rsqrt(dr.maximum(x * x + y * y, 1e-12))
        c, s = x * inv, y * inv
        k, re, im = mi.UInt32(self.count), mi.Float(0), mi.Float(0)
        while dr.hint(k > 0, label="margin", exclude=[self, c, s]):
            k -= 1
            a = re + dr.gather(mi.Float, self.waves, 2 * k)
            b = im + dr.gather(mi.Float, self.waves, 2 * k + 1)
            re, im = a * c - b * s, a * s + b * c
        return 1 + re


@dataclass(kw_only=True)
class Lights:
    """The lamps in the eye frame, in one buffer, so kernels do not depend on their number."""

    count: mi.UInt32  # number of lamps
    suns: mi.UInt32  # 1 if the last lamp is a sun with sharp shadows, else 0
    rows: mi.Float  # the numbers of the lamps, as in `LampTable`; the last one is 1 for lamps whose light passes lenses
    lenses: tuple[DeviceLens, ...] = ()  # worn lenses in the eye's frame

    @classmethod
    def upload(cls, table: LampTable, lenses: tuple[DeviceLens, ...] = (), through: Bools | bool = False) -> Lights:
        """Copy lamps to the device; `lenses` in the eye's frame shade what they light, some light the eye `through`."""
        rows = np.zeros((max(len(table), 1), _LIGHT_ROW), np.float32)
        rows[: len(table), : table.rows.shape[1]] = table.rows
        rows[: len(table), 10] = through
        sharp = table.suns and table.widths[-1] < SMALL
        count, suns = (dr.opaque(mi.UInt32, n) for n in (len(table), table.suns if sharp else 0))
        return cls(count=count, suns=suns, rows=upload_array(rows), lenses=lenses)

    def __getitem__(self, i: mi.UInt32) -> DeviceLamp:
        # Four numbers are gathered at once.
        a, b, c = (dr.gather(mi.Vector4f, self.rows, i * (_LIGHT_ROW // 4) + k) for k in range(3))
        return DeviceLamp(
            position=mi.Vector3f(a.x, a.y, a.z), axis=mi.Vector3f(a.w, b.x, b.y), radius=b.z, intensity=b.w,
            exponent=c.x, inner_radius=c.y, number=i, through=c.z, lenses=self.lenses,
        )  # fmt: skip


@dataclass(kw_only=True)
class DeviceLamp:
    """One LED on the device: I(w) = intensity * max(0, cos)^exponent, emitted by an annulus across its axis."""

    position: mi.Vector3f
    axis: mi.Vector3f
    radius: mi.Float
    intensity: mi.Float
    exponent: mi.Float
    inner_radius: mi.Float
    number: mi.UInt32
    through: mi.Float
    lenses: tuple[DeviceLens, ...]

    def point(self, u: mi.Float, sine: mi.Float, cosine: mi.Float) -> mi.Vector3f:
        """Sample the emitting disc or ring, uniformly by area: u in [0, 1) and a direction in its plane."""
        e1, e2 = mi.coordinate_system(self.axis)
        inner = self.inner_radius * self.inner_radius
        r = dr.sqrt(inner + u * (self.radius * self.radius - inner))
        return self.position + (r * cosine) * e1 + (r * sine) * e2

    def node(self, k: mi.UInt32, count: mi.UInt32) -> mi.Vector3f:
        """Return point k of the `count` that represent the lamp at grid nodes: its middle, or four around it."""
        turn = (mi.Float(k) + 0.5) * (0.5 * dr.pi)
        return self.point(dr.select(count > 1, 0.5, 0), *dr.sincos(turn))

    def shade(self, x: mi.Vector3f, source: mi.Vector3f) -> mi.Float:
        """Return the share of the light from a point of the lamp that worn lenses let pass to points x (eye frame)."""
        share = mi.Float(1)
        for lens in self.lenses:
            share *= lens.shade(x, source)
        return share

    @syntax
    def radiant_intensity(self, direction: mi.Vector3f) -> mi.Float:
        """Compute the radiant intensity (mW/sr) into a unit direction that leaves the lamp."""
        c, m = dr.dot(direction, self.axis), self.exponent
        lobe = dr.maximum(c, 0)
        # A Lambertian lamp, the usual one, needs no power function.
        if dr.hint(m != 1, exclude=[c, m]):
            lobe = dr.select(m == 0, 1, dr.select(c > 0, dr.power(dr.maximum(c, 1e-6), m), 0))
        return self.intensity * lobe
