"""Fetch libraries from the Debian or Ubuntu archive, with the machine's own apt settings but without root."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from ..base.errors import BackendError
from ..base.processes import run

PAUSES_S = (3.0, 10.0)


def fetch_library(package: str, name: str, store: Path) -> None:
    """Fetch a package and extract one of its libraries; nothing on the system changes.

    Args:
        package: the package.
        name: file name of the library.
        store: folder that receives the file, replaced at once if another process wrote it meanwhile.

    Raises:
        BackendError: the archive does not respond, or the package lacks the library.
        OSError: the folder cannot be written.
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
