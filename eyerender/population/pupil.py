"""Pupil size and shape: light, age, accommodation."""

from __future__ import annotations

import numpy as np

from ..base.arrays import FloatLike, Floats

OLDEST, YOUNGEST = 83.0, 20.0
"""Ages for which the formula holds; younger and older people have the pupil of these."""


def watson_yellott_mm(
    luminance_cd_m2: FloatLike, field_deg: FloatLike, age_years: FloatLike, *, eyes: int = 2
) -> Floats:
    """Compute the diameter (mm) of the entrance pupil by Watson and Yellott's unified formula.

    F = L a e with the luminance L, the field's area a = pi d^2 / 4 (deg^2) and e = 1 for two eyes, 0.1 for one;

        D_SD = 7.75 - 5.75 q / (q + 2),  q = (F / 846)^0.41,
        D = D_SD + (y - 28.58) (0.02132 - 0.009562 D_SD).

    (Watson and Yellott 2012, "A unified formula for light-adapted pupil size", J. Vis. 12(10):12, with the coefficients
    0.021323 and 0.0095623 of their code.)

    Args:
        luminance_cd_m2: luminance of the field.
        field_deg: diameter of the field.
        age_years: age, clipped to 20 to 83.
        eyes: number of eyes that see the field.
    """
    area = np.pi / 4.0 * np.asarray(field_deg) ** 2
    flux = np.asarray(luminance_cd_m2) * area * (1.0 if eyes == 2 else 0.1)
    q = (flux / 846.0) ** 0.41
    young = 7.75 - 5.75 * q / (q + 2.0)
    age = np.clip(age_years, YOUNGEST, OLDEST)
    return np.asarray(young + (age - 28.58) * (0.021323 - 0.0095623 * young))


def ellipticity(stop_diameter_mm: float) -> tuple[float, float]:
    """Compute the ellipticity 1 - b/a of the stop, and the direction of its long axis (deg): 0 horizontal, 90 vertical.

    The signed eccentricity of a stop of radius r is 0.0973 (tanh(4.7609 (r - 1.7523)) + 0.1800), positive for a tall
    pupil: small pupils are slightly wide, large ones slightly tall (Wyatt 1995, Vision Res. 35, 2021-2036, with the
    curve of gkaModelEye).
    """
    signed = 0.0973 * (np.tanh(4.7609 * (stop_diameter_mm / 2.0 - 1.7523)) + 0.1800)
    return float(1.0 - np.sqrt(1.0 - signed**2)), 90.0 if signed > 0 else 0.0
