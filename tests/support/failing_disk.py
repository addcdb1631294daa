"""A disk that fails: calls of `open`, `write`, `fsync`, `rename` and others from the package's code raise `OSError`.

Python's own functions are replaced while a `Disk` is in use. Only calls on files below its folder count, and only
those that come from code of the package, directly or through the standard library. Each has a name: the kind of call,
the path without its random parts, and how often it came before. So a run can be repeated with any one of them failing.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import re
import sys
import tarfile
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import eyerender

PACKAGE = str(Path(eyerender.__file__).parent) + os.sep
_RANDOM = re.compile(r"\.partial-\d+|[0-9a-f]{12}|\.[0-9a-f]{8}(?=\.part)")
_TAKING_ROOM = ("create", "write", "mkdir")
Name = tuple[str, str, int]


class Disk:
    """Records the package's calls below `root`; from `fails` on they fail.

    Args:
        root: the folder.
        fails: the name of the call that fails; None: none.
        code: `errno.EIO` lets that call alone fail; with `errno.ENOSPC` every later one fails too that takes room.
    """

    def __init__(self, root: Path, fails: Name | None = None, code: int = errno.EIO) -> None:
        self.root, self.fails, self.code = str(root), fails, code
        self.calls: list[Name] = []
        self.failed = False
        self._counts = Counter[tuple[str, str]]()
        self._lock = threading.Lock()
        self._stack = ExitStack()

    def __enter__(self) -> Disk:
        opened = builtins.open
        replaced: tuple[tuple[Any, str, Any], ...] = (
            (builtins, "open", self._opening(opened)),
            (io, "open", self._opening(opened)),
            (tarfile, "bltn_open", self._opening(opened)),
            (os, "open", self._os_open(os.open)),
            (os, "fsync", self._by_handle(os.fsync)),
            *((os, kind, self._by_path(kind, getattr(os, kind))) for kind in ("mkdir", "rename", "replace")),
            *((os, kind, self._by_path(kind, getattr(os, kind))) for kind in ("unlink", "rmdir")),
        )
        for owner, name, new in replaced:
            self._stack.enter_context(patch.object(owner, name, new))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def check(self, kind: str, path: Any) -> None:
        """Count a call, and raise where it is to fail."""
        place = os.path.abspath(os.fsdecode(path)) if isinstance(path, str | bytes | os.PathLike) else ""
        if not place.startswith(self.root) or not _from_package():
            return
        key = (kind, _RANDOM.sub("*", place[len(self.root) :]))
        with self._lock:
            name = (*key, self._counts[key])
            self._counts[key] += 1
            self.calls.append(name)
            full = self.failed and self.code == errno.ENOSPC and kind in _TAKING_ROOM
            if name != self.fails and not full:
                return
            self.failed = True
        raise OSError(self.code, os.strerror(self.code), place)

    def _opening(self, opened: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, mode: str = "r", buffering: int = -1, *args: Any, **keys: Any) -> Any:
            if isinstance(file, int) or not set(mode) & set("wxa+"):
                self.check("read", file)
                return opened(file, mode, buffering, *args, **keys)
            self.check("create", file)
            if not _from_package():
                return opened(file, mode, buffering, *args, **keys)
            raw = _Raw(self, file, mode.replace("b", "").replace("t", ""))
            buffered: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            return buffered if "b" in mode else io.TextIOWrapper(buffered, *args, **keys)

        return call

    def _os_open(self, call: Callable[..., int]) -> Callable[..., int]:
        def opening(path: Any, flags: int, *args: Any, **keys: Any) -> int:
            self.check("create" if flags & os.O_CREAT else "read", path)
            return call(path, flags, *args, **keys)

        return opening

    def _by_handle(self, call: Callable[[Any], None]) -> Callable[[Any], None]:
        def syncing(file: Any) -> None:
            self.check("fsync", os.readlink(f"/proc/self/fd/{file if isinstance(file, int) else file.fileno()}"))
            call(file)

        return syncing

    def _by_path(self, kind: str, call: Callable[..., None]) -> Callable[..., None]:
        def changing(path: Any, *args: Any, **keys: Any) -> None:
            if keys.get("dir_fd") is None:  # shutil.rmtree, by which remains are removed as far as possible
                self.check(kind, path)
            call(path, *args, **keys)

        return changing


class _Raw(io.FileIO):
    """A file whose writes are counted."""

    def __init__(self, disk: Disk, path: Any, mode: str) -> None:
        super().__init__(path, mode)
        self._disk = disk

    def write(self, data: Any) -> int:
        self._disk.check("write", self.name)
        return super().write(data)


def _from_package() -> bool:
    frame: Any = sys._getframe(2)
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGE):
            return True
        frame = frame.f_back
    return False
