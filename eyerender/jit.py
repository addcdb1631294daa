"""How the compiled functions are compiled. Numba keeps the machine code in $XDG_CACHE_HOME/eyerender/kernels.

The index of that code is a pickle, so it is kept only in a private folder (`cachefolder`).

Numba compiles a function again when its own file changed, but not when another file did from which it calls a
function. So the machine code is kept in a folder of a name that depends on all files with compiled functions. When such
a folder is made, those of other versions that nothing has used for thirty days are removed.

Numba compiles one function at a time. So where the extractor's machine code is missing, several processes make it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config
from numba.core import event as numba_event

from .storage.cachefolder import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])
_DIGITS, _UNUSED_S = 16, 30 * 86400.0
config: Any = numba_config  # it makes its attributes at run time
event: Any = numba_event
njit: Any = numba.njit  # its types lack some options


def _folder() -> Path | None:
    """Folder of the machine code of these files as they are; None where there is no private one to write to."""
    cache = cache_folder()
    if cache is None or not os.access(cache, os.W_OK):
        return None
    package = Path(__file__).parent
    sources = sorted([*package.glob("extraction/**/*.py"), *package.glob("*/*kernels.py")])
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
FUNCTIONS: dict[Any, str] = {}  # what `compiled` made, numba's dispatchers, and the types of their arguments
# Helpers are called by compiled functions only.
HELPER: dict[str, Any] = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
ABOUT_S = 20  # time that compilation takes on two cores, as people are told
_MOST_WORKERS = 4
_WORKER = "EYERENDER_COMPILE_WORKER"  # set in the processes that compile


class _Announcement(numba_event.Listener):
    """At the first compilation, says so on stderr and has the whole extractor compiled."""

    def __init__(self) -> None:
        kept = FOLDER is not None and any(Path(FOLDER).glob("pupil_*"))
        self.said = kept or _WORKER in os.environ

    def on_start(self, event: Any) -> None:
        """Compile everything, where no earlier process kept anything."""
        if not self.said and event.data["dispatcher"].py_func.__module__.startswith("eyerender.extraction"):
            self.said = True
            print(f"compiling the extractor (once per machine), about {ABOUT_S} s ...", file=sys.stderr)
            if FOLDER is not None:
                _compile_in_processes()  # the compilation that starts here goes on, and finds the others' machine code

    def on_end(self, event: object) -> None:
        """Do nothing."""


event.register("numba:compile", _Announcement())


def _compile_in_processes() -> None:
    """Compile the extractor in as many processes as there are cores, at most four, and wait for them.

    What they could not compile is compiled when it is called.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)), _WORKER: "1"}
    null = subprocess.DEVNULL
    with suppress(OSError), tempfile.TemporaryDirectory(prefix="eyerender-compile-") as claims, ExitStack() as workers:
        command = [sys.executable, "-P", "-m", "eyerender.extraction.compile", claims]
        for _ in range(min(cores, _MOST_WORKERS) if cores > 1 else 0):
            workers.enter_context(subprocess.Popen(command, env=environment, stdin=null, stdout=null, stderr=null))


def compiled(types: str = "") -> Callable[[Function], Function]:
    """Compile at the first call; the machine code is kept on disk if a private folder there can be written.

    Args:
        types: those of the arguments that extraction passes, as numba writes them, for compilation beforehand.
    """

    def decorate(function: Function) -> Function:
        made = _dispatcher(function)
        FUNCTIONS[made] = types
        return cast(Function, made)

    return decorate


def _dispatcher(function: Callable[..., Any]) -> Any:
    """Make what compiles a function at its first call."""
    if FOLDER is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = FOLDER
        try:
            kept = njit(cache=True, no_cfunc_wrapper=True, nogil=True, error_model="numpy")(function)
            if str(kept.stats.cache_path).startswith(FOLDER):  # else numba chose a folder that nobody checked
                return kept
        except (RuntimeError, OSError):  # numba found no folder to write to
            pass
        finally:
            config.CACHE_DIR = before
    return njit(nogil=True, error_model="numpy")(function)


def summing(function: Function) -> Function:
    """Compile a helper whose sums may be taken in any order, so that they use vector instructions."""
    return cast(Function, njit(fastmath={"reassoc", "contract"}, **HELPER)(function))


def inlined(function: Function) -> Function:
    """Compile a helper as part of what calls it."""
    return cast(Function, njit(**HELPER)(function))
