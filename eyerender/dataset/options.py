"""Options of a dataset run, shared by Python, the command line and the engines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..backends.choose import BackendChoice
from ..errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a dataset run; none of them changes a byte of the result.

    Attributes:
        workers: Number of worker processes (default: one per processor, as far as memory allows).
        engine: Processes on this machine (local), or actors on a Ray cluster (ray).
        address: Address of the Ray cluster (default: start one on this machine).
        backend: The render backend.
        threads: Total number of CPU threads (default: all).
        timeout_s: Seconds without a sign of life after which a worker is ended and its shard is retried.
        overwrite: Replace the contents of the folder.
    """

    workers: int | None = None
    engine: Literal["local", "ray"] = "local"
    address: str | None = None
    backend: BackendChoice = "auto"
    threads: int | None = None
    timeout_s: float = 600.0
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"must be >= 1, not {value}", path=name)
        if not self.timeout_s > 0:
            raise InputError(f"must be > 0, not {self.timeout_s:g}", path="timeout_s")
