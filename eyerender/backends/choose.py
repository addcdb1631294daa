"""The choice of the backend: the processor (llvm) or an NVIDIA GPU (cuda).

`choose_backend` sets Mitsuba's variant. What Dr.Jit reads at its import, `hook` has set by then.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..base.errors import BackendError, InputError
from ..base.storage.cachefolder import cache_folder, private_folder
from ..base.versions import package_version
from .libraries import CUDA_FIX, load_runtime
from .llvm import ensure_llvm, select_llvm
from .probe import Verdict, cpu_name, probe

BackendName = Literal["cuda", "llvm"]
BackendChoice = Literal["auto", "cuda", "llvm"]

# Environment variable of Dr.Jit: the folder of its compiled kernels.
KERNELS = "DRJIT_CACHE_DIR"
VARIANTS: dict[BackendName, str] = {"cuda": "cuda_ad_mono", "llvm": "llvm_ad_mono"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Backend:
    """The backend that renders in this process."""

    name: BackendName  # cuda or llvm
    variant: str  # Mitsuba's variant
    device: str  # name of the processor or the GPU
    threads: int  # size of Dr.Jit's thread pool
    mitsuba: str  # version of Mitsuba
    drjit: str  # version of Dr.Jit
    llvm: str | None = None  # version of libLLVM; None with cuda
    library: str | None = None  # file of libLLVM; None with cuda

    @property
    def versions(self) -> dict[str, str]:
        """Return the versions that affect the pixels, by package."""
        versions = {"mitsuba": self.mitsuba, "drjit": self.drjit}
        return versions | ({"llvm": self.llvm} if self.llvm else {})


@dataclass(frozen=True, slots=True)
class BackendState:
    """Whether a backend renders on this machine; `detail` describes what was found, `fix` how to repair it."""

    name: BackendName
    ok: bool
    detail: str
    fix: str = ""


def choose_backend(name: BackendChoice = "auto", threads: int | None = None) -> Backend:
    """Select a backend that was tested successfully for this process.

    Args:
        name: "auto" selects the GPU if one renders, else the processor.
        threads: threads of the processor to use, >= 1; None leaves Dr.Jit's choice, all of them.

    Raises:
        InputError: no such backend, or `threads` below 1.
        BackendError: no backend renders, or drjit was imported before eyerender with a libLLVM that does not; the
            message says how to fix it.
    """
    if name not in ("auto", "cuda", "llvm"):
        raise InputError(f"must be auto, cuda or llvm, not {name!r}", path="backend")
    if threads is not None and threads < 1:
        raise InputError(f"must be >= 1, not {threads}", path="threads")
    if package_version("mitsuba") == "unknown":
        raise BackendError("mitsuba is not installed; run: pip install mitsuba")
    if name != "llvm":
        cuda = cuda_state()
        if cuda.ok:
            return _start("cuda", cuda.detail, threads)
        if name == "cuda":
            raise BackendError(f"cuda cannot render here: {cuda.detail}; {cuda.fix}")
    library = ensure_llvm()
    path = str(library.path) if library.path else None
    return _start("llvm", cpu_name(), threads, llvm=library.version, library=path)


def prepare_drjit() -> None:
    """Set what Dr.Jit reads when it is first imported (`hook`). Where no libLLVM renders, it loads what it finds."""
    _keep_kernels_private()
    with contextlib.suppress(OSError):
        load_runtime()
        select_llvm()


def _keep_kernels_private() -> None:
    """Make Dr.Jit store its kernels, which are executable code, in a folder that only this user can write to.

    Without such a folder, a temporary one is used while this process runs.
    """
    given = os.environ.get(KERNELS)
    place = private_folder(Path(given).absolute()) if given else cache_folder()
    if place is not None and not given:
        place /= "drjit"
    if place is None:
        place = Path(tempfile.mkdtemp(prefix="eyerender-drjit-"))
        atexit.register(shutil.rmtree, place, ignore_errors=True)
    os.environ[KERNELS] = str(place)


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


def cuda_state(*, refresh: bool = False) -> BackendState:
    """Return whether an NVIDIA GPU renders here; `refresh` repeats a test that failed earlier."""
    driver = _cuda_driver()
    if driver is None:
        return BackendState("cuda", False, "no NVIDIA driver on this machine", CUDA_FIX)
    verdict: Verdict = probe(VARIANTS["cuda"], context=driver)
    if refresh and not verdict.ok:
        verdict = probe(VARIANTS["cuda"], context=driver, refresh=True)
    return BackendState("cuda", verdict.ok, verdict.detail, "" if verdict.ok else CUDA_FIX)


def _cuda_driver() -> str | None:
    """Return a text that identifies the driver and the GPUs; None, at no cost, without a driver."""
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
