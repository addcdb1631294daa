"""Light that the fundus returns through the pupil: bright near the direction of the lamp, dark elsewhere.

A lamp sends a pencil of rays through each point q of the pupil. On the retina the pencil arrives at the direction

    theta_L(q) = u_L + (F - V_L) q

in object space, where u_L is the direction of the lamp, V_L = 1/d_L its vergence and F the vergence at which the eye is
focused. The fundus spreads the light with a kernel K (1/sr) about that direction and returns a share rho of it. A
camera that looks through the pupil's point p sees the direction theta_C(p), so the radiance in air is

    L(p) = T_L T_C rho / (pi n'^2 f^2) * integral E(q) K(theta_C(p) - theta_L(q)) dA_q

with E the irradiance of the stop, n' the index of the vitreous, f the height on the retina per angle in air, and T the
transmittances of the cornea. The optics is paraxial about the camera's ray. The spread is a Gaussian core (aberrations
and diffraction) and an exponential halo: choroid and retina carry infrared light sideways before it returns. The
remaining light, after several reflections in the globe, is uniform.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import ArrayValue, Floats, frozen, remembered
from ..optics.trace import trace
from ..optics.vectors import crosses
from .entrance import entrance_pupil
from .landmarks import path_to_retina
from .model import EyeModel

EDGE = 1.25  # half width of the grid, in semi-axes of the stop; uneven margins reach beyond 1
CELLS = 24
# Optic disc in the visual field: 15.5 deg temporal of the line of sight and 1.5 deg below it; and its radius.
_DISC_DEG, _DISC_RADIUS_DEG = (15.5, -1.5), 2.9
# Delori and Pflibsen 1989, table I, at 805 nm: 10.37 % at the fovea, 11.27 % beside it, 12.52 % nasally.
_FOVEA_SHARE, _FOVEA_DEG = 0.92, 2.5
_NODES = 169  # sample points of the pupil
_UP = frozen([0.0, 0.0, 1.0])
_ASIDE, _BEFORE_MM = (0.01, -0.01), 50.0  # slopes of rays to the retina, and their start before the entrance pupil
_VANISHED = 210.0  # squared gap, in sigma^2, beyond which a Gaussian is 0 in single precision
_REACH = 12.0  # halo widths, beyond which a lamp returns less than a hundred-thousandth of its halo's peak


@dataclass(frozen=True, slots=True, eq=False)
class FundusLight(ArrayValue):
    """Radiance factors over the stop, for each lamp."""

    # (m, CELLS, CELLS) radiance in air towards the camera per irradiance of the stop (1/sr), before the transmittance
    # of the cornea on the way out. Row and column are the coordinates along the second and the first semi-axis of the
    # stop, from -EDGE to EDGE in units of these, at the centres of the cells.
    factors: Floats

    def at(self, lamp: int, first: Floats, second: Floats) -> Floats:
        """Interpolate the factor of a lamp at stop coordinates (...), bilinearly."""
        table = self.factors[lamp]
        x, y = (np.clip((np.asarray(c) / EDGE + 1) * CELLS / 2 - 0.5, 0, CELLS - 1 - 1e-9) for c in (first, second))
        i, j = x.astype(int), y.astype(int)
        s, t = x - i, y - j
        low = (1 - s) * table[j, i] + s * table[j, i + 1]
        high = (1 - s) * table[j + 1, i] + s * table[j + 1, i + 1]
        return np.asarray((1 - t) * low + t * high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Reflectance and scatter of the fundus."""

    reflectance: float  # share of the light that returns, away from fovea and optic disc
    halo_share: float  # share of that light in the halo
    halo_rad: float  # distance at which the halo has fallen by e, in object space
    blur_rad: float  # standard deviation of the core, in object space
    disc_gain: float  # reflectance of the optic disc over that of the fundus beside it


def fundus_light(eye: EyeModel, lamps_mm: Floats, camera_mm: Floats, focus_dpt: float, spread: Spread) -> FundusLight:
    """Compute the light of lamps that the fundus returns through the pupil to a camera.

    Args:
        eye: the eye.
        lamps_mm: (m, 3) positions of the lamps in the eye frame.
        camera_mm: (3,) position of the camera's pinhole in the eye frame.
        focus_dpt: vergence (D) of the point in focus, 1 / its distance in metres from the pupil; negative for a
            hyperope who does not accommodate.
        spread: reflectance and scatter of the fundus.
    """
    centre, scale = entrance_pupil(eye)
    lamps, camera = np.asarray(lamps_mm, float) - centre, np.asarray(camera_mm, float) - centre
    axes = scale * eye.stop.rotation[:, 1:] * eye.stop.semi_axes_mm
    out_of_pupil = camera / np.linalg.norm(camera)
    e1 = crosses(_UP, out_of_pupil)
    e1 /= np.linalg.norm(e1)
    plane = np.stack([e1, crosses(out_of_pupil, e1)])

    line = (np.arange(CELLS) + 0.5) * 2 * EDGE / CELLS - EDGE
    first, second = np.meshgrid(line, line)
    p = np.stack([first, second], -1) @ (plane @ axes).T  # mm
    nodes, weight = _pupil_nodes(eye)
    q = nodes @ (plane @ axes).T
    cell_mm = np.sqrt(weight * scale**2)

    theta_c = (focus_dpt - 1e3 / np.linalg.norm(camera)) * p * 1e-3
    factors = np.zeros((len(lamps), CELLS, CELLS))
    reach = max(_REACH * spread.halo_rad, 6 * spread.blur_rad) + np.abs(theta_c).max()
    for k, lamp in enumerate(lamps):
        distance = np.linalg.norm(lamp)
        blur = focus_dpt - 1e3 / distance
        aside = _direction(lamp / distance, out_of_pupil, plane)
        if np.linalg.norm(aside) > reach + np.abs(blur * q).max() * 1e-3:
            continue
        # The light of a node is spread over its cell.
        sigma = np.hypot(spread.blur_rad, abs(blur) * cell_mm * 1e-3 / np.sqrt(12))
        core, halo = _sums(theta_c, aside + blur * q * 1e-3, sigma, spread.halo_rad)
        core *= (1 - spread.halo_share) / (2 * np.pi * sigma**2)
        halo *= spread.halo_share / (2 * np.pi * spread.halo_rad**2)
        factors[k] = (core + halo) * weight
    if np.any(factors):
        factors /= retinal_scale_mm(eye) ** 2
    index = float((eye.back_indices or eye.front_indices)[-1])
    rho = spread.reflectance * _relative_reflectance(eye, out_of_pupil, plane, theta_c, spread.disc_gain)
    # The retina is a sphere 1 mm, the thickness of the wall, inside the sclera's.
    area_mm2 = float(4 * np.pi * (float(eye.sclera.radius_mm) - 1.0) ** 2)
    even = len(nodes) * weight * spread.reflectance / (1 - spread.reflectance) / area_mm2
    return FundusLight(rho * (factors + even) / (np.pi * index**2))


def _sums(seen: Floats, lit: Floats, sigma: float, fall: float) -> tuple[Floats, Floats]:
    """Sum exp(-g^2 / 2 sigma^2) and exp(-g / fall) over points `lit` (n, 2); g is the distance to `seen` (..., 2).

    Computed in single precision, which takes a tenth of the time; sums of hundreds of terms are accurate to 1e-6.
    """
    x, y = (np.subtract.outer(seen[..., k].astype(np.float32), lit[:, k].astype(np.float32)) for k in (0, 1))
    x *= x
    y *= y
    square, ones = np.add(x, y, out=x), np.ones(len(lit), np.float32)
    core = np.zeros(square.shape[:-1])
    if np.min(square) < _VANISHED * sigma**2:
        np.multiply(square, np.float32(-0.5 / sigma**2), out=y)
        core = np.exp(y, out=y) @ ones
    np.sqrt(square, out=square)
    square *= np.float32(-1 / fall)
    halo = np.exp(square, out=square) @ ones
    return np.asarray(core, dtype=float), np.asarray(halo, dtype=float)


@remembered
def retinal_scale_mm(eye: EyeModel) -> float:
    """Compute the height on the retina per angle in air about the entrance pupil, near the optic axis (mm/rad).

    It is the geometric mean over two meridians.
    """
    outward = np.array([[1.0, s, 0.0] for s in _ASIDE] + [[1.0, 0.0, s] for s in _ASIDE]) / np.hypot(1.0, _ASIDE[0])
    found = trace(path_to_retina(eye), 1.0, entrance_pupil(eye)[0] + _BEFORE_MM * outward, -outward)
    heights = np.linalg.norm(found.points_mm[-1, ::2] - found.points_mm[-1, 1::2], axis=-1)
    return float(np.sqrt(heights.prod()) / (2.0 * np.arctan(_ASIDE[0])))


@remembered
def _pupil_nodes(eye: EyeModel) -> tuple[Floats, float]:
    """Return points (n, 2) of the stop in units of its semi-axes, and the stop area (mm^2) per point."""
    k = np.arange(_NODES)
    radius, angle = np.sqrt((k + 0.5) / _NODES), k * np.pi * (3 - np.sqrt(5))  # Vogel's spiral, even by area
    f = np.arange(360) * np.pi / 180
    area = np.pi * float(np.prod(eye.stop.semi_axes_mm)) * float(np.mean(eye.stop.relative_radius(f) ** 2))
    if eye.stop.contour.shape[-1]:
        radius = radius * eye.stop.relative_radius(angle)
    side = float(eye.stop.handed)
    return frozen(np.stack([side * radius * np.cos(angle), radius * np.sin(angle)], -1)), area / _NODES


def _direction(way: Floats, axis: Floats, plane: Floats) -> Floats:
    """Compute the angles (2,) rad of a unit vector from an axis, along the axes of a plane across it."""
    across = plane @ way
    sine = np.linalg.norm(across)
    return np.asarray(across * (np.arctan2(sine, way @ axis) / sine) if sine > 0 else across)


def _relative_reflectance(eye: EyeModel, axis: Floats, plane: Floats, theta: Floats, disc_gain: float) -> Floats:
    """Compute the reflectance at `theta` from the camera's axis, relative to the fundus off fovea and disc."""
    way = axis + theta @ plane
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    sight = eye.chief_ray.direction
    # Field angles from the line of sight, temporal and up. A right eye has +y nasal.
    temporal = crosses(_UP, sight) * (-1.0 if eye.side == "right" else 1.0)
    temporal /= np.linalg.norm(temporal)
    up = crosses(sight, temporal) * (1.0 if eye.side == "left" else -1.0)
    ahead = way @ sight
    field = np.degrees(np.stack([np.arctan2(way @ temporal, ahead), np.arctan2(way @ up, ahead)], -1))
    to_disc = np.linalg.norm(field - np.array(_DISC_DEG), axis=-1)
    s = np.clip((_DISC_RADIUS_DEG + 0.4 - to_disc) / 0.8, 0, 1)
    on_disc = s * s * (3 - 2 * s)
    fovea = (1 - _FOVEA_SHARE) * np.exp(-0.5 * (np.linalg.norm(field, axis=-1) / _FOVEA_DEG) ** 2)
    return np.asarray((1 - fovea) * (1 + (disc_gain - 1) * on_disc))
