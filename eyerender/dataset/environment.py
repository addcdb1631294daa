"""What a run was made with, for those who want to make it again years later: source, packages, processor, options."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from .done import cpu_family
from .options import RunOptions


@cache
def environment() -> dict[str, Any]:
    """SHA-256 of this package's source, versions of all installed packages, and the processor."""
    return {"source_sha256": source_sum(), "packages": packages(), "cpu": cpu_family()}


def source_sum() -> str:
    """SHA-256 over the names and contents of the package's Python files, in the order of their names."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).as_posix()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def packages() -> dict[str, str]:
    """Versions of all installed packages by name."""
    found = {str(one.metadata["Name"]): one.version for one in distributions() if one.metadata["Name"]}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def flags(options: RunOptions) -> dict[str, Any]:
    """Options of a run, as its log keeps them."""
    return {key: value for key, value in asdict(options).items() if value is not None}
