"""Instructions for installing a missing backend: one line for this machine."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from .libraries import WHEEL, load_runtime, wheel_libraries

CUDA_FIX = "install NVIDIA's driver (with OptiX and CUDA 12 or newer), or use --backend llvm"

_LLVM_BY_DISTRIBUTION = {
    "debian": "sudo apt-get install libllvm19",
    "ubuntu": "sudo apt-get install libllvm19",
    "fedora": "sudo dnf install llvm-libs",
    "rhel": "sudo dnf install llvm-libs",
    "arch": "sudo pacman -S llvm-libs",
    "suse": "sudo zypper install libLLVM19",
}
_ATOMIC_BY_DISTRIBUTION = {
    "debian": "sudo apt-get install libatomic1",
    "ubuntu": "sudo apt-get install libatomic1",
    "fedora": "sudo dnf install libatomic",
    "rhel": "sudo dnf install libatomic",
    "arch": "sudo pacman -S gcc-libs",
    "suse": "sudo zypper install libatomic1",
}


def has_archive() -> bool:
    """Return whether packages can be fetched and unpacked with Debian's and Ubuntu's tools."""
    return sys.platform == "linux" and all(shutil.which(tool) for tool in ("apt-get", "dpkg-deb"))


def llvm_fix() -> str:
    """Return what to install if no libLLVM renders: the libraries that Dr.Jit needs, or else a libLLVM."""
    try:
        load_runtime()
    except OSError:
        return "run: eyerender setup-llvm" if has_archive() else runtime_command()
    return llvm_command()


def runtime_command() -> str:
    """Return the command of this machine's package manager that installs libatomic."""
    return _by_distribution(_ATOMIC_BY_DISTRIBUTION) or "install libatomic (libatomic.so.1)"


def llvm_command() -> str:
    """Return the command that installs a libLLVM: pip's if there is a wheel, else the package manager's."""
    return _wheel_command() or _system_command()


def _wheel_command() -> str:
    """Return the command that installs the wheel with libLLVM; "" if there is none, or it is fully installed."""
    if sys.platform != "linux" or platform.machine() != "x86_64" or any(path.is_file() for path in wheel_libraries()):
        return ""
    try:
        wheel = distribution(WHEEL)
    except PackageNotFoundError:
        return f"run: pip install {WHEEL}"
    install = f"pip install --no-deps --ignore-installed --prefix '{wheel.locate_file('')}' {WHEEL}=={wheel.version}"
    return f"{WHEEL} lacks its library, which pip install --target drops; run: {install}"


def _system_command() -> str:
    if os.environ.get("CONDA_PREFIX") or (Path(sys.prefix) / "conda-meta").is_dir():
        return "run: conda install -c conda-forge libllvm19"
    if sys.platform == "darwin":
        return "run: brew install llvm@19"
    if sys.platform == "win32":
        return "run: winget install LLVM.LLVM, then set DRJIT_LIBLLVM_PATH to its LLVM-C.dll"
    return _by_distribution(_LLVM_BY_DISTRIBUTION) or (
        "install LLVM 19 (conda install -c conda-forge libllvm19) and set DRJIT_LIBLLVM_PATH to its libLLVM.so"
    )


def _by_distribution(commands: dict[str, str]) -> str:
    return next((f"run: {commands[name]}" for name in _distribution() if name in commands), "")


def _distribution() -> list[str]:
    """Return the ids of this Linux distribution and of those it derives from, nearest first."""
    try:
        text = Path("/etc/os-release").read_text(encoding="utf-8")
    except OSError:
        return []
    entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    ids = f"{entries.get('ID', '')} {entries.get('ID_LIKE', '')}".replace('"', "").split()
    return [part for name in ids for part in (name, name.partition("-")[0])]  # opensuse-leap -> opensuse; like: suse
