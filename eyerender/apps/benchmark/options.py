"""Options of a benchmark, shared by Python and the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from ...base.errors import InputError

LONGEST_S = 86400.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOptions:
    """Options of a benchmark.

    >>> er.apps.BenchOptions(jobs=2).jobs
    2

    Attributes:
        jobs: Number of extractor processes that run at the same time.
        timeout_s: Seconds that an extractor may take for one image.
        start_timeout_s: Seconds until an extractor must be ready.
        gamma: Encoding gamma of images whose folder states none (default: 1, linear).
        eye_error_mm: Standard deviation, per axis and in mm, of the error of the eye position given to extractors.
        pupil_class: Value of the pupil in masks of several classes.
        film: The folder holds a film, or the frames of one in the order of their names, without labels: measure how
            much the answers jitter from frame to frame.
        quick: Use a tenth of the images, with hard conditions in the same proportion.
        fresh: Ignore the answers that an interrupted run left in the output folder.
        against: The results.json of an earlier benchmark to compare with.
        require: A result that must be reached, such as right>=.95 or own-fast:centre_px<.1. Repeat the option for
            several.
        overwrite: Replace the contents of the output folder.
    """

    jobs: int = 1
    timeout_s: float = 30.0
    start_timeout_s: float = 60.0
    gamma: float | None = None
    eye_error_mm: Annotated[float, Parameter(name="--eye-error")] = 5.0
    pupil_class: int | None = None
    film: bool = False
    quick: bool = False
    fresh: bool = False
    against: Path | None = None
    require: tuple[str, ...] = ()
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InputError(f"must be >= 1, not {self.jobs}", path="jobs")
        for name in ("timeout_s", "start_timeout_s"):
            if not 0 < getattr(self, name) <= LONGEST_S:
                raise InputError(f"must be above 0 and at most {LONGEST_S:g} seconds", path=name)
        if self.film and (self.quick or self.require or self.against):
            raise InputError("has no labels, which --quick, --require and --against need", source="--film")
        if not 0 <= self.eye_error_mm <= 1000:
            raise InputError("must be 0 to 1000 mm", source="--eye-error")
        if self.pupil_class is not None and not 1 <= self.pupil_class <= 65535:
            raise InputError("must be 1 to 65535", path="pupil_class")
        if self.gamma is not None and not (math.isfinite(self.gamma) and 0.1 <= self.gamma <= 10):
            raise InputError("must be between 0.1 and 10", path="gamma")
