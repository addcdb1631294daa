"""Spectacle lenses as a user gives them, solved to two surfaces.

The back vertex power F of a lens with the surface powers F1, F2, the centre thickness t and the index n is
F = F1 / (1 - t F1 / n) + F2 (Jalie 2021, The Principles of Ophthalmic Lenses, chapter 4), in each principal meridian.
The front is a sphere with the base curve F1, so F2 = (1 - n) / R follows for both meridians of the back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from ..base.arrays import Floats, frozen
from ..base.errors import InputError
from ..base.spec import EYES, KeyProblem, Positive, Side, Spec, Vec2
from ..optics.media import CauchyMedium, SellmeierMedium
from ..optics.surfaces import Surface
from ..optics.surfaces_graph import Biconic
from ..optics.surfaces_quadric import Quadric
from ..optics.transforms import rotation_x, rotation_y, rotation_z
from .frames import SpectacleFrame
from .worn import WornLens

NOMINAL_NM = 546.07
"""Wavelength of prescriptions, the green line of mercury (ISO 7944)."""
CENTRE_MM, EDGE_MM = 1.5, 1.0
"""Smallest thickness at the vertex and along the outline (chosen; the trade's values lie between 1 and 2 mm)."""
_OUTLINE_POINTS = 360
_LAST_STEP_MM = 1e-13
_LEAST_VERTEX_MM = 1.0  # closer lenses, as tilted as worn, meet corneas and lids


def _by_abbe(n_d: float, abbe: float) -> CauchyMedium:
    """Cauchy's two-term formula through n_d and the Abbe number (n_d - 1) / (n_F - n_C)."""
    d, f, c = (1.0 / nm**2 for nm in (587.56, 486.13, 656.27))
    slope = (n_d - 1.0) / (abbe * (f - c))
    return CauchyMedium(n_d - slope * d, slope, 0.0, 0.0)


MATERIALS: dict[str, CauchyMedium | SellmeierMedium] = {
    # n_d and Abbe numbers are nominal values of the trade. Polycarbonate: Sultanova, Kasarova and Nikolov 2009, Acta
    # Phys. Pol. A 116, 585.
    "CR-39": _by_abbe(1.4985, 58.0),
    "Trivex": _by_abbe(1.530, 44.0),
    "polycarbonate": SellmeierMedium(((1.4182, 0.021304),)),
    "1.60": _by_abbe(1.592, 41.0),
    "1.67": _by_abbe(1.661, 32.0),
    "1.74": _by_abbe(1.732, 33.0),
}
"""Materials of lenses."""

Radius = Annotated[float, Field(ge=-1e6, le=1e6)]
Radii = Annotated[
    Annotated[Radius, Tag("NumberSpec")] | Annotated[tuple[Radius, Radius], Tag("PairSpec")],
    Discriminator(lambda value: "NumberSpec" if isinstance(value, int | float) else "PairSpec"),
]
Reflectance = Annotated[float, Field(ge=0, lt=1)]
Reflectances = Annotated[
    Annotated[Reflectance, Tag("NumberSpec")] | Annotated[tuple[Reflectance, Reflectance], Tag("PairSpec")],
    Discriminator(lambda value: "NumberSpec" if isinstance(value, int | float) else "PairSpec"),
]
Index = Annotated[float, Field(ge=1, le=2.5)]
Dioptres = Annotated[float, Field(ge=-30, le=30)]
Thickness = Annotated[float, Field(gt=0.01, le=30)]


class LensSurfaces(Spec):
    """A lens as it is made. Radii > 0 have their centre on the eye's side, < 0 on the world's; null is a plane."""

    front_radius_mm: Radii | None = Field(
        description="radius of the front, or `[ry, rz]` along the lens's y and z axes (a biconic); null: a plane"
    )
    back_radius_mm: Radii | None = Field(description="the same of the back")
    thickness_mm: Thickness = Field(description="distance of the vertices")
    index: Index = Field(description="index of refraction at `wavelength_nm`")
    front_asphericity: Annotated[float, Field(ge=-10, le=10)] | None = Field(
        default=None, description="conic constant Q of the front; default: 0"
    )
    back_asphericity: Annotated[float, Field(ge=-10, le=10)] | None = Field(
        default=None, description="conic constant Q of the back; default: 0"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("front", "back"):
            radius, asphericity = getattr(self, f"{name}_radius_mm"), getattr(self, f"{name}_asphericity")
            if radius is not None and any(abs(r) < 1.0 for r in np.atleast_1d(radius)):
                raise KeyProblem(f"{name}_radius_mm", "must be at least 1 mm on either side, or null for a plane")
            if asphericity is not None and not isinstance(radius, float):
                raise KeyProblem(
                    f"{name}_asphericity", "needs one radius; a plane and a surface of two radii have none"
                )
        return self


Bend = float | tuple[float, float] | None
"""Radius of a surface (mm), or both along y and z; None: a plane."""


class _Solved(NamedTuple):
    """Shape of a lens: radii of front and back, conic constants, thickness."""

    front_mm: Bend
    back_mm: Bend
    asphericities: tuple[float, float]
    thickness_mm: float


OWN = "`own`: the prescription of the drawn person, for each eye, in scenes with a `population`"
OWN_MISSING = "needs a drawn person: `population`, or person.spectacles() and person.contact_lens() in Python"

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "reading": {"sphere_d": 2.0, "outline_mm": (23.0, 13.0), "vertex_mm": 15.0, "pantoscopic_deg": 12.0},
    "single vision": {"material": "1.60", "outline_mm": (25.0, 17.0)},
    "safety": {"material": "polycarbonate", "thickness_mm": 2.2, "wrap_deg": 10.0, "outline_mm": (30.0, 23.0)},
    "sport wrap": {"material": "polycarbonate", "thickness_mm": 2.0, "base_curve_d": 8.0, "wrap_deg": 20.0,
                   "outline_mm": (32.0, 20.0)},
}  # fmt: skip
"""Keys of common glasses (chosen): single vision for powers of -6 to +6 D; safety and sport glasses are plano."""

_PRESCRIBED = ("sphere_d", "cylinder_d", "axis_deg", "material", "index", "base_curve_d", "thickness_mm")


class SpectacleLens(Spec):
    """A lens of spectacles or an insert in front of one eye: a prescription that is solved, or surfaces as made."""

    preset: Literal["reading", "single vision", "safety", "sport wrap"] | None = Field(
        default=None, description="common glasses, whose keys replace the defaults below"
    )
    sphere_d: Dioptres = Field(default=0.0, description="back vertex power of the sphere at 546 nm, dioptres")
    cylinder_d: Dioptres = Field(default=0.0, description="cylinder at 546 nm, which acts across the axis, dioptres")
    axis_deg: Annotated[float, Field(ge=0, le=180)] = Field(
        default=0.0,
        description="axis of the cylinder, counter-clockwise from the right of somebody who faces the wearer",
    )
    vertex_mm: Annotated[float, Field(gt=0, le=100)] = Field(
        default=13.0, description="distance from the corneal apex to the back surface"
    )
    pantoscopic_deg: Annotated[float, Field(ge=-45, le=45)] | None = Field(
        default=None, description="tilt as worn: > 0 turns the lens's axis down; default: 8 on the head, 0 on the rig"
    )
    wrap_deg: Annotated[float, Field(ge=-45, le=45)] | None = Field(
        default=None, description="turn of the lens's axis towards the temple; default: 5 on the head, 0 on the rig"
    )
    decentration_mm: Vec2 = Field(
        default=(0.0, 0.0), description="displacement of the optics, nasal and up; the outline stays"
    )
    material: Literal["CR-39", "Trivex", "polycarbonate", "1.60", "1.67", "1.74"] | None = Field(
        default=None, description="material with its dispersion; default: CR-39"
    )
    index: Index | None = Field(
        default=None, description="index of refraction at every wavelength, in place of `material`"
    )
    base_curve_d: Annotated[float, Field(ge=0, le=20)] | None = Field(
        default=None,
        description="power of the front surface at 546 nm; default: Vogel's rule for the mean power M, M + 6, or "
        "M / 2 + 6 for minus lenses and at least 0.5",
    )
    thickness_mm: Thickness | None = Field(
        default=None, description="thickness at the vertex; default: at least 1.5 there and 1 along the outline"
    )
    surfaces: LensSurfaces | None = Field(default=None, description="the lens as made, in place of a prescription")
    outline_mm: tuple[Positive, Positive] = Field(
        default=(27.0, 20.0), description="half width and half height of the elliptical outline"
    )
    mount: Literal["head", "rig"] = Field(
        default="head", description="whether the lens moves with the head, or stays with the cameras as an insert does"
    )
    reflectance: Reflectances | None = Field(
        default=None, description="of both surfaces or `[front, back]`, at every angle; default: Fresnel's"
    )
    transmission: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0, description="of the material, along any path"
    )
    prescription: Literal["own"] | None = Field(default=None, description=OWN)
    frame: SpectacleFrame | None = Field(
        default=None,
        description="what holds the lens, in pictures with a region; default: as `{}`, and none at index 1",
    )

    @field_validator("material", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """Take 1.6, which YAML reads from 1.60, for the material of this name."""
        try:
            return f"{float(value):.2f}"
        except (TypeError, ValueError):
            return value

    @model_validator(mode="after")
    def _of_preset(self) -> Self:
        """Fill in the keys of a preset that are not given."""
        for key, value in PRESETS.get(self.preset or "", {}).items():
            if key not in self.model_fields_set and not (key == "material" and self.index is not None):
                self.__dict__[key] = value
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.prescription is not None:
            raise KeyProblem("prescription", OWN_MISSING)
        if self.vertex_mm < _LEAST_VERTEX_MM:
            raise KeyProblem("vertex_mm", f"is {self.vertex_mm:g} mm, on the cornea; lengths are in mm, not in metres")
        if self.surfaces is not None:
            for name in _PRESCRIBED:
                if getattr(self, name) != type(self).model_fields[name].default:
                    raise KeyProblem(name, "cannot be combined with `surfaces`, which give the lens as made")
        if self.material is not None and self.index is not None:
            raise KeyProblem("index", "cannot be combined with `material`")
        if self.surfaces is None and self.nominal_index <= 1.0 and (self.sphere_d or self.cylinder_d):
            raise KeyProblem("index", "must be > 1 for a lens with power")
        try:
            self._solved_within_outline(self.surfaces.index if self.surfaces else self.nominal_index)
        except InputError as error:
            raise KeyProblem(error.path, error.reason) from None
        return self

    @property
    def mean_d(self) -> float:
        """Mean back vertex power (D), at `wavelength_nm` and in the mean meridian for a lens as made."""
        if self.surfaces is None:
            return self.sphere_d + 0.5 * self.cylinder_d
        return float(np.mean(back_vertex_power_d(self._solved(), self.surfaces.index)))

    @property
    def nominal_index(self) -> float:
        """Index at the wavelength of prescriptions."""
        return self.index_at(NOMINAL_NM)

    def index_at(self, wavelength_nm: float) -> float:
        """Compute the index at a wavelength (nm)."""
        if self.surfaces is not None:
            return self.surfaces.index
        return MATERIALS[self.material or "CR-39"].index(wavelength_nm) if self.index is None else self.index

    def build(self, side: Side, wavelength_nm: float, head_mm: Floats | None = None) -> WornLens:
        """Build the lens of one eye in the frame of the unrotated eye, for rays of a wavelength.

        `head_mm` (3,) is the displacement of the head, which a lens on the rig does not follow.
        """
        solved, nasal = self._solved(), 1.0 if side == "right" else -1.0
        on_rig = self.mount == "rig"
        tilt = (0.0 if on_rig else 8.0) if self.pantoscopic_deg is None else self.pantoscopic_deg
        wrap = (0.0 if on_rig else 5.0) if self.wrap_deg is None else self.wrap_deg
        turn = rotation_z(np.radians(-nasal * wrap)) @ rotation_y(np.radians(tilt))
        centre = np.array([self.vertex_mm, 0.0, 0.0])
        if on_rig and head_mm is not None:
            centre = centre - head_mm
        origin = centre + np.array([0.0, nasal * self.decentration_mm[0], self.decentration_mm[1]])
        meridians = turn @ rotation_x(np.radians(0.0 if self.surfaces else self.axis_deg))
        front, back = (
            _surface(radius, q, origin + x * turn[:, 0], meridians)
            for radius, q, x in zip(
                (solved.front_mm, solved.back_mm), solved.asphericities, (solved.thickness_mm, 0.0), strict=True
            )
        )
        shares, index = self.reflectance, self.index_at(wavelength_nm)
        frame = self.frame or (SpectacleFrame() if index > 1.0 else None)
        return WornLens(
            front=front,
            back=back,
            index=index,
            centre_mm=frozen(centre),
            rotation=frozen(turn),
            half_mm=self.outline_mm,
            reflectances=None if shares is None else ((shares, shares) if isinstance(shares, float) else shares),
            transmission=self.transmission,
            frame=None if frame is None else frame.shape(side, on_rig=on_rig),
        )

    def _solved(self) -> _Solved:
        return self._solved_within_outline(self.nominal_index)

    def _solved_within_outline(self, index: float) -> _Solved:
        """Solve radii and thickness, and check that both surfaces exist, and do not cross, inside the outline."""
        made = self.surfaces
        thickness = self.thickness_mm or CENTRE_MM
        while True:
            if made is None:
                solved = self._prescribed(index, thickness)
            else:
                asphericities = made.front_asphericity or 0.0, made.back_asphericity or 0.0
                solved = _Solved(made.front_radius_mm, made.back_radius_mm, asphericities, made.thickness_mm)
            edge = self._thinnest_mm(solved)
            if not np.isfinite(edge):
                raise InputError("is wider than a surface of the lens reaches", path="outline_mm")
            wanted = max(CENTRE_MM, solved.thickness_mm + EDGE_MM - edge)
            if made is not None or self.thickness_mm is not None or abs(wanted - thickness) < _LAST_STEP_MM * wanted:
                break
            if wanted > 30.0:
                raise InputError("needs a lens thicker than 30 mm; take a smaller outline", path="outline_mm")
            thickness = wanted
        if edge < 0.0:
            path = "thickness_mm" if made is None else "surfaces.thickness_mm"
            raise InputError(f"the surfaces cross inside the outline; add at least {-edge:.3g} mm", path=path)
        return solved

    def _prescribed(self, index: float, thickness_mm: float) -> _Solved:
        """Solve the back for the prescribed power."""
        mean = self.sphere_d + 0.5 * self.cylinder_d
        vogel = mean + 6.0 if mean >= 0.0 else max(0.5, mean / 2.0 + 6.0)
        base = vogel if self.base_curve_d is None else self.base_curve_d
        if index == 1.0:  # no power at all: the shape of a CR-39 lens
            index = MATERIALS["CR-39"].index(NOMINAL_NM)
        behind = base / (1.0 - 1e-3 * thickness_mm * base / index)
        bend = [_radius_mm(behind - power, index) for power in (self.sphere_d, self.sphere_d + self.cylinder_d)]
        back: Bend = bend[0]
        if self.cylinder_d:
            # A biconic takes a very large radius for a plane meridian.
            back = (bend[0] or _FLAT_MM, bend[1] or _FLAT_MM)
        return _Solved(_radius_mm(base, index), back, (0.0, 0.0), thickness_mm)

    def _thinnest_mm(self, solved: _Solved) -> float:
        """Compute the smallest thickness (mm) along the outline and at the vertex; NaN if a surface ends inside it."""
        angle = 2.0 * np.pi * np.arange(_OUTLINE_POINTS) / _OUTLINE_POINTS
        nasal, up = self.decentration_mm
        # Nasal is +y for a right and -y for a left eye; a lens is thick enough for both.
        y = np.concatenate([self.outline_mm[0] * np.cos(angle) + shift for shift in (nasal, -nasal)] + [[0.0]])
        z = np.append(np.tile(self.outline_mm[1] * np.sin(angle) - up, 2), 0.0)
        turn = rotation_x(np.radians(0.0 if self.surfaces else self.axis_deg))
        local = np.stack([np.zeros_like(y), y, z], axis=-1) @ turn
        front, back = (
            _surface(radius, q, np.zeros(3), np.eye(3)).sag(local[:, 1], local[:, 2])
            for radius, q in zip((solved.front_mm, solved.back_mm), solved.asphericities, strict=True)
        )
        return float(np.min(solved.thickness_mm + front - back))


_FLAT_MM = 1e9


def _radius_mm(power_d: float, index: float) -> float | None:
    """Compute the radius r = (n - 1) / F of a surface of power F between air and the lens; None for a plane."""
    return None if abs(power_d) < 1e-9 else 1000.0 * (index - 1.0) / power_d


def _surface(radius: Bend, asphericity: float, origin: Floats, rotation: Floats) -> Surface:
    if radius is None:
        return Quadric.plane(origin, rotation)
    if isinstance(radius, float | int):
        return Quadric.conic(radius, asphericity, origin, rotation)
    return Biconic(origin, rotation, np.array(radius), np.zeros(2))


def back_vertex_power_d(solved: _Solved, index: float) -> Floats:
    """Compute the back vertex powers (2,) in dioptres along the lens's y and z: F1 / (1 - t F1 / n) + F2."""

    def curvature(radius: Bend) -> Floats:
        return np.zeros(2) if radius is None else 1.0 / np.broadcast_to(np.asarray(radius, dtype=float), 2)

    front = (index - 1.0) * curvature(solved.front_mm)
    back = (1.0 - index) * curvature(solved.back_mm)
    return np.asarray(1000.0 * (front / (1.0 - solved.thickness_mm * front / index) + back))


def _form(value: object) -> str:
    if isinstance(value, list | tuple):
        return "ListSpec"
    sides = value.keys() if isinstance(value, Mapping) else ()
    return "SidesSpec" if isinstance(value, BySide) or {"right", "left"} & set(sides) else "LensSpec"


def _in_order(lenses: tuple[SpectacleLens, ...]) -> tuple[SpectacleLens, ...]:
    """Refuse a lens that stands within or behind the one before it."""
    for k, (near, far) in enumerate(pairwise(lenses), start=1):
        front = near.vertex_mm + near._solved().thickness_mm
        if far.vertex_mm < front:
            reason = f"is {far.vertex_mm:g}, but the lens before it ends at {front:.3g}; list lenses from the eye on"
            raise KeyProblem(f"{k}.vertex_mm", reason)
    return lenses


_Lenses = Annotated[tuple[SpectacleLens, ...], Field(min_length=1, max_length=2), AfterValidator(_in_order)]
OneEye = Annotated[
    Annotated[SpectacleLens, Tag("LensSpec")] | Annotated[_Lenses, Tag("ListSpec")], Discriminator(_form)
]


class BySide(Spec):
    """Lenses that differ between the eyes; an eye without an entry wears none."""

    right: OneEye | None = Field(default=None, description="one lens, or a list in order from the eye")
    left: OneEye | None = Field(default=None, description="the same for the left eye")


Spectacles = Annotated[
    Annotated[SpectacleLens, Tag("LensSpec")]
    | Annotated[_Lenses, Tag("ListSpec")]
    | Annotated[BySide, Tag("SidesSpec")],
    Discriminator(_form),
]
"""What `spectacles` may be: one lens, a list of lenses in order from the eye, or `{right: .., left: ..}` of these."""


def demand_through_d(lenses: Sequence[SpectacleLens], distance_mm: Floats) -> Floats:
    """Compute the vergence (D) that targets ask of an emmetropic eye behind thin lenses, listed from the eye on.

    Light of the vergence V leaves a lens with V + F, and arrives after a distance d with V / (1 - d V).
    """
    place = max((lens.vertex_mm for lens in lenses), default=0.0)
    vergence = -1000.0 / np.maximum(distance_mm - place, 1.0)
    for lens in sorted(lenses, key=lambda one: -one.vertex_mm):
        vergence = vergence / (1.0 - 1e-3 * (place - lens.vertex_mm) * vergence) + lens.mean_d
        place = lens.vertex_mm
    return np.asarray(-vergence / (1.0 - 1e-3 * place * vergence))


def lenses_of(
    spectacles: SpectacleLens | tuple[SpectacleLens, ...] | BySide | None, side: str
) -> tuple[SpectacleLens, ...]:
    """Return the lenses in front of one eye, in order from the eye."""
    assert side in EYES
    if isinstance(spectacles, BySide):
        spectacles = spectacles.right if side == "right" else spectacles.left
    if spectacles is None:
        return ()
    return (spectacles,) if isinstance(spectacles, SpectacleLens) else spectacles
