"""The rigs, looks and jobs that the tests of this room share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from eyerender.base.arrays import OBSTACLE, Body
from eyerender.eye.catalogue import load_eye
from eyerender.eye.model import EyeModel
from eyerender.eye.pose import Poses, rigid_motion
from eyerender.region.look import Fundus, IrisPattern, Look
from eyerender.rig.camera import Camera, PinholeCamera
from eyerender.rig.light import Lamp, Led, LedRing
from eyerender.rig.sensor import Sensor

if TYPE_CHECKING:
    from eyerender.rendering.output.window import RenderedWindow
    from eyerender.rendering.records.job import RenderJob
    from eyerender.rendering.renderer import Renderer

MODELS = ("E1", "E2", "E3", "E4", "E5")
NO_FUNDUS = Fundus(reflectance=0.0)
FLAT_IRIS = IrisPattern(relief=0.0, convexity_mm=0.0)
BLACK = Look(
    fundus=NO_FUNDUS,
    iris_albedo=0.0,
    pupil_albedo=0.0,
    sclera_albedo=0.0,
    limbus_albedo=0.0,
    backdrop_albedo=0.0,
    limbus_width_mm=0.0,
    limbus_transmittance=0.0,
    iris=FLAT_IRIS,
)
PLAIN = Look(
    fundus=NO_FUNDUS,
    pupil_albedo=0.02,
    iris_contrast=0.0,
    sclera_contrast=0.0,
    backdrop_contrast=0.0,
    limbus_transmittance=0.0,
    iris=FLAT_IRIS,
)


@dataclass(frozen=True)
class LampRig:
    """A camera with its lamps, and the pixel that the apex of an unrotated eye at the origin falls on."""

    camera: PinholeCamera
    lights: tuple[Lamp, ...]

    def window(self, width: int, height: int, centre_px: Any = None) -> tuple[int, int, int, int]:
        """A window of the sensor about the apex, or about a pixel."""
        u, v = self.camera.project(np.zeros(3))[0] if centre_px is None else centre_px
        return round(u - (width - 1) / 2), round(v - (height - 1) / 2), width, height


def remote_rig(radius_mm: float = 2.5) -> LampRig:
    """The remote tracker of Blignaut (2014) with a strong LED."""
    camera = Camera(
        resolution_px=(1600, 1200), position_mm=(520.0, 0.0, -300.0), tilt_deg=30.0, focal_length_px=3571.43
    ).build()
    light = Led(position_mm=(560.0, 0.0, -250.0), radius_mm=radius_mm, aim_mm=(0, 0, 0), intensity_mw_sr=450.0)
    return LampRig(camera, light.build((camera,)))


def head_rig(radius_mm: float = 0.5, count: int = 6) -> LampRig:
    """A camera 35 mm from the apex, 25 degrees below and 15 degrees temporal, in a ring of LEDs."""
    a, b = np.radians(25.0), np.radians(15.0)
    place = 35.0 * np.array([np.cos(a) * np.cos(b), -np.cos(a) * np.sin(b), -np.sin(a)])
    camera = Camera(
        resolution_px=(640, 480), position_mm=tuple(place), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=600.0
    ).build()
    light = Led(ring=LedRing(radius_mm=12.0, count=count), radius_mm=radius_mm, aim_mm=(0, 0, 0), intensity_mw_sr=0.3)
    return LampRig(camera, light.build((camera,)))


RIGS: dict[str, Callable[..., LampRig]] = {"remote": remote_rig, "head": head_rig}


def eye_of(model: str, side: str = "right", pupil_mm: float = 4.0) -> EyeModel:
    return load_eye(model).build(eye=side, pupil_diameter_mm=pupil_mm)  # type: ignore[arg-type]


def job_of(
    eye: EyeModel,
    rig: LampRig,
    window: tuple[int, int, int, int],
    pose_deg: tuple[float, float] = (0.0, 0.0),
    **changes: Any,
) -> RenderJob:
    """A job for an eye at the world's origin; the sensor is noise-free unless given."""
    from eyerender.rendering.records.job import RenderJob

    M, t = rigid_motion(Poses.from_degrees([pose_deg[0]], [pose_deg[1]]), eye)
    job = RenderJob(
        eye=eye, M=M[0], t=t[0], camera=rig.camera, window=window, lights=rig.lights, sensor=Sensor(noise=False),
        apex_mm=np.zeros(3), seed=1,
    )  # fmt: skip
    return replace(job, **changes)


def card(corners_mm: np.ndarray) -> tuple[Body, ...]:
    """An obstacle with four corners (4, 3) in a plane."""
    normal = np.cross(corners_mm[1] - corners_mm[0], corners_mm[2] - corners_mm[0])
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return (Body(part=OBSTACLE, vertices=corners_mm, normals=normals, faces=faces, albedo=0.3),)


def digest(window: RenderedWindow) -> str:
    """A checksum of a window's pictures."""
    return hashlib.sha256(window.irradiance.tobytes() + window.dn.tobytes() + window.labels.part.tobytes()).hexdigest()


def noisy_job() -> RenderJob:
    rig = head_rig()
    return job_of(eye_of("E4"), rig, (200, 150, 160, 120), (5.0, 3.0), sensor=Sensor(), seed=77)


def iris_irradiance(renderer: Renderer, job: RenderJob, points_mm: np.ndarray) -> np.ndarray:
    """Irradiance (n,) mW/mm^2 of points (n, 3) of the iris' plane (eye frame, mm) from all lamps' middles, by paths."""
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.transport.directlight import irradiance_through_cornea

    shown, _ = renderer.bind(job, lit=False)
    x = mi.Vector3f(*np.asarray(points_mm, dtype=np.float32).T)
    corner = mi.Float(0)  # of the unit square, which is the disc's centre
    bent, _ = irradiance_through_cornea(shown.frame, x, dr.full(mi.Bool, True, len(points_mm)), corner, corner)
    return np.asarray(bent.numpy(), dtype=float)


def depths_mm(renderer: Renderer, job: RenderJob) -> np.ndarray:
    """Distances (height, width) from the nodal point of what pixels' centres show, infinite where that is nothing."""
    import drjit as dr
    import mitsuba as mi

    from eyerender.rendering.hits.primary import intersect
    from eyerender.rendering.integrator.sampling import Pixels, camera_ray

    shown, _ = renderer.bind(job, lit=False)
    _, _, width, height = job.window
    u, v = Pixels.of(job.window).at(dr.arange(mi.UInt32, width * height))
    o, d, _ = camera_ray(shown.frame, mi.Float(u), mi.Float(v))
    view, _ = intersect(shown.frame, o, d, True)
    return dr.select(view.met, view.distance, dr.inf).numpy().reshape(height, width)
