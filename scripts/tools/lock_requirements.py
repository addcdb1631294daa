#!/usr/bin/env python3
"""Write requirements.lock: the packages that containers/Dockerfile installs, with the hashes of their wheels.

    lock_requirements.py

The versions are those of constraints.txt. All extras that run without a display are included except PyTorch, which
takes several GB. The hashes are those of the wheels that pip chooses for CPython 3.11 to 3.13 on Linux x86-64 with
glibc, and for nothing else. Run it on such a machine after each change of constraints.txt or of the dependencies. It
needs a package index and the package `packaging`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements.lock"
PYTHONS = ("3.11", "3.12", "3.13")
# Newest first, as pip prefers them: those of glibc up to 2.41, which Debian 13 has, each with its older name.
OLDER_NAMES = {17: ["manylinux2014"], 12: ["manylinux2010"], 5: ["manylinux1"]}
TAGS = [tag for minor in range(41, 4, -1) for tag in (f"manylinux_2_{minor}", *OLDER_NAMES.get(minor, ()))]
PLATFORMS = [f"{tag}_x86_64" for tag in (*TAGS, "linux")]
LEFT_OUT = {"torch", "test", "oracles", "fuzz", "docs"}
HEAD = """\
# Written by scripts/tools/lock_requirements.py from constraints.txt: wheels for CPython 3.11-3.13, Linux x86-64, glibc.
# pip install --require-hashes -r requirements.lock
# pip install --no-deps --no-build-isolation .
"""


def wanted() -> list[str]:
    """List what the package, its extras and its build need directly."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = pyproject["project"]["optional-dependencies"]
    inside = [requirement for name in sorted(extras.keys() - LEFT_OUT) for requirement in extras[name]]
    return [*pyproject["project"]["dependencies"], *inside, *pyproject["build-system"]["requires"]]


def resolve(requirements: Iterable[str], *options: str) -> list[Mapping[str, Any]]:
    """Ask pip which wheels it would install; one entry of its report per package.

    Raises:
        SystemExit: pip found no solution; its message is on stderr.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--only-binary", ":all:", "--target", folder, "--report", str(report), *options]
        if subprocess.run([*command, *requirements], check=False).returncode:
            raise SystemExit("error: pip cannot resolve the requirements")
        return list(json.loads(report.read_text(encoding="utf-8"))["install"])


def check_markers(requirements: Sequence[str], found: Mapping[str, Mapping[str, Any]], python: str) -> None:
    """Check that another Python needs no package that the one that runs this script does not need.

    Raises:
        SystemExit: it does.
    """
    todo = [(requirement, "") for requirement in requirements]
    seen: set[tuple[str, str]] = set()
    while todo:
        text, extra = todo.pop()
        need = Requirement(text)
        environment = {"python_version": python, "python_full_version": f"{python}.0", "extra": extra}
        if need.marker is not None and not need.marker.evaluate(environment):
            continue
        name = canonicalize_name(need.name)
        if name not in found:
            raise SystemExit(f"error: Python {python} needs {name} too; run this script with that Python")
        for wish in ("", *need.extras):
            if (name, wish) not in seen:
                seen.add((name, wish))
                todo += [(line, wish) for line in found[name].get("requires_dist", ())]


def main() -> None:
    requirements = wanted()
    resolved = [item["metadata"] for item in resolve(requirements, "-c", str(ROOT / "constraints.txt"))]
    found: dict[str, Mapping[str, Any]] = {canonicalize_name(metadata["name"]): metadata for metadata in resolved}
    pins = [f"{name}=={metadata['version']}" for name, metadata in sorted(found.items())]
    hashes: dict[str, set[str]] = defaultdict(set)
    for python in PYTHONS:
        check_markers(requirements, found, python)
        platforms = [word for platform in PLATFORMS for word in ("--platform", platform)]
        for item in resolve(pins, "--no-deps", "--python-version", python, *platforms):
            pin = f"{canonicalize_name(item['metadata']['name'])}=={item['metadata']['version']}"
            hashes[pin].add(item["download_info"]["archive_info"]["hashes"]["sha256"])
    entries = [" \\\n    ".join([pin, *(f"--hash=sha256:{digest}" for digest in sorted(hashes[pin]))]) for pin in pins]
    LOCK.write_text(HEAD + "\n".join(entries) + "\n", encoding="utf-8")
    print(f"{LOCK.name}: {len(pins)} packages, {sum(map(len, hashes.values()))} wheels")


if __name__ == "__main__":
    main()
