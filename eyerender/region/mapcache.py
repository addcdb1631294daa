"""Disk cache of subjects' maps: computed in a second, read in milliseconds.

A file is named by the digest of everything that determines its content: the function, its argument, the source code of
`region`, and the versions of NumPy and SciPy. It is written under another name and renamed when complete, so several
processes may use the folder at once. Files are not trusted: one whose header, size or checksum is wrong is removed and
computed again. If the folder cannot be used, maps are computed every time.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.errors import WRONG, EyerenderError, InputError
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import PART, parse_json, read_bytes, written
from ..base.versions import __version__
from .anatomy import Region
from .iris import DrawnPattern

LIMIT = "EYERENDER_MAP_CACHE_MB"
"""Environment variable: size of the map cache in megabytes; 0 disables it."""
DEFAULT_MB = 1000
SCHEMA = "eyerender/map/2"
_ENDING = ".map"
_DTYPES = ("float16", "float32")
_LARGEST_HEADER, _ALIGNMENT = 4096, 64
_STALE_S = 3600.0  # a temporary file of this age was left by a process that ended
_KEPT_SHARE = 0.9  # share of the limit that remains after files were removed
_Argument = TypeVar("_Argument", int, Region, DrawnPattern)


@contextmanager
def without_cache() -> Iterator[None]:
    """Disable the cache during the block, in this process and in processes that it starts."""
    before = os.environ.get(LIMIT)
    os.environ[LIMIT] = "0"
    try:
        yield
    finally:
        if before is None:
            del os.environ[LIMIT]
        else:
            os.environ[LIMIT] = before


def kept(make: Callable[[_Argument], NDArray[Any]], argument: _Argument) -> NDArray[Any]:
    """Return the read-only array `make(argument)`, float16 or float32, from the cache if it is there.

    Args:
        make: a function of the module's top level that depends on its argument alone.
        argument: a seed, or a record with everything that matters.
    """
    file = _place(make.__name__, argument)
    if file is None:
        return make(argument)
    known = _read(file)
    if known is None:
        known = make(argument)
        with suppress(OSError, EyerenderError):
            _write(file, known)
            _trim(file.parent, _limit_bytes())
    return known


def folder() -> Path | None:
    """Return the folder of the maps; None if maps are not cached."""
    place = cache_folder()
    return place / "maps" if place is not None and _limit_bytes() > 0 else None


def _limit_bytes() -> float:
    try:
        limit = float(os.environ.get(LIMIT, DEFAULT_MB))
    except ValueError:
        raise InputError("must be a number of megabytes", source=LIMIT) from None
    return limit * 1e6


def _place(name: str, argument: int | Region | DrawnPattern) -> Path | None:
    place = folder()
    if place is None:
        return None
    said = argument.to_mapping() if isinstance(argument, Region | DrawnPattern) else int(argument)
    key = json.dumps([SCHEMA, name, said, _code()], sort_keys=True)
    return place / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}{_ENDING}"


@lru_cache(maxsize=1)
def _code() -> list[str]:
    """Describe what determines the maps: the package's version, a digest of this folder's sources, NumPy and SciPy."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return [__version__, digest.hexdigest(), np.__version__, scipy.__version__]


def _write(file: Path, values: NDArray[Any]) -> None:
    """Write a map: a header, one line of JSON, and the bytes of the array."""
    data = np.ascontiguousarray(values)
    header = {"schema": SCHEMA, "dtype": str(data.dtype), "shape": data.shape, "crc32": zlib.crc32(data.data)}
    file.parent.mkdir(parents=True, exist_ok=True)
    with written(file, sync=False) as out:  # the checksum detects the damage of a power cut
        line = json.dumps(header).encode()
        out.write(line + b" " * (-(len(line) + 1) % _ALIGNMENT) + b"\n")
        out.write(data.data)


def _read(file: Path) -> NDArray[Any] | None:
    """Read the map of a file; None if there is none. A damaged file is removed."""
    try:
        if not file.is_file():
            return None
        data = read_bytes(file, follow=False)
        found = _decoded(data)
    except (InputError, OSError):
        return None
    with suppress(OSError):
        os.utime(file) if found is not None else file.unlink()
    return found


def _decoded(data: bytes) -> NDArray[Any] | None:
    line = data[:_LARGEST_HEADER].partition(b"\n")[0]
    try:
        header = parse_json(line)
        dtype, shape = header["dtype"], tuple(header["shape"])
        sound = header["schema"] == SCHEMA and dtype in _DTYPES and all(type(n) is int and n >= 0 for n in shape)
        body = memoryview(data)[len(line) + 1 :]
        if sound and len(body) == np.prod(shape) * np.dtype(dtype).itemsize and header["crc32"] == zlib.crc32(body):
            return np.frombuffer(body, dtype).reshape(shape)
    except (InputError, *WRONG):
        pass
    return None


def _trim(place: Path, limit: float) -> None:
    """Remove the least recently used maps above a total of `limit` bytes, and stale temporary files."""
    now = time.time()
    files = []
    for path in list(place.iterdir()):
        with suppress(OSError):
            state = path.stat()
            if path.name.endswith(PART) and now - state.st_mtime > _STALE_S:
                path.unlink()
            elif path.suffix == _ENDING:
                files.append((state.st_mtime, state.st_size, path))
    size = sum(entry[1] for entry in files)
    if size > limit:
        for _, bytes_, path in sorted(files):
            if size <= _KEPT_SHARE * limit:
                break
            with suppress(OSError):
                path.unlink()
            size -= bytes_
