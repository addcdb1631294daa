"""Media: a constant index, or Cauchy's dispersion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ConstantMedium:
    """A medium whose index n is the same at every wavelength, for sources that name no wavelength."""

    n: float

    def index(self, wavelength_nm: float) -> float:
        """Index n, whatever the wavelength."""
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
        """Index at a vacuum wavelength (nm)."""
        inverse = 1.0 / (wavelength_nm * wavelength_nm)
        return self.c0 + inverse * (self.c1 + inverse * (self.c2 + inverse * self.c3))


Medium = ConstantMedium | CauchyMedium

AIR = ConstantMedium(1.0)
