"""Who may write to a folder: one run, or several runs over disjoint parts of its shards.

Locks are the kernel's (flock), held by an open file: a process that dies in any way lets go of them.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import EyerenderError, InputError

try:
    import fcntl
except ImportError:  # Windows has none
    fcntl = None  # type: ignore[assignment]

LOCK = ".eyerender-lock"
_UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}


@contextmanager
def run_lock(folder: Path, part: tuple[int, int], warn: Callable[[str], None]) -> Iterator[None]:
    """Hold a folder while the block runs; `part` = (K, N) of --shard K/N, (1, 1) for all of it.

    Raises:
        InputError: another run holds it, or a part of it that overlaps.
        EyerenderError: it cannot be written.
    """
    k, n = part
    with contextlib.ExitStack() as stack:
        whole = n == 1
        _take(stack, folder / LOCK, shared=not whole, folder=folder, warn=warn)
        if not whole:
            for other in folder.glob(f"{LOCK}-*-of-*"):
                if not other.name.endswith(f"-of-{n}"):
                    # Parts of another division overlap with ours: nobody may hold one.
                    with contextlib.ExitStack() as brief:
                        _take(brief, other, shared=True, folder=folder, warn=warn)
            _take(stack, folder / f"{LOCK}-{k}-of-{n}", shared=False, folder=folder, warn=warn)
        yield


@contextmanager
def final_lock(folder: Path, warn: Callable[[str], None]) -> Iterator[None]:
    """Hold the right to put the finished dataset together, waiting for it."""
    with contextlib.ExitStack() as stack:
        _take(stack, folder / f"{LOCK}-final", shared=False, folder=folder, warn=warn, wait=True)
        yield


def _take(
    stack: contextlib.ExitStack,
    path: Path,
    *,
    shared: bool,
    folder: Path,
    warn: Callable[[str], None],
    wait: bool = False,
) -> None:
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise EyerenderError(f"{folder}: cannot be written ({error.strerror})") from None
    stack.callback(os.close, file)
    if fcntl is None:
        warn("this system has no file locks: do not start two runs on one folder")
        return
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno in _UNSUPPORTED:
            warn("this file system has no locks: do not start two runs on one folder")
            return
        raise InputError("another run is at work in this folder", source=str(folder)) from None
