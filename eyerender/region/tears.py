"""The tear meniscus: a concave strip of water between the globe and the inner edge of either margin.

Its section is an arc that leaves the globe and the margin along their tangents, as tall as `height_mm` on the globe;
the upper one is two thirds of the lower (Doughty et al. 2002 for the height). Opaque here: what shows is
its line of light, not what it refracts.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Floats
from .anatomy import Region
from .contour import step
from .globe import Globe
from .lids import Sheet

ROWS = 5


def meniscus(spec: Region, globe: Globe, sheet: Sheet) -> Floats:
    """The strip's vertices (ROWS, columns, 3), from the globe to the margin."""
    c = sheet.contour
    on_globe = step(np.abs(np.sin(c.angle)), 0.25, 0.6)
    height = spec.tears.height_mm * on_globe * np.where(c.upper > 0, 0.66, 1.0) * step(c.openness, 0.02, 0.25)
    # Never so tall that both would meet.
    height = height + 1e-3
    u = np.linspace(0, np.pi / 2, ROWS)[:, None]
    down, out = height * (1 - np.sin(u)), height * (1 - np.cos(u))
    rows = c.point - down[..., None] * c.away + out[..., None] * c.normal
    # So far out of the globe that no chord between columns dips into it.
    return globe.pushed_out(rows, np.where(np.arange(ROWS)[:, None] == 0, 0.010, 0.014) * np.ones_like(height))
