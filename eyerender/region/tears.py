"""The tear meniscus: a concave strip of water between the globe and the inner edge of either margin.

Its section is an arc tangential to globe and margin, with the height `height_mm` on the globe (Doughty et al. 2002);
the upper meniscus has two thirds of it. The height varies along the lids, and short waves bend the surface (`waves`),
so lamps appear in it as broken rows of points.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..base.arrays import Floats, frozen
from .anatomy import Region
from .contour import step
from .globe import Globe
from .lids import Sheet

ROWS = 5
_OUT = 1.8  # width on the margin over the height on the globe, so that the radius is about 1.6 heights
_TURN = np.linspace(0, np.pi / 2, ROWS)[:, None]  # angle of each row along the arc
_LONG, _SHORT = (6, 40), (6, 20)  # waves once around the fissure, which is about 60 mm long
_SLOPE = 0.12  # standard deviation of the slope of the short waves at an unevenness of 1


def waves(spec: Region, count: int) -> Floats:
    """Compute the slope of the meniscus along the lids at `count` positions around the fissure."""
    return _SLOPE * spec.tears.unevenness * _noise(spec.seed + 1, count, *_SHORT)


@lru_cache(maxsize=16)
def _noise(seed: int, count: int, low: int, high: int) -> Floats:
    """Compute noise (count,) of mean 0 and variance 1 with `low` to `high` waves around the fissure."""
    rng = np.random.default_rng((0x7EA2, seed))
    turn = rng.uniform(0, 2 * np.pi, high - low)
    angle = 2 * np.pi * np.arange(count)[:, None] / count
    return frozen(np.cos(np.arange(low, high) * angle + turn).sum(axis=1) * np.sqrt(2 / (high - low)))


def on_globe(angle: Floats) -> Floats:
    """Compute the relative height of the meniscus at angles around the fissure; it ends towards the canthi."""
    return np.asarray(step(np.abs(np.sin(angle)), 0.25, 0.6))


def meniscus(spec: Region, globe: Globe, sheet: Sheet) -> Floats:
    """Compute vertices (ROWS, columns, 3) of the strip, from the globe to the margin."""
    c = sheet.contour
    angle = 2 * np.pi * np.arange(len(c.angle)) / len(c.angle)  # its triangles do not slide with the lower lid
    height = spec.tears.height_mm * on_globe(angle) * np.where(c.upper > 0, 0.66, 1.0) * step(c.openness, 0.02, 0.25)
    low = np.maximum(1 + 0.8 * spec.tears.unevenness * _noise(spec.seed, len(c.angle), *_LONG), 0.15)
    height = height * low
    # The two menisci must not meet.
    height = height + 1e-3
    down, out = height * (1 - np.sin(_TURN)), _OUT * height * (1 - np.cos(_TURN))
    rows = c.point - down[..., None] * c.away + out[..., None] * c.normal
    # The strip is far enough outside the globe that no chord between columns enters it.
    return globe.pushed_out(rows, np.where(_TURN == 0, 0.010, 0.014))
