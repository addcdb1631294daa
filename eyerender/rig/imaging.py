"""Specification of effects between the eye and the sensor: focus, vignetting, motion, ambient light."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ..spec import NonNegative, Positive, Spec, Vec2, Vec3


class Lens(Spec):
    """A thin lens out of focus, and vignetting beyond cos^4."""

    focus_mm: Positive | None = Field(
        default=None, description="distance of the plane in focus from the nodal point; default: the eye is in focus"
    )
    vignetting: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.0,
        description="loss of light in the corner of the sensor beyond cos^4; the loss grows with the squared radius",
    )


class Motion(Spec):
    """Motion during the exposure, at constant speed and centred on its middle."""

    eye_deg_s: Vec2 = Field(default=(0.0, 0.0), description="angular velocity of the eye: azimuth and elevation")
    head_mm_s: Vec3 = Field(default=(0.0, 0.0, 0.0), description="velocity of the head in the world")
    steps: Annotated[int, Field(ge=2, le=64)] = Field(default=8, description="number of averaged moments")


class Panel(Spec):
    """A rectangle that emits evenly to its front, like a screen or a window; the cornea reflects it."""

    centre_mm: Vec3 = Field(description="centre in the world")
    size_mm: tuple[Positive, Positive] = Field(description="width (horizontal) and height")
    radiance_w_m2_sr: NonNegative = Field(description="radiance within the camera's filter")


class RadianceMap(Spec):
    """Surroundings infinitely far away, as a picture over all directions.

    The picture's axes are latitude and longitude, and it is twice as wide as high. Its upper edge is straight up, its
    middle the forward direction, and it continues to the subject's right.
    """

    file: Annotated[str, Field(min_length=1)] = Field(
        description="a linear picture, .hdr, .exr, .pfm or .npy (relative to the scene)"
    )
    scale_w_m2_sr: NonNegative = Field(
        default=1.0, description="radiance of the value 1, within the camera's filter; scales the map"
    )
    channel: Literal["red", "green", "blue", "luminance"] = Field(
        default="red", description="channel of a colour picture that stands for the near infrared; red is nearest to it"
    )
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="azimuth of the map's middle, from straight ahead (+x) to the subject's left"
    )
    elevation_deg: Annotated[float, Field(ge=-90, le=90)] = Field(
        default=0.0, description="elevation of the map's middle"
    )
    roll_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="rotation about the middle, clockwise for the subject"
    )
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = Field(
        default=None, description="SHA-256 of the file; a different file is refused"
    )


class Ambient(Spec):
    """Light other than that of the lamps: even light from all sides, surroundings, and panels that face the head."""

    irradiance_w_m2: NonNegative = Field(
        default=0.0, description="even light from all sides: irradiance of a matte surface, within the camera's filter"
    )
    panels: Annotated[tuple[Panel, ...], Field(max_length=16)] = Field(
        default=(), description="rectangles that emit light, such as screens and windows"
    )
    map: RadianceMap | None = Field(default=None, description="an HDR picture of the surroundings of the head")
