"""Noise of features from the sensor: how accurately a pixel's width of outline, or a glint, can be located.

An edge between two levels of electrons, blurred to mu(x) (slope mu'), carries the information

    J = integral mu'(x)^2 / (mu(x) + r^2) dx            per px of outline and px^2 of shift along the normal     (1)

with the read noise r (quantisation included). With constant noise s, a step of height d and a blur b this is (d / s)^2
/ (2 sqrt(pi) b). A glint mu(x, y) carries the same integral over its pixels in each direction,

    1 / sigma_g^2 = integral (d mu / dx)^2 / (mu + background + r^2) dx dy                                         (2)

which for constant noise s and a peak A is pi A^2 / (2 s^2). Saturated pixels carry no information, so a saturated glint
loses its core.

The extractor takes the outline of a pupil that is no ellipse from ridges of the gradient (Canny 1986), with a filter of
width f. The second derivative of filtered noise over the curvature of the ridge is the error of an edge point, and
points within 2 sqrt(pi) f share it, so the variance of one px of outline is

    sigma^2 = (3 sqrt(pi) / 4) (s / d)^2 (b^2 + f^2)^3 / f^5                                                      (2b)

with the noise s of a pixel half-way up the edge. For constant noise and the best f, 2.2 b, this is 1.4 times the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Floats, frozen
from ..base.errors import InputError
from ..rig.camera import PinholeCamera
from ..rig.defocus import confusion_px
from ..rig.exposure import electrons, iris_radiance, radiance_to_irradiance
from ..rig.light import Lamp
from ..rig.rig import RigGeometry
from ..rig.sensor import Sensor
from ..scene import Scene
from ..scene.observation import EYES

FIXATION_DEG = 0.3
"""Noise of fixation on a target, per axis (chosen)."""
PUPIL_SHARE = 0.1
"""Light of the dark pupil, as a share of the iris' (chosen)."""
CORNEAL_RADIUS_MM, CORNEAL_INDEX = 7.8, 1.376
PUPIL_DEPTH_MM, ROTATION_MM = 3.5, 10.0
"""Depth of the pupil behind the corneal apex, and its distance from the centre of rotation (both rounded)."""
BESIDE_PUPIL = 0.8
"""Light of the iris beside the pupil over that of a mean iris that is lit alike (four rendered ones: 0.74 to 0.82)."""
_SAMPLES, _REACH = 400, 6.0
_EXTRACTED_GLINT = 1.1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FeatureNoise(ArrayValue):
    """Standard deviations of features.

    Attributes:
        outline_px: (cameras,) of one px of outline along its normal; outline_px / sqrt(l) for l px of outline.
        glint_px: (cameras, lights) of a glint along each axis; inf if it cannot be located or the light does not light
            the eye.
        fixation_deg: of fixation on a target, per axis.
    """

    outline_px: Floats
    glint_px: Floats
    fixation_deg: float = FIXATION_DEG

    @classmethod
    def of(
        cls, outline_px: ArrayLike, glint_px: ArrayLike, *, rig: RigGeometry, fixation_deg: float = FIXATION_DEG
    ) -> FeatureNoise:
        """Create the noise for all cameras and lights of a rig, equal or given for each.

        Raises:
            InputError: a value is not > 0, or the shapes do not fit the rig.
        """
        cameras, lights = len(rig.cameras), len(rig.lights)
        try:
            outline = np.broadcast_to(np.asarray(outline_px, dtype=float), (cameras,))
            glint = np.broadcast_to(np.asarray(glint_px, dtype=float), (cameras, lights))
        except ValueError:
            raise InputError(f"must fit {cameras} cameras and {lights} lights", path="noise") from None
        if not ((outline > 0).all() and (glint > 0).all() and fixation_deg > 0):
            raise InputError("must be > 0", path="noise")
        return cls(outline_px=frozen(outline), glint_px=frozen(glint), fixation_deg=fixation_deg)


def sensor_noise(
    scene: Scene, *, fixation_deg: float = FIXATION_DEG, lights: Sequence[Lamp] | None = None
) -> FeatureNoise:
    """Compute the feature noise of a scene from its lamps, sensor and iris albedo, without rendering.

    The levels of a camera are those of the first eye that it sees, at its reference position, looking straight ahead.
    Its blur is the sensor's, a pixel's area, the circle of confusion at the pupil and the pupil's path during the
    exposure, each by its variance. The variance of an outline is the mean of those along and across the path.

    >>> (er.sensor_noise(er.load_scene("headset")).outline_px < 1).tolist()
    [True]

    Args:
        scene: the scene.
        fixation_deg: noise of fixation.
        lights: replaces the scene's lamps.
    """
    return _noise_of(scene, False, fixation_deg, scene.rig.lights if lights is None else lights)


def extracted_noise(scene: Scene, *, fixation_deg: float = FIXATION_DEG) -> FeatureNoise:
    """Compute the noise of the features that `extract` finds, for pupils that are no ellipses; equation (2b).

    Lamps light the iris obliquely, and it is darker beside the pupil, which has the light of the lens' glare alone.
    Glints lie on the iris; the factor 1.1 of their noise was fitted to rendered frames. `scripts/bench_noise.py`
    compares both with frames of other people and rigs.
    """
    return _noise_of(scene, True, fixation_deg, scene.rig.lights)


def _noise_of(scene: Scene, extracted: bool, fixation_deg: float, lights: Sequence[Lamp]) -> FeatureNoise:
    """Compute the noise of features from the sensor alone, or as they are extracted."""
    rig, sensor = scene.rig, scene.spec.sensor
    read = read_noise_e(sensor)
    pupil_share = scene.spec.lens.glare if extracted else PUPIL_SHARE
    outline, glint = np.empty(len(rig.cameras)), np.full((len(rig.cameras), len(lights)), np.inf)
    for k, camera in enumerate(rig.cameras):
        side = next(filter(camera.sees, scene.spec.subject.eyes), scene.spec.subject.eyes[0])
        eye_mm = scene.eye_position_mm(side) + np.array(scene.spec.subject.head_positions_mm[0])
        lit = {j: lamp for j, lamp in enumerate(lights) if lamp.lights(EYES.index(side))}
        surface, point = camera.light_shares(eye_mm)
        radiance = surface * iris_radiance(lit.values(), eye_mm, scene.spec.look.iris_albedo)
        iris = float(electrons(sensor, radiance_to_irradiance(sensor) * np.asarray(radiance), scene.spec.wavelength_nm))
        if extracted:
            iris *= BESIDE_PUPIL * oblique_share(list(lit.values()), eye_mm)
        dark = pupil_share * iris
        behind = iris if extracted else dark
        blurs = blurs_px(scene, camera, eye_mm)
        blur = float(np.sqrt(np.mean(blurs**2)))
        if extracted:
            outline[k] = ridge_deviation(dark, iris, blurs, read, sensor.full_well_e)
        else:
            parts = [edge_deviation(dark, iris, b, read, sensor.full_well_e) for b in blurs.tolist()]
            outline[k] = np.sqrt(np.mean(np.square(parts)))
        for j, lamp in lit.items():
            energy, size = glint_energy(lamp, camera, eye_mm, sensor, scene.spec.wavelength_nm)
            spread = float(np.hypot(blur, size))
            glint[k, j] = glint_deviation(point * energy, spread, behind, read, sensor.full_well_e)
    if extracted:
        glint = _EXTRACTED_GLINT * glint
    return FeatureNoise(outline_px=frozen(outline), glint_px=frozen(glint), fixation_deg=fixation_deg)


def oblique_share(lamps: Sequence[Lamp], eye_mm: Floats) -> float:
    """Compute the light on the iris of an eye that looks straight ahead, over that of one that faces every lamp."""
    light = np.array([lamp.towards(eye_mm)[::2] for lamp in lamps]).reshape(-1, 2)
    ways = np.array([lamp.position_mm for lamp in lamps]).reshape(-1, 3) - eye_mm + [PUPIL_DEPTH_MM, 0.0, 0.0]
    far = np.linalg.norm(ways, axis=1)
    facing = float(np.sum(light[:, 0] * np.maximum(ways[:, 0], 0.0) / far**3))
    return facing / max(float(np.sum(light[:, 0] / light[:, 1] ** 2)), 1e-300)


def blurs_px(scene: Scene, camera: PinholeCamera, eye_mm: Floats) -> Floats:
    """Compute the standard deviations (2,) px of the blur of an eye's pupil, along its path and across it.

    The blur is that of sensor, pixel, defocus and motion. A disc of diameter c has the variance c^2 / 16 along each
    axis, a path of length l has l^2 / 12 along it.
    """
    sensor, motion = scene.spec.sensor, scene.spec.motion
    pupil = eye_mm + np.array([-PUPIL_DEPTH_MM, 0.0, 0.0])
    depth = float(camera.depth(pupil))
    disc = 0.0 if scene.spec.lens.focus_mm is None else float(confusion_px(scene.spec.lens, camera, sensor, depth))
    variance = np.full(2, sensor.psf_sigma_px**2 + 1.0 / 12.0 + disc**2 / 16.0)
    if motion is not None:
        turn = np.radians(np.array([motion.eye_deg_s[0], motion.eye_deg_s[1]])) * ROTATION_MM
        speed = np.array(motion.head_mm_s) + np.array([0.0, turn[0], turn[1]])
        path = speed * sensor.time_ms * 1e-3
        ends, _ = camera.project(np.stack([pupil - path / 2.0, pupil + path / 2.0]))
        variance[0] += float(np.sum((ends[1] - ends[0]) ** 2)) / 12.0
    return np.asarray(np.sqrt(variance))


def read_noise_e(sensor: Sensor) -> float:
    """Compute the noise of a dark pixel in electrons: read-out, and rounding (1/12 of a code squared)."""
    return float(np.sqrt(sensor.read_noise_e**2 + 1.0 / (12.0 * sensor.gain**2)))


def edge_information(low_e: float, high_e: float, blur_px: float, read_e: float, well_e: float = np.inf) -> float:
    """Compute the information of one px of an edge on its shift along the normal, equation (1), per px^2.

    Args:
        low_e: electrons of a pixel on the dark side.
        high_e: electrons of a pixel on the bright side.
        blur_px: standard deviation of the blur, the pixel's area included.
        read_e: noise of a dark pixel.
        well_e: electrons from which a pixel is saturated.
    """
    x = np.linspace(-_REACH, _REACH, 2 * _SAMPLES + 1)
    density = np.exp(-(x**2) / 2.0) / np.sqrt(2.0 * np.pi)
    step = x[1] - x[0]
    share = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2.0 * step)])
    level = low_e + (high_e - low_e) * share / share[-1]
    slope = (high_e - low_e) * density / blur_px
    use = level < well_e
    return float(np.sum(np.where(use, slope**2 / (level + read_e**2), 0.0)) * step * blur_px)


def edge_deviation(low_e: float, high_e: float, blur_px: float, read_e: float, well_e: float = np.inf) -> float:
    """Compute the least standard deviation (px) of one px of an edge, equation (1); arguments of `edge_information`."""
    information = edge_information(low_e, high_e, blur_px, read_e, well_e)
    return float(1.0 / np.sqrt(information)) if information > 0 else np.inf


def ridge_deviation(low_e: float, high_e: float, blur_px: ArrayLike, read_e: float, well_e: float = np.inf) -> float:
    """Compute the standard deviation (px) of one px of an edge from the gradient's ridge, equation (2b).

    The extractor's filter is 1 px wide for a clear edge, up to 2.5 px for a noisy one, and as wide as a blur of more
    than 1.7 times that, all around the pupil. The arguments are those of `edge_information`, but for several blurs (n,)
    of equal parts of the outline, whose variances are averaged.
    """
    blur2 = np.square(blur_px)
    low, high = min(low_e, well_e), min(high_e, well_e)
    if high <= low:
        return np.inf
    ratio = float(np.sqrt((low + high) / 2.0 + read_e**2)) / (high - low)
    width = min(max(9.0 * ratio, 1.0), 2.5)
    blur = float(np.sqrt(np.mean(blur2)))
    width = blur if blur > 1.7 * width else width
    return float(np.sqrt(0.75 * np.sqrt(np.pi) * np.mean((blur2 + width**2) ** 3) / width**5)) * ratio


def glint_deviation(energy_e: float, spread_px: float, background_e: float, read_e: float, well_e: float) -> float:
    """Compute the standard deviation (px) of a Gaussian glint along each axis, equation (2), without saturated pixels.

    Args:
        energy_e: electrons of the whole glint.
        spread_px: its standard deviation, blur and pixel included.
        background_e: electrons of a pixel beside it.
        read_e: noise of a dark pixel.
        well_e: electrons from which a pixel is saturated.
    """
    r = (np.arange(_SAMPLES) + 0.5) * (_REACH / _SAMPLES)
    level = energy_e / (2.0 * np.pi * spread_px**2) * np.exp(-(r**2) / 2.0)
    total = level + background_e
    density = np.where(total < well_e, (level * r) ** 2 / (total + read_e**2), 0.0)
    # Half of the squared radial slope lies along each axis, and the spread cancels: slope r / spread, area spread^2.
    information = np.pi * np.sum(density * r) * (_REACH / _SAMPLES)
    return float(1.0 / np.sqrt(information)) if information > 0 else np.inf


def glint_energy(
    lamp: Lamp, camera: PinholeCamera, eye_mm: Floats, sensor: Sensor, wavelength_nm: float
) -> tuple[float, float]:
    """Compute the electrons of a lamp's glint, and the standard deviation (px) of its image, for a convex mirror.

    The mirror image is m = f / (d + f) times as large (f = R / 2), so it has m^2 F of the lamp's intensity, with
    Fresnel's reflectance F.
    """
    intensity, _, distance = lamp.towards(eye_mm)
    focal = CORNEAL_RADIUS_MM / 2.0
    scale = focal / (distance + focal)
    reflectance = ((CORNEAL_INDEX - 1.0) / (CORNEAL_INDEX + 1.0)) ** 2
    away = float(np.linalg.norm(camera.nodal_point_mm - eye_mm))
    pitch_mm = sensor.pixel_pitch_um * 1e-3
    focal_px = float(camera.K[0, 0])
    aperture_mm2 = np.pi * (focal_px * pitch_mm / (2.0 * sensor.f_number)) ** 2
    power_w = 1e-3 * intensity * reflectance * scale**2 * aperture_mm2 / away**2 * sensor.lens_transmission
    irradiance = power_w / (pitch_mm * 1e-3) ** 2
    radius_px = lamp.radius_mm * scale * focal_px / away
    return float(electrons(sensor, np.asarray(irradiance), wavelength_nm)), radius_px / 2.0
