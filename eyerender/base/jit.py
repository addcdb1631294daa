"""Compile functions with numba, and keep the machine code in $XDG_CACHE_HOME/eyerender/kernels.

The index of that code is a pickle, so it is kept only in a private folder (`cachefolder`).

Numba compiles a function again when its own file changes, but not when a file changes whose functions it calls. So the
machine code is kept in a folder whose name depends on all files with compiled functions. A new folder removes those of
other versions that have not been used for thirty days.

Numba compiles one function at a time in a process, so several processes share the compilation.
"""

from __future__ import annotations

import gc
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from .apart import imported_apart

imported_apart("numba", ".numba_config.yaml")
import numba
from numba.core import config as numba_config
from numba.core import sigutils
from numba.core.dispatcher import Dispatcher

from .processes import python_command, start
from .storage.cachefolder import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])
_DIGITS, _UNUSED_S = 16, 30 * 86400.0
config: Any = numba_config  # it makes its attributes at run time
config._config_fname = os.devnull  # otherwise it reads the current folder's file again whenever it compiles
normalize_signature: Any = sigutils.normalize_signature  # it has no types
njit: Any = numba.njit  # its types lack some options


def _folder() -> Path | None:
    """Return the folder for the machine code of the current source files; None if no private, writable one exists."""
    cache = cache_folder()
    if cache is None or not os.access(cache, os.W_OK):
        return None
    package = Path(__file__).parents[1]
    sources = sorted(
        [*package.glob("extraction/**/*.py"), *package.glob("*/*kernels.py"), *package.glob("*/formulas.py")]
    )
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:_DIGITS]
    return cache / "kernels" / digest


def used(folder: Path) -> Path:
    """Mark a folder of machine code as recently used; if it does not exist yet, remove outdated folders next to it."""
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
FUNCTIONS: dict[Any, tuple[str, dict[str, np.dtype[Any]]]] = {}  # dispatchers of `compiled`, and argument types
# Helpers are called by compiled functions only.
HELPER: dict[str, Any] = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
ABOUT_S = 15  # time of compilation on two cores, for the message
_MOST_WORKERS = 4
_LOCK = threading.Lock()  # lock of `ensure_compiled`


class Program(NamedTuple):
    """Functions that are compiled together."""

    title: str  # its name in messages
    about_s: int  # compilation time on two cores in seconds, for the message
    packages: tuple[str, ...]  # packages of its modules
    module: str  # module that imports them all; run as a script, it compiles a share of them
    complete: str  # file in FOLDER whose existence means that all functions are compiled


EXTRACTOR = Program("the extractor", ABOUT_S, ("eyerender.extraction",), "eyerender.extraction.compile", "complete")
RAYS = Program(
    "the ray optics",
    15,
    ("eyerender.optics", "eyerender.eye", "eyerender.analytic"),
    "eyerender.analytic.compile",
    "complete-rays",
)


def ensure_compiled(program: Program = EXTRACTOR) -> None:
    """Compile a whole program in up to four processes, unless its machine code is on disk."""
    with _LOCK:
        _compile_missing(program)


@cache
def _compile_missing(program: Program) -> None:
    """Announce the compilation on stderr, start the other processes, and compile a share of the functions here.

    A function that another process failed to compile is compiled when it is called.
    """
    if FOLDER is not None and Path(FOLDER, program.complete).exists():
        return
    print(f"compiling {program.title} (once per machine), about {program.about_s} s ...", file=sys.stderr)
    if FOLDER is None:
        return  # no other process could use the machine code, so each function is compiled at its first call
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
    null = subprocess.DEVNULL
    with suppress(OSError), tempfile.TemporaryDirectory(prefix="eyerender-compile-") as claims, ExitStack() as workers:
        command = python_command(program.module, claims)
        for k in range(1, min(cores, _MOST_WORKERS)):
            one = start([*command, str(k)], env=environment, stdin=null, stdout=null, stderr=null)
            workers.enter_context(one)  # it waits for the process at the end
        compile_share(Path(claims), 0, program)
    with suppress(OSError):
        Path(FOLDER, program.complete).touch()


def compile_share(claims: Path, worker: int, program: Program = EXTRACTOR) -> None:
    """Compile the functions of a program, except those that other processes claimed by a subfolder of `claims`.

    Functions of one module share helpers, which every process has to compile for itself. So workers with even numbers
    begin with the modules of glints and those with odd numbers with the pupil's, the largest module first.
    """

    def place(function: Any) -> tuple[bool, int, str]:
        module = function.py_func.__module__
        pupil, size = ".pupil." in module, _code_size(module)
        return pupil, size if pupil else -size, module

    ordered = sorted(functions(program), key=place)
    collecting = gc.isenabled()
    gc.disable()  # numba creates millions of objects, which the garbage collector would scan again and again
    try:
        for one in ordered if worker % 2 == 0 else reversed(ordered):
            with suppress(FileExistsError):
                (claims / f"{one.py_func.__module__}.{one.py_func.__name__}").mkdir()
                one.compile(argument_types(one))
    finally:
        if collecting:
            gc.enable()


def _code_size(module: str) -> int:
    """Count the bytes of bytecode of all numba functions in the names of a module, imported helpers included."""
    names = vars(sys.modules[module]).values()
    return sum(len(one.py_func.__code__.co_code) for one in names if isinstance(one, Dispatcher))


def functions(program: Program = EXTRACTOR) -> list[Any]:
    """Return all compiled functions of a program as numba dispatchers."""
    return [one for one in FUNCTIONS if one.py_func.__module__.startswith(program.packages)]


def argument_types(function: Any) -> tuple[Any, ...]:
    """Return the argument types declared for a compiled function, as in numba's index of machine code."""
    types, records = FUNCTIONS[function]
    known = {**vars(numba.types), **{name: numba.from_dtype(record) for name, record in records.items()}}
    return tuple(normalize_signature(eval(f"({types},)", {}, known))[0])


def compiled(types: str = "", **records: np.dtype[Any]) -> Callable[[Function], Function]:
    """Decorate a function so that numba compiles it at its first call and keeps the machine code on disk.

    Args:
        types: argument types with which the function is called, in numba's notation, for compilation ahead of time.
        records: types of structured arrays by their names in `types`.
    """

    def decorate(function: Function) -> Function:
        made = _dispatcher(function)
        FUNCTIONS[made] = types, records
        return cast(Function, made)

    return decorate


def _dispatcher(function: Callable[..., Any]) -> Any:
    """Create the numba dispatcher that compiles a function at its first call."""
    if FOLDER is not None:
        before = config.CACHE_DIR
        config.CACHE_DIR = FOLDER
        try:
            kept = njit(cache=True, no_cfunc_wrapper=True, nogil=True, error_model="numpy")(function)
            if str(kept.stats.cache_path).startswith(
                FOLDER
            ):  # otherwise numba would choose a folder that nobody checked
                return kept
        except (RuntimeError, OSError):  # numba found no folder to write to
            pass
        finally:
            config.CACHE_DIR = before
    return njit(nogil=True, error_model="numpy")(function)


def summing(function: Function) -> Function:
    """Compile a helper whose sums may be reordered, which allows vector instructions."""
    return _helper(function, fastmath={"reassoc", "contract"})


def inlined(function: Function) -> Function:
    """Compile a helper into its callers."""
    return _helper(function)


def _helper(function: Function, **options: Any) -> Function:
    return cast(Function, njit(**HELPER, **options)(function))
