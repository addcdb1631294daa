"""Locks of folders, for one writer, or for several runs over disjoint parts of its shards.

The locks are kernel locks (flock) on an open file, so a process that dies in any way releases them.

Why not filelock: its kernel locks are exclusive only, and runs over parts of a folder share the folder's lock. Its
read-write locks are a SQLite database, or files that outlive a dead process until they expire. Its other features would
replace a single call of flock.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import EyerenderError, InputError
from ..progress import Say

try:
    import fcntl
except ImportError:  # Windows has none
    fcntl = None  # type: ignore[assignment]

LOCK = ".eyerender-lock"
_UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}


@contextmanager
def writer_lock(folder: Path, warn: Say = lambda _text: None) -> Iterator[None]:
    """Hold a whole folder during the block; the lock file is removed afterwards.

    Raises InputError if another writer holds the folder; EyerenderError if the folder cannot be written.
    """
    with contextlib.ExitStack() as stack:
        _take(stack, folder / LOCK, shared=False, folder=folder, warn=warn)
        try:
            yield
        finally:
            # The file is removed while the lock is held: `_take` does not accept a lock on a removed file.
            with contextlib.suppress(OSError):
                (folder / LOCK).unlink()


@contextmanager
def run_lock(folder: Path, part: tuple[int, int], warn: Say) -> Iterator[None]:
    """Hold a folder during the block; `part` = (K, N) of --shard K/N, (1, 1) for the whole.

    Raises:
        InputError: another run holds the folder, or an overlapping part of it.
        EyerenderError: the folder cannot be written.
    """
    k, n = part
    with contextlib.ExitStack() as stack:
        whole = n == 1
        _take(stack, folder / LOCK, shared=not whole, folder=folder, warn=warn)
        if not whole:
            for other in folder.glob(f"{LOCK}-*-of-*"):
                if not other.name.endswith(f"-of-{n}"):
                    # Parts of another division overlap with this one, so none of them may be held.
                    with contextlib.ExitStack() as brief:
                        _take(brief, other, shared=True, folder=folder, warn=warn)
            _take(stack, folder / f"{LOCK}-{k}-of-{n}", shared=False, folder=folder, warn=warn)
        yield


@contextmanager
def final_lock(folder: Path, warn: Say) -> Iterator[None]:
    """Wait for and hold the lock for assembling the finished dataset."""
    with contextlib.ExitStack() as stack:
        _take(stack, folder / f"{LOCK}-final", shared=False, folder=folder, warn=warn, wait=True)
        yield


def _take(
    stack: contextlib.ExitStack, path: Path, *, shared: bool, folder: Path, warn: Say, wait: bool = False
) -> None:
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        except OSError as error:
            raise EyerenderError(f"{folder}: cannot be written ({error.strerror})") from None
        try:
            if fcntl is None:
                warn("this system has no file locks: do not start two runs on one folder")
            else:
                fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                os.close(file)
                raise InputError("another run is using this folder", source=str(folder)) from None
            warn("this file system has no locks: do not start two runs on one folder")
        if _is_at(file, path):
            stack.callback(os.close, file)
            return
        os.close(file)  # its last holder has removed it in the meantime


def _is_at(file: int, path: Path) -> bool:
    """Return whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except OSError:
        return False
