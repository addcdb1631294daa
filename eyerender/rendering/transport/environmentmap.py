"""Environment maps on the host: read files, and compute the irradiance of matte surfaces.

A map is the sum of two parts. The soft part is clipped at a ceiling. The rest, which may be as bright and small as the
sun, is represented by directions with equal shares of its light (median cut: Debevec 2005). The irradiance of both is a
table over the normals,

    E(n) = sum_k max(0, n . V_k),    V_k = integral of L w dw over a block of texels,

exact for every block that the horizon does not cut.
"""

from __future__ import annotations

import math
import os
import re
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import ArrayValue, Floats, frozen
from ...base.errors import InputError
from ...base.spec import file_digest
from ...base.storage.files import opened
from ...rig.imaging import RadianceMap
from ...rig.surroundings import paint
from ..scene.exr import second_thread

_WIDTH, _HEIGHT = 1024, 512
_FINE, _BLOCKS, NORMALS = 256, 32, 48  # rows from which blocks are summed, and of blocks and normals
_CEILING = 2.0  # ceiling of a map's soft part, relative to its mean
_CUTS = 6  # 2^6 directions
_FORMATS = (".hdr", ".exr", ".pfm", ".npy")
# Rec. 709.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# 16384 x 8192, of which 1024 x 512 are used.
MAX_MAP_PIXELS = 2**27
_HEADER_BYTES = 65536
# Values that a file may hold, by its size; compression of plain maps reaches 47 (.hdr), and of very plain ones more.
_FEW_VALUES, _MOST_PER_BYTE = 2**26, 64
_CHANNEL_BYTES = 18  # of a channel in the header of an OpenEXR file, at least
_SIDES = {
    ".hdr": rb"[-+][XY] *([0-9]{1,20}) *[-+][XY] *([0-9]{1,20})",
    ".pfm": rb"^P[fF]\s+([0-9]{1,20})\s+([0-9]{1,20})\s",
}


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentMap(ArrayValue):
    """A prepared environment map, in its own frame."""

    values: Any  # (h, 2 h) radiance, float32
    ceiling: float  # largest radiance of the soft part
    # (rows, 2 rows, 2) irradiance of surfaces whose normal is the direction of a texel, from the soft part and from the
    # rest, float32
    irradiance: Any
    bright: Floats  # (n, 3) directions that represent the rest, times the irradiance of a surface that faces them


def read_map(path: str | Path, channel: str = "red") -> Floats:
    """Read the values (h, w) of a latitude-longitude map; w = 2 h.

    Args:
        path: Radiance .hdr, OpenEXR .exr, .pfm, or a NumPy array .npy of shape (h, w) or (h, w, channels).
        channel: the channel of a colour map to use: red, green, blue, or luminance (Rec. 709).

    Raises:
        InputError: the file is missing, unreadable, of another shape, or holds negative or non-finite values.
    """
    source, path = str(path), Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"must end with one of {', '.join(_FORMATS)}", source=source)
    _refuse_size(path)
    try:
        data = _decoded(path)
    except InputError:
        raise
    except Exception as error:
        # Image readers may raise any exception for a broken file.
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


def _refuse_size(path: Path) -> None:
    """Check the size that a header declares, because a reader allocates it all before it notices a short file."""
    kind, source = path.suffix.lower(), str(path)
    with opened(path) as file:
        head, most = file.read(_HEADER_BYTES), _FEW_VALUES + _MOST_PER_BYTE * os.fstat(file.fileno()).st_size
    size, channels = _size(kind, head), _channels(head)
    if size == 0 or (size is None and kind == ".pfm"):  # Mitsuba would divide by zero
        raise InputError("is not a readable map (its header names no size)", source=source)
    if size is not None and size > MAX_MAP_PIXELS:
        raise InputError(f"has {size} pixels; at most {MAX_MAP_PIXELS}", source=source)
    if size is not None and size * channels > most:
        raise InputError(f"has {size} pixels of {channels} channels in too few bytes", source=source)


def _decoded(path: Path) -> NDArray[Any]:
    """Read the pixels of a file (h, w) or (h, w, channels)."""
    if path.suffix.lower() == ".npy":
        with opened(path) as file, warnings.catch_warnings(action="ignore"):
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    with second_thread():
        bitmap = mi.Bitmap(str(path))  # from a stream in memory, a damaged EXR file would be read for ever
    return np.array(bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False))


def _size(kind: str, head: bytes) -> int | None:
    """Return the number of pixels declared in the header of a map's file; None if it declares none."""
    if kind == ".npy":
        shape = re.search(rb"'shape': *\(([0-9, ]{1,99})\)", head)
        return math.prod(int(n) for n in re.findall(rb"[0-9]+", shape[1])) if shape else None
    if kind == ".exr":
        window = re.search(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", head, re.DOTALL)
        x0, y0, x1, y1 = struct.unpack("<4i", window[1]) if window else (0, 0, -1, -1)
        return max(int(x1 - x0) + 1, 0) * max(int(y1 - y0) + 1, 0)
    sides = re.search(_SIDES[kind], head)
    return int(sides[1]) * int(sides[2]) if sides else None


def _channels(head: bytes) -> int:
    """Return the number of channels that the header of an OpenEXR file lists, at most; 3 for other files."""
    listed = re.search(rb"channels\0chlist\0(.{4})", head, re.DOTALL)
    return 3 if listed is None else max(1, int.from_bytes(listed[1], "little") // _CHANNEL_BYTES)


def environment_map(values: Floats) -> EnvironmentMap:
    """Prepare a map (h, 2 h): average it down to at most 1024 x 512 and compute its irradiance."""
    reduced = _reduce(values)
    if not reduced.any():  # every renderer keeps this map for scenes without one
        dark = np.zeros((NORMALS, 2 * NORMALS, 2))
        return EnvironmentMap(frozen(reduced, np.float32), 0.0, frozen(dark, np.float32), frozen(np.zeros((0, 3))))
    fold = max(1, -(-_FINE // len(reduced)))
    fine = np.repeat(np.repeat(reduced, fold, axis=0), fold, axis=1)
    way, angle = _directions(len(fine))
    ceiling = _CEILING * float(np.sum(fine * angle)) / (4 * np.pi)
    # Blocks have whole rows and columns of texels, but for the last ones.
    size = len(fine) // _BLOCKS
    starts = np.arange(0, len(fine), size), np.arange(0, 2 * len(fine), size)

    def blocks(radiance: Floats) -> Floats:
        flux = (radiance * angle)[..., None] * way
        out = np.add.reduceat(np.add.reduceat(flux, starts[0], axis=0), starts[1], axis=1)
        return np.asarray(out.reshape(-1, 3))

    soft, rest = blocks(np.minimum(fine, ceiling)), blocks(np.maximum(fine - ceiling, 0))
    whole = blocks(np.ones_like(fine))
    normals = _directions(NORMALS)[0]
    table = [[np.maximum(row @ flux.T, 0).sum(axis=1) for flux in (soft, rest, whole)] for row in normals]
    irradiance = np.moveaxis(np.asarray(table), 1, -1)
    # Blocks cut by the horizon are slightly wrong; the known total light of all directions corrects most of that.
    irradiance = np.pi * irradiance[..., :2] / irradiance[..., 2:]
    return EnvironmentMap(
        frozen(reduced, np.float32), ceiling, frozen(irradiance, np.float32), frozen(_median_cut(rest, _CUTS))
    )


def _directions(rows: int) -> tuple[Floats, Floats]:
    """Compute directions (rows, 2 rows, 3) of a map's texels in its own frame, and their solid angles (rows, 1)."""
    edge = np.pi * np.arange(rows + 1) / rows
    polar, turn = 0.5 * (edge[1:] + edge[:-1])[:, None], (np.pi - np.pi * (np.arange(2 * rows) + 0.5) / rows)[None]
    s = np.sin(polar)
    way = np.stack(np.broadcast_arrays(s * np.cos(turn), s * np.sin(turn), np.cos(polar)), axis=-1)
    return way, -np.diff(np.cos(edge))[:, None] * (np.pi / rows)


def _median_cut(flux: Floats, cuts: int) -> Floats:
    """Group vectors (n, 3) by direction into at most 2^cuts groups of similar total length; return the sums (m, 3)."""
    length = np.linalg.norm(flux, axis=1)
    flux, length = flux[length > 0], length[length > 0]
    groups = [np.arange(len(flux))] if len(flux) else []
    for _ in range(cuts):
        halves = []
        for group in groups:
            at = flux[group] / length[group, None]
            spread = np.average(
                (at - np.average(at, axis=0, weights=length[group])) ** 2, axis=0, weights=length[group]
            )
            order = group[np.argsort(at[:, np.argmax(spread)], kind="stable")]
            before = np.cumsum(length[order]) - 0.5 * length[order]
            split = int(np.searchsorted(before, 0.5 * length[order].sum()))
            halves += [half for half in (order[:split], order[split:]) if len(half)]
        groups = halves
    return np.array([flux[group].sum(axis=0) for group in groups]).reshape(-1, 3)


def map_rotation(spec: RadianceMap) -> Floats:
    """Compute the rotation M (3, 3) = Rz(az) Ry(-el) Rx(roll) from the map's frame to the world.

    In the map's frame, x points to its middle, y to its left, z up.
    """
    az, el, roll = np.radians([spec.azimuth_deg, spec.elevation_deg, spec.roll_deg])
    (ca, sa), (ce, se), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (az, el, roll))
    Rz = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1.0]])
    Ry = np.array([[ce, 0, -se], [0, 1.0, 0], [se, 0, ce]])
    Rx = np.array([[1.0, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(Rz @ Ry @ Rx)


def map_values(spec: RadianceMap) -> Floats:
    """Return the values of a map, from its file or painted."""
    if spec.file is None:
        return paint(str(spec.place), spec.place_seed)
    if spec.sha256 is not None and file_digest(Path(spec.file)) != spec.sha256:
        raise InputError("does not have the given sha256", source=spec.file)
    return read_map(spec.file, spec.channel)


def _reduce(values: Floats) -> Floats:
    """Average a map down to at most 1024 x 512, by whole texels or by linear resampling of its running sum."""
    if values.shape[0] <= _HEIGHT:
        return values
    return _average(_average(values, _HEIGHT).T, _WIDTH).T


def _average(values: Floats, count: int) -> Floats:
    """Average rows over `count` equal intervals."""
    running = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    at = np.linspace(0, len(values), count + 1)
    low = np.minimum(at.astype(int), len(values) - 1)
    sums = running[low] + (at - low)[:, None] * values[low]
    return np.asarray(np.diff(sums, axis=0) * (count / len(values)))
