"""Find a libLLVM that renders for Mitsuba's llvm variants, and make Dr.Jit load it.

On Linux x86-64 the wheel karellen-llvm-core provides it; elsewhere it must be installed on the system. Some versions
are rejected, and some end the process at their first kernel, so each candidate is probed in a separate process
(`probe`). Dr.Jit loads a libLLVM only when drjit is first imported. `select_llvm` runs before that (`hook`), and
`ensure_llvm` checks what was loaded.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..base.errors import BackendError
from ..base.processes import run
from .libraries import llvm_fix, load_llvm, wheel_libraries
from .probe import Verdict, probe

VARIANT = "llvm_ad_mono"
ENVIRONMENT = "DRJIT_LIBLLVM_PATH"


@dataclass(frozen=True, slots=True)
class LibLlvm:
    """A libLLVM that renders: its file (None if only the loader knows) and version."""

    path: Path | None
    version: str

    @classmethod
    def probed(cls, path: Path, verdict: Verdict) -> LibLlvm:
        """Create it from the verdict of a successful probe."""
        return cls(path, verdict.detail.removeprefix("LLVM "))


_selected: LibLlvm | None = None
_active: LibLlvm | None = None


def candidates() -> Iterator[Path]:
    """Yield every libLLVM of this machine once: the user's choice, the wheel's, then the system's from new to old."""
    seen: set[Path] = set()
    for group in (_named, wheel_libraries, _installed):
        for path in sorted(group(), key=_order):
            real = path.resolve()
            if real not in seen and real.is_file():
                seen.add(real)
                yield real


def examine(*, refresh: bool = False) -> Iterator[tuple[Path, Verdict]]:
    """Probe the candidates one by one and yield each with its verdict; `refresh` ignores earlier failures only."""
    for path in candidates():
        verdict = probe(VARIANT, path)
        if refresh and not verdict.ok:
            verdict = probe(VARIANT, path, refresh=True)
        yield path, verdict


def find_llvm(*, refresh: bool = False) -> tuple[LibLlvm | None, list[str]]:
    """Return the first candidate that renders (None if there is none), and what is wrong with those before it."""
    refused: list[str] = []
    for path, verdict in examine(refresh=refresh):
        if verdict.ok:
            return LibLlvm.probed(path, verdict), refused
        refused.append(f"{path}: {verdict.detail}")
    return None, refused


def ensure_llvm() -> LibLlvm:
    """Make Dr.Jit in this process use a libLLVM that renders.

    Raises:
        BackendError: there is none, or drjit was imported before eyerender and has loaded another, or none; the message
            says how to fix it.
    """
    global _active
    if _active is None:
        _active = _loaded()
    return _active


def select_llvm() -> None:
    """Load the first libLLVM that renders, if any does, and name it to Dr.Jit, which must not be imported yet."""
    global _selected
    for path, verdict in examine():
        if not verdict.ok:
            continue
        try:
            load_llvm(path)
        except OSError:
            # It is cached as good, but something that it needs has been removed since.
            probe(VARIANT, path, refresh=True)
            continue
        os.environ[ENVIRONMENT] = str(path)
        _selected = LibLlvm.probed(path, verdict)
        return


def version_of(path: Path) -> tuple[int, ...]:
    """Parse the version in a file name such as "libLLVM-19.so" or "libLLVM.19.1.dylib"; () if there is none."""
    match = re.match(r"(?:lib)?LLVM(?:-C)?[-.](?:so\.)?(\d+(?:\.\d+)*)", path.name)
    return tuple(int(part) for part in match[1].split(".")) if match else ()


def _loaded() -> LibLlvm:
    """Import drjit and return the library that it has loaded, if it renders."""
    wrong = "found no libLLVM"
    try:
        import drjit as dr
    except (ImportError, OSError) as error:  # a library that drjit is linked with is missing
        raise BackendError(f"drjit cannot start: {str(error).splitlines()[0]}; {llvm_fix()}") from error
    if dr.has_backend(dr.JitBackend.LLVM):
        if _selected:
            return _selected
        version = ".".join(map(str, dr.detail.llvm_version()))
        path = _mapped(dr.detail.llvm_version())
        verdict = probe(VARIANT, path)
        if verdict.ok:
            return LibLlvm(path, version)
        wrong = f"loaded {path or 'a libLLVM'} (LLVM {version}), which cannot render ({verdict.detail})"
    found, _ = find_llvm()
    if found is None:
        raise BackendError(f"no libLLVM here can render, and the llvm backend needs one; {llvm_fix()}")
    raise BackendError(
        f"drjit was imported before eyerender and {wrong}; start Python again with `import eyerender` above the first "
        f"import of mitsuba or drjit, or with {ENVIRONMENT}={found.path} in the environment"
    )


def _mapped(version: tuple[int, ...]) -> Path | None:
    """Return the file of the libLLVM with this version in this process; other packages may have loaded others."""
    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    paths = {Path(line.split(None, 5)[5]) for line in lines if "libLLVM" in line}
    fitting = sorted(p for p in paths if version_of(p)[:1] == version[:1])
    return next(iter(fitting or sorted(paths)), None)


def _order(path: Path) -> tuple[bool, list[int], str]:
    """Return the sort key: newest first, then names without a version, then versions too old for Mitsuba 3.9."""
    version = version_of(path.resolve()) or version_of(path)
    return bool(version) and version[0] < 17, [-part for part in version] or [0], str(path)


def _named() -> list[Path]:
    given = os.environ.get(ENVIRONMENT)
    return [Path(given)] if given else []


def _installed() -> list[Path]:
    prefixes = [Path(p) for p in (sys.prefix, sys.base_prefix, os.environ.get("CONDA_PREFIX")) if p]
    folders = [prefix / ("Library/bin" if sys.platform == "win32" else "lib") for prefix in prefixes]
    found: list[Path] = []
    if sys.platform == "darwin":
        for brew in ("/opt/homebrew", "/usr/local"):
            folders += sorted(Path(brew).glob("opt/llvm*/lib"))
    elif sys.platform == "win32":
        folders += [Path(p) for p in os.environ.get("PATH", "").split(os.pathsep) if p]
        folders.append(Path(os.environ.get("PROGRAMFILES", "C:/Program Files")) / "LLVM" / "bin")
    else:
        folders += [Path(p) for p in os.environ.get("LD_LIBRARY_PATH", "").split(":") if os.path.isabs(p)]
        triplet = sysconfig.get_config_var("MULTIARCH")
        roots = [f"/usr/lib/{triplet}"] if triplet else []
        folders += [Path(p) for p in (*roots, "/usr/lib64", "/usr/lib", "/usr/local/lib64", "/usr/local/lib")]
        for pattern in ("lib/llvm-*/lib", "lib/llvm/*/lib*", "lib64/llvm*/lib*"):
            folders += sorted(Path("/usr").glob(pattern))
        folders += sorted(Path("/home/linuxbrew/.linuxbrew/opt").glob("llvm*/lib"))
        found = _loader_cache()
    patterns = ("libLLVM-*.so*", "libLLVM.so*", "libLLVM*.dylib", "LLVM-C.dll")
    return [path for folder in folders for pattern in patterns for path in folder.glob(pattern)] + found


def _loader_cache() -> list[Path]:
    for tool in ("/sbin/ldconfig", "/usr/sbin/ldconfig", "ldconfig"):
        try:
            listed = run([tool, "-p"], capture_output=True, text=True, timeout=20, check=False).stdout
        except (OSError, subprocess.TimeoutExpired):
            continue
        return [Path(line.partition("=> ")[2].strip()) for line in listed.splitlines() if "libLLVM" in line]
    return []
