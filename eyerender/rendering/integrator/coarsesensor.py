"""The whole sensor in coarse blocks, for light that the lens scatters into a window from outside.

The same frame is rendered by a camera with larger pixels, without supersampling of hairs and menisci.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Singles
from ...rig.camera import Window
from ...rig.stray import block_px, misses_light
from .film import Film, start
from .hostdata import HostData
from .request import BoundFrame

_CELLS, _SAMPLES = 4096, 4


@dataclass(frozen=True, slots=True)
class CoarseSensor:
    """A coarse rendering of the whole sensor, in progress.

    Attributes:
        film: the cells being rendered.
        blocks: number of blocks along the side of a cell; scattered light is smooth over a block.
        size: number of blocks down and across.
    """

    film: Film
    blocks: int
    size: tuple[int, int]

    @classmethod
    def begin(cls, bound: BoundFrame) -> CoarseSensor | None:
        """Start the rendering; return None if no light scatters into the window from outside."""
        job, frame = bound.host.job, bound.frame
        if not misses_light(job.lens, job.camera, job.window):
            return None
        width, height = job.camera.resolution_px
        block = block_px(job.lens)
        blocks = max(int(np.ceil(np.sqrt(width * height / _CELLS) / block)), 1)
        side = blocks * block
        (fx, fy), (cx, cy) = np.diag(job.camera.K)[:2] / side, (job.camera.K[:2, 2] + 0.5) / side - 0.5
        focal, principal = ((dr.opaque(mi.Float, a), dr.opaque(mi.Float, b)) for a, b in ((fx, fy), (cx, cy)))
        coarse = replace(frame, camera=replace(frame.camera, focal=focal, principal=principal))
        window: Window = (0, 0, -(-width // side), -(-height // side))
        film = start(BoundFrame(coarse, HostData(job, None)), window, _SAMPLES, job.seed, layered=False)
        return cls(film, blocks, (-(-height // block), -(-width // block)))

    def picture(self) -> Singles:
        """Compute the mean weighted radiance of the blocks, as in `film.start`, (height, width) in blocks."""
        down, across = self.size
        return self.film.means()[0].repeat(self.blocks, axis=0).repeat(self.blocks, axis=1)[:down, :across]
