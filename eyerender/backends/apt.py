"""Access to the package archive of Debian and Ubuntu with the machine's own apt settings but without root."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

PAUSES_S = (3.0, 10.0)
# Preferred versions: the one that this project's Mitsuba is tested with, then its neighbours. Versions 15 and 16 end
# the process.
_PREFERRED = (19, 18, 20, 17, 21)
# Packages that every system with apt and Python has. A process must not have a second C or C++ runtime.
_PRESENT = re.compile(r"libc6|libc-bin|libcrypt1|libgcc-s1|libstdc\+\+6|gcc-\d+-base|debconf.*|cdebconf|dpkg")


class Apt:
    """Runs apt with its lists and caches in `folder`, so that it needs neither root nor its system-wide lock."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._complaint = ""
        for name in ("lists/partial", "cache/archives/partial", "packages"):
            (folder / name).mkdir(parents=True)
        (folder / "status").touch()
        # These settings follow the machine's own: its sources and proxies stay, its hooks on system folders do not. The
        # empty status makes the archive's versions the candidates, whatever is installed.
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
        self._options = ["-q", "-c", str(settings)]

    @property
    def complaint(self) -> str:
        """Last error of apt, in brackets, to append to a sentence; empty if there was none."""
        return f" ({self._complaint})" if self._complaint else ""

    def llvm_packages(self) -> list[str]:
        """Packages of LLVM's library that may fit, preferred ones first, from freshly fetched lists."""
        for pause in (0.0, *PAUSES_S):
            time.sleep(pause)
            # A failing source, for instance a third party's, does not matter as long as the archive answers.
            self._run("apt-get", "update")
            names = self._run("apt-cache", "pkgnames", "libllvm").stdout.split()
            if names:
                break
        else:
            self._complaint = self._complaint or "it does not answer; check the network"
        versions = {name: int(match[1]) for name in names if (match := re.fullmatch(r"libllvm(\d+)(?:t64)?", name))}
        fitting = [name for name, number in versions.items() if number >= min(_PREFERRED)]

        def rank(name: str) -> tuple[int, int]:
            number = versions[name]
            return (_PREFERRED.index(number) if number in _PREFERRED else len(_PREFERRED)), number

        return sorted(fitting, key=rank)

    def unpack(self, packages: Sequence[str], tree: Path) -> bool:
        """Fetch packages with their dependencies, and unpack all of them into `tree`.

        Returns:
            Whether that succeeded.
        """
        others = ("recommends", "suggests", "conflicts", "breaks", "replaces", "enhances")
        closure = self._run("apt-cache", "depends", "--recurse", *(f"--no-{kind}" for kind in others), *packages).stdout
        names = {line for line in closure.splitlines() if re.fullmatch(r"[a-z0-9][a-z0-9+.-]+", line)}
        wanted = sorted(name for name in names if not _PRESENT.fullmatch(name))
        folder = self._folder / "packages"
        for old in folder.glob("*.deb"):
            old.unlink()
        for pause in (0.0, *PAUSES_S):
            time.sleep(pause)
            if wanted and self._run("apt-get", "download", *wanted, folder=folder).returncode == 0:
                break
        else:
            return False
        tree.mkdir(exist_ok=True)
        for deb in sorted(folder.glob("*.deb")):
            done = subprocess.run(["dpkg-deb", "-x", str(deb), str(tree)], capture_output=True, check=False, text=True)
            if done.returncode != 0:
                self._note(done.stderr)
                return False
        return True

    def _run(self, tool: str, *arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [tool, *self._options, *arguments],
            cwd=folder or self._folder,
            env={**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        self._note(done.stderr)
        return done

    def _note(self, stderr: str) -> None:
        errors: Sequence[str] = [line for line in stderr.splitlines() if line.startswith(("E:", "dpkg-deb:"))]
        if errors:
            self._complaint = errors[0].partition(":")[2].strip()
