"""Media: a constant index, Cauchy's dispersion, or Sellmeier's."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ConstantMedium:
    """A medium with the same index n at every wavelength, for sources that name no wavelength."""

    n: float

    def index(self, wavelength_nm: float) -> float:
        """Return the index n, which is the same at every wavelength."""
        del wavelength_nm
        return self.n


@dataclass(frozen=True, slots=True)
class CauchyMedium:
    """Cauchy's n = c0 + c1 / l^2 + c2 / l^4 + c3 / l^6, l in nm (Atchison & Smith 2005, JOSA A 22, 29-37, eq. 1)."""

    c0: float
    c1: float
    c2: float
    c3: float

    def index(self, wavelength_nm: float) -> float:
        """Compute the index at a vacuum wavelength (nm)."""
        inverse = 1.0 / (wavelength_nm * wavelength_nm)
        return self.c0 + inverse * (self.c1 + inverse * (self.c2 + inverse * self.c3))


@dataclass(frozen=True, slots=True)
class SellmeierMedium:
    """Sellmeier's n = offset + sqrt(1 + sum_k a_k l^2 / (l^2 - b_k)), l in um, a_k and b_k (um^2) in pairs."""

    pairs: tuple[tuple[float, float], ...]
    offset: float = 0.0

    def index(self, wavelength_nm: float) -> float:
        """Compute the index at a vacuum wavelength (nm)."""
        square = 1e-6 * wavelength_nm * wavelength_nm
        return self.offset + math.sqrt(1.0 + sum(a * square / (square - b) for a, b in self.pairs))


Medium = ConstantMedium | CauchyMedium

_WATER = (
    (5.666959820e-1, 5.084151894e-3),
    (1.731900098e-1, 1.818488474e-2),
    (2.095951857e-2, 2.625439472e-2),
    (1.125228406e-1, 1.073842352e1),
)

TEARS = SellmeierMedium(_WATER, offset=0.0040)
"""Tears: 1.337 at 589 nm, the mean of harvested samples (Patel and Tutchenko 2019, Cont Lens Anterior Eye 42, 575),
with the dispersion of water (Daimon and Masumura 2007, Appl. Opt. 46, 3811, at 24 deg C); 1.3314 at 850 nm."""
