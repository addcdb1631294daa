"""The whole sensor in coarse cells, for the light that a lens scatters into a window from outside of it.

It is a picture of the same frame through a camera with larger pixels, in which hairs and menisci are not supersampled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import Singles
from ...rig.camera import Window
from ...rig.stray import block_px, misses_light
from .film import Film, start
from .hostdata import HostData
from .request import BoundFrame

_CELLS, _SAMPLES = 4096, 4


@dataclass(frozen=True, slots=True)
class CoarseSensor:
    """The whole sensor in cells whose samples are being taken.

    Attributes:
        film: the cells.
        blocks: number of blocks along the side of a cell, in which the lens' scattered light is smooth.
        size: number of blocks down and across.
    """

    film: Film
    blocks: int
    size: tuple[int, int]

    @classmethod
    def begin(cls, bound: BoundFrame) -> CoarseSensor | None:
        """Begin to take the samples; None if the window of the frame's job lacks no scattered light."""
        job, frame = bound.host.job, bound.frame
        if not misses_light(job.lens, job.camera, job.window):
            return None
        width, height = job.camera.resolution_px
        block = block_px(job.lens)
        blocks = max(int(np.ceil(np.sqrt(width * height / _CELLS) / block)), 1)
        side = blocks * block
        (fx, fy), (cx, cy) = np.diag(job.camera.K)[:2] / side, (job.camera.K[:2, 2] + 0.5) / side - 0.5
        focal, principal = ((dr.opaque(mi.Float, a), dr.opaque(mi.Float, b)) for a, b in ((fx, fy), (cx, cy)))
        coarse = replace(
            frame,
            camera=replace(frame.camera, focal=focal, principal=principal),
        )
        window: Window = (0, 0, -(-width // side), -(-height // side))
        film = start(BoundFrame(coarse, HostData(job, None)), window, _SAMPLES, job.seed, layered=False)
        return cls(film, blocks, (-(-height // block), -(-width // block)))

    def picture(self) -> Singles:
        """Compute the mean radiance of the blocks times its weight, as of `film.start`, (height, width) in blocks."""
        down, across = self.size
        return self.film.means()[0].repeat(self.blocks, axis=0).repeat(self.blocks, axis=1)[:down, :across]
