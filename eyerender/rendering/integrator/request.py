"""What a film is asked to show."""

from __future__ import annotations

from dataclasses import dataclass

from ...rig.camera import Window
from ..records.frame import Frame
from .hostdata import HostData

LANES = 2**24  # samples at a time; more are rendered in several passes


@dataclass(frozen=True, slots=True)
class BoundFrame:
    """A frame on the device, ready to be rendered, and the host's data of its job."""

    frame: Frame
    host: HostData


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmRequest:
    """A window of a frame and its samples.

    Attributes:
        shown: the frame.
        window: (x0, y0, width, height) in full-sensor pixels.
        spp: samples per pixel.
        seed: of the samples.
        layered: whether the parts of the scene are wanted one by one, with their depths.
    """

    shown: BoundFrame
    window: Window
    spp: int
    seed: int
    layered: bool

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.window[2] * self.window[3]
