"""The last measured rate of a spec on this machine, stored in the user's cache folder.

The file is only a cache: if it is missing or damaged, the rate is unknown.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from ..base.errors import EyerenderError
from ..base.spec import Positive, Spec
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import read_json, write_json
from .done import cpu_family
from .plan import Plan

ENOUGH_SAMPLES = 200  # more samples do not make a rate more representative
_BYTES = 2**16
_Count = Annotated[float, Field(ge=0, le=1e15)]


class Rate(Spec):
    """Time and size of the samples of a spec."""

    format: Literal["eyerender/rate/2"] = "eyerender/rate/2"
    how: Literal["run", "measured"] = Field(
        description="whether a run measured it, or a few samples made for this purpose"
    )
    time: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z$")]
    backend: Annotated[str, Field(max_length=20)]
    samples: Annotated[int, Field(ge=1, le=10**9)] = Field(description="number of measured samples")
    start_seconds: _Count = Field(
        description="additional time of a worker until its kernels are loaded and recorded; 0: included in `seconds`"
    )
    seconds: Positive = Field(description="time of one worker for a sample")
    subject_seconds: _Count = Field(
        description="additional time for the first sample of a subject; 0: included in `seconds`"
    )
    images: _Count = Field(description="images per sample")
    bytes: _Count = Field(description="bytes per sample, including metadata")


def now() -> str:
    """Return the current time in the format of a rate."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def keep_rate(plan: Plan, rate: Rate) -> None:
    """Store a rate, unless the stored one of the same backend comes from more than twice as many samples.

    If the cache cannot be written, the rate is discarded.
    """
    path = _path(plan)
    old = last_rate(plan, rate.backend)
    if path is not None and (old is None or rate.samples >= min(old.samples, ENOUGH_SAMPLES) / 2):
        with suppress(OSError, EyerenderError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, rate.to_mapping(), sync=False)


def last_rate(plan: Plan, backend: str = "auto") -> Rate | None:
    """Return the rate last measured on this machine with a backend; None if there is none."""
    path = _path(plan)
    if path is None:
        return None
    try:
        rate = Rate.from_mapping(read_json(path, limit=_BYTES, follow=False))
    except EyerenderError:
        return None
    return rate if backend in ("auto", rate.backend) else None


def _path(plan: Plan) -> Path | None:
    """Return the path of a plan's rate on this machine; it does not depend on seed and number of samples."""
    folder = cache_folder()
    if folder is None:
        return None
    data = plan.to_mapping()
    data["spec"] = {k: v for k, v in data["spec"].items() if k not in ("count", "planned", "choice", "seed")}
    key = json.dumps([data, platform.node(), cpu_family()], sort_keys=True)
    return folder / "rates" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"
