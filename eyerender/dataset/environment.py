"""Record of what produced a run, so that it can be repeated years later: source, packages, processor."""

from __future__ import annotations

import hashlib
from email.parser import HeaderParser
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from .done import cpu_family


@cache
def environment() -> dict[str, Any]:
    """Return the SHA-256 of this package's source, the versions of all installed packages, and the processor."""
    return {"source_sha256": source_sum(), "packages": packages(), "cpu": cpu_family()}


def source_sum() -> str:
    """Compute the SHA-256 over names and contents of the package's Python files, sorted by name."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).as_posix()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def packages() -> dict[str, str]:
    """Return the versions of all installed packages by name."""
    found = {}
    for one in distributions():
        # `one.metadata` would also parse the description, which takes most of the time.
        head = (one.read_text("METADATA") or one.read_text("PKG-INFO") or "").partition("\n\n")[0]
        fields = HeaderParser().parsestr(head)
        if fields["Name"]:
            found[fields["Name"]] = fields["Version"]
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))
