"""The visible limbus: sclera and conjunctiva cover more of the cornea above and below than at the sides.

In 88 people the limbus itself is round (13.64 x 13.65 mm), but the clear cornea is lower than wide (11.74 x 11.52 mm;
Abass et al. 2018, PLoS ONE 13(11), e0207710). So the optical surfaces stay round here, and only the opaque tissue on
the cornea has an elliptical border.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats
from ..optics.surfaces import Surface


def upwards(front: Surface) -> Floats:
    """Compute the direction (2,), in the front cornea's y, z plane, that is up in the eye frame."""
    up = np.asarray(front.rotation)[2, 1:]
    return np.asarray(up / np.hypot(*up))


def lower(front: Surface, y: Floats, z: Floats, aspect: float) -> tuple[Floats, Floats]:
    """Move points of the front cornea (its own frame, mm) towards the horizontal plane through its axis.

    Their height above that plane is multiplied by `aspect`, so a circle about the axis becomes an ellipse whose height
    is `aspect` times its width.
    """
    up = upwards(front)
    less = (aspect - 1.0) * (up[0] * y + up[1] * z)
    return np.asarray(y + less * up[0]), np.asarray(z + less * up[1])
