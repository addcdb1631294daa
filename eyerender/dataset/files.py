"""Files that a dataset's spec names (HDR maps, head meshes, obstacles, calibrations, eye files), and their checksums.

Their content affects the images, so their checksums, by the names in the spec, are part of a run's identity. `Plan.of`
adds the eye files, which it reads itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..base.spec import file_digest
from ..region.headspec import is_manifest, read_manifest
from .template import possible


def sums_of_files(scene: Mapping[str, Any], base: Path) -> dict[str, str]:
    """Compute the SHA-256 of every file that a scene of the template may name, including the files of a manifest.

    Names are kept as written; those in a manifest are relative to `base`, like all others. Raises InputError if a file
    is missing or cannot be read.
    """
    return {name: sum_of_file(base / name) for name in sorted(set(_names(scene, base)))}


def _names(scene: Mapping[str, Any], base: Path) -> Iterator[str]:
    yield from _texts(scene, "ambient", "map", "file")
    yield from _texts(scene, "rig", "cameras", "calibration", "file")
    yield from _texts(scene, "rig", "calibration", "file")
    yield from _texts(scene, "rig", "obstacles", "file")
    yield from _texts(scene, "region", "head", "texture")
    for name in _texts(scene, "region", "head", "file"):
        yield name
        if is_manifest(name):
            head = read_manifest(base / name)
            inside = (*head.files, *(() if head.texture is None else (head.texture,)))
            yield from (str(Path(name).parent / file) for file in inside)


def _texts(node: Any, *keys: str) -> Iterator[str]:
    """Return every text that a template allows at a path, or in a list there."""
    for value in possible(node):
        if keys and isinstance(value, Mapping):
            yield from _texts(value.get(keys[0]), *keys[1:])
        elif not keys and isinstance(value, str):
            yield value
        elif not keys and isinstance(value, list | tuple):
            for entry in value:
                yield from _texts(entry)
        elif keys and isinstance(value, list | tuple):
            for entry in value:
                yield from _texts(entry, *keys)


def sum_of_file(path: Path) -> str:
    """Compute the SHA-256 of a file, cached while its time and size are unchanged.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        state = path.stat()
    except OSError:
        return file_digest(path)  # the loader of this file reports what is wrong with it
    return _kept_sum(path, (state.st_mtime_ns, state.st_size, state.st_ino))


@lru_cache(maxsize=256)
def _kept_sum(path: Path, state: tuple[int, int, int]) -> str:
    del state
    return file_digest(path)
