"""How light spreads in tissue, against Monte Carlo simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from eyerender.optics import diffusion
from tests.support.photons import photons

AT_MM = np.linspace(-3.0, 3.0, 61)


def edge(at_mm: np.ndarray, length_mm: float) -> np.ndarray:
    """Light at places of a surface that is lit where x > 0 only, by the profile R(r): integrated over half planes."""
    r = np.geomspace(1e-4, 80.0, 4001)
    share = np.append(0.0, diffusion.share_within(r))
    r = np.append(0.0, r)
    middle, weight = 0.5 * (r[1:] + r[:-1]) * length_mm, np.diff(share)
    lit = 0.5 + np.arcsin(np.clip(at_mm[:, None] / middle, -1, 1)) / np.pi  # of each ring
    return lit @ weight


def test_the_profile_holds_all_light_and_its_shares_are_integrals():
    def profile(r):
        return (np.exp(-r) + np.exp(-r / 3)) / (8 * np.pi * r)

    for radius in (0.2, 1.0, 4.0):
        share, _ = integrate.quad(lambda r: 2 * np.pi * r * profile(r), 0, radius)
        assert float(diffusion.share_within(radius)) == pytest.approx(share, rel=1e-8)
        assert diffusion.radius_of(share) == pytest.approx(radius, rel=1e-8)
    assert float(diffusion.share_within(80.0)) == pytest.approx(1.0, abs=1e-11)


@pytest.mark.parametrize("absorption", [0.04, *(pytest.param(a, marks=pytest.mark.slow) for a in (0.02, 0.08))])
def test_shadow_edges_on_skin_agree_with_photons(absorption):
    found = photons(100_000, 2.04, absorption)
    length = diffusion.half_space_length_mm(found.reflectance, 2.04)
    # The fit is good to 0.016, and 100,000 photons leave 0.003.
    assert np.abs(edge(AT_MM, length) - found.edge(AT_MM)).max() < 0.02


@pytest.mark.parametrize(
    ("thickness", "scattering"),
    [(0.8, 2.5), pytest.param(0.6, 2.0, marks=pytest.mark.slow), pytest.param(1.0, 3.0, marks=pytest.mark.slow)],
)
def test_shadow_edges_on_the_sclera_agree_with_photons(thickness, scattering):
    found = photons(100_000, scattering, 0.03, thickness=thickness, below=0.1)
    length = diffusion.slab_length_mm(found.reflectance, scattering)
    assert np.abs(edge(AT_MM, length) - found.edge(AT_MM)).max() < 0.02


@pytest.mark.parametrize(
    ("absorption", "thickness"),
    [(0.033, 2.6), pytest.param(0.02, 2.0, marks=pytest.mark.slow), pytest.param(0.08, 1.5, marks=pytest.mark.slow)],
)
def test_lids_transmit_as_photons_do(absorption, thickness):
    albedo = photons(40_000, 2.04, absorption).reflectance
    passed = photons(40_000, 2.04, absorption, thickness=thickness).passed
    # An exponential fits thicknesses of 0.5 to 3.5 mm within 8 %.
    assert np.exp(-diffusion.transmitted(albedo, 2.04) * thickness) == pytest.approx(passed, rel=0.08)
