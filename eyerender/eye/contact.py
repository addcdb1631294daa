"""Soft contact lenses: a lens that drapes over the cornea, as one more surface in front of it.

The back of the lens takes the shape of the cornea, and the tear film beneath bends nothing. Bending leaves the
thickness of the lens where it is, so its front has the cornea's curvature plus the difference of the curvatures of the
lens as made, and the cornea's asphericity. The back vertex power as made is F = F1 / (1 - t F1 / n) + F2 with
F1 = (n - 1) / R_front and F2 = (1 - n) / R_back (Jalie 2021, The Principles of Ophthalmic Lenses, chapter 4). A
displaced lens turns its front by the displacement times that difference of curvatures, which is Prentice's prism.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from ..base.arrays import Floats, frozen
from ..base.errors import InputError
from ..base.spec import EYES, KeyProblem, Spec, Vec2
from ..optics.surfaces import Surface
from ..optics.surfaces_graph import Biconic
from ..optics.surfaces_measured import Measured, ZernikeSurface
from ..optics.surfaces_quadric import Quadric
from ..optics.transforms import rotation_y, rotation_z
from .landmarks import chief_ray_in_air
from .model import EyeModel
from .spectacles import OWN, OWN_MISSING

CENTRE_MM, EDGE_MM = 0.08, 0.03
"""Smallest thickness at the centre and over the limbus (chosen)."""


class ContactLens(Spec):
    """A soft contact lens on one eye."""

    power_d: Annotated[float, Field(ge=-25, le=25)] = Field(default=0.0, description="back vertex power, dioptres")
    base_curve_mm: Annotated[float, Field(ge=7, le=11)] = Field(
        default=8.6, description="radius of the back as made, before it drapes"
    )
    thickness_mm: Annotated[float, Field(gt=0.01, le=2)] | None = Field(
        default=None, description="thickness at the centre; default: at least 0.08 there and 0.03 over the limbus"
    )
    index: Annotated[float, Field(gt=1.3, le=1.6)] = Field(
        default=1.42, description="index of refraction at every wavelength"
    )
    diameter_mm: Annotated[float, Field(ge=10, le=20)] = Field(
        default=14.2, description="diameter; the lens must cover the cornea, and beyond it nothing is drawn"
    )
    decentration_mm: Vec2 = Field(default=(0.0, 0.0), description="displacement on the eye, nasal and up")
    prescription: Literal["own"] | None = Field(default=None, description=OWN)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.prescription is not None:
            raise KeyProblem("prescription", OWN_MISSING)
        return self

    def bend(self, thickness_mm: float) -> float:
        """Compute the curvature of the front as made less that of the back, 1/mm."""
        back = 1.0 / self.base_curve_mm
        lost = 1e-3 * self.power_d + (self.index - 1.0) * back  # F - F2
        front = lost / (1.0 + thickness_mm * lost / self.index)
        return front / (self.index - 1.0) - back

    def worn_by(self, eye: EyeModel) -> EyeModel:
        """Return the eye with this lens on; its fovea stays, and its chief ray passes the lens.

        Raises:
            InputError: the lens does not cover the cornea, is too thin, or the cornea is a shape without radii.
        """
        limbus, nasal = float(eye.limbus_radius_mm), 1.0 if eye.side == "right" else -1.0
        shift = np.array([nasal, 1.0]) * self.decentration_mm
        if 0.5 * self.diameter_mm - float(np.hypot(*shift)) < limbus:
            path = "diameter_mm" if 0.5 * self.diameter_mm < limbus else "decentration_mm"
            raise InputError(f"the lens must reach over the cornea, which is {2.0 * limbus:g} mm wide", path=path)
        thickness = self.thickness_mm or CENTRE_MM
        front = self._front(eye.front[0], thickness, shift)
        edge = _thinnest_mm(front, eye.front[0], limbus)
        for _ in range(20 if self.thickness_mm is None else 0):  # thickness changes the bend a little
            if abs(edge - EDGE_MM) < 1e-4 or (edge > EDGE_MM and thickness == CENTRE_MM):
                break
            thickness = max(CENTRE_MM, thickness + EDGE_MM - edge)
            front = self._front(eye.front[0], thickness, shift)
            edge = _thinnest_mm(front, eye.front[0], limbus)
        if not edge > 0.0:
            raise InputError(
                "the front of the lens meets the cornea before the limbus; make it thicker", path="thickness_mm"
            )
        worn = replace(
            eye, front=(front, *eye.front), front_indices=(self.index, *eye.front_indices), has_contact_lens=True
        )
        return replace(worn, chief_ray=chief_ray_in_air(worn, eye.fovea_mm))

    def _front(self, cornea: Surface, thickness_mm: float, shift_mm: Floats) -> Surface:
        """Return the front of the draped lens."""
        bend = self.bend(thickness_mm)
        # A toric cornea's frame is turned about its axis.
        prism, axis = bend * (shift_mm @ cornea.rotation[1:])[1:], cornea.rotation[:, 0]
        # The lens's thickness at its own centre, seen from the cornea's apex.
        origin = cornea.origin_mm + (thickness_mm - 0.5 * bend * float(shift_mm @ shift_mm)) * axis
        turn = cornea.rotation @ rotation_z(-prism[0]) @ rotation_y(prism[1])
        return _bent(cornea, bend, frozen(origin), frozen(turn))


def _bent(surface: Surface, bend: float, origin_mm: Floats, rotation: Floats) -> Surface:
    """Return a surface with its curvatures raised by `bend` (1/mm), at another place; InputError if it has no radii."""
    if isinstance(surface, Biconic):
        return replace(surface, radii_mm=_raised(surface.radii_mm, bend), origin_mm=origin_mm, rotation=rotation)
    if isinstance(surface, Quadric) and (shape := surface.as_conic()) is not None:
        radius, conic_constant = shape
        return Quadric.conic(_raised(radius, bend), conic_constant, origin_mm, rotation)
    if isinstance(surface, Measured):
        outer = np.concatenate([_raised(surface.outer[:2], bend), surface.outer[2:]])
        if isinstance(surface, ZernikeSurface):
            base = surface.base + np.array([bend, 0.0])
            return replace(surface, outer=outer, base=base, origin_mm=origin_mm, rotation=rotation)
        return replace(surface, outer=outer, origin_mm=origin_mm, rotation=rotation)  # type: ignore[type-var]
    raise InputError("needs a cornea that is a sphere, conic, biconic or measured")


def _raised(radius_mm: Floats, bend: float) -> Floats:
    return np.asarray(1.0 / (1.0 / radius_mm + bend))


def _thinnest_mm(front: Surface, cornea: Surface, radius_mm: float) -> float:
    """Compute the smallest thickness (mm) along the cornea's axis, on circles out to a radius; NaN where none is."""
    angle = 2.0 * np.pi * np.arange(32) / 32
    rho = radius_mm * np.linspace(0.0, 1.0, 9)[:, None]
    y, z = (rho * np.cos(angle)).ravel(), (rho * np.sin(angle)).ravel()
    points = cornea.to_eye(np.stack([cornea.local_sag(y, z), y, z], axis=-1))
    axis = np.broadcast_to(cornea.rotation[:, 0], points.shape)
    distance, ok = front.intersect(points - 5.0 * axis, axis)
    return float(np.min(np.where(ok, distance - 5.0, np.nan)))


def _form(value: object) -> str:
    sides = value.keys() if isinstance(value, Mapping) else ()
    return "SidesSpec" if isinstance(value, ContactLensBySide) or {"right", "left"} & set(sides) else "LensSpec"


class ContactLensBySide(Spec):
    """Contact lenses that differ between the eyes; an eye without an entry wears none."""

    right: ContactLens | None = Field(default=None, description="the lens on the right eye")
    left: ContactLens | None = Field(default=None, description="the lens on the left eye")


ContactLenses = Annotated[
    Annotated[ContactLens, Tag("LensSpec")] | Annotated[ContactLensBySide, Tag("SidesSpec")], Discriminator(_form)
]
"""What `contact_lens` may be: one lens for both eyes, or `{right: .., left: ..}`."""


def contact_lens_of(given: ContactLens | ContactLensBySide | None, side: str) -> ContactLens | None:
    """Return the contact lens on one eye."""
    assert side in EYES
    if isinstance(given, ContactLensBySide):
        return given.right if side == "right" else given.left
    return given
