"""Solve for the eye that has a drawn refraction: its corneal astigmatism and its lens.

All vergences are power matrices [[m + a, b], [b, m - a]] in the meridians y (nasal) and z (up), written (m, a, b) = (M,
J0, J45), in 1/mm. The spectacles of power F at the distance d from the cornea leave light of vergence K = F / (1 - d F)
at the cornea. With the powers P_a and P_p of the cornea's surfaces, its thickness t and index n, light behind the
cornea has the vergence

    W = V / (1 - V t / n) + P_p,   V = K + P_a.

The lens is symmetric about the axis, so W must be the same in all meridians. Its mean part follows from the drawn mean
radius, and P_a = V - K is then the power matrix of the front surface: the corneal astigmatism that, with the posterior
one, makes that of the drawn refraction.

The residual of all lengths and radii is absorbed by the equivalent index of the lens, because biometry does not
determine lens power, which differs most between eyes: the index is the one that brings W to a focus on the retina.
(SyntEyes derives its index from a lens power in the same way: Rozema et al. 2016, Invest. Ophthalmol. Vis. Sci. 57,
683.) A gradient n_core - (n_core - n_edge) p^2 like that of E5 is far too strong with the radii of Navarro 2014, so the
lens is homogeneous.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..base.arrays import ArrayValue, Floats
from ..optics.media import CauchyMedium

# Navarro, Lopez-Gil and Palos 2014 and Atchison and Smith 2005, as in E5 of the catalogue: Cauchy's coefficients.
CORNEA = (1.362994, 6009.687, -6.760760e8, 5.908450e13)
AQUEOUS = (1.323031, 6070.796, -7.062305e8, 6.147861e13)
VITREOUS = (1.323757, 5560.240, -5.817391e8, 5.036810e13)
LENS = (6521.218, -6.11066e8, 5.908191e13)
"""Coefficients of the lens after the first, as in the core of E5's lens."""
SMALLEST_INDEX, LARGEST_INDEX = 1.345, 1.6
"""Limits of the lens' equivalent index; outside them an eye is physically impossible."""
_START = 1.41
_NEWTON = 8

Power = tuple[Floats, Floats, Floats]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Optics(ArrayValue):
    """Optics that give eyes their refraction, (...,) each."""

    steep_mm: Floats  # smaller principal radius of the front cornea
    flat_mm: Floats  # larger principal radius
    flat_axis_deg: Floats  # direction of the meridian of the larger radius, from nasal towards up
    posterior_steep_mm: Floats  # smaller principal radius of the back cornea
    posterior_flat_mm: Floats  # larger principal radius
    posterior_flat_axis_deg: Floats  # direction of its meridian
    # first coefficient of the lens' equivalent index; NaN if none within its limits gives the refraction
    lens_c0: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Biometry(ArrayValue):
    """Lengths (mm) and radii (mm, positive) of eyes, (...,) each; the refraction in dioptres at the spectacles."""

    refraction: tuple[Floats, Floats, Floats]
    corneal_radius_mm: Floats
    posterior_radius_mm: Floats
    posterior_astigmatism_d: tuple[Floats, Floats]
    corneal_thickness_mm: Floats
    chamber_depth_mm: Floats
    lens_thickness_mm: Floats
    lens_radii_mm: tuple[Floats, Floats]
    axial_length_mm: Floats
    vertex_mm: float
    wavelength_nm: float


def lens_index(lens_c0: Floats, wavelength_nm: float) -> Floats:
    """Compute the equivalent index of lenses at a wavelength."""
    return np.asarray(lens_c0 + CauchyMedium(0.0, *LENS).index(wavelength_nm))


def solve(eyes: Biometry) -> Optics:
    """Compute the corneal astigmatism and the lens index of eyes with drawn refractions."""
    cornea, aqueous, _ = _indices(eyes.wavelength_nm)
    mean, j0, j45 = (np.asarray(p) / 1000.0 for p in eyes.refraction)
    at_cornea = mapped((mean, j0, j45), lambda v: v / (1.0 - eyes.vertex_mm * v))
    back = (
        (aqueous - cornea) / eyes.posterior_radius_mm,
        eyes.posterior_astigmatism_d[0] / 1000.0,
        eyes.posterior_astigmatism_d[1] / 1000.0,
    )
    wanted = (cornea - 1.0) / eyes.corneal_radius_mm + at_cornea[0]
    share = eyes.corneal_thickness_mm / cornea
    behind = wanted / (1.0 - share * wanted) + back[0]
    for _ in range(_NEWTON):
        before = _before(behind, back, share)
        behind = behind + (wanted - before[0]) * (1.0 + share * (behind - back[0])) ** 2
    before = _before(behind, back, share)
    front = (before[0] - at_cornea[0], before[1] - at_cornea[1], before[2] - at_cornea[2])
    flat, steep, axis = _principal(front, cornea - 1.0)
    p_flat, p_steep, p_axis = _principal(back, aqueous - cornea)
    return Optics(
        steep_mm=steep,
        flat_mm=flat,
        flat_axis_deg=axis,
        posterior_steep_mm=p_steep,
        posterior_flat_mm=p_flat,
        posterior_flat_axis_deg=p_axis,
        lens_c0=_lens(eyes, behind),
    )


def _lens(eyes: Biometry, behind: Floats) -> Floats:
    """Compute the first coefficient of the lens that focuses the vergence behind the cornea on the retina."""
    _, aqueous, vitreous = _indices(eyes.wavelength_nm)
    at_lens = behind / (1.0 - (eyes.chamber_depth_mm - eyes.corneal_thickness_mm) / aqueous * behind)
    front, back = eyes.lens_radii_mm
    depth = eyes.axial_length_mm - eyes.chamber_depth_mm - eyes.lens_thickness_mm
    wanted = vitreous / depth

    def miss(index: Floats) -> Floats:
        entering = at_lens + (index - aqueous) / front
        return np.asarray(
            entering / (1.0 - eyes.lens_thickness_mm / index * entering) + (index - vitreous) / back - wanted
        )

    low = np.full(behind.shape, lens_index(np.array(_START), eyes.wavelength_nm))
    high = low + 0.01
    f_low, f_high = miss(low), miss(high)
    for _ in range(_NEWTON):
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(f_high == f_low, 0.0, f_high * (high - low) / (f_high - f_low))
        low, f_low, high = high, f_high, high - step
        f_high = miss(high)
    found = high - lens_index(np.array(0.0), eyes.wavelength_nm)
    return np.where((high > SMALLEST_INDEX) & (high < LARGEST_INDEX), found, np.nan)


def _indices(wavelength_nm: float) -> tuple[float, float, float]:
    """Compute indices of cornea, aqueous and vitreous."""
    cornea, aqueous, vitreous = (float(CauchyMedium(*c).index(wavelength_nm)) for c in (CORNEA, AQUEOUS, VITREOUS))
    return cornea, aqueous, vitreous


def _before(behind: Floats, back: Power, share: Floats) -> Power:
    """Compute the vergence in front of the cornea's thickness that becomes `behind` after its back surface."""
    zero = np.zeros_like(behind)
    return mapped((behind - back[0], zero - back[1], zero - back[2]), lambda v: v / (1.0 + share * v))


def mapped(power: Power, f: Callable[[Floats], Floats]) -> Power:
    """Apply a function to a power matrix, through its two eigenvalues."""
    m, a, b = power
    r = np.hypot(a, b)
    high, low = f(m + r), f(m - r)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(r > 0.0, (high - low) / (2.0 * r), 0.0)
    return (high + low) / 2.0, a * scale, b * scale


def _principal(power: Power, step: float) -> tuple[Floats, Floats, Floats]:
    """Compute the larger and smaller radius of a surface's power, and the larger one's meridian, 0 to 180 deg."""
    m, a, b = power
    r = np.hypot(a, b)
    high, low = step / (m + r), step / (m - r)
    axis = np.degrees(0.5 * np.arctan2(b, a))
    # The meridian of m + r is the axis; which radius is larger there depends on the power's sign.
    turned = np.where(high >= low, axis, axis + 90.0)
    return np.maximum(high, low), np.minimum(high, low), np.mod(turned, 180.0)
