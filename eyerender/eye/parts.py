"""The keys of an eye file, which describes a right eye.

Eye frame (mm): origin at the front corneal apex of the unrotated eye, +x outward along the optic axis, +y nasal, +z
up. A left eye is the mirror image y -> -y. Lists of surfaces run from outside in; a medium is the one BEHIND its
surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Discriminator, Field, Tag

from ..spec import FileSpec, Number, Positive, Spec, Vec2, Vec3

# This is the number of surfaces of the finest lens of shells.
MAX_SURFACES = 400
# Germanium has the highest index of all materials that are transparent somewhere in the infrared: 4.
LARGEST_INDEX = 5.0
# Cauchy's coefficients grow with the sixth power of nanometres.
Coefficient = Annotated[float, Field(ge=-1e20, le=1e20)]

Side = Literal["right", "left"]
Facing = Literal["front", "back"]


class SphereSpec(Spec):
    """Sphere y^2 + z^2 + 2 R s + s^2 = 0 from the apex; R > 0 opens to -x (cornea), R < 0 to +x (lens back, retina)."""

    kind: Literal["sphere"]
    radius_mm: Number


class ConicSpec(Spec):
    """Conic y^2 + z^2 + 2 R s + (1 + Q) s^2 = 0 from the apex, on the sheet through the apex."""

    kind: Literal["conic"]
    radius_mm: Number
    conic_constant: Number


class BiconicSpec(Spec):
    """Biconic: two apex radii and conic constants, for the meridians of y and z."""

    kind: Literal["biconic"]
    radii_mm: Vec2
    conic_constants: Vec2


class EllipsoidSpec(Spec):
    """Ellipsoid (x/a)^2 + (y/b)^2 + (z/c)^2 = 1 about its centre; the half towards +x ('front') or -x ('back')."""

    kind: Literal["ellipsoid"]
    semi_axes_mm: tuple[Positive, Positive, Positive]
    side: Facing = "front"


class QuadricSpec(Spec):
    """Quadric A x^2 + B y^2 + C z^2 + 2 D xy + 2 E xz + 2 F yz + 2 G x + 2 H y + 2 I z + K = 0 about its position.

    The sheet is where dF/dx > 0 ('front') or < 0 ('back') with the coefficients as given.
    """

    kind: Literal["quadric"]
    coefficients: tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number, Number]
    side: Facing = "front"


class PlaneSpec(Spec):
    """Plane x = 0 of its frame."""

    kind: Literal["plane"]


def _shape_tag(value: object) -> str | None:
    kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
    return f"{str(kind).capitalize()}Spec"


ShapeSpec = Annotated[
    Annotated[SphereSpec, Tag("SphereSpec")]
    | Annotated[ConicSpec, Tag("ConicSpec")]
    | Annotated[BiconicSpec, Tag("BiconicSpec")]
    | Annotated[EllipsoidSpec, Tag("EllipsoidSpec")]
    | Annotated[QuadricSpec, Tag("QuadricSpec")]
    | Annotated[PlaneSpec, Tag("PlaneSpec")],
    Discriminator(
        _shape_tag,
        custom_error_type="unknown_kind",
        custom_error_message="kind must be sphere, conic, biconic, ellipsoid, quadric or plane",
    ),
]


class MediumSpec(Spec):
    """A medium: a constant `index`, or `cauchy` = (c0, c1, c2, c3), n = c0 + c1/l^2 + c2/l^4 + c3/l^6, l in nm."""

    index: float | None = Field(default=None, ge=1.0, le=LARGEST_INDEX)
    cauchy: tuple[Coefficient, Coefficient, Coefficient, Coefficient] | None = None


class PlacedSpec(Spec):
    """A shape in the eye: its apex at `position_mm` (a quadric's origin), turned about it by `tilt_deg`.

    The angles (t_x, t_y, t_z) about the axes make the rotation Rz(t_z) Ry(t_y) Rx(t_x).
    """

    shape: ShapeSpec
    position_mm: Vec3 = (0.0, 0.0, 0.0)
    tilt_deg: Vec3 = (0.0, 0.0, 0.0)


class SurfaceSpec(PlacedSpec):
    """A refracting surface and the medium behind it."""

    name: str = ""
    medium: MediumSpec


class SurfaceLensSpec(Spec):
    """A lens of homogeneous media; the last medium is the vitreous."""

    kind: Literal["surfaces"]
    surfaces: tuple[SurfaceSpec, ...] = Field(min_length=1, max_length=MAX_SURFACES)


class LayerSpec(Spec):
    """A shell of a lens and the medium inside it.

    The shell is the lens' outer surface scaled by `size` about the lens' centre. Inside it the index has changed by
    `index_share` of the way from edge to core.
    """

    size: float = Field(gt=0.0, le=1.0)
    index_share: float = Field(ge=0.0, le=1.0)


class GradientLensSpec(Spec):
    """A gradient-index lens.

    Its surfaces of constant index are the outer surfaces scaled by p in (0, 1] about the lens' centre: n(p) = n_core -
    (n_core - n_edge) p^2. The centre is at `centre_mm`, or on the line between the two apexes at `centre_fraction` of
    it, counted from the front. Rays are traced through the gradient itself, or through the given number of `shells` in
    each half: shell k is where n has changed by k / shells from edge to core, and the medium inside it has the index
    half a step farther. `layers` in place of `shells` gives each shell a size and an index of its own, from outside in.
    """

    kind: Literal["gradient"]
    front: PlacedSpec
    back: PlacedSpec
    edge: MediumSpec
    core: MediumSpec
    vitreous: MediumSpec
    shells: int | None = Field(default=None, ge=1, le=200)
    centre_fraction: float = Field(default=0.4, gt=0.0, lt=1.0)
    centre_mm: Vec3 | None = None
    layers: tuple[LayerSpec, ...] | None = Field(default=None, min_length=1, max_length=MAX_SURFACES // 2)


def _lens_tag(value: object) -> str | None:
    kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
    return {"surfaces": "SurfaceLensSpec", "gradient": "GradientLensSpec"}.get(str(kind), "UnknownSpec")


Lens = Annotated[
    Annotated[SurfaceLensSpec, Tag("SurfaceLensSpec")] | Annotated[GradientLensSpec, Tag("GradientLensSpec")],
    Discriminator(
        _lens_tag,
        custom_error_type="unknown_kind",
        custom_error_message="kind must be surfaces or gradient",
    ),
]


class ContourSpec(Spec):
    """A margin that is not an ellipse: the ellipse times r(f) = 1 + sum_k c_k cos(k f) + s_k sin(k f), k from 1.

    f is the ellipse's parameter from its first semi-axis (nasal where it is not turned) towards up, and r (a cos f, b
    sin f) is the margin. c_k and s_k are the Fourier coefficients of a measured pupil's radius over its mean (Wyatt
    1995, "The form of the human pupil", Vision Res. 35, 2021-2036). The shorter list is padded with zeros.
    """

    cosines: tuple[Number, ...] = Field(default=(), max_length=32)
    sines: tuple[Number, ...] = Field(default=(), max_length=32)


class StopSpec(Spec):
    """The anatomical pupil: an ellipse in a plane, or a `contour` about one.

    `ellipticity` = 1 - b/a at the area of the circle of `diameter_mm`; the long axis lies `axis_deg` from nasal
    towards up. A pupil of another diameter d is centred at position_mm + (s_x, s_y, s_z) (d - diameter_mm), (s_y, s_z)
    = `shift_mm_per_mm`. s_x follows from the condition that the pupil stays in its plane.
    """

    diameter_mm: Positive
    position_mm: Vec3
    tilt_deg: Vec3 = (0.0, 0.0, 0.0)
    ellipticity: float = Field(default=0.0, ge=0.0, lt=1.0)
    axis_deg: Number = 0.0
    shift_mm_per_mm: Vec2 = (0.0, 0.0)
    contour: ContourSpec | None = None


class IrisSpec(Spec):
    """The iris: the annulus in the pupil's plane out to `root_radius_mm` from the eye's axis."""

    root_radius_mm: Positive


class ScleraSpec(Spec):
    """A sphere. Without a centre, it is the one through the limbus circle with its centre on the cornea's axis."""

    radius_mm: Positive
    centre_mm: Vec3 | None = None


class RotationSpec(Spec):
    """Centres of rotation: azimuth (about z), elevation (about y), torsion (about x)."""

    azimuth_centre_mm: Vec3
    elevation_centre_mm: Vec3
    torsion_centre_mm: Vec3 = (0.0, 0.0, 0.0)


class FoveaSpec(Spec):
    """Place of the fovea: `position_mm`, or the point where a nodal ray meets the retina.

    The nodal ray comes from the field direction (1, tan h, tan v), (h, v) = `field_deg` nasal and up, seen from the
    incident node, from an object `distance_mm` from the corneal apex.
    """

    field_deg: Vec2 = (0.0, 0.0)
    distance_mm: Positive = 1500.0
    position_mm: Vec3 | None = None


class EyeParts(FileSpec):
    """The keys of an eye file; `EyeSpec` also checks the geometry that they describe.

    `sources` maps a dotted path (or the beginning of one) to the source of its values.
    """

    FORMATS: ClassVar[tuple[int, ...]] = (1, 2)

    format: int = Field(default=2, description="version of this file format")
    name: str
    description: str = ""
    cornea: tuple[SurfaceSpec, ...] = Field(
        min_length=1, max_length=MAX_SURFACES, description="surfaces between air and the stop"
    )
    lens: Lens | None = None
    retina: PlacedSpec
    stop: StopSpec
    limbus_radius_mm: Positive = 5.85
    iris: IrisSpec
    sclera: ScleraSpec = ScleraSpec(radius_mm=12.0)
    rotation: RotationSpec
    fovea: FoveaSpec
    sources: dict[str, str] = Field(default_factory=dict)
