"""The protocol of observers."""

from __future__ import annotations

from typing import Protocol

from ..rig.rig import RigLike
from .observation import Observations
from .scene import Frames


class Observer(Protocol):
    """A class that reports the pupils and glints of frames: `AnalyticObserver`, `ImageObserver`, or your own.

    >>> hasattr(er.AnalyticObserver(), "observe")
    True
    """

    def observe(self, frames: Frames, rig: RigLike | None = None) -> Observations:
        """Report one observation for each row of `frames`; `rig` replaces the rig of the frames."""
        ...
