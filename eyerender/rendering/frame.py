"""From eye, pose, camera, lamps and look to the numbers that a kernel takes: host side, float64, no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import ArrayValue, Floats
from ..errors import InputError
from ..eye.model import Eye
from ..geometry.surfaces import Surface
from ..geometry.surfaces_biconic import Biconic
from ..geometry.surfaces_quadric import Quadric
from ..region.anatomy import RegionSpec
from ..region.look import LookSpec
from ..rig.camera import Camera
from ..rig.imaging import AmbientSpec, LensSpec
from ..rig.light import Light
from ..rig.sensor import SensorSpec

_SENSOR, _LOOK, _LENS, _AMBIENT = SensorSpec(), LookSpec(), LensSpec(), AmbientSpec()
_GLOBE_CENTRE_MM = np.array([-13.5, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class RenderJob(ArrayValue):
    """One window of one exposure: what is rendered.

    eye, and its rigid motion x_world = M x + t; camera, lamps, sensor and look; `window` (x0, y0, width, height) in
    full-sensor pixels. `apex_mm` is where the apex of the unrotated eye stands in the world (the surround keeps its
    place to it); by default it follows from a turn about a point 13.5 mm behind the apex. `seed` fixes samples and
    noise. `purkinje` lists the mirror images of the lamps to show, 1 (the glint) to 4.
    """

    eye: Eye
    M: Floats
    t: Floats
    camera: Camera
    window: tuple[int, int, int, int]
    lights: tuple[Light, ...]
    sensor: SensorSpec = _SENSOR
    look: LookSpec = _LOOK
    wavelength_nm: float = 850.0
    seed: int = 0
    labels: bool = True
    purkinje: tuple[int, ...] = (1,)
    apex_mm: Floats | None = None
    region: RegionSpec | None = None
    lens: LensSpec = _LENS
    ambient: AmbientSpec = _AMBIENT

    @property
    def anchor_mm(self) -> Floats:
        """Origin of the scene's frame in the world: the apex of the unrotated eye, (3,) mm."""
        if self.apex_mm is not None:
            return np.asarray(self.apex_mm, dtype=float)
        return np.asarray(self.M @ _GLOBE_CENTRE_MM + self.t - _GLOBE_CENTRE_MM)


def kinds(eye: Eye) -> tuple[tuple[bool, bool], ...]:
    """(biconic, tilted) of each refracting surface in front of the iris."""
    return tuple((isinstance(s, Biconic), not np.array_equal(s.rotation, np.eye(3))) for s in eye.front)


def eye_numbers(eye: Eye) -> dict[str, ArrayLike]:
    """The eye's part of a kernel's numbers."""
    numbers: dict[str, ArrayLike] = {}
    indices = np.asarray(eye.front_indices, dtype=float)
    before = 1.0
    for i, (surface, index) in enumerate(zip(eye.front, indices, strict=True)):
        numbers |= {f"s{i}.origin": surface.origin_mm, f"s{i}.shape": _shape(surface), f"s{i}.eta": before / index}
        numbers |= {f"s{i}.row{k}": np.asarray(surface.rotation)[:, k] for k in range(3)}
        before = float(index)
    front = eye.front[0]
    angle = np.linspace(0, 2 * np.pi, 64)
    rim = front.sag(eye.limbus_radius_mm * np.cos(angle), eye.limbus_radius_mm * np.sin(angle))
    scale, shift = _image(eye.front, indices, float(eye.stop.centre_mm[0]))
    numbers |= {
        "inner_index": before,
        "stop.centre": eye.stop.centre_mm,
        "stop.normal": eye.stop.rotation[:, 0],
        "stop.u": eye.stop.rotation[:, 1],
        "stop.v": eye.stop.rotation[:, 2],
        "stop.axes": eye.stop.semi_axes_mm,
        "iris_root": eye.iris_root_radius_mm,
        "limbus_radius": eye.limbus_radius_mm,
        "limbus_floor": float(np.min(rim)) - 2.0,
        "sclera.centre": eye.sclera.centre_mm,
        "sclera.radius": eye.sclera.radius_mm,
        # Of the sphere about the sclera's centre that holds the cornea too.
        "globe.reach": max(float(eye.sclera.radius_mm), float(np.linalg.norm(apex_of(front) - eye.sclera.centre_mm)))
        + 0.5,
        "image.scale": scale,
        "image.shift": shift,
    }
    return numbers


def margin_waves(eye: Eye) -> Floats:
    """Fourier coefficients (k, 2) of the pupil's relative radius over the angle in the stop's plane, as c_k and -s_k.

    The stop's own angle runs the other way about for a left eye: f' = pi - f, cos(k f') = (-1)^k cos(k f),
    sin(k f') = -(-1)^k sin(k f).
    """
    cosines, sines = np.asarray(eye.stop.contour, dtype=float)
    if float(eye.stop.handed) < 0:
        turned = (-1.0) ** np.arange(1, len(cosines) + 1)
        cosines, sines = turned * cosines, -turned * sines
    return np.stack([cosines, -sines], axis=1)


def look_numbers(look: LookSpec) -> dict[str, ArrayLike]:
    """The look's part of a kernel's numbers."""
    return {
        "limbus_width": look.limbus_width_mm,
        "limbus_gain": 1 / max(look.limbus_width_mm, 1e-6),
        "iris.albedo": look.iris_albedo,
        "iris.contrast": look.iris_contrast,
        "pupil.albedo": look.pupil_albedo,
        "sclera.albedo": look.sclera_albedo,
        "sclera.contrast": look.sclera_contrast,
        "limbus.albedo": look.limbus_albedo,
        "backdrop.x": -look.backdrop_distance_mm,
    }


def pose_numbers(M: Floats, t: Floats, anchor: Floats) -> dict[str, ArrayLike]:
    """The pose's part: eye frame to scene's frame (the world's axes, origin at `anchor`)."""
    numbers: dict[str, ArrayLike] = {f"pose.col{k}": M[:, k] for k in range(3)}
    return numbers | {"pose.shift": t - anchor}


def camera_numbers(camera: Camera, anchor: Floats) -> dict[str, ArrayLike]:
    """The camera's part, in the scene's frame."""
    return {
        "camera.centre": camera.nodal_point_mm - anchor,
        "camera.right": camera.R[0],
        "camera.down": camera.R[1],
        "camera.forward": camera.R[2],
        "camera.focal": (camera.K[0, 0], camera.K[1, 1]),
        "camera.principal": (camera.K[0, 2], camera.K[1, 2]),
        "camera.distortion": camera.distortion,
    }


def ambient_numbers(ambient: AmbientSpec) -> dict[str, ArrayLike]:
    """The ambient light's part: irradiance in mW/mm^2."""
    return {"ambient.irradiance": ambient.irradiance_w_m2 * 1e-3}


def panel_table(ambient: AmbientSpec, anchor: Floats) -> Floats:
    """The panels in the scene's frame, (n, 13): centre, normal to the origin, right, up (over half sizes), radiance.

    A panel faces the origin; its width is level.
    """
    rows = []
    for panel in ambient.panels:
        centre = np.asarray(panel.centre_mm, dtype=float) - anchor
        normal = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, 0.0, 1.0], normal)
        size = np.linalg.norm(right)
        right = right / size if size > 1e-9 else np.array([0.0, 1.0, 0.0])
        up = np.cross(normal, right)
        w, h = panel.size_mm
        rows.append([*centre, *normal, *(2 / w * right), *(2 / h * up), panel.radiance_w_m2_sr * 1e-3])
    return np.reshape(rows, (-1, 13))


def light_table(lights: Sequence[Light], M: Floats, t: Floats) -> Floats:
    """The lamps in the eye frame, (n, 10): position, axis, radius, intensity, lobe exponent, inner radius."""
    rows = [
        [*(M.T @ (lamp.position_mm - t)), *(M.T @ lamp.axis), lamp.radius_mm, lamp.intensity_mw_sr,
         lamp.lobe_exponent, ring_radius_mm(lamp)]
        for lamp in lights
    ]  # fmt: skip
    return np.reshape(rows, (-1, 10))


def ring_radius_mm(lamp: Light) -> float:
    """The radius of the dark middle of a ring-shaped lamp; 0 for points and discs."""
    return lamp.inner_radius_mm


def _shape(surface: Surface) -> Floats:
    if isinstance(surface, Biconic):
        return np.array([*surface.radii_mm, *(1 + np.asarray(surface.conic_constants)), 0.0])
    if not isinstance(surface, Quadric):
        raise InputError(f"a surface of kind {surface.kind} cannot be rendered")
    A, b = np.asarray(surface.matrix), np.asarray(surface.vector)
    if np.any(np.diag(np.diag(A)) != A) or b[1] != 0 or b[2] != 0:
        raise InputError("a quadric cannot be rendered whose axes are not those of its frame")
    return np.array([*np.diag(A), b[0], float(surface.constant)])


def _image(front: Sequence[Surface], indices: Floats, stop_x: float) -> tuple[float, float]:
    """Lateral magnification of the stop's Gaussian image seen from outside, and its shift along x (mm).

    n / s - n' / s' = (n - n') / R at each surface, from the stop outwards; m = n s' / (n' s).
    """
    x, scale = stop_x, 1.0
    behind = list(indices)
    before = [1.0, *behind[:-1]]
    for surface, n, n_out in reversed(list(zip(front, behind, before, strict=True))):
        apex = float(apex_of(surface)[0])
        R = 1 / _curvature(surface)
        depth = apex - x
        out = n_out / (n / depth - (n - n_out) / R)
        scale *= n * out / (n_out * depth)
        x = apex - out
    return scale, x - stop_x


def apex_of(surface: Surface) -> Floats:
    """The surface's apex in the eye frame, (3,) mm."""
    return np.asarray(surface.origin_mm + surface.rotation[:, 0] * float(surface.sag(0.0, 0.0)))


def _curvature(surface: Surface) -> float:
    """Mean curvature at the apex (1/mm), from the sag."""
    h = 0.05
    apex = float(surface.sag(0.0, 0.0))
    return float((2 * apex - surface.sag(h, 0.0) - surface.sag(0.0, h)) / h**2)
