"""A small writer of MP4 files whose frames are PNG pictures: lossless, and read by FFmpeg and OpenCV.

ISO/IEC 14496-12 (boxes) and 14496-14 (the `mp4v` sample entry); object type 0x6D is PNG (MP4 registration authority).
"""

from __future__ import annotations

import io
import struct
from array import array
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from PIL import Image

from ...arrays import Bytes

_PNG = 0x6D
_MATRIX = struct.pack(">9i", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)


class PngVideo:
    """Frames (h, w) uint8 into a file, 25 a second; the index is written when it is closed."""

    def __init__(self, path: Path, width: int, height: int, frames_per_second: int = 25) -> None:
        self.size = (width, height)
        self.rate = frames_per_second
        self._file: Any = open(path, "wb")  # noqa: SIM115  (closed by close)
        self._offsets = array("Q")
        self._sizes = array("L")
        self._file.write(_box(b"ftyp", b"isom" + struct.pack(">I", 0x200) + b"isomiso2mp41"))
        self._start = self._file.tell()
        self._file.write(struct.pack(">I4sQ", 1, b"mdat", 0))  # 64-bit size, filled in at the end

    def add(self, image: Bytes) -> None:
        """One more frame."""
        buffer = io.BytesIO()
        # Colour: decoders differ in whether they take greyscale PNG frames.
        Image.fromarray(np.repeat(image[..., None], 3, axis=-1)).save(buffer, format="PNG", compress_level=1)
        self._offsets.append(self._file.tell())
        self._sizes.append(buffer.tell())
        self._file.write(buffer.getvalue())

    def close(self) -> None:
        """Write the index."""
        if self._file.closed:
            return
        end = self._file.tell()
        self._file.seek(self._start + 8)
        self._file.write(struct.pack(">Q", end - self._start))
        self._file.seek(end)
        self._file.write(self._movie())
        self._file.close()

    def __enter__(self) -> PngVideo:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _movie(self) -> bytes:
        n, (w, h) = len(self._sizes), self.size
        header = struct.pack(">IIII", 0, 0, self.rate, n)
        mvhd = _full(b"mvhd", header + struct.pack(">IHHII", 0x10000, 0x100, 0, 0, 0) + _MATRIX + bytes(24) + _u32(2))
        tkhd = _full(
            b"tkhd",
            struct.pack(">IIIIIIIhhhH", 0, 0, 1, 0, n, 0, 0, 0, 0, 0, 0) + _MATRIX + _u32(w << 16) + _u32(h << 16),
            flags=3,
        )
        mdhd = _full(b"mdhd", header + struct.pack(">HH", 0x55C4, 0))  # language: undetermined
        hdlr = _full(b"hdlr", struct.pack(">I4s", 0, b"vide") + bytes(12) + b"frames\0")
        vmhd = _full(b"vmhd", bytes(8), flags=1)
        dinf = _box(b"dinf", _full(b"dref", _u32(1) + _full(b"url ", b"", flags=1)))
        config = bytes([_PNG, 0x11]) + bytes(3) + _u32(0) + _u32(0)
        sync = b"\x06" + bytes([1]) + b"\x02"
        descriptor = struct.pack(">BBHB", 3, 3 + 2 + len(config) + len(sync), 1, 0)
        esds = _full(b"esds", descriptor + bytes([4, len(config)]) + config + sync)
        entry = bytes(6) + struct.pack(">H", 1) + bytes(16) + struct.pack(">HHIIIH", w, h, 0x480000, 0x480000, 0, 1)
        mp4v = _box(b"mp4v", entry + bytes(32) + struct.pack(">Hh", 24, -1) + esds)
        table = (
            _full(b"stsd", _u32(1) + mp4v)
            + _full(b"stts", struct.pack(">III", 1, n, 1))
            + _full(b"stsc", struct.pack(">IIII", 1, 1, 1, 1))
            + _full(b"stsz", struct.pack(">II", 0, n) + np.array(self._sizes, dtype=">u4").tobytes())
            + _full(b"co64", struct.pack(">I", n) + np.array(self._offsets, dtype=">u8").tobytes())
        )
        media = _box(b"mdia", mdhd + hdlr + _box(b"minf", vmhd + dinf + _box(b"stbl", table)))
        return _box(b"moov", mvhd + _box(b"trak", tkhd + media))


def _box(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(data), kind) + data


def _full(kind: bytes, data: bytes, *, flags: int = 0) -> bytes:
    return _box(kind, _u32(flags) + data)


def _u32(value: int) -> bytes:
    return struct.pack(">I", value)
