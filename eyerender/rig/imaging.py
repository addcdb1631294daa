"""Settings of pictures: rendered window of the sensor, focus, vignetting, motion, ambient light."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.arrays import Floats
from ..base.spec import NonNegative, Positive, Spec, Vec2, Vec3

Surfaces = Literal["exact", "mesh"]


class Picture(Spec):
    """The rendered part of the sensor, and the number of samples.

    >>> er.Picture(window_px=(320, 240), spp=32).spp
    32
    """

    window_px: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] | None = Field(
        default=None, description="width and height of one window per eye, centred on it; default: the whole sensor"
    )
    spp: Annotated[int, Field(ge=1, le=65536)] = Field(
        default=16,
        description="samples per pixel; `auto`: as many as the blur of the sensor needs, as the image states",
    )
    surfaces: Surfaces = Field(
        default="exact",
        description="the cornea of the picture: `exact` (in closed form) or `mesh` (triangles, interpolated normals)",
    )
    mesh_edge_mm: Annotated[float, Field(ge=0.02, le=2)] = Field(
        default=0.1, description="length of the triangles' edges, with `surfaces: mesh`"
    )
    purkinje: tuple[Annotated[int, Field(ge=2, le=4)], ...] = Field(
        default=(),
        description="further mirror images of the lamps: 2 (back of the cornea), 3 and 4 (front and back of the lens), "
        "where the eye has these surfaces",
    )
    interreflection: bool = Field(
        default=True,
        description="whether surfaces send light to each other: iris and cornea, globe, lids, face and background; "
        "off is faster and darker",
    )


def samples_for(psf_sigma_px: float) -> int:
    """Return how many samples per pixel a blur needs: a power of two, at least 4 (0.9 px / sigma)^2.6, from 4 to 32.

    A blur averages the samples of its neighbourhood. With four samples at a sigma of 1.8 px, skin with lashes is as
    even as with eight at 0.7 px (1.0 codes of 255); fewer than four cost as much. Without blur, lashes thinner than a
    pixel need 32. The power law that joins these is chosen.
    """
    wanted = 4.0 * (0.9 / max(psf_sigma_px, 0.1)) ** 2.6
    return int(min(max(2 ** np.ceil(np.log2(wanted)), 4), 32))


class Opening(Spec):
    """An opening through which the camera looks: a lens barrel, an aperture, a hot mirror in its holder.

    It stands near the lens, so it is out of focus: its edge is blurred. Its shape is a superellipse in the picture,
    (abs(x) / a)^p + (abs(y) / b)^p = 1. A straight edge is a rectangle whose other edges lie far outside the picture.
    """

    centre: Vec2 = Field(
        default=(0.0, 0.0),
        description="centre, to the right and down from the sensor's middle, in halves of the sensor's width",
    )
    half_size: tuple[Annotated[float, Field(gt=0, le=20)], Annotated[float, Field(gt=0, le=20)]] = Field(
        default=(1.05, 1.05), description="semi-axes a and b, in halves of the sensor's width"
    )
    power: Annotated[float, Field(ge=1, le=50)] = Field(
        default=2.0, description="exponent p: 2 is an ellipse, larger ones approach a rectangle"
    )
    turn_deg: Annotated[float, Field(ge=-180, le=180)] = Field(
        default=0.0, description="turn of the shape in the picture, clockwise"
    )
    edge_px: Annotated[float, Field(ge=0, le=400)] = Field(
        default=4.0, description="standard deviation of the edge's blur (chosen)"
    )
    radiance_w_m2_sr: NonNegative = Field(default=0.0, description="radiance of the rim, within the camera's filter")
    arcs_w_m2_sr: NonNegative = Field(
        default=0.0,
        description="radiance of the brightest arc on the rim beside that: edges of a lens and its mount, lit by "
        "lamps, around a dark corner of the picture (shapes chosen)",
    )
    arcs_seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="selects the arcs")


class Star(Spec):
    """The star around bright points: light diffracted at the straight edges of the aperture's blades.

    Each edge causes an arm on both sides of the point, whose light falls as 1 / r^2 (Fraunhofer diffraction at a
    straight edge). An even number of blades makes as many arms, an odd number twice as many.
    """

    blades: Annotated[int, Field(ge=3, le=12)] = Field(default=6, description="number of the aperture's blades")
    share: Annotated[float, Field(ge=0, le=0.2)] = Field(default=0.02, description="share of the light in the arms")
    turn_deg: Annotated[float, Field(ge=-180, le=180)] = Field(
        default=0.0, description="direction of one arm, clockwise from the right of the picture"
    )
    reach_px: Annotated[int, Field(ge=2, le=200)] = Field(default=40, description="length at which arms are cut off")


class Lens(Spec):
    """Lens effects: defocus, vignetting beyond cos^4, scattered light, and openings that frame the view.

    Scattering conserves energy: `glare` and `ghost` are shares of the light that arrive elsewhere in the image.
    """

    focus_mm: Positive | None = Field(
        default=None, description="distance of the plane in focus from the nodal point; default: the eye is in focus"
    )
    vignetting: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.0,
        description="loss of light in the corner of the sensor beyond cos^4; the loss grows with the squared radius",
    )

    glare: Annotated[float, Field(ge=0, le=0.3)] = Field(
        default=0.0,
        description="share of the light that the lens scatters widely over the picture (veiling glare, ISO 9358). "
        "Coatings for visible light fail at 850 nm: eight surfaces that reflect 0.02 to 0.04 and a sensor that "
        "reflects 0.15 lead 0.035 to 0.09 astray by two reflections",
    )
    glare_radius_px: Positive = Field(
        default=80.0, description="radius r0 of the scatter, whose irradiance falls as (1 + (r / r0)^2)^(-3/2) (chosen)"
    )
    ghost: Annotated[float, Field(ge=0, le=0.1)] = Field(
        default=0.0,
        description="share of the light in a ghost, a blurred picture turned by 180 degrees about the optical axis "
        "(two reflections of 0.005 at coated surfaces return 2.5e-5, one of 0.05 at the sensor and one more 2.5e-4)",
    )
    ghost_scale: Annotated[float, Field(ge=0.1, le=5)] = Field(default=1.0, description="size of the ghost (chosen)")
    ghost_blur_px: Annotated[float, Field(ge=0, le=200)] = Field(
        default=6.0, description="standard deviation of the ghost's blur (chosen)"
    )
    star: Star | None = Field(default=None, description="star about bright points, such as glints")
    openings: Annotated[tuple[Opening, ...], Field(max_length=8)] = Field(
        default=(), description="openings that the camera looks through; the picture is dark outside any of them"
    )


class Motion(Spec):
    """Motion during the exposure, at constant speed and centred on its middle."""

    eye_deg_s: Vec2 = Field(default=(0.0, 0.0), description="angular velocity of the eye: azimuth and elevation")
    head_mm_s: Vec3 = Field(default=(0.0, 0.0, 0.0), description="velocity of the head in the world")
    steps: Annotated[int, Field(ge=2, le=64)] = Field(default=8, description="number of averaged moments")


class Panel(Spec):
    """A rectangle that emits evenly to its front, like a screen or a window; the cornea reflects it.

    It stands still in the world: its orientation is the same for both eyes and all head positions.
    """

    centre_mm: Vec3 = Field(description="centre in the world")
    size_mm: tuple[Positive, Positive] = Field(description="width (horizontal) and height")
    radiance_w_m2_sr: NonNegative = Field(description="radiance within the camera's filter")
    aim_mm: Vec3 = Field(
        default=(0, 0, 0), description="world point that its front faces; the default is midway between the eyes"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.allclose(self.centre_mm, self.aim_mm, atol=1e-6):
            raise ValueError("aim_mm is the panel's own centre")
        return self

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Return unit vectors (3,) in the world: the front's normal, along the level width, and along the height."""
        normal = np.subtract(self.aim_mm, self.centre_mm)
        normal /= np.linalg.norm(normal)
        right = np.cross((0.0, 0.0, 1.0), normal)
        size = np.linalg.norm(right)
        right = right / size if size > 1e-9 else np.array([0.0, 1.0, 0.0])
        return normal, right, np.cross(normal, right)


class RadianceMap(Spec):
    """Surroundings infinitely far away, as an image over all directions.

    The picture's axes are latitude and longitude, and it is twice as wide as high. Its upper edge is straight up, its
    middle the forward direction, and it continues to the subject's right.
    """

    file: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="a linear picture, .hdr, .exr, .pfm or .npy (relative to the scene); this or `place`"
    )
    place: Literal["office", "car", "outdoors"] | None = Field(
        default=None, description="painted surroundings, whose value 1 is 1 W/m^2/sr (values chosen); this or `file`"
    )
    place_seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(
        default=1, description="selects windows, buildings, trees and clouds of painted surroundings"
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

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.file is None) == (self.place is None):
            raise ValueError("give either file or place")
        if self.file is None and self.sha256 is not None:
            raise ValueError("sha256: needs a file")
        return self


class Sun(Spec):
    """The sun, a small bright disc infinitely far away: its shadows are sharp, and the cornea mirrors it as a glint."""

    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="azimuth of its middle, from straight ahead (+x) to the subject's left"
    )
    elevation_deg: Annotated[float, Field(ge=-90, le=90)] = Field(
        default=30.0, description="elevation of its middle above the horizon"
    )
    irradiance_w_m2: NonNegative = Field(
        description="irradiance of a matte surface that faces it, within the camera's filter (about 0.8 W/m^2 for each "
        "nm of the filter's width under a clear sky)"
    )
    diameter_deg: Annotated[float, Field(ge=0.05, le=40)] = Field(
        default=0.533, description="diameter of the disc, of even radiance"
    )


class Ambient(Spec):
    """Light other than that of the lamps: uniform light, surroundings, the sun, and panels."""

    irradiance_w_m2: NonNegative = Field(
        default=0.0, description="even light from all sides: irradiance of a matte surface, within the camera's filter"
    )
    panels: Annotated[tuple[Panel, ...], Field(max_length=16)] = Field(
        default=(), description="rectangles that emit light, such as screens and windows"
    )
    map: RadianceMap | None = Field(default=None, description="an HDR picture of the surroundings of the head")
    sun: Sun | None = Field(default=None, description="the sun, in addition to the rest")
