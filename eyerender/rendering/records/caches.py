"""Light that is computed once per frame, before its samples, and looked up at their places.

Every cache has the same two functions: `build(frame, ...)` computes it, and `at(...)` looks it up at points. A cache
that holds light of several surfaces has a lookup for each: `at_skin`, `at_globe`, `at_iris`, `at_background`. The
radiosity field takes two steps instead of `build`, because the device computes other caches between them (`gather` and
`solve` of `radiosity`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(kw_only=True)
class Caches:
    """Caches of light, None where a frame has none.

    `transport/` holds their classes. Those that use others are built after them, in this order (`FrameBuilder`). No
    record but the frame holds them, and none of them holds another, so their modules need not know each other.

    Attributes:
        shadow_maps: where a lamp's light is certain to reach skin (`shadowmaps.ShadowMaps`).
        diffusion: light that spreads inside skin and sclera (`diffusion.DiffusedLight`).
        ambience: light from the panels and the environment map (`environment.Ambience`).
        iris: irradiance of the lamps in the plane of the iris (`irisirradiance.IrisIrradiance`).
        relief: relief mapping of the iris in the light of the lamps (`reliefmapping.IrisRelief`).
        fundus: light of the lamps that the fundus returns (`fundusirradiance.FundusIrradiance`).
        radiosity: irradiance by way of other surfaces (`radiosityfield.RadiosityField`).
        globe: irradiance of the lamps on a bare globe and on the plane about it (`globeirradiance.GlobeIrradiance`).
    """

    shadow_maps: Any = None
    diffusion: Any = None
    ambience: Any = None
    iris: Any = None
    relief: Any = None
    fundus: Any = None
    radiosity: Any = None
    globe: Any = None
