"""Caches of light, computed once per frame before its samples and looked up at points.

Every cache has the same two functions: `build(frame, ...)` computes it, and `at(...)` looks it up at points. A cache
for several surfaces has one lookup per surface: `at_skin`, `at_globe`, `at_iris`, `at_background`. The radiosity field
takes two steps instead of `build`, because the device computes other caches between them (`gather` and `solve` of
`radiosity`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(kw_only=True)
class Caches:
    """Caches of light of a frame; None where a frame has none.

    Their classes are in `transport/`. `FrameBuilder` builds them in this order, because later ones use earlier ones.
    Only the frame refers to them, so their modules do not depend on each other.

    Attributes:
        shadow_maps: where a lamp certainly reaches skin (`shadowmaps.ShadowMaps`).
        diffusion: subsurface light of skin and sclera (`diffusion.DiffusedLight`).
        ambience: light from the panels and the environment map (`environment.Ambience`).
        iris: irradiance of the lamps in the plane of the iris (`irisirradiance.IrisIrradiance`).
        relief: relief mapping of the iris in the light of the lamps (`reliefmapping.IrisRelief`).
        fundus: lamp light returned by the fundus (`fundusirradiance.FundusIrradiance`).
        radiosity: irradiance from other surfaces (`radiosityfield.RadiosityField`).
        globe: irradiance of the lamps on a bare globe and the plane around it (`globeirradiance.GlobeIrradiance`).
    """

    shadow_maps: Any = None
    diffusion: Any = None
    ambience: Any = None
    iris: Any = None
    relief: Any = None
    fundus: Any = None
    radiosity: Any = None
    globe: Any = None
