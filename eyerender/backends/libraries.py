"""Load shared libraries that are not in the system's search path, or say how to get a libLLVM."""

from __future__ import annotations

import ctypes
import platform
import shutil
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
    replace the system's C++ runtime in libraries that are loaded later. Raises OSError if a dependency is missing, or
    the library does not fit this system.
    """
    load_runtime()
    for name in _BESIDE_LLVM:
        file = library.parent / "x86_64-unknown-linux-gnu" / name
        if file.is_file():
            ctypes.CDLL(str(file))
    ctypes.CDLL(str(library))


CUDA_FIX = "install NVIDIA's driver (with OptiX and CUDA 12 or newer), or use --backend llvm"
LLVM_PACKAGES = (
    "install LLVM 17 or newer (Debian, Ubuntu: sudo apt-get install libllvm19; Fedora: sudo dnf install llvm-libs; "
    "conda: conda install -c conda-forge libllvm19; macOS: brew install llvm@19; Windows: winget install LLVM.LLVM); "
    "where it is not found, set DRJIT_LIBLLVM_PATH to its library"
)


def has_archive() -> bool:
    """Return whether packages can be fetched and unpacked with Debian's and Ubuntu's tools."""
    return sys.platform == "linux" and all(shutil.which(tool) for tool in ("apt-get", "dpkg-deb"))


def llvm_fix() -> str:
    """Return what to install if no libLLVM renders: the libraries that Dr.Jit needs, or else a libLLVM."""
    try:
        load_runtime()
    except OSError as error:
        return "run: eyerender setup-llvm" if has_archive() else str(error)
    return llvm_command()


def llvm_command() -> str:
    """Return what installs a libLLVM: pip, if there is a wheel that is not fully installed, else the system's tools."""
    if sys.platform != "linux" or platform.machine() != "x86_64" or any(path.is_file() for path in wheel_libraries()):
        return LLVM_PACKAGES
    try:
        wheel = distribution(WHEEL)
    except PackageNotFoundError:
        return f"run: pip install {WHEEL}"
    install = f"pip install --no-deps --ignore-installed --prefix '{wheel.locate_file('')}' {WHEEL}=={wheel.version}"
    return f"{WHEEL} lacks its library, which pip install --target drops; run: {install}"
