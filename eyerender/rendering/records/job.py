"""Frame parameters from eye, pose, camera, lamps and appearance: on the host, in float64, without Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import ArrayValue, Body, Bools, Floats, frozen, remembered, sealed
from ...base.errors import InputError
from ...eye.entrance import entrance_pupil
from ...eye.frames import frame_body
from ...eye.fundus import FundusLight, Spread, fundus_light
from ...eye.legs import air_legs, apparent_places
from ...eye.model import EyeModel
from ...eye.worn import WornLens, choices
from ...optics.media import TEARS
from ...optics.surfaces import Surface
from ...optics.surfaces_graph import Biconic
from ...optics.surfaces_measured import Measured
from ...optics.surfaces_quadric import Quadric
from ...optics.transforms import rotated
from ...region.anatomy import Region
from ...region.globe import Globe
from ...region.limbus import upwards
from ...region.look import Look
from ...region.mesh import RegionMesh
from ...region.texture import film_ripples
from ...rig.camera import PinholeCamera, Window
from ...rig.distortion import ray_polynomials
from ...rig.imaging import Ambient, Lens
from ...rig.light import Lamp
from ...rig.sensor import Sensor
from ...scene.viewer import past_lenses
from .lattice import lattice
from .parameters import (
    CameraParameters,
    ImageParameters,
    IrisParameters,
    Kind,
    LensParameters,
    LimbusParameters,
    Parameters,
    PoseParameters,
    ScleraParameters,
    StopParameters,
    SurfaceParameters,
)

_SENSOR, _LOOK, _LENS, _AMBIENT = Sensor(), Look(), Lens(), Ambient()
_SUN_MM = 1e6
_APEX = (np.zeros((1, 1)),) * 3
_LENS_REACH_MM = 40.0  # a lens is not larger
_POINT_LIKE, _NARROW, _LARGE = 0.015, 0.05, 0.25  # radius of a lamp over its distance
_PANEL_PARTS = 4  # parts of a panel along each side
_GLOBE_CENTRE_MM = np.array([-13.5, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RenderJob(ArrayValue):
    """One window of one exposure to render."""

    eye: EyeModel
    M: Floats  # (3, 3) rotation of its rigid motion x_world = M x + t
    t: Floats  # (3,) translation of that motion, mm
    camera: PinholeCamera
    window: Window  # (x0, y0, width, height) in full-sensor pixels
    lights: tuple[Lamp, ...]
    sensor: Sensor = _SENSOR
    look: Look = _LOOK  # albedos and textures
    wavelength_nm: float = 850.0  # wavelength in vacuum
    seed: int = 0  # seed of samples and noise
    labels: bool = True  # whether to compute raster labels
    purkinje: tuple[int, ...] = (1,)  # mirror images of the lamps to show, from 1 (the glint) to 4
    # (3,) apex of the unrotated eye in the world, to which the surround is fixed. By default it follows from a turn
    # about a point 13.5 mm behind the apex
    apex_mm: Floats | None = None
    region: Region | None = None  # the eye region; None for the bare eye
    posed: RegionMesh | None = None  # the region's mesh, where moments of an exposure share it; None: that of this pose
    lens: Lens = _LENS  # focus and vignetting
    ambient: Ambient = _AMBIENT  # light other than that of the lamps
    focus_dpt: float = 0.0  # vergence (D) of the point in focus, 1 / its distance in metres
    mesh_edge_mm: float | None = None  # edge length of meshes that replace the cornea's surfaces; None: closed forms
    interreflection: bool = True  # whether surfaces illuminate each other
    highlights: bool = False  # whether to find the highlights of wet and oily surfaces
    annotated: bool = False  # whether to compute the mask that people would draw
    geometry: tuple[str, ...] = ()  # kinds of geometry to find: depth, normals, iris_coordinates, instances
    flip: bool = False  # whether to turn the window left to right in the end; camera and window are those before
    # bodies in the world that hide and shade the eye; they send no light to other surfaces
    obstacles: tuple[Body, ...] = ()

    @property
    def anchor_mm(self) -> Floats:
        """Origin of the scene's frame in the world: the apex of the unrotated eye, (3,) mm."""
        if self.apex_mm is not None:
            return np.asarray(self.apex_mm, dtype=float)
        return np.asarray(rotated(self.M, _GLOBE_CENTRE_MM) + self.t - _GLOBE_CENTRE_MM)

    @property
    def turned_lenses(self) -> tuple[WornLens, ...]:
        """Worn lenses in the frame of the turned eye, in order from it."""
        return tuple(lens.behind(self.M, self.t - self.anchor_mm) for lens in self.eye.worn)

    def viewer(self, *, thorough: bool = False) -> PinholeCamera:
        """Return the camera, which sees what surrounds the eye past the lenses worn (see `viewer`)."""
        return past_lenses(self.camera, self.eye.worn, self.anchor_mm, thorough=thorough)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Obstacles in the scene's frame."""
        anchor = self.anchor_mm if self.obstacles else 0.0
        return tuple(replace(body, vertices=sealed(body.vertices - anchor)) for body in self.obstacles)

    @property
    def globe(self) -> Globe:
        """Posed globe in the scene's frame, with what stands before it."""
        globe = globe_of(self.eye, self.M, self.t - self.anchor_mm)
        return replace(globe, frames=(*globe.frames, *self.bodies)) if self.obstacles else globe

    @property
    def film_index(self) -> float:
        """Refractive index at the front of the cornea."""
        return film_index(self.eye, self.look)


def film_index(eye: EyeModel, look: Look) -> float:
    """Return the refractive index at the front of the cornea: tears, or the cornea itself without a tear film."""
    return TEARS.index(eye.wavelength_nm) if look.tear_film else float(eye.front_indices[0])


def globe_of(eye: EyeModel, M: Floats, t: Floats) -> Globe:
    """Return the posed globe of an eye; p = M x + t maps to the frame of the unrotated eye."""
    sclera = eye.sclera
    return Globe(
        cornea=eye.front[0],
        limbus_radius_mm=float(eye.limbus_radius_mm),
        centre_mm=np.asarray(sclera.centre_mm),
        radius_mm=float(sclera.radius_mm),
        M=M,
        t=t,
        mirrored=eye.side == "left",
        frames=tuple(body for lens in eye.worn if (body := frame_body(lens)) is not None),
    )


def lens_kinds(eye: EyeModel) -> tuple[tuple[Kind, Kind], ...]:
    """Return the kinds of front and back of each worn lens, from outside inwards."""
    return tuple((_kind(lens.front), _kind(lens.back)) for lens in eye.worn[::-1])


def kinds(eye: EyeModel) -> tuple[tuple[Kind, bool], ...]:
    """Return the kind of each refracting surface in front of the iris, and whether it is tilted."""
    return tuple((_kind(s), not np.array_equal(s.rotation, np.eye(3))) for s in eye.front)


def _kind(surface: Surface) -> Kind:
    return "biconic" if isinstance(surface, Biconic) else "measured" if isinstance(surface, Measured) else "quadric"


def tables(eye: EyeModel) -> tuple[NDArray[np.float32] | None, ...]:
    """Return spline coefficients of the measured surfaces in front of the iris; None for other surfaces."""
    return tuple(lattice(s, float(eye.limbus_radius_mm)).table if isinstance(s, Measured) else None for s in eye.front)


def _corner(camera: PinholeCamera) -> float:
    """Compute the distance of the farthest corner of the sensor from the principal point, in focal lengths."""
    ends = np.array([[-0.5, -0.5], np.array(camera.resolution_px) - 0.5]) - camera.K[:2, 2]
    return float(np.hypot(*(np.abs(ends).max(axis=0) / np.diag(camera.K)[:2])))


def parameters_of(job: RenderJob) -> Parameters:
    """Compute the parameters of a frame on the host."""
    eye, look, anchor, camera = job.eye, job.look, job.anchor_mm, job.camera
    still, wide = _still(eye), camera.is_fisheye
    surfaces = (replace(still.surfaces[0], film=1 / job.film_index), *still.surfaces[1:])
    stop, sclera = eye.stop, eye.sclera
    return Parameters(
        surfaces=surfaces,
        inner_index=float(eye.front_indices[-1]),
        stop=StopParameters(
            centre=stop.centre_mm,
            normal=stop.rotation[:, 0],
            u=stop.rotation[:, 1],
            v=stop.rotation[:, 2],
            axes=tuple(stop.semi_axes_mm),
        ),
        iris=IrisParameters(
            root_radius=eye.iris_root_radius_mm,
            albedo=look.iris_albedo,
            contrast=look.iris_contrast,
            ring=look.limbal_ring,
            relief=look.iris.relief,
            convexity=look.iris.convexity_mm,
        ),
        limbus=LimbusParameters(
            radius=eye.limbus_radius_mm,
            floor=still.floor,
            gain=1 / max(look.limbus_width_mm, 1e-6),
            albedo=look.limbus_albedo,
            up=tuple(upwards(eye.front[0])),
            lowering=1 / look.limbus_aspect**2 - 1,
            bulge=still.bulge,
            bulge_radius=still.bulge_radius,
        ),
        sclera=ScleraParameters(
            centre=sclera.centre_mm,
            radius=sclera.radius_mm,
            albedo=look.sclera_albedo,
            contrast=look.sclera_contrast,
            ripples=film_ripples(look.iris_seed) if look.film_ripples is None else look.film_ripples,
        ),
        image=still.image,
        pose=PoseParameters((job.M[:, 0], job.M[:, 1], job.M[:, 2]), job.t - anchor),
        camera=CameraParameters(
            centre=camera.nodal_point_mm - anchor,
            right=camera.sensor_axes[0],
            down=camera.R[1],
            forward=camera.R[2],
            focal=(camera.K[0, 0], camera.K[1, 1]),
            principal=(camera.K[0, 2], camera.K[1, 2]),
            distortion=tuple(camera.distortion),
            polynomials=ray_polynomials(tuple(camera.distortion.tolist()), 1.1 * _corner(camera)) if wide else (),
        ),
        pupil_albedo=look.pupil_albedo,
        globe_reach=still.globe_reach,
        backdrop_x=-look.backdrop_distance_mm,
        ambient_irradiance=job.ambient.irradiance_w_m2 * 1e-3,
        lenses=tuple(_lens_parameters(lens) for lens in job.eye.worn[::-1]),
        turned_lenses=tuple(_lens_parameters(lens) for lens in job.turned_lenses[::-1]),
    )


def _lens_parameters(lens: WornLens) -> LensParameters:
    """Return the parameters of a lens; its own transmittance replaces that at normal incidence."""
    n, (front, back) = lens.index, (lens.front, lens.back)
    bare = ((n - 1.0) / (n + 1.0)) ** 2
    first, second = lens.reflectances or (bare, bare)
    gain = lens.transmission * (1.0 - first) * (1.0 - second) / (1.0 - first * second) / (1.0 - bare) ** 2
    return LensParameters(
        front=_surface_parameters(front, 1.0 / n, np.inf),
        back=_surface_parameters(back, n, np.inf),
        centre=lens.centre_mm,
        axes=(lens.rotation[:, 0], lens.rotation[:, 1], lens.rotation[:, 2]),
        half=lens.half_mm,
        reach=float(np.linalg.norm(lens.centre_mm)) + _LENS_REACH_MM,
        gain=gain,
        edge=float(n == 1.0),
        reflectances=lens.reflectances or (-1.0, -1.0),
        transmission=lens.transmission,
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SubFrames(ArrayValue):
    """Moments of an exposure that share its rows."""

    jobs: tuple[RenderJob, ...]  # the jobs, whose pictures have equal weights
    rows: Floats | None = None  # (height,) share of the whole exposure of each row of the window; None: all of it
    # part (x0, y0, width, height) of the sensor beyond which all moments have the same picture under the same lamps;
    # None: they differ everywhere
    moving: Window | None = None
    labelled: Bools | None = None  # (height,) rows whose raster labels the first job gives; None: none


@dataclass(frozen=True, slots=True, kw_only=True)
class _Still:
    """Parameters that depend on the eye only; surfaces have no tear film."""

    surfaces: tuple[SurfaceParameters, ...]
    image: ImageParameters
    floor: float
    bulge: Floats
    bulge_radius: float
    globe_reach: float


@remembered
def _still(eye: EyeModel) -> _Still:
    indices = np.asarray(eye.front_indices, dtype=float)
    surfaces = tuple(
        _surface_parameters(surface, before / index, float(eye.limbus_radius_mm))
        for surface, index, before in zip(eye.front, indices, [1.0, *indices[:-1]], strict=True)
    )
    front, sclera = eye.front[0], eye.sclera
    entrance_mm, magnification = entrance_pupil(eye)
    angle = np.linspace(0, 2 * np.pi, 64)
    edge = front.sag(eye.limbus_radius_mm * np.cos(angle), eye.limbus_radius_mm * np.sin(angle))
    ring = eye.limbus_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim = front.origin_mm + np.column_stack([edge, ring]) @ np.asarray(front.rotation).T
    bulge = 0.5 * (rim.mean(axis=0) + apex_of(front))
    cornea_reach = float(np.linalg.norm(apex_of(front) - sclera.centre_mm))
    return _Still(
        surfaces=surfaces,
        image=ImageParameters(magnification, float(entrance_mm[0] - eye.stop.centre_mm[0])),
        floor=float(np.min(edge)) - 2.0,
        bulge=bulge,
        bulge_radius=float(np.max(np.linalg.norm(rim - bulge, axis=1))) + 0.05,
        globe_reach=max(float(sclera.radius_mm), cornea_reach) + 0.5,
    )


def _surface_parameters(surface: Surface, eta: float, limbus_mm: float) -> SurfaceParameters:
    rotation = np.asarray(surface.rotation)
    axes = None if np.array_equal(rotation, np.eye(3)) else (rotation[:, 0], rotation[:, 1], rotation[:, 2])
    return SurfaceParameters(origin=surface.origin_mm, shape=tuple(_shape(surface, limbus_mm)), eta=eta, axes=axes)


def boundary_waves(eye: EyeModel) -> Floats:
    """Compute Fourier coefficients (k, 2), c_k and -s_k, of the pupil's relative radius over the stop plane's angle.

    For a left eye the stop's own angle runs in the opposite direction: f' = pi - f, cos(k f') = (-1)^k cos(k f), sin(k
    f') = -(-1)^k sin(k f).
    """
    cosines, sines = np.asarray(eye.stop.contour, dtype=float)
    if float(eye.stop.handed) < 0:
        turned = (-1.0) ** np.arange(1, len(cosines) + 1)
        cosines, sines = turned * cosines, -turned * sines
    return np.stack([cosines, -sines], axis=1)


def panel_table(ambient: Ambient, anchor: Floats) -> Floats:
    """Return panels in the scene's frame, (n, 13): centre, normal, right, up (over half sizes), radiance."""
    rows = []
    for panel in ambient.panels:
        centre = np.asarray(panel.centre_mm, dtype=float) - anchor
        normal, right, up = panel.axes()
        w, h = panel.size_mm
        rows.append([*centre, *normal, *(2 / w * right), *(2 / h * up), panel.radiance_w_m2_sr * 1e-3])
    return np.reshape(rows, (-1, 13))


def panel_lamps(ambient: Ambient, anchor: Floats) -> tuple[Lamp, ...]:
    """Divide panels into lamps that light the iris through the cornea: each part is Lambertian, at its centre."""
    out = []
    for panel, row in zip(ambient.panels, panel_table(ambient, anchor), strict=True):
        centre, normal = row[0:3] + anchor, row[3:6]
        right, up = (v / (v @ v) for v in (row[6:9], row[9:12]))
        share = (2 * np.arange(_PANEL_PARTS) + 1) / _PANEL_PARTS - 1
        intensity = panel.radiance_w_m2_sr * 1e-3 * np.prod(panel.size_mm) / _PANEL_PARTS**2
        out += [
            Lamp(
                position_mm=frozen(centre + a * right + b * up),
                axis=frozen(normal),
                radius_mm=0.0,
                intensity_mw_sr=float(intensity),
                lobe_exponent=1.0,
            )
            for a in share
            for b in share
        ]
    return tuple(out)


def sun_lamps(ambient: Ambient, anchor: Floats) -> tuple[Lamp, ...]:
    """Return the sun, if there is one, as a lamp: a uniform disc at a distance of a kilometre."""
    if ambient.sun is None or ambient.sun.irradiance_w_m2 == 0:
        return ()
    sun = ambient.sun
    az, el, half = np.radians([sun.azimuth_deg, sun.elevation_deg, sun.diameter_deg / 2])
    way = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    return (
        Lamp(
            position_mm=frozen(anchor + _SUN_MM * way),
            axis=frozen(-way),
            radius_mm=float(_SUN_MM * np.tan(half)),
            intensity_mw_sr=float(sun.irradiance_w_m2 * 1e-3 * (_SUN_MM / np.cos(half)) ** 2),
            lobe_exponent=1.0,
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class LampTable(ArrayValue):
    """Lamps in the eye frame, on the host."""

    rows: Floats  # (n, 10) position, axis, radius, intensity, lobe exponent, inner radius
    suns: int = 0  # 1 if the last lamp is the sun, else 0

    @classmethod
    def of(cls, lights: Sequence[Lamp], M: Floats, t: Floats, suns: int = 0) -> LampTable:
        """Create the table from lamps in the world for an eye at x_world = M x + t."""
        rows = [
            [*rotated(M.T, lamp.position_mm - t), *rotated(M.T, lamp.axis), lamp.radius_mm, lamp.intensity_mw_sr,
             lamp.lobe_exponent, lamp.inner_radius_mm]
            for lamp in lights
        ]  # fmt: skip
        return cls(np.reshape(rows, (-1, 10)), suns)

    def lit_through(self, lenses: Sequence[WornLens]) -> Bools:
        """Return which lamps light the eye's apex through the lenses in its frame, (n,).

        Raises:
            InputError: a lamp lights it through one of two lenses only.
        """
        x, y, z = self.rows[:, 0], self.rows[:, 1], self.rows[:, 2]
        status = air_legs([lens.take(None) for lens in lenses], _APEX, (x[None], y[None], z[None]))
        passed = status.passed[0]
        if ((passed > 0) & (passed < len(choices(len(lenses))) - 1)).any():
            raise InputError("are rendered only where each lamp passes all lenses or none", path="subject.spectacles")
        return np.asarray(passed == 0)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def widths(self) -> Floats:
        """Radius of each lamp over its distance from the apex of the eye, (n,)."""
        return np.asarray(self.rows[:, 6] / np.maximum(np.linalg.norm(self.rows[:, :3], axis=1), 1e-3))

    @property
    def widest(self) -> float:
        """Largest of the `widths`."""
        return float(np.max(self.widths, initial=0.0))

    @property
    def points(self) -> int:
        """Number of points that represent each lamp at grid nodes: its middle, or four around it."""
        return 1 if self.widest < _POINT_LIKE and not np.any(self.rows[:, 9] > 0) else 4

    @property
    def points_on_relief(self) -> int:
        """Number of points that represent each lamp on the iris relief, whose own shadows are soft."""
        return 1 if self.widest < _NARROW else 4

    @property
    def gridded(self) -> bool:
        """Whether the lamps are small enough for light interpolated on grids."""
        return self.widest < _LARGE


def returned_light(job: RenderJob) -> FundusLight:
    """Return the fundus factors for the lamps of a job."""
    fundus = job.look.fundus
    spread = Spread(
        reflectance=fundus.reflectance,
        halo_share=fundus.halo_share,
        halo_rad=float(np.radians(fundus.halo_deg)),
        blur_rad=float(np.radians(fundus.blur_deg)),
        disc_gain=fundus.disc_gain,
    )
    lamps = LampTable.of(job.lights, job.M, job.t).rows[:, :3]
    camera = rotated(job.M.T, job.camera.nodal_point_mm - job.t)
    if job.eye.worn:
        lamps, camera = apparent_places(job.turned_lenses, lamps), apparent_places(job.turned_lenses, camera[None])[0]
    return fundus_light(job.eye, lamps, camera, job.focus_dpt, spread)


def _shape(surface: Surface, limbus_mm: float) -> Floats:
    if isinstance(surface, Measured):
        return np.array(lattice(surface, limbus_mm).shape)
    if isinstance(surface, Biconic):
        return np.array([*surface.radii_mm, *(1 + np.asarray(surface.conic_constants)), 0.0])
    if not isinstance(surface, Quadric):
        raise InputError(f"a surface of kind {surface.kind} cannot be rendered")
    A, b = np.asarray(surface.matrix), np.asarray(surface.vector)
    if np.any(np.diag(np.diag(A)) != A) or b[1] != 0 or b[2] != 0:
        raise InputError("a quadric whose axes differ from those of its frame cannot be rendered")
    return np.array([*np.diag(A), b[0], float(surface.constant)])


def apex_of(surface: Surface) -> Floats:
    """Return the apex of a surface in the eye frame, (3,) mm."""
    return np.asarray(surface.origin_mm + surface.rotation[:, 0] * float(surface.sag(0.0, 0.0)))
