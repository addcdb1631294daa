"""`setup_llvm`: install a libLLVM from Debian's or Ubuntu's archive, without root.

The packages are fetched with the machine's own apt settings but into folders of ours, and only unpacked, so nothing on
the system changes. `python -m eyerender.backends.set_up [--quiet]` runs it and prints the library's path.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import BackendError
from ..progress import Say
from .apt import Apt
from .libraries import RUNTIME, llvm_store
from .llvm import VARIANT, LibLlvm, find_llvm, version_of
from .probe import probe, run_probe
from .remedies import has_archive, llvm_command


def _silent(line: str) -> None:
    pass


def setup_llvm(*, say: Say = _silent) -> LibLlvm:
    """Find a libLLVM that renders, or fetch one.

    Args:
        say: receives one line for each step that takes time.

    Raises:
        BackendError: no libLLVM could be had; the message names the command that brings one.
    """
    found = find_llvm(refresh=True)
    if found is not None:
        return found
    if not has_archive():
        raise BackendError(f"no libLLVM here can render; {llvm_command()}")
    store = llvm_store()
    if store is None:
        raise BackendError("there is no home folder for unpacking a libLLVM; set XDG_CACHE_HOME to a writable folder")
    try:
        store.mkdir(parents=True, exist_ok=True)
        with _locked(store / "lock", say):
            # Another process may have installed it while this one waited.
            return find_llvm() or _fetch(store, say)
    except OSError as error:
        raise BackendError(f"cannot set up libLLVM in {store}: {error.strerror or error}") from error


def _fetch(store: Path, say: Say) -> LibLlvm:
    for left in store.glob("fetch-*"):  # remains of a killed process; this one holds the lock
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="fetch-", dir=store) as scratch:
        apt = Apt(Path(scratch))
        say("looking for libLLVM in the package archive")
        packages = apt.llvm_packages()
        if not packages:
            raise BackendError(f"the package archive has no suitable libLLVM{apt.complaint}; {llvm_command()}")
        refused = ""
        runtime = [debian for debian, _ in RUNTIME.values()]
        for package in packages:
            say(f"fetching {package} and its dependencies (about 50 MB)")
            tree = Path(scratch) / package
            if not apt.unpack([package, *runtime], tree):
                raise BackendError(f"{package} cannot be downloaded{apt.complaint}; try again, or {llvm_command()}")
            library = _library_in(tree)
            verdict = run_probe(VARIANT, library) if library else None
            if library is not None and verdict is not None and verdict.ok:
                return _keep(tree, library, store)
            refused = f"{package} cannot render" + (f" ({verdict.detail})" if verdict else "")
        raise BackendError(f"{refused}; {llvm_command()}")


def _keep(tree: Path, library: Path, store: Path) -> LibLlvm:
    """Move a tree whose library has passed its probe to its place, and probe it there, so that the result is cached."""
    place = store / tree.name
    if place.exists():  # an earlier one, which does not pass the probe any more
        shutil.rmtree(place)
    tree.rename(place)
    kept = (place / library.relative_to(tree.resolve())).resolve()
    verdict = probe(VARIANT, kept, refresh=True)
    if not verdict.ok:
        raise BackendError(f"{kept} cannot render ({verdict.detail})")
    return LibLlvm.probed(kept, verdict)


def _library_in(tree: Path) -> Path | None:
    inside = [p.resolve() for p in sorted(tree.glob("usr/lib/**/libLLVM*.so*")) if p.resolve().is_file()]
    return max(inside, key=lambda path: version_of(path), default=None)


@contextmanager
def _locked(file: Path, say: Say) -> Iterator[None]:
    import fcntl

    with file.open("a") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another process is setting up libLLVM; waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def main(arguments: Sequence[str]) -> int:
    """Run `python -m eyerender.backends.set_up`: the library's path on stdout, or one line on stderr."""
    quiet = "--quiet" in arguments

    def say(line: str) -> None:
        print(f"eyerender: {line} ...", file=sys.stderr, flush=True)

    try:
        # Slow steps are announced even with --quiet, because a first run takes half a minute.
        library = setup_llvm(say=say)
    except BackendError as error:
        print(f"eyerender: {'warning: rendering on the CPU is not possible: ' * quiet}{error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    print(library.path)
    if not quiet:
        print(f"LLVM {library.version}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
