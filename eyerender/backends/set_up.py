"""`setup_llvm`: find a libLLVM that renders, and fetch the libraries of Dr.Jit that a bare Debian lacks.

`python -m eyerender.backends.set_up` runs it and prints the paths of that libLLVM and of the fetched libraries.
"""

from __future__ import annotations

import sys

from ..base.errors import BackendError
from ..base.progress import Say
from .apt import fetch_library
from .libraries import RUNTIME, load_runtime, runtime_store
from .llvm import LibLlvm, find_llvm
from .remedies import has_archive, llvm_fix


def _silent(line: str) -> None:
    pass


def setup_llvm(*, say: Say = _silent) -> LibLlvm:
    """Find a libLLVM that renders, after fetching the libraries of Dr.Jit that this machine lacks.

    They come from Debian's or Ubuntu's archive, without root. They are fetched with the machine's own apt settings but
    into a folder of this package, so nothing on the system changes.

    Args:
        say: receives one line for each step that takes time.

    Raises:
        BackendError: something is missing that cannot be fetched; the message names the command that installs it.
    """
    try:
        load_runtime()
    except OSError as error:
        _fetch_runtime(str(error), say)
    found, refused = find_llvm(refresh=True)
    if found is None:
        raise BackendError(f"no libLLVM here can render{f' ({refused[0]})' if refused else ''}; {llvm_fix()}")
    return found


def _fetch_runtime(reason: str, say: Say) -> None:
    if not has_archive():
        raise BackendError(reason)
    store = runtime_store()
    if store is None:
        raise BackendError(
            f"{reason}; there is no private cache folder to fetch it into: set XDG_CACHE_HOME to a private folder"
        )
    try:
        for name, (package, _) in RUNTIME.items():
            say(f"fetching {package} from the package archive")
            fetch_library(package, name, store)
        load_runtime()
    except BackendError as error:
        raise BackendError(f"{error}; try again, or install it: {reason}") from error
    except OSError as error:
        raise BackendError(f"cannot fetch into {store}: {error.strerror or error}") from error


def main() -> int:
    """Run `python -m eyerender.backends.set_up`; print one line on stderr if rendering will not work."""

    def say(line: str) -> None:
        print(f"eyerender: {line} ...", file=sys.stderr, flush=True)

    try:
        library = setup_llvm(say=say)
    except BackendError as error:
        print(f"eyerender: warning: rendering on the CPU is not possible: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    store = runtime_store()
    print(library.path, *(sorted(store.glob("lib*")) if store else ()), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
