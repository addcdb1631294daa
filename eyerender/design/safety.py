"""Eye safety of a rig's LEDs against the limits of IEC 62471 and ICNIRP 2013. This is not a conformity test.

    cornea:  E = sum over LEDs of  d I / r^2                   <= 100 W/m^2 for t >= 1000 s, 18000 t^(-3/4) below   (5)
    retina:  L_R = R(lambda) d I / (A cos a)                   <= 6000 / alpha W/m^2/sr                             (6)

with the duty cycle d, the radiant intensity I towards the eye, its distance r, the emitting area A seen at an angle a,
and R = 10^((700 nm - lambda) / 500 nm). alpha is the angle that the source subtends, taken as at least 0.011 and at
most 0.1 rad. Equation (6) is the limit for a weak visual stimulus and long exposures. Corneal irradiances of all LEDs
add; their images on the retina lie apart and do not.

Sources: IEC 62471:2006, infrared radiation hazard of the eye and retinal thermal hazard for a weak visual stimulus
(its limit 6000 / alpha from memory); ICNIRP, Health Phys. 105 (2013), 74-96: the corneal limits, and 6300 / alpha.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from ..base.arrays import ArrayValue, Bools, Floats, frozen
from ..base.errors import InputError
from ..rig.light import Lamp
from ..rig.rig import RigLike

BOX_MM = (3.0, 3.0, 3.0)
"""Half sizes of the box that contains the eye (chosen)."""
LONG_S = 1000.0
_RETINA, _LEAST_RAD, _MOST_RAD = 6000.0, 0.011, 0.1
_MEASURED_NM = (700.0, 1400.0)
_GRID = 5
NOTE = "not a conformity test"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Exposure(ArrayValue):
    """Exposure of an eye to the LEDs of a rig, at the place in its box that is worst for each LED and for each limit.

    Attributes:
        distance_mm: (m,) distance of each LED from the place where it irradiates most.
        cornea_w_m2: (m,) irradiance by each LED.
        cornea_limit_w_m2: limit of their sum.
        retina_w_m2_sr: (m,) weighted radiance; NaN for a point source, whose radiance is unknown.
        retina_limit_w_m2_sr: (m,) limit of the radiance.
        duty_cycle: (m,) share of the time in which each LED is on.
    """

    distance_mm: Floats
    cornea_w_m2: Floats
    cornea_limit_w_m2: float
    retina_w_m2_sr: Floats
    retina_limit_w_m2_sr: Floats
    duty_cycle: Floats

    @property
    def stuck_on(self) -> Exposure:
        """The exposure if a fault leaves all LEDs on (duty cycle 1)."""
        return Exposure(
            distance_mm=self.distance_mm,
            cornea_w_m2=frozen(self.cornea_w_m2 / self.duty_cycle),
            cornea_limit_w_m2=self.cornea_limit_w_m2,
            retina_w_m2_sr=frozen(self.retina_w_m2_sr / self.duty_cycle),
            retina_limit_w_m2_sr=self.retina_limit_w_m2_sr,
            duty_cycle=frozen(np.ones_like(self.duty_cycle)),
        )

    @property
    def cornea_share(self) -> float:
        """Sum of the irradiances over its limit."""
        return float(self.cornea_w_m2.sum() / self.cornea_limit_w_m2)

    @property
    def retina_share(self) -> Floats:
        """Weighted radiance of each LED over its limit, (m,); NaN if unknown."""
        return np.asarray(self.retina_w_m2_sr / self.retina_limit_w_m2_sr)

    @property
    def retina_known(self) -> Bools:
        """Whether the radiance of an LED is known, (m,)."""
        return np.isfinite(self.retina_w_m2_sr)

    def to_mapping(self) -> dict[str, Any]:
        """Convert to JSON values; an unknown retinal exposure names the missing key."""
        lights = [
            {
                "light": k,
                "distance_mm": float(self.distance_mm[k]),
                "cornea_w_m2": float(self.cornea_w_m2[k]),
                "retina": _retina(self, k),
            }
            for k in range(len(self.distance_mm))
        ]
        return {
            "note": NOTE,
            "cornea_w_m2": float(self.cornea_w_m2.sum()),
            "cornea_limit_w_m2": self.cornea_limit_w_m2,
            "cornea_share": self.cornea_share,
            "stuck_on": {
                "cornea_share": self.stuck_on.cornea_share,
                "retina_share": float(np.nanmax(self.stuck_on.retina_share)) if self.retina_known.any() else None,
            },
            "lights": lights,
        }


def _retina(found: Exposure, k: int) -> Any:
    if not found.retina_known[k]:
        return f"not known; give rig.lights.{k}.radius_mm (it is 0, a point)"
    return {"radiance_w_m2_sr": float(found.retina_w_m2_sr[k]), "share": float(found.retina_share[k])}


def eye_exposure(
    rig: RigLike,
    eye_mm: ArrayLike,
    *,
    wavelength_nm: float = 850.0,
    box_mm: ArrayLike = BOX_MM,
    duration_s: float = 3e4,
) -> Exposure:
    """Compute the exposure of one eye, equations (5) and (6).

    Intensities are taken from the rig, so give those of an LED's brightest bin.

    >>> er.design.eye_exposure(er.load_scene("headset").rig, [0, -31.5, 0]).cornea_share < 0.1
    True

    Args:
        rig: the rig, with the duty cycles of its LEDs.
        eye_mm: (3,) corneal apex.
        wavelength_nm: wavelength.
        box_mm: (3,) half sizes of the box that contains the eye.
        duration_s: exposure within a day.

    Raises:
        InputError: the wavelength is not between 700 and 1400 nm, an LED is inside the box, or a time is not > 0.
    """
    low, high = _MEASURED_NM
    if not low <= wavelength_nm <= high:
        raise InputError(f"must be {low:g} to {high:g} for these limits, not {wavelength_nm:g}", path="wavelength_nm")
    if not duration_s > 0:
        raise InputError("must be > 0", path="duration_s")
    eye, box = np.asarray(eye_mm, dtype=float), np.asarray(box_mm, dtype=float)
    rows = [_of_lamp(lamp, eye, box, wavelength_nm, f"rig.lights.{k}") for k, lamp in enumerate(rig.build().lights)]
    distance, cornea, retina, limit, duty = np.array(rows).reshape(-1, 5).T
    return Exposure(
        distance_mm=frozen(distance),
        cornea_w_m2=frozen(cornea),
        cornea_limit_w_m2=100.0 if duration_s >= LONG_S else float(18000.0 * duration_s**-0.75),
        retina_w_m2_sr=frozen(retina),
        retina_limit_w_m2_sr=frozen(limit),
        duty_cycle=frozen(duty),
    )


def _of_lamp(
    lamp: Lamp, eye_mm: Floats, box_mm: Floats, wavelength_nm: float, path: str
) -> tuple[float, float, float, float, float]:
    """Compute distance, irradiance, weighted radiance, its limit and the duty cycle of one LED.

    Distance and irradiance are those of the place in the box with the largest irradiance, radiance and limit those of
    the place with the largest ratio.
    """
    if (np.abs(lamp.position_mm - eye_mm) <= box_mm).all():
        raise InputError("lies inside the eye box", path=path)
    weight = 10.0 ** ((700.0 - wavelength_nm) / 500.0)
    emitter = np.pi * (lamp.radius_mm**2 - lamp.inner_radius_mm**2) * 1e-6

    def irradiance(place: Floats) -> float:
        intensity, _, distance = lamp.towards(place)
        return 1e-3 * intensity * lamp.duty_cycle / (distance * 1e-3) ** 2

    def radiance(place: Floats) -> float:
        intensity, cosine, _ = lamp.towards(place)
        return weight * 1e-3 * intensity * lamp.duty_cycle / (emitter * cosine) if cosine > 0.0 else 0.0

    def limit(place: Floats) -> float:
        return _RETINA / float(np.clip(2.0 * lamp.radius_mm / lamp.towards(place)[2], _LEAST_RAD, _MOST_RAD))

    near = _worst(irradiance, eye_mm, box_mm)
    bright = near if lamp.radius_mm == 0.0 else _worst(lambda place: radiance(place) / limit(place), eye_mm, box_mm)
    seen = np.nan if lamp.radius_mm == 0.0 else radiance(bright)
    return lamp.towards(near)[2], irradiance(near), seen, limit(bright), lamp.duty_cycle


def _worst(value: Callable[[Floats], float], eye_mm: Floats, box_mm: Floats) -> Floats:
    """Find the place (3,) mm of the box with the largest value: the best point of a grid, improved by descent."""
    corners = [eye_mm + box_mm * share for share in map(np.array, product(np.linspace(-1.0, 1.0, _GRID), repeat=3))]
    start: Floats = max(corners, key=value)
    scale = value(start)
    if scale == 0.0:
        return start
    limits = list(zip(eye_mm - box_mm, eye_mm + box_mm, strict=True))
    found = minimize(lambda place: -value(place) / scale, start, bounds=limits, tol=1e-14)
    return np.asarray(found.x) if value(found.x) > scale else start
