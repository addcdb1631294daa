"""What goes wrong between the eye and the sensor, as a person writes it: focus, vignetting, motion, ambient light."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..spec import NonNegative, Positive, Spec, Vec2, Vec3


class LensSpec(Spec):
    """A thin lens out of focus, and the shade towards the picture's corners beyond cos^4."""

    focus_mm: Positive | None = Field(
        default=None, description="distance of the plane in focus from the nodal point; default: the eye is in focus"
    )
    vignetting: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.0, description="loss of light in the sensor's corner beyond cos^4; it grows with the radius squared"
    )


class MotionSpec(Spec):
    """What moves during the exposure, evenly about its middle."""

    eye_deg_s: Vec2 = Field(default=(0.0, 0.0), description="turn of the eye: azimuth and elevation per second")
    head_mm_s: Vec3 = Field(default=(0.0, 0.0, 0.0), description="velocity of the head in the world")
    steps: Annotated[int, Field(ge=2, le=64)] = Field(default=8, description="moments that are averaged")


class PanelSpec(Spec):
    """A rectangle that emits evenly to its front, as a screen or a window does; seen mirrored in the cornea."""

    centre_mm: Vec3
    size_mm: tuple[Positive, Positive] = Field(description="width (level) and height")
    radiance_w_m2_sr: NonNegative = Field(description="within the camera's filter")


class AmbientSpec(Spec):
    """Light that does not come from the lamps: even from all sides, and panels that face the head."""

    irradiance_w_m2: NonNegative = Field(default=0.0, description="on a matte surface, within the camera's filter")
    panels: Annotated[tuple[PanelSpec, ...], Field(max_length=16)] = ()
