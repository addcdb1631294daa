"""Record of what produced a run, so that it can be repeated years later: source, packages, processor."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from email.parser import HeaderParser
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np

from ..analytic.observer import trace
from ..scene import load_scene
from .done import cpu_family, read_done


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


@cache
def rounding() -> str:
    """Compute a fingerprint of rounding: 16 hexadecimal digits of the SHA-256 of the results of a small computation.

    It multiplies and factorises small matrices, evaluates functions of NumPy, and traces two frames of an eye.
    Processes that agree in it may still render single pixels differently, where Embree rounds a silhouette.
    """
    a, b = np.random.default_rng(0).standard_normal((2, 24, 24))
    single = np.random.default_rng(0).standard_normal((40, 200), dtype=np.float32)
    found = [
        single @ single.T,
        a @ b,
        a[:3, :3] @ b[:3, 0],
        np.linalg.solve(a, b),
        np.linalg.eigvalsh(a + a.T),
        np.sin(9 * a),
        np.exp(b),
    ]
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(values).tobytes() for values in found))
    eyes = trace(load_scene("guestrin2006").frames()[:2], boundary_points=24)
    digest.update(json.dumps(list(eyes.records())).encode())
    return digest.hexdigest()[:16]


def by_rounding(folder: Path, shards: Iterable[int]) -> dict[str, list[int]]:
    """Group finished shards by the fingerprint of the process that made them; "" where it is unknown.

    Raises:
        InputError: a done.json is not valid.
    """
    found: dict[str, list[int]] = {}
    for shard in shards:
        found.setdefault(read_done(folder, shard).get("rounding") or "", []).append(shard)
    return found
