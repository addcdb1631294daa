"""Light other than that of the lamps: even light, emitting panels, and surroundings given as an HDR map.

The front cornea mirrors all of it along exact rays (those of the integrator). Matte surfaces are lit by its irradiance,
without shadows. A map is infinitely far away. Its irradiance is its cosine convolution in spherical harmonics up to
order 2 (Ramamoorthi and Hanrahan 2001, equations 4 to 12; on average within a few per cent of the integral),

    E(n) = sum_lm A_l L_lm Y_lm(n),    A = (pi, 2 pi / 3, pi / 4),    L_lm = integral of L Y_lm over all directions.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayValue, Floats, frozen
from ..errors import InputError
from ..files import opened
from ..rig.imaging import RadianceMap
from ..rig.surroundings import paint
from ..spec import file_digest
from .exr import second_thread
from .panels import Panels

_WIDTH, _HEIGHT = 1024, 512
_FINE = 256
_FORMATS = (".hdr", ".exr", ".pfm", ".npy")
# Rec. 709.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_KEPT = 4
# 16384 x 8192, of which 1024 x 512 are used.
MAX_MAP_PIXELS = 2**27
_HEADER_BYTES = 65536
_SIDES = {
    ".hdr": rb"[-+][XY] *([0-9]{1,20}) *[-+][XY] *([0-9]{1,20})",
    ".pfm": rb"^P[fF]\s+([0-9]{1,20})\s+([0-9]{1,20})",
}
_ENTRIES = 21  # even irradiance, 9 of the rotation, scale, rows, 9 of the irradiance


@dataclass(frozen=True, slots=True, eq=False)
class Surrounding(ArrayValue):
    """A map made ready: `values` (h, w) float32, and `harmonics` (9,) of the irradiance per unit of its values."""

    values: Any
    harmonics: Floats


def read_map(path: str | Path, channel: str = "red") -> Floats:
    """Read the values (h, w) of a latitude-longitude map; w = 2 h.

    Args:
        path: Radiance .hdr, OpenEXR .exr, .pfm, or a NumPy array .npy of shape (h, w) or (h, w, channels).
        channel: channel of a colour map that is used: red, green, blue, or luminance (Rec. 709).

    Raises:
        InputError: it is missing, unreadable, of another shape, or holds negative or non-finite values.
    """
    source, path = str(path), Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"must end with one of {', '.join(_FORMATS)}", source=source)
    with opened(path) as file:
        size = _size(path.suffix.lower(), file.read(_HEADER_BYTES))
    if size is not None and size > MAX_MAP_PIXELS:
        raise InputError(f"has {size} pixels; at most {MAX_MAP_PIXELS}", source=source)
    try:
        if path.suffix.lower() == ".npy":
            with opened(path) as file:
                data = np.lib.format.read_array(file, allow_pickle=False)
        else:
            with second_thread():
                bitmap = mi.Bitmap(str(path))
            data = np.array(bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False))
    except InputError:
        raise
    except Exception as error:
        # For a broken file, image readers may raise any exception.
        detail = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"is not a readable map ({detail})", source=source) from None
    if data.dtype.kind not in "fiu" or data.ndim not in (2, 3):
        raise InputError("must hold numbers (height, width) or (height, width, channels)", source=source)
    values: Floats = np.asarray(_channel(data, channel), dtype=np.float64)
    height, width = values.shape
    if width != 2 * height or height < 4:
        raise InputError(f"is {width} x {height}; a map of all directions must be twice as wide as high", source=source)
    if not np.all(np.isfinite(values)) or np.min(values) < 0:
        raise InputError("holds values that are negative or not finite", source=source)
    return values


def _channel(data: NDArray[Any], channel: str) -> NDArray[Any]:
    """Select one channel (h, w) of a map (h, w) or (h, w, channels).

    Maps with fewer than three channels have no colours, and their first channel is used.
    """
    if data.ndim == 2:
        return data
    if data.shape[2] < 3:
        return data[..., 0]
    if channel == "luminance":
        return np.asarray(data[..., :3] @ _LUMINANCE)
    return data[..., ("red", "green", "blue").index(channel)]


def _size(kind: str, head: bytes) -> int | None:
    """Number of pixels that the header of a map's file declares; None where it declares none.

    The reader allocates all of them before it notices that the file is too short.
    """
    if kind == ".npy":
        shape = re.search(rb"'shape': *\(([0-9, ]{1,99})\)", head)
        return math.prod(int(n) for n in shape[1].split(b",") if n.strip()) if shape else None
    if kind == ".exr":
        window = re.search(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", head, re.DOTALL)
        x0, y0, x1, y1 = struct.unpack("<4i", window[1]) if window else (0, 0, -1, -1)
        return max(int(x1 - x0) + 1, 0) * max(int(y1 - y0) + 1, 0)
    sides = re.search(_SIDES[kind], head)
    return int(sides[1]) * int(sides[2]) if sides else None


def surrounding(values: Floats) -> Surrounding:
    """Prepare a map (h, 2 h): average it down to at most 1024 x 512, and compute its irradiance."""
    reduced = _reduced(values)
    return Surrounding(frozen(reduced, np.float32), frozen(irradiance_harmonics(reduced)))


def irradiance_harmonics(values: Floats) -> Floats:
    """Coefficients A_l L_lm c_lm of a map's irradiance, (9,).

    E(n) is their sum with the factors 1, y, z, x, xy, yz, 3 z^2 - 1, xz and x^2 - y^2 of n.
    """
    fold = max(1, -(-_FINE // len(values)))
    h, w = len(values) * fold, values.shape[1] * fold
    edges = np.cos(np.pi * np.arange(h + 1) / h)
    # This is the solid angle of a texel in each row; values are constant within texels.
    weight = (edges[:-1] - edges[1:]) * (2 * np.pi / w)
    polar = np.pi * (np.arange(h) + 0.5) / h
    turn = 2 * np.pi * (0.5 - (np.arange(w) + 0.5) / w)
    # Columns are summed first, because each basis function is a product of one of the row and one of the column.
    rows = np.repeat(values, fold, axis=0)

    def along(f: Floats) -> Floats:
        out: Floats = rows @ f.reshape(-1, fold).sum(axis=1) * weight
        return out

    c, s, c2, s2 = (along(f) for f in (np.cos(turn), np.sin(turn), np.cos(2 * turn), np.sin(2 * turn)))
    one = along(np.ones(w))
    st, ct = np.sin(polar), np.cos(polar)
    moments = np.array(
        [
            np.sum(one),
            np.sum(s * st),
            np.sum(one * ct),
            np.sum(c * st),
            np.sum(0.5 * s2 * st * st),
            np.sum(s * st * ct),
            np.sum(one * (3 * ct * ct - 1)),
            np.sum(c * st * ct),
            np.sum(c2 * st * st),
        ]
    )
    y0, y1, y2, y20, y22 = 1 / (4 * np.pi), 3 / (4 * np.pi), 15 / (4 * np.pi), 5 / (16 * np.pi), 15 / (16 * np.pi)
    squares = np.array([y0, y1, y1, y1, y2, y2, y20, y2, y22])
    band = np.pi * np.array([1, *[2 / 3] * 3, *[1 / 4] * 5])
    return np.asarray(moments * squares * band, dtype=np.float64)


def map_rotation(spec: RadianceMap) -> Floats:
    """Rotation M (3, 3) = Rz(az) Ry(-el) Rx(roll) from the map's frame to the world.

    In the map's frame x is its middle, y to its left, z up.
    """
    az, el, roll = np.radians([spec.azimuth_deg, spec.elevation_deg, spec.roll_deg])
    (ca, sa), (ce, se), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (az, el, roll))
    Rz = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1.0]])
    Ry = np.array([[ce, 0, -se], [0, 1.0, 0], [se, 0, ce]])
    Rx = np.array([[1.0, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(Rz @ Ry @ Rx)


def _values(spec: RadianceMap) -> Floats:
    """Values of a map: those of its file, or painted ones."""
    if spec.file is None:
        return paint(str(spec.place), spec.place_seed)
    if spec.sha256 is not None and file_digest(Path(spec.file)) != spec.sha256:
        raise InputError("does not have the given sha256", source=spec.file)
    return read_map(spec.file, spec.channel)


class Maps:
    """The maps in use, on the device; each is read and sent there once."""

    def __init__(self) -> None:
        self._kept: dict[Any, tuple[Any, Surrounding]] = {}
        self._none = self._sent(Surrounding(frozen(np.zeros((2, 4)), np.float32), frozen(np.zeros(9))))

    def of(self, spec: RadianceMap | None) -> tuple[Any, Surrounding]:
        """Texture and map of a spec (its file's path is absolute or relative to the current folder)."""
        if spec is None:
            return self._none
        key: tuple[Any, ...] = (spec.place, spec.place_seed)
        if spec.file is not None:
            try:
                state = Path(spec.file).stat()
            except OSError:
                raise InputError("no such file", source=spec.file) from None
            key = (spec.file, spec.channel, spec.sha256, state.st_mtime_ns, state.st_size)
        if key not in self._kept:
            if len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = self._sent(surrounding(_values(spec)))
        return self._kept[key]

    @staticmethod
    def _sent(made: Surrounding) -> tuple[Any, Surrounding]:
        # The texture repeats so that the columns wrap. Additional rows separate the poles.
        rows = np.concatenate([made.values[:1], made.values, made.values[-1:]])
        texture: Any = mi.Texture2f
        return texture(mi.TensorXf(rows[..., None]), use_accel=False, wrap_mode=dr.WrapMode.Repeat), made


class Ambience:
    """Even light, panels and surroundings for the integrator; kernels do not depend on the numbers."""

    def __init__(
        self,
        even_mw_mm2: float,
        panels: np.ndarray[Any, np.dtype[np.float64]],
        spec: RadianceMap | None,
        maps: Maps,
    ) -> None:
        """Prepare the light.

        Args:
            even_mw_mm2: irradiance of even light.
            panels: (n, 13) as from `frame.panel_table`.
            spec: the map, whose rays are in the world's axes; None for none.
            maps: the maps that are kept.
        """
        self._panels = Panels(panels)
        self._texture, made = maps.of(spec)
        scale = 0.0 if spec is None else spec.scale_w_m2_sr * 1e-3
        M = np.eye(3) if spec is None else map_rotation(spec)
        numbers = [even_mw_mm2, *M.T.ravel(), scale, len(made.values), *(made.harmonics * scale)]
        buffer = mi.Float(np.array(numbers, dtype=np.float32))
        n = [dr.gather(mi.Float, buffer, mi.UInt32(k)) for k in range(_ENTRIES)]
        dr.eval(n)
        self._even, self._scale, self._rows, self._harmonics = n[0], n[10], n[11], n[12:]
        self._axes = tuple(mi.Vector3f(*n[k : k + 3]) for k in (1, 4, 7))

    def _in_map(self, v: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(*(dr.dot(axis, v) for axis in self._axes))

    def radiance(self, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Radiance (mW/mm^2/sr) along rays of the scene's frame, without the even light.

        Overlapping panels add up, and they do not hide the map behind them.
        """
        return self._panels.radiance(o, d, active) + self._mapped(d, active)

    def far(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Radiance (mW/mm^2/sr) of even light and map along directions of the scene's frame."""
        return self._even * dr.inv_pi + self._mapped(d, active)

    def _mapped(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        w = self._in_map(d)
        u = 0.5 - dr.atan2(w.y, w.x) * (0.5 * dr.inv_pi)
        v = dr.acos(dr.clip(w.z, -1, 1)) * dr.inv_pi
        place = mi.Point2f(u, (1 + v * self._rows) / (self._rows + 2))
        return self._scale * self._texture.eval(place, active)[0]

    def irradiance(self, x: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """Irradiance (mW/mm^2) of a matte surface at points x with unit normals n of the scene's frame, unshadowed."""
        w = self._in_map(n)
        h = self._harmonics
        far = h[0] + h[1] * w.y + h[2] * w.z + h[3] * w.x
        far += h[4] * w.x * w.y + h[5] * w.y * w.z + h[6] * (3 * w.z * w.z - 1) + h[7] * w.x * w.z
        far += h[8] * (w.x * w.x - w.y * w.y)
        return self._even + dr.maximum(far, 0) + self.of_panels(x, n)

    def of_panels(self, x: mi.Vector3f, n: mi.Vector3f) -> mi.Float:
        """The panels' part of the irradiance."""
        return self._panels.irradiance(x, n)


def _reduced(values: Floats) -> Floats:
    """Average a map down to at most 1024 x 512, by whole texels or by linear resampling of its running sum."""
    if values.shape[0] <= _HEIGHT:
        return values
    return _averaged(_averaged(values, _HEIGHT).T, _WIDTH).T


def _averaged(values: Floats, count: int) -> Floats:
    """Means of rows over `count` equal intervals."""
    running = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    at = np.linspace(0, len(values), count + 1)
    low = np.minimum(at.astype(int), len(values) - 1)
    sums = running[low] + (at - low)[:, None] * values[low]
    return np.asarray(np.diff(sums, axis=0) * (count / len(values)))
