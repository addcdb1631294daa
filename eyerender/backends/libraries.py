"""Load shared libraries that are not in the system's search path."""

from __future__ import annotations

import ctypes
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from ..base.storage.cachefolder import cache_folder

WHEEL = "karellen-llvm-core"
# Libraries that Dr.Jit is linked with and a bare Linux lacks, with their packages on Debian and on Fedora.
RUNTIME = {"libatomic.so.1": ("libatomic1", "libatomic")} if sys.platform == "linux" else {}
# Libraries that the wheel's libLLVM needs, each after those that it needs itself. The wheel makes links to them when
# Python starts, but only in a writable environment, so they are loaded by their real names.
_BESIDE_LLVM = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")


def runtime_store() -> Path | None:
    """Return the folder of the libraries that `setup_llvm` fetched; None without a private cache folder."""
    folder = cache_folder()
    return folder / "lib" if folder else None


def load_runtime() -> None:
    """Load the libraries that Dr.Jit is linked with: the system's, else those that `setup_llvm` fetched.

    Raises:
        OSError: a library is missing; the message names the package.
    """
    store = runtime_store()
    for name, (debian, fedora) in RUNTIME.items():
        try:
            ctypes.CDLL(name)
        except OSError as error:
            if store is None or not (store / name).is_file():
                raise OSError(f"{name} is missing (package {debian} on Debian, {fedora} elsewhere)") from error
            ctypes.CDLL(str(store / name))


def wheel_libraries() -> list[Path]:
    """Return the libLLVM files recorded by pip, and their paths in a `--target` folder after `pip install --prefix`."""
    try:
        wheel = distribution(WHEEL)
    except PackageNotFoundError:
        return []
    recorded = [Path(str(file.locate())) for file in wheel.files or [] if file.name.startswith("libLLVM.so.")]
    return recorded + sorted(Path(str(wheel.locate_file("lib"))).glob("libLLVM.so.*"))


def load_llvm(library: Path) -> None:
    """Load a libLLVM and the libraries that it and Dr.Jit need.

    Their symbols stay private (RTLD_LOCAL); the loader finds a loaded dependency by name anyway. Public symbols would
    replace the system's C++ runtime in libraries that are loaded later.

    Raises:
        OSError: a dependency is missing, or the library does not fit this system.
    """
    load_runtime()
    for name in _BESIDE_LLVM:
        file = library.parent / "x86_64-unknown-linux-gnu" / name
        if file.is_file():
            ctypes.CDLL(str(file))
    ctypes.CDLL(str(library))
