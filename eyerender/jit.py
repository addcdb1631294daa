"""How the compiled functions are compiled. Numba keeps the machine code in $XDG_CACHE_HOME/eyerender/kernels.

The index of that code is a pickle, so it is kept only in a private folder (`cachefolder`).

Numba compiles a function again when its own file changed, but not when another file did from which it calls a
function. So the machine code is kept in a folder of a name that depends on all files of compiled functions. When such
a folder is made, those of other versions that nothing has used for thirty days are removed.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit
from numba.core import config as numba_config

from .cachefolder import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])
_DIGITS, _UNUSED_S = 16, 30 * 86400.0
config: Any = numba_config  # it makes its attributes at run time


def _folder() -> Path | None:
    """Folder of the machine code of these files as they are; None where there is no private one to write to."""
    cache = cache_folder()
    if cache is None or not os.access(cache, os.W_OK):
        return None
    sources = sorted(Path(__file__).parent.glob("*/*kernels.py"))
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:_DIGITS]
    return cache / "kernels" / digest


def used(folder: Path) -> Path:
    """Mark a folder of machine code as used; if it does not exist yet, remove old ones beside it."""
    with suppress(OSError):
        if folder.exists():
            os.utime(folder)
        else:
            for other in folder.parent.iterdir():
                ours = re.fullmatch(f"[0-9a-f]{{{_DIGITS}}}", other.name) and other.is_dir() and not other.is_symlink()
                if ours and time.time() - other.stat().st_mtime > _UNUSED_S:
                    shutil.rmtree(other, ignore_errors=True)  # numba compiles again what another process misses
    return folder


FOLDER = None if (_place := _folder()) is None else str(used(_place))


def compiled(function: Function) -> Function:
    """Compile at the first call; the machine code is kept on disk if a private folder there can be written."""
    if FOLDER is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = FOLDER
        try:
            kept = njit(cache=True, nogil=True, error_model="numpy")(function)
            if str(kept.stats.cache_path).startswith(FOLDER):  # else numba chose a folder that nobody checked
                return cast(Function, kept)
        except (RuntimeError, OSError):  # numba found no folder to write to
            pass
        finally:
            config.CACHE_DIR = before
    return cast(Function, njit(nogil=True, error_model="numpy")(function))


def summing(function: Function) -> Function:
    """Compile a helper whose sums may be taken in any order, so that they use vector instructions."""
    return cast(Function, njit(error_model="numpy", fastmath={"reassoc", "contract"})(function))


def inlined(function: Function) -> Function:
    """Compile a helper as part of what calls it."""
    return cast(Function, njit(inline="never", error_model="numpy")(function))
