"""Loading of shared libraries that are not where the system's loader searches."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from pathlib import Path

# Libraries that Dr.Jit is linked with and a bare Linux lacks, with their packages on Debian and on Fedora.
RUNTIME = {"libatomic.so.1": ("libatomic1", "libatomic")} if sys.platform == "linux" else {}


def cache_folder() -> Path | None:
    """Folder for what this package found and fetched; None where the user has no home folder."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        return Path(given) / "eyerender"
    try:
        home = Path.home()
    except RuntimeError:
        return None
    return home / ".cache" / "eyerender" if home.is_absolute() and home != Path("/") else None


def llvm_store() -> Path | None:
    """Folder into which `setup_llvm` unpacks, one folder per package; None without a home folder."""
    folder = cache_folder()
    return folder / "llvm" if folder else None


def stored_folders() -> tuple[Path, ...]:
    """Library folders of everything that `setup_llvm` has unpacked."""
    store = llvm_store()
    patterns = ("*/usr/lib/*", "*/usr/lib", "*/lib/*")
    return tuple(p for pattern in patterns for p in sorted(store.glob(pattern)) if p.is_dir()) if store else ()


def load_runtime(folders: Sequence[Path] = ()) -> None:
    """Load the libraries that Dr.Jit is linked with.

    The system is searched first, then `folders` or what `setup_llvm` has unpacked.

    Raises:
        OSError: a library is nowhere; the message names the package.
    """
    for name, (debian, fedora) in RUNTIME.items():
        try:
            ctypes.CDLL(name)
        except OSError as error:
            found = next((f / name for f in (*folders, *stored_folders()) if (f / name).is_file()), None)
            if found is None:
                raise OSError(f"{name} is missing (package {debian} on Debian, {fedora} elsewhere)") from error
            load_library(found)


def load_library(library: Path, folders: Sequence[Path] = ()) -> None:
    """Load a shared library after those of its dependencies that only `folders` have.

    LD_LIBRARY_PATH is read when a process starts, so a library that was unpacked into a folder of ours does not find
    what was unpacked beside it. The system's libraries have priority. The loader's message names the missing object.

    Raises:
        OSError: a dependency is nowhere, or the library does not fit this system.
    """
    for _ in range(64):
        try:
            ctypes.CDLL(str(library))
        except OSError as error:
            missing = str(error).partition(":")[0].strip()
            found = next((f / missing for f in folders if "/" not in missing and (f / missing).is_file()), None)
            if found is None or found == library:
                raise
            load_library(found, folders)
        else:
            return
    raise OSError(f"{library}: its dependencies cannot be resolved")


def library_folders(library: Path) -> tuple[Path, ...]:
    """Folders that may hold what was unpacked together with `library`: its own, and lib folders of the same tree."""
    folders = [library.parent]
    for above in library.parents:
        if above.name == "usr" and above != Path("/usr"):
            tree = above.parent
            folders += [p for p in sorted(tree.glob("usr/lib/*")) + sorted(tree.glob("lib/*")) if p.is_dir()]
            folders += [tree / "usr" / "lib", tree / "lib"]
            break
    return tuple(dict.fromkeys(folders))
