"""State of an installation: which backends render, and how to fix the others."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass

from ..base.processes import usable_cpus
from ..base.storage.cachefolder import cache_folder
from ..base.versions import package_version
from .choose import BackendName, BackendState, cuda_state
from .libraries import llvm_fix
from .llvm import find_llvm
from .probe import cpu_name


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorReport:
    """State of an installation: `ok` if a backend renders, `chosen` is the one that "auto" selects."""

    ok: bool
    chosen: BackendName | None
    backends: tuple[BackendState, ...]
    python: str
    platform: str
    cpu: str
    packages: tuple[tuple[str, str], ...]
    cache: str


def backend_states() -> list[BackendState]:
    """Test each backend on this machine, in separate processes so that this one is not changed."""
    return [cuda_state(refresh=True), _llvm_state()]


def doctor_report() -> DoctorReport:
    """Return a report on the installation, for instance for a bug report."""
    states = tuple(backend_states())
    packages = ("eyerender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "scikit-image")
    return DoctorReport(
        ok=any(state.ok for state in states),
        chosen=next((state.name for state in states if state.ok), None),
        backends=states,
        python=f"{platform.python_version()} ({sys.executable})",
        platform=platform.platform(),
        cpu=f"{cpu_name()}, {usable_cpus()} usable",
        packages=tuple((package, package_version(package)) for package in packages),
        cache=str(cache_folder() or "none (no private folder)"),
    )


def _llvm_state() -> BackendState:
    found, refused = find_llvm(refresh=True)
    if found is not None:
        return BackendState("llvm", True, f"LLVM {found.version}, {found.path}")
    return BackendState("llvm", False, "; ".join(refused) or "no libLLVM on this machine", llvm_fix())
