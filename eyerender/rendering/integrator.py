"""The Mitsuba integrator `eyerender`: near-infrared light through a refracting cornea, without noise from small lamps.

A ray is intersected with the eye in closed form (the exact surfaces, not a mesh) and with everything else by Embree or
OptiX; the nearer hit is used. At the cornea the ray splits deterministically. The refracted branch meets the iris
plane, which every lamp lights through all refracting surfaces by manifold next-event estimation:

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

Sclera and surround are matte and lit directly. What surfaces send to each other is added from `exchange`. Glints are
not sampled here; they are splatted (`glints`). Frames: the scene's frame has the world's axes and its origin at the
apex of the unrotated eye. The eye is fixed in its own frame, so a pose changes numbers and never geometry.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi

from .shading import shade
from .values import Lights, Values
from .view import Textures

if TYPE_CHECKING:
    from .sampling import Sampler

NAME = "eyerender"


_registered: dict[str, type] = {}


def integrator_class() -> type:
    """Class of the integrator for the variant in use, registered with Mitsuba under `NAME`."""
    variant = str(mi.variant())
    if variant in _registered:
        return _registered[variant]

    class EyeIntegrator(mi.SamplingIntegrator):  # type: ignore[misc]
        """Radiance (mW/mm^2/sr) along rays of the scene's frame; `bind` sets the eye, the lamps and the look."""

        def __init__(self, props: mi.Properties | None = None) -> None:
            super().__init__(mi.Properties() if props is None else props)
            self.values: Values | None = None
            self.lights: Lights | None = None
            self.textures: Textures | None = None
            self.failures: Any = None

        def bind(self, values: Values, lights: Lights, textures: Textures) -> None:
            """Set the frame that `sample` renders."""
            self.values, self.lights, self.textures = values, lights, textures

        def sample(
            self, scene: mi.Scene, sampler: Sampler, ray: mi.Ray3f, medium: object = None, active: mi.Bool | bool = True
        ) -> tuple[mi.Color1f, mi.Bool, list[mi.Float]]:
            """Radiance along `ray`; the third item is empty, and failed light paths are counted in `failures`."""
            del medium
            if self.values is None or self.lights is None or self.textures is None:
                raise RuntimeError("bind() the integrator to a frame first")
            values, lights, textures = self.values, self.lights, self.textures
            active = mi.Bool(active)
            d = mi.Vector3f(ray.d)
            spot = sampler.next_2d(active)
            first = shade(values, lights, textures, scene, mi.Vector3f(ray.o), d, active, spot.x, spot.y)
            self.failures = first.failures
            return mi.Color1f(first.radiance), first.view.met, []

        def to_string(self) -> str:
            return "EyeIntegrator[]"

    mi.register_integrator(NAME, EyeIntegrator)
    _registered[variant] = EyeIntegrator
    return EyeIntegrator
