"""The keys of an eye file, which describes a right eye.

Eye frame (mm): origin at the front corneal apex of the unrotated eye, +x outward along the optic axis, +y nasal, +z
up. A left eye is the mirror image y -> -y. Lists of surfaces run from outside in; a medium is the one BEHIND its
surface.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ..base.spec import ByKind, FileSpec, Number, Positive, Spec, Vec2, Vec3
from .biometry import BiometrySpec

# This is the number of surfaces of the finest lens of shells.
MAX_SURFACES = 400
# Zernike terms of radial order 14, and nodes of a grid in a row: a grid of 201 x 201 takes some seconds to fit.
MAX_TERMS, MAX_NODES = 120, 201
# Radii of discs and zones of measured corneas, and their depths: every real eye is well within.
Reach = Annotated[float, Field(ge=0.5, le=20.0)]
Depth = Annotated[float, Field(ge=-30.0, le=30.0)]
# Germanium has the highest index, 4, of all materials that are transparent somewhere in the infrared.
LARGEST_INDEX = 5.0
# Cauchy's coefficients grow with the sixth power of nanometres.
Coefficient = Annotated[float, Field(ge=-1e20, le=1e20)]

Facing = Literal["front", "back"]


class SphereSpec(Spec):
    """Sphere y^2 + z^2 + 2 R s + s^2 = 0 from the apex; R > 0 opens to -x (cornea), R < 0 to +x (lens back, retina)."""

    kind: Literal["sphere"] = Field(description="the shape")
    radius_mm: Number = Field(description="signed radius of curvature")


class ConicSpec(Spec):
    """Conic y^2 + z^2 + 2 R s + (1 + Q) s^2 = 0 from the apex, on the sheet through the apex."""

    kind: Literal["conic"] = Field(description="the shape")
    radius_mm: Number = Field(description="signed radius of curvature at the apex")
    conic_constant: Number = Field(description="Q; 0 is a sphere, between -1 and 0 a prolate ellipsoid")


class BiconicSpec(Spec):
    """Biconic: two apex radii and conic constants, for the meridians of y and z."""

    kind: Literal["biconic"] = Field(description="the shape")
    radii_mm: Vec2 = Field(description="signed radii of curvature at the apex, in the meridians of y and z")
    conic_constants: Vec2 = Field(description="Q in the meridians of y and z")


class EllipsoidSpec(Spec):
    """Ellipsoid (x/a)^2 + (y/b)^2 + (z/c)^2 = 1 about its centre; the half towards +x ('front') or -x ('back')."""

    kind: Literal["ellipsoid"] = Field(description="the shape")
    semi_axes_mm: tuple[Positive, Positive, Positive] = Field(description="semi-axes a, b, c along x, y and z")
    side: Facing = Field(default="front", description="the half that is the surface")


class QuadricSpec(Spec):
    """Quadric A x^2 + B y^2 + C z^2 + 2 D xy + 2 E xz + 2 F yz + 2 G x + 2 H y + 2 I z + K = 0 about its position.

    The sheet is where dF/dx > 0 ('front') or < 0 ('back') with the coefficients as given.
    """

    kind: Literal["quadric"] = Field(description="the shape")
    coefficients: tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number, Number] = Field(
        description="A, B, C, D, E, F, G, H, I and K of the equation, with lengths in mm"
    )
    side: Facing = Field(default="front", description="the sheet that is the surface")


class ZernikeSpec(Spec):
    """Zernike terms on a conic: x = conic(y, z) - sum_j c_j Z_j(y / r, z / r), shifted to x = 0 at the position.

    The terms are orthonormal on the disc of radius r, in the standard order of OSA/ANSI: j = (n (n + 2) + m) /
    2, the angle counted from +y (nasal) towards +z (up). Coefficients are depths, positive into the eye. Beyond the
    measured zone a biconic continues the surface, see `zone_radius_mm`.
    """

    kind: Literal["zernike"] = Field(description="the shape")
    radius_mm: Reach = Field(description="r, the radius of the disc on which the terms are orthonormal")
    coefficients_mm: tuple[Depth, ...] = Field(
        min_length=1, max_length=MAX_TERMS, description="c_0, c_1, ..., depths; order 14 at most"
    )
    base_radius_mm: float | None = Field(
        default=None,
        ge=-1000.0,
        le=1000.0,
        description="signed radius of curvature of the conic at its apex; default: a plane",
    )
    base_conic_constant: float = Field(default=0.0, ge=-20.0, le=20.0, description="Q of the conic")
    zone_radius_mm: Reach | None = Field(
        default=None,
        description="radius of the measured zone; between 0.75 and 1.15 of it a biconic takes over; default: r",
    )


class TopographySpec(Spec):
    """A file of measured points: a table (CSV) or a mesh (PLY), with its axes and units."""

    path: str = Field(min_length=1, max_length=1024, description="file, relative to the eye file")
    layout: Literal["points", "polar", "matrix", "mesh"] = Field(
        description="`points`: columns x, y, z; `polar`: columns radius, angle (deg, from x to y), z; `matrix`: x in "
        "the first row, y in the first column, z in the cells; `mesh`: the vertices of a PLY file"
    )
    columns: tuple[str | int, str | int, str | int] | None = Field(
        default=None,
        description="names of the three columns, or their numbers from 0 in a table without a header; default: 0, 1, 2",
    )
    x: Literal["nasal", "temporal"] = Field(description="where the file's x axis points")
    y: Literal["up", "down"] = Field(description="where the file's y axis points")
    z: Literal["out", "in"] = Field(description="where the file's z axis points: out of the eye (heights) or into it")
    unit: Literal["mm", "um", "m"] = Field(description="unit of x, y and radius")
    z_unit: Literal["mm", "um", "m"] | None = Field(default=None, description="unit of z; default: that of x")
    centre: Vec2 = Field(default=(0.0, 0.0), description="place (x, y) of the eye's axis in the file, in its unit")
    spacing_mm: float = Field(default=0.2, ge=0.02, le=2.0, description="spacing of the grid that is fitted")
    smoothing: float = Field(
        default=0.0,
        ge=0.0,
        le=1e6,
        description="weight of the penalty on third differences of the grid, against the squares of the deviations; "
        "0 passes through the points as far as the grid can",
    )


class GridSpec(Spec):
    """A square grid of depths x over (y, z): a bicubic surface with continuous curvature, shifted to its position.

    The rows run from low z to high z, and each runs from temporal to nasal (+y). Their number is odd, and the middle
    lies on the axis. `file` stands in place of `heights_mm` and is read with the eye file.
    """

    kind: Literal["grid"] = Field(description="the shape")
    spacing_mm: float | None = Field(default=None, ge=0.02, le=2.0, description="spacing of the grid")
    heights_mm: tuple[tuple[Depth, ...], ...] | None = Field(
        default=None, min_length=5, max_length=MAX_NODES, description="x of the surface, row by row"
    )
    zone_radius_mm: Reach | None = Field(
        default=None,
        description="radius of the measured zone; between 0.75 and 1.15 of it a biconic takes over; default: so that "
        "1.15 of it is half of the grid's width",
    )
    file: TopographySpec | None = Field(default=None, description="measured points, in place of the heights")


class PlaneSpec(Spec):
    """Plane x = 0 of its frame."""

    kind: Literal["plane"] = Field(description="the shape")


ShapeSpec = Annotated[
    SphereSpec | ConicSpec | BiconicSpec | EllipsoidSpec | QuadricSpec | PlaneSpec | ZernikeSpec | GridSpec, ByKind()
]


class MediumSpec(Spec):
    """A medium: a constant `index`, or `cauchy` = (c0, c1, c2, c3), n = c0 + c1/l^2 + c2/l^4 + c3/l^6, l in nm."""

    index: float | None = Field(
        default=None, ge=1.0, le=LARGEST_INDEX, description="refractive index at every wavelength"
    )
    cauchy: tuple[Coefficient, Coefficient, Coefficient, Coefficient] | None = Field(
        default=None, description="c0, c1, c2 and c3 of Cauchy's formula"
    )


class PlacedSpec(Spec):
    """A shape in the eye: its apex at `position_mm` (a quadric's origin), turned about it by `tilt_deg`.

    The angles (t_x, t_y, t_z) about the axes make the rotation Rz(t_z) Ry(t_y) Rx(t_x).
    """

    shape: ShapeSpec = Field(description="the form of the surface")
    position_mm: Vec3 = Field(default=(0.0, 0.0, 0.0), description="place of the apex in the eye")
    tilt_deg: Vec3 = Field(default=(0.0, 0.0, 0.0), description="angles t_x, t_y and t_z about the axes")


class SurfaceSpec(PlacedSpec):
    """A refracting surface and the medium behind it."""

    name: str = Field(default="", description="name of the surface, for reports")
    medium: MediumSpec = Field(description="the medium behind the surface")


class SurfaceLensSpec(Spec):
    """A lens of homogeneous media; the last medium is the vitreous."""

    kind: Literal["surfaces"] = Field(description="the kind of lens")
    surfaces: tuple[SurfaceSpec, ...] = Field(
        min_length=1, max_length=MAX_SURFACES, description="surfaces behind the stop, from outside in"
    )


class LayerSpec(Spec):
    """A shell of a lens and the medium inside it.

    The shell is the lens' outer surface scaled by `size` about the lens' centre. Inside it the index has changed by
    `index_share` of the way from edge to core.
    """

    size: float = Field(gt=0.0, le=1.0, description="size of the shell, as a share of the lens' outer surface")
    index_share: float = Field(
        ge=0.0, le=1.0, description="share of the way from the index of the edge to that of the core"
    )


class GradientLensSpec(Spec):
    """A gradient-index lens.

    Its surfaces of constant index are the outer surfaces scaled by p in (0, 1] about the lens' centre: n(p) = n_core -
    (n_core - n_edge) p^2. The centre is at `centre_mm`, or on the line between the two apexes at `centre_fraction` of
    it, counted from the front. Rays are traced through the gradient itself, or through the given number of `shells` in
    each half: shell k is where n has changed by k / shells from edge to core, and the medium inside it has the index
    half a step farther. `layers` instead of `shells` gives the size and the index of each shell, from outside in.
    """

    kind: Literal["gradient"] = Field(description="the kind of lens")
    front: PlacedSpec = Field(description="front surface")
    back: PlacedSpec = Field(description="back surface")
    edge: MediumSpec = Field(description="medium at the outer surfaces")
    core: MediumSpec = Field(description="medium at the centre")
    vitreous: MediumSpec = Field(description="medium behind the lens")
    shells: int | None = Field(
        default=None,
        ge=1,
        le=200,
        description="number of shells in each half; default: rays are traced through the gradient",
    )
    centre_fraction: float = Field(
        default=0.4, gt=0.0, lt=1.0, description="place of the centre between the two apexes, counted from the front"
    )
    centre_mm: Vec3 | None = Field(default=None, description="place of the centre, in place of a fraction")
    layers: tuple[LayerSpec, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=MAX_SURFACES // 2,
        description="shells with sizes and indices of their own, from outside in",
    )


Lens = Annotated[SurfaceLensSpec | GradientLensSpec, ByKind()]


class ContourSpec(Spec):
    """A margin that is not an ellipse: the ellipse times r(f) = 1 + sum_k c_k cos(k f) + s_k sin(k f), k from 1.

    f is the ellipse's parameter from its first semi-axis (nasal where it is not turned) towards up, and r (a cos f, b
    sin f) is the margin. c_k and s_k are the Fourier coefficients of a measured pupil's radius over its mean (Wyatt
    1995, "The form of the human pupil", Vision Res. 35, 2021-2036). The shorter list is padded with zeros.
    """

    cosines: tuple[Number, ...] = Field(default=(), max_length=32, description="c_1, c_2, ...")
    sines: tuple[Number, ...] = Field(default=(), max_length=32, description="s_1, s_2, ...")


class StopSpec(Spec):
    """The anatomical pupil: an ellipse in a plane, or a `contour` about one.

    `ellipticity` = 1 - b/a at the area of the circle of `diameter_mm`; the long axis lies `axis_deg` from nasal
    towards up. A pupil of another diameter d is centred at position_mm + (s_x, s_y, s_z) (d - diameter_mm), (s_y, s_z)
    = `shift_mm_per_mm`. s_x follows from the condition that the pupil stays in its plane.
    """

    diameter_mm: Positive = Field(description="diameter of the circle of equal area")
    position_mm: Vec3 = Field(description="centre of the pupil of this diameter")
    tilt_deg: Vec3 = Field(default=(0.0, 0.0, 0.0), description="angles t_x, t_y and t_z of its plane about the axes")
    ellipticity: float = Field(default=0.0, ge=0.0, lt=1.0, description="1 - b/a")
    axis_deg: Number = Field(default=0.0, description="direction of the long axis, from nasal towards up")
    shift_mm_per_mm: Vec2 = Field(
        default=(0.0, 0.0), description="shift of the centre, nasal and up, per mm of diameter"
    )
    contour: ContourSpec | None = Field(default=None, description="a margin that is not an ellipse")


class IrisSpec(Spec):
    """The iris: the annulus in the pupil's plane out to `root_radius_mm` from the eye's axis."""

    root_radius_mm: Positive = Field(description="outer radius, from the eye's axis")


class ScleraSpec(Spec):
    """A sphere. Without a centre, it is the one through the limbus circle with its centre on the cornea's axis."""

    radius_mm: Positive = Field(description="radius of the sphere")
    centre_mm: Vec3 | None = Field(
        default=None, description="centre; default: on the cornea's axis, so that the sphere passes through the limbus"
    )


class RotationSpec(Spec):
    """Centres of rotation: azimuth (about z), elevation (about y), torsion (about x)."""

    azimuth_centre_mm: Vec3 = Field(description="point on the vertical axis of rotation")
    elevation_centre_mm: Vec3 = Field(description="point on the horizontal axis of rotation")
    torsion_centre_mm: Vec3 = Field(default=(0.0, 0.0, 0.0), description="point on the axis of torsion")


class FoveaSpec(Spec):
    """Place of the fovea: `position_mm`, or the point where a nodal ray meets the retina.

    The nodal ray comes from the field direction (1, tan h, tan v), (h, v) = `field_deg` nasal and up, seen from the
    incident node, from an object `distance_mm` from the corneal apex.
    """

    field_deg: Vec2 = Field(default=(0.0, 0.0), description="direction (h, v) of the nodal ray, nasal and up")
    distance_mm: Positive = Field(default=1500.0, description="distance of the object from the corneal apex")
    position_mm: Vec3 | None = Field(default=None, description="place of the fovea, in place of a direction")


class EyeParts(FileSpec):
    """The keys of an eye file; `EyeSpec` also checks the geometry that they describe.

    `sources` maps a dotted path (or the beginning of one) to the source of its values.
    """

    FORMAT: ClassVar[int] = 3

    format: int = Field(default=FORMAT, description="version of this file format")
    name: str = Field(description="name of the model")
    description: str = Field(default="", description="description of the model, in a sentence")
    biometry: BiometrySpec | None = Field(
        default=None,
        description="numbers of a biometer in place of the keys that follow from them; all other keys may be left out",
    )
    cornea: tuple[SurfaceSpec, ...] = Field(
        min_length=1, max_length=MAX_SURFACES, description="surfaces between air and the stop"
    )
    toric_axis: Literal["same"] | None = Field(
        default=None,
        description="`same`: the front cornea of the left eye has its meridians at the axes of the right one's, as an "
        "examiner sees them; default: it is the mirror image, so that an axis of 20 deg is one of 160 in the left eye",
    )
    lens: Lens | None = Field(default=None, description="the lens; without one the eye has a cornea only")
    retina: PlacedSpec = Field(description="the surface on which the fovea lies")
    stop: StopSpec = Field(description="the anatomical pupil")
    limbus_radius_mm: Positive = Field(default=5.85, description="radius of the circle where cornea and sclera meet")
    iris: IrisSpec = Field(description="the iris")
    sclera: ScleraSpec = Field(default=ScleraSpec(radius_mm=12.0), description="the white of the eye")
    rotation: RotationSpec = Field(description="the centres of rotation")
    fovea: FoveaSpec = Field(description="the place of the fovea")
    sources: dict[str, str] = Field(
        default_factory=dict, description="dotted path, or the beginning of one -> source of its values"
    )
