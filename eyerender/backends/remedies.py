"""Instructions for installing a missing backend, in one line."""

from __future__ import annotations

import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, distribution

from .libraries import WHEEL, load_runtime, wheel_libraries

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
