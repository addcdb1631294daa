"""Choosing what renders, the processor (llvm) or an NVIDIA GPU (cuda), and telling what stands in the way.

Call `choose_backend` before anything imports mitsuba or drjit (see `llvm`); it sets Mitsuba's variant.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..errors import BackendError, InputError
from .libraries import cache_folder, load_runtime
from .llvm import ensure_llvm, examine
from .llvm_setup import setup_llvm
from .mend import CUDA_MEND, llvm_mend
from .probe import Verdict, cpu_name, package_version, probe

__all__ = [
    "Backend",
    "BackendChoice",
    "BackendName",
    "BackendState",
    "DoctorReport",
    "backend_states",
    "choose_backend",
    "doctor_report",
    "setup_llvm",
]

BackendName = Literal["cuda", "llvm"]
BackendChoice = Literal["auto", "cuda", "llvm"]

VARIANTS: dict[BackendName, str] = {"cuda": "cuda_ad_mono", "llvm": "llvm_ad_mono"}


@dataclass(frozen=True, slots=True)
class Backend:
    """The backend this process renders with.

    `device` names the processor or the GPU, `threads` is the size of Dr.Jit's thread pool, `llvm` the version of
    libLLVM and `library` its file (both None with cuda).
    """

    name: BackendName
    variant: str
    device: str
    threads: int
    mitsuba: str
    drjit: str
    llvm: str | None = None
    library: str | None = None

    @property
    def versions(self) -> dict[str, str]:
        """Versions that shape the pixels, by package."""
        versions = {"mitsuba": self.mitsuba, "drjit": self.drjit}
        return versions | ({"llvm": self.llvm} if self.llvm else {})


@dataclass(frozen=True, slots=True)
class BackendState:
    """Whether a backend renders on this machine; `detail` says what was found, `mend` what would help (empty if ok)."""

    name: BackendName
    ok: bool
    detail: str
    mend: str = ""


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """State of an installation: `ok` where some backend renders, `chosen` the one that "auto" takes."""

    ok: bool
    chosen: BackendName | None
    backends: tuple[BackendState, ...]
    python: str
    platform: str
    cpu: str
    packages: tuple[tuple[str, str], ...]
    cache: str


def choose_backend(name: BackendChoice = "auto", threads: int | None = None) -> Backend:
    """Make this process render with a backend that was seen to work.

    Parameters
    ----------
    name
        "auto" takes the GPU where one renders, else the processor.
    threads
        Threads of the processor to use, >= 1; None leaves Dr.Jit's choice, all of them.

    Raises
    ------
    InputError
        No such backend, or `threads` below 1.
    BackendError
        None renders, or mitsuba was imported earlier with a libLLVM that does not; the message names the mend.
    """
    if name not in ("auto", "cuda", "llvm"):
        raise InputError(f"must be auto, cuda or llvm, not {name!r}", path="backend")
    if threads is not None and threads < 1:
        raise InputError(f"must be >= 1, not {threads}", path="threads")
    if package_version("mitsuba") == "none":
        raise BackendError("mitsuba is not installed; run: pip install mitsuba")
    if name != "llvm":
        cuda = _cuda_state()
        if cuda.ok:
            return _start("cuda", cuda.detail, threads)
        if name == "cuda":
            raise BackendError(f"cuda does not render here: {cuda.detail}; {cuda.mend}")
    library = ensure_llvm()
    path = str(library.path) if library.path else None
    return _start("llvm", cpu_name(), threads, llvm=library.version, library=path)


def backend_states() -> list[BackendState]:
    """What each backend would do on this machine. Looks in other processes only, so this one stays as it is."""
    return [_cuda_state(refresh=True), _llvm_state()]


def doctor_report() -> DoctorReport:
    """Everything a report of a defect should carry about the installation."""
    states = tuple(backend_states())
    packages = ("eyerender", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "scikit-image")
    return DoctorReport(
        ok=any(state.ok for state in states),
        chosen=next((state.name for state in states if state.ok), None),
        backends=states,
        python=f"{platform.python_version()} ({sys.executable})",
        platform=platform.platform(),
        cpu=f"{cpu_name()}, {_cpu_count()} usable",
        packages=tuple((package, package_version(package)) for package in packages),
        cache=str(cache_folder() or "none (no home folder)"),
    )


def _start(
    name: BackendName, device: str, threads: int | None, *, llvm: str | None = None, library: str | None = None
) -> Backend:
    try:
        load_runtime()
        import drjit as dr
        import mitsuba as mi

        if mi.variant() != VARIANTS[name]:
            mi.set_variant(VARIANTS[name])
    except (ImportError, OSError) as error:
        raise BackendError(f"mitsuba cannot start {VARIANTS[name]}: {str(error).splitlines()[0]}") from error
    if threads is not None:
        dr.set_thread_count(threads)
    return Backend(
        name=name,
        variant=VARIANTS[name],
        device=device,
        threads=dr.thread_count(),
        mitsuba=package_version("mitsuba"),
        drjit=package_version("drjit"),
        llvm=llvm,
        library=library,
    )


def _llvm_state() -> BackendState:
    refused: list[str] = []
    for examined in examine(refresh=True):
        if examined.verdict.ok:
            return BackendState("llvm", True, f"{examined.verdict.detail}, {examined.path}")
        refused.append(f"{examined.path}: {examined.verdict.detail}")
    return BackendState("llvm", False, "; ".join(refused) or "no libLLVM on this machine", llvm_mend())


def _cuda_state(*, refresh: bool = False) -> BackendState:
    driver = _cuda_driver()
    if driver is None:
        return BackendState("cuda", False, "no NVIDIA driver on this machine", CUDA_MEND)
    verdict: Verdict = probe(VARIANTS["cuda"], context=driver)
    if refresh and not verdict.ok:
        verdict = probe(VARIANTS["cuda"], context=driver, refresh=True)
    return BackendState("cuda", verdict.ok, verdict.detail, "" if verdict.ok else CUDA_MEND)


def _cuda_driver() -> str | None:
    """What tells one driver and set of GPUs from another; None, at no cost, where there is no driver to load."""
    named = os.environ.get("DRJIT_LIBCUDA_PATH")
    library = named or ("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    try:
        ctypes.CDLL(library)
    except OSError:
        return None
    parts = [library, os.environ.get("CUDA_VISIBLE_DEVICES", "all")]
    parts += sorted(str(device) for device in Path("/dev").glob("nvidia[0-9]*"))
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/driver/nvidia/version").read_text(encoding="utf-8"))
    return "\n".join(parts)


def _cpu_count() -> int:
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
