"""Read and write image files: 16- and 8-bit greyscale PNG; other common greyscale formats can be read.

Pixel values are linear sensor counts. Only `preview`, which is for viewing, scales them.
"""

from __future__ import annotations

import io
import os
import warnings
import zipfile
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..base.arrays import Bytes, Singles
from ..base.errors import InputError
from ..base.storage.files import opened, written
from .foreign import foreign_kind

ENDINGS = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm", ".gif", ".webp", ".jp2")  # suffixes of images
MAX_FILES = 1_000_000

# Size of the largest window that can be rendered; it limits the memory that a hostile file can make us allocate.
MAX_PIXELS = 8192 * 8192
# Larger than any such image in any of the formats, plus the file's metadata.
MAX_IMAGE_BYTES = 2**30
# Pillow supports many more formats, some of which start other programs.
FORMATS = ("PNG", "TIFF", "JPEG", "BMP", "PPM", "GIF", "WEBP", "JPEG2000")

COLOURED = ("RGB", "RGBA", "P", "PA", "LA", "La", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")


_WAITING = 8  # images of a `Writer`
_ARRAY, _HEAD_BYTES = "data.npy", 1000  # member of an .npz file of an array, and bytes before its numbers at most


def write_png(path: str | Path, image: NDArray[Any], *, sync: bool = False) -> None:
    """Write (h, w) uint8 or uint16 as greyscale, or (h, w, 3) uint8 as colour; on an error, nothing is left.

    Images are mostly written into a folder that is synced as a whole before it is published; `sync` makes a single one
    durable.
    """
    with written(path, sync=sync) as file:
        file.write(png_bytes(image))


def png_bytes(image: NDArray[Any]) -> bytes:
    """Encode (h, w) uint8 or uint16 as a greyscale PNG, or (h, w, 3) uint8 as a colour one (ISO/IEC 15948).

    Noise does not compress, and writing must not take longer than rendering. So every row has the same filter, and the
    encoder searches only for runs, which occur in masks.
    """
    import cv2

    colour = image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8
    if not colour and (image.ndim != 2 or image.dtype not in (np.uint8, np.uint16)):
        raise ValueError(f"no PNG holds {image.shape} of {image.dtype}")
    how = (cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    _, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1] if colour else image), how)
    return data.tobytes()


def write_picture(path: str | Path, picture: NDArray[Any]) -> None:
    """Write a picture as `picture_bytes` encodes it, completely or not at all."""
    with written(path, sync=False) as file:
        file.write(picture_bytes(picture))


def picture_bytes(picture: NDArray[Any]) -> bytes:
    """Encode integers as PNG (`png_bytes`), and real numbers as a compressed .npz of NumPy with the array `data`.

    The array is float16 if the picture is, else float32.
    """
    if picture.dtype.kind == "u":
        return png_bytes(picture)
    values = np.ascontiguousarray(picture, dtype="<f2" if picture.dtype == np.float16 else "<f4")
    out = io.BytesIO()
    # A higher level takes longer and saves less than 2 %.
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open(_ARRAY, "w") as file:
        np.lib.format.write_array(file, values, version=(1, 0))
    return out.getvalue()


def array_of(data: bytes, shape: tuple[int, ...], source: str) -> Singles:
    """Read the array `data` of float16 or float32 of an .npz file, unpacking no more than such an array has.

    Raises:
        InputError: it is another kind of file, or of another shape.
    """
    size = int(np.prod(shape))
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open(_ARRAY) as packed:
            file = io.BytesIO(packed.read(4 * size + _HEAD_BYTES))
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError
        found, by_columns, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=_HEAD_BYTES)
    except Exception:
        # The decoders of zip files may raise any exception for a damaged one.
        raise InputError("is no .npz file with an array 'data' of numbers", source=source) from None
    values = file.read()
    if found != shape or by_columns or dtype.str not in ("<f2", "<f4") or len(values) != dtype.itemsize * size:
        wanted = " x ".join(map(str, shape))
        raise InputError(f"must hold an array {wanted} of float32 or float16", source=source)
    return np.frombuffer(values, dtype=dtype).reshape(shape).astype(np.float32, copy=False)


class Writer:
    """Writes pictures in a second thread, while the next image is rendered; a context manager.

    At most a few images wait. An error of a write is raised by the next call, or at the end of the block.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "png")
        self._waiting: deque[Future[None]] = deque()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            while self._waiting and kind is None:
                self._waiting.popleft().result()
        finally:
            self._thread.shutdown(wait=True, cancel_futures=True)

    def flush(self) -> None:
        """Wait until every image is written; raise the error of a failed write."""
        while self._waiting:
            self._waiting.popleft().result()

    def put(self, path: Path, image: NDArray[Any]) -> None:
        """Write an image like `write_picture`, later."""
        while len(self._waiting) >= _WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(write_picture, path, image))


def compressed(image: Bytes, quality: int) -> Bytes:
    """Compress an 8-bit image (h, w) as JPEG of a quality from 1 to 100, and decode it again."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=quality)
    return np.asarray(Image.open(buffer, formats=("JPEG",)))


def image_files(folder: str | Path) -> list[str]:
    """Return the image files in a folder and below it, relative to it and sorted; links are not followed.

    Raises:
        InputError: there are none, or too many files.
    """
    found: list[str] = []
    seen = 0
    for place, _, names in os.walk(folder):
        seen += len(names)
        if seen > MAX_FILES:
            raise InputError(f"holds more than {MAX_FILES} files", source=str(folder))
        images = (name for name in names if name.lower().endswith(ENDINGS))
        found += [str((Path(place) / name).relative_to(folder)) for name in images]
    if not found:
        raise InputError(f"holds no images ({', '.join(ENDINGS)})", source=str(folder))
    return sorted(found)


def read_image(path: str | Path) -> tuple[NDArray[Any], int]:
    """Read a greyscale image and its bit depth (8 or 16).

    Returns (h, w) uint8 or uint16, or float32 for a float TIFF; bit depth (32 for float). Raises InputError if the file
    is missing, not regular, unreadable, empty or too large, or the image has real colour, transparency or several
    frames.
    """
    image, depth, _ = _read(path, colour=False)
    return image, depth


def image_of(data: bytes, source: str) -> tuple[NDArray[Any], int]:
    """Decode the content of an image file, like `read_image`."""
    image, depth, _ = _image(io.BytesIO(data), len(data), source, colour=False)
    return image, depth


def read_any_image(path: str | Path) -> tuple[NDArray[Any], int, bool]:
    """Read an image like `read_image`, but convert real colour to luminance (ITU-R BT.601).

    Returns the image and its bit depth as of `read_image`, and whether it has colour. Raises InputError as
    `read_image`, except for colour.
    """
    return _read(path, colour=True)


def _read(path: str | Path, *, colour: bool) -> tuple[NDArray[Any], int, bool]:
    with opened(path, limit=MAX_IMAGE_BYTES) as data:
        return _image(data, os.fstat(data.fileno()).st_size, str(path), colour=colour)


def _image(data: BinaryIO, size: int, source: str, *, colour: bool) -> tuple[NDArray[Any], int, bool]:
    try:
        if size == 0:
            raise InputError("is empty", source=source)
        # If Pillow warns, it either reads the image anyway or fails with an error.
        with warnings.catch_warnings(action="ignore"), Image.open(data, formats=FORMATS) as file:
            return _decoded(file, source, colour, _is_followed(data, file))
    except InputError:
        raise
    except MemoryError:
        raise InputError("needs more memory than is available", source=source) from None
    except Exception:
        # Pillow's decoders may raise any exception for a damaged file.
        data.seek(0)
        raise InputError(foreign_kind(data.read(512)) or "is not a readable image", source=source) from None


def _is_followed(data: BinaryIO, file: Image.Image) -> bool:
    """Return whether another image follows the first one in a PNG, JPEG or binary PGM file, where Pillow stops."""
    if file.format not in ("PNG", "JPEG", "PPM"):
        return False
    place = data.tell()
    data.seek(0)
    content = data.read()
    data.seek(place)
    if file.format == "JPEG":
        return b"\xff\xd9\xff\xd8\xff" in content
    if file.format == "PNG":
        return content.partition(b"IEND\xaeB`\x82")[2].lstrip().startswith(b"\x89PNG")
    start = int(cast("Any", file).tile[0][2])
    size = file.width * file.height * (1 if file.mode == "L" else 2)
    return content.startswith(b"P5") and content[start + size :].lstrip().startswith(b"P5")


def _decoded(file: Image.Image, source: str, colour: bool, is_followed: bool) -> tuple[NDArray[Any], int, bool]:
    if file.width * file.height > MAX_PIXELS:
        raise InputError(f"is too large ({file.width} x {file.height} pixels)", source=source)
    # Counting the frames would read the whole file.
    if getattr(file, "is_animated", False) or is_followed:
        raise InputError("holds several images; give a file with one", source=source)
    if file.mode in COLOURED:
        return _from_colour(file, source, colour)
    file.load()
    data = np.asarray(file)
    if file.mode == "1":
        return data.astype(np.uint8) * np.uint8(255), 8, False
    if file.mode == "L":
        return data, 8, False
    if file.mode == "F":
        return data.astype(np.float32), 32, False
    if data.min(initial=0) < 0 or data.max(initial=0) > 65535:
        raise InputError("has values outside 16 bits", source=source)
    return data.astype(np.uint16), 16, False


def _from_colour(file: Image.Image, source: str, colour: bool) -> tuple[Bytes, int, bool]:
    """Convert a file with colour channels to grey levels; real colour only if it is allowed."""
    if file.has_transparency_data and np.asarray(file.convert("RGBA"))[..., 3].min() < 255:
        raise InputError("has transparent pixels", source=source)
    grey = _same_channels(file)
    if grey is not None:
        return grey, 8, False
    if not colour:
        raise InputError(f"has colour channels ({file.mode}); give a greyscale near-infrared image", source=source)
    return np.asarray(file.convert("RGB").convert("L")), 8, True


def _same_channels(file: Image.Image) -> Bytes | None:
    """Return the grey channel of a colour file whose channels are all equal; None for real colour."""
    rgb = np.asarray(file.convert("RGB"))
    equal = np.array_equal(rgb[..., 0], rgb[..., 1]) and np.array_equal(rgb[..., 0], rgb[..., 2])
    return np.ascontiguousarray(rgb[..., 0]) if equal else None


def preview(image: NDArray[Any], full_scale: float) -> Bytes:
    """Convert an image to 8 bits for viewing. Codes are scaled linearly, as is usual for near-infrared cameras."""
    return np.asarray(np.round(255 * np.clip(np.asarray(image, dtype=float) / full_scale, 0, 1)), dtype=np.uint8)
