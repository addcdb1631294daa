"""`setup_llvm`: find a libLLVM that renders, and fetch the libraries of Dr.Jit that a bare Debian lacks.

`python -m eyerender.backends.set_up` runs it and prints the paths of that libLLVM and of the fetched libraries.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ..base.errors import BackendError
from ..base.processes import run
from ..base.progress import Say
from .libraries import RUNTIME, has_archive, llvm_fix, load_runtime, runtime_store
from .llvm import LibLlvm, find_llvm

PAUSES_S = (3.0, 10.0)


def fetch_library(package: str, name: str, store: Path) -> None:
    """Fetch a package and extract one of its libraries; nothing on the system changes.

    `name`: file name of the library; `store`: folder that receives the file, replaced at once if another process wrote
    it meanwhile. Raises BackendError if the archive does not respond, or the package lacks the library; OSError if the
    folder cannot be written.
    """
    store.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="fetch-", dir=store) as scratch:
        folder = Path(scratch)
        options = _private_options(folder)
        complaint = ""
        for pause in (0.0, *PAUSES_S):
            time.sleep(pause)
            # A failing source, for instance of a third party, does not matter as long as another one has the package.
            update = _run(["apt-get", *options, "update"], folder)
            download = _run(["apt-get", *options, "download", package], folder)
            if download.returncode == 0:
                break
            complaint = _complaint(download) or _complaint(update) or "check the network"
        else:
            raise BackendError(f"{package} cannot be downloaded from the package archive ({complaint})")
        for deb in folder.glob("*.deb"):
            unpacked = _run(["dpkg-deb", "-x", str(deb), "tree"], folder)
            if unpacked.returncode != 0:
                raise BackendError(f"{package} cannot be unpacked ({_complaint(unpacked)})")
        found = next((folder / "tree").rglob(name), None)
        if found is None:
            raise BackendError(f"the package {package} of this archive has no {name}")
        shutil.copyfile(found.resolve(), folder / name)
        (folder / name).replace(store / name)


def _private_options(folder: Path) -> list[str]:
    """Write options that move apt's lists and caches to `folder`, so that apt needs no root and no system-wide lock.

    The machine's own sources and proxies stay, its hooks on system folders do not. The empty status makes the archive's
    versions the candidates, even if other versions are installed.
    """
    for name in ("lists/partial", "cache/archives/partial"):
        (folder / name).mkdir(parents=True)
    (folder / "status").touch()
    settings = folder / "apt.conf"
    settings.write_text(
        f'Dir::State::Lists "{folder}/lists";\nDir::State::status "{folder}/status";\n'
        f'Dir::Cache "{folder}/cache";\nDir::Cache::archives "{folder}/cache/archives";\n'
        'Debug::NoLocking "true";\nAPT::Sandbox::User "";\n'
        'Acquire::Languages "none";\nAcquire::Retries "2";\n'
        'Acquire::http::Timeout "60";\nAcquire::https::Timeout "60";\n'
        "#clear APT::Update::Pre-Invoke;\n#clear APT::Update::Post-Invoke;\n"
        "#clear APT::Update::Post-Invoke-Success;\n",
        encoding="utf-8",
    )
    return ["-q", "-c", str(settings)]


def _run(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return run(
        command,
        cwd=folder,
        env={**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )


def _complaint(done: subprocess.CompletedProcess[str]) -> str:
    """Return the last error that apt or dpkg printed."""
    errors = [line for line in done.stderr.splitlines() if line.startswith(("E:", "dpkg-deb:"))]
    return errors[-1].partition(":")[2].strip() if errors else ""


def _silent(line: str) -> None:
    pass


def setup_llvm(*, say: Say = _silent) -> LibLlvm:
    """Find a libLLVM that renders, after fetching the libraries of Dr.Jit that this machine lacks.

    They come from Debian's or Ubuntu's archive, without root. They are fetched with the machine's own apt settings but
    into a folder of this package, so nothing on the system changes. `say`: receives one line for each step that takes
    time. Raises BackendError if something is missing that cannot be fetched; the message names the command that
    installs it.
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
