"""Requests to the film: which window of which frame to render, with which samples."""

from __future__ import annotations

from dataclasses import dataclass

from ...rig.camera import Window
from ..records.frame import Frame
from .hostdata import HostData

_LARGEST_GROUP = 4
_LEAST_GROUPS = 4  # a pixel
_TIMES, _ENOUGH = 3, 32  # times as many samples at hairs, unless a pixel has more than enough


@dataclass(frozen=True, slots=True)
class BoundFrame:
    """A frame on the device, ready to be rendered, and the host data of its job."""

    frame: Frame
    host: HostData


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmRequest:
    """A window of a frame and its samples.

    Attributes:
        bound: the frame.
        window: (x0, y0, width, height) in full-sensor pixels.
        spp: samples per pixel.
        seed: seed of the samples.
        layered: whether to render the parts of the scene separately, with their depths.
    """

    bound: BoundFrame
    window: Window
    spp: int
    seed: int
    layered: bool

    @property
    def group_size(self) -> int:
        """Samples per group; larger with subsurface scattering, which leaves no fine shadows in skin."""
        if self.bound.frame.structure.scattering and self.spp == _LARGEST_GROUP:
            return self.spp
        size = _LARGEST_GROUP
        while size > 1 and (self.spp % size or self.spp // size < min(_LEAST_GROUPS, self.spp // 2)):
            size //= 2
        return size

    @property
    def groups(self) -> int:
        """Groups per pixel."""
        return self.spp // self.group_size

    @property
    def times(self) -> int:
        """Factor by which supersampled pixels have more samples."""
        return _TIMES if self.spp <= _ENOUGH else 1
