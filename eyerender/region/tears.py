"""The tear meniscus: a concave strip of water between the globe and the inner edge of either margin.

Its section is an arc that leaves the globe and the margin along their tangents, with the height `height_mm` on the
globe. The upper one has two thirds of the lower one's height (Doughty et al. 2002 for the height). It is opaque here:
it shows the line of light that it reflects, not what it would refract.
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
    """Vertices (ROWS, columns, 3) of the strip, from the globe to the margin."""
    c = sheet.contour
    on_globe = step(np.abs(np.sin(c.angle)), 0.25, 0.6)
    height = spec.tears.height_mm * on_globe * np.where(c.upper > 0, 0.66, 1.0) * step(c.openness, 0.02, 0.25)
    # The two menisci must not meet.
    height = height + 1e-3
    u = np.linspace(0, np.pi / 2, ROWS)[:, None]
    down, out = height * (1 - np.sin(u)), height * (1 - np.cos(u))
    rows = c.point - down[..., None] * c.away + out[..., None] * c.normal
    # The strip is far enough out of the globe that no chord between columns enters it.
    return globe.pushed_out(rows, np.where(np.arange(ROWS)[:, None] == 0, 0.010, 0.014) * np.ones_like(height))
