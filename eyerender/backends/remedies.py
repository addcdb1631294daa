"""Instructions to install a missing backend: one line for this machine."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

CUDA_FIX = "install NVIDIA's driver (with OptiX and CUDA 12 or newer), or use --backend llvm"

_BY_DISTRIBUTION = {
    "fedora": "sudo dnf install llvm-libs",
    "rhel": "sudo dnf install llvm-libs",
    "arch": "sudo pacman -S llvm-libs",
    "suse": "sudo zypper install libLLVM19",
}


def has_archive() -> bool:
    """Whether packages can be fetched and unpacked as on Debian and Ubuntu."""
    return sys.platform == "linux" and all(shutil.which(tool) for tool in ("apt-get", "apt-cache", "dpkg-deb"))


def llvm_fix() -> str:
    """Command that installs a libLLVM here; on Debian and Ubuntu that is this package's own."""
    return "run: eyerender setup-llvm" if has_archive() else llvm_command()


def llvm_command() -> str:
    """Command of this machine's own package manager that installs a libLLVM."""
    if os.environ.get("CONDA_PREFIX") or (Path(sys.prefix) / "conda-meta").is_dir():
        return "run: conda install -c conda-forge libllvm19"
    if sys.platform == "darwin":
        return "run: brew install llvm@19"
    if sys.platform == "win32":
        return "run: winget install LLVM.LLVM, then set DRJIT_LIBLLVM_PATH to its LLVM-C.dll"
    for name in _distribution():
        if name in _BY_DISTRIBUTION:
            return f"run: {_BY_DISTRIBUTION[name]}"
    return "install LLVM 19 (conda install -c conda-forge libllvm19) and set DRJIT_LIBLLVM_PATH to its libLLVM.so"


def _distribution() -> list[str]:
    """Ids of this Linux distribution and of those from which it derives, nearest first."""
    try:
        text = Path("/etc/os-release").read_text(encoding="utf-8")
    except OSError:
        return []
    entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    ids = f"{entries.get('ID', '')} {entries.get('ID_LIKE', '')}".replace('"', "").split()
    return [part for name in ids for part in (name, name.partition("-")[0])]  # opensuse-leap -> opensuse; like: suse
