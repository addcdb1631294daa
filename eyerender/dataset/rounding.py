"""How this process rounds: BLAS, NumPy and numba choose their code by the processor and by settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np

from ..analytic.observer import trace
from ..scene import load_scene
from .done import read_done


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
