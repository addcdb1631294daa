"""Marginal distributions: monotone maps between a standard normal number z and a value.

The map is F^-1(Phi(z)), where F is the cumulative distribution of the quantity.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp

from ..base.arrays import Floats
from ..base.spec import ByKind, Number, Positive, Spec


class Fixed(Spec):
    """One value for everybody."""

    kind: Literal["fixed"] = Field(description="the distribution")
    value: Number = Field(description="the value")

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        return np.full(np.shape(z), self.value)

    def latent(self, x: Floats) -> Floats:
        """Map values to standard normal numbers, the inverse of `at`."""
        return np.zeros(np.shape(x))

    @property
    def moments(self) -> tuple[float, float]:
        """Return mean and standard deviation."""
        return self.value, 0.0


class Normal(Spec):
    """Normal distribution; with `low` or `high` it is truncated there."""

    kind: Literal["normal"] = Field(description="the distribution")
    mean: Number = Field(description="mean before any truncation")
    sd: Positive = Field(description="standard deviation before any truncation")
    low: Number | None = Field(default=None, description="smallest value")
    high: Number | None = Field(default=None, description="largest value")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low must be < high, not {self.low:g} and {self.high:g}")
        return self

    @property
    def _ends(self) -> tuple[float, float]:
        low = -np.inf if self.low is None else (self.low - self.mean) / self.sd
        high = np.inf if self.high is None else (self.high - self.mean) / self.sd
        return low, high

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        low, high = self._ends
        if low == -np.inf and high == np.inf:
            return np.asarray(self.mean + self.sd * z)
        return np.asarray(self.mean + self.sd * truncated(z, low, high))

    def latent(self, x: Floats) -> Floats:
        """Return the standard normal numbers of values."""
        low, high = self._ends
        t = (np.asarray(x) - self.mean) / self.sd
        if low == -np.inf and high == np.inf:
            return np.asarray(t)
        share = (ndtr(t) - ndtr(low)) / (ndtr(high) - ndtr(low))
        return np.asarray(ndtri(np.clip(share, 0.0, 1.0)))

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Compute mean and standard deviation, in closed form."""
        low, high = self._ends
        mass = float(ndtr(high) - ndtr(low))
        at = [0.0 if np.isinf(e) else float(np.exp(-e * e / 2) / np.sqrt(2 * np.pi)) for e in (low, high)]
        ends = [0.0 if np.isinf(e) else e for e in (low, high)]
        shift = (at[0] - at[1]) / mass
        spread = 1 + (ends[0] * at[0] - ends[1] * at[1]) / mass - shift**2
        return self.mean + self.sd * shift, self.sd * float(np.sqrt(spread))


class Lognormal(Spec):
    """Lognormal distribution: median exp(sigma z)."""

    kind: Literal["lognormal"] = Field(description="the distribution")
    median: Positive = Field(description="median")
    sigma: Positive = Field(description="standard deviation of the natural logarithm")

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        return np.asarray(self.median * np.exp(self.sigma * z))

    def latent(self, x: Floats) -> Floats:
        """Return the standard normal numbers of values."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(np.asarray(x) / self.median) / self.sigma)

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Compute mean and standard deviation, in closed form."""
        mean = self.median * float(np.exp(self.sigma**2 / 2))
        return mean, mean * float(np.sqrt(np.expm1(self.sigma**2)))


class Uniform(Spec):
    """Uniform distribution."""

    kind: Literal["uniform"] = Field(description="the distribution")
    low: Number = Field(description="smallest value")
    high: Number = Field(description="largest value")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low must be < high, not {self.low:g} and {self.high:g}")
        return self

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        return np.asarray(self.low + (self.high - self.low) * ndtr(z))

    def latent(self, x: Floats) -> Floats:
        """Return the standard normal numbers of values."""
        share = (np.asarray(x) - self.low) / (self.high - self.low)
        return np.asarray(ndtri(np.where((share >= 0) & (share <= 1), share, np.nan)))

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Compute mean and standard deviation, in closed form."""
        return (self.low + self.high) / 2, (self.high - self.low) / float(np.sqrt(12.0))


class Share(Spec):
    """1 for a share of the people, 0 for the others."""

    kind: Literal["share"] = Field(description="the distribution")
    share: float = Field(ge=0, le=1, description="share of the people with the value 1")

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        return np.asarray(ndtr(z) > 1.0 - self.share, dtype=np.float64)

    def latent(self, x: Floats) -> Floats:
        """Return the median of the standard normal numbers that give a value."""
        x = np.asarray(x)
        middle = np.where(x > 0.5, 1.0 - self.share / 2, (1.0 - self.share) / 2)
        possible = ((x == 1) & (self.share > 0)) | ((x == 0) & (self.share < 1))
        return np.asarray(ndtri(np.where(possible, middle, np.nan)))

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Compute mean and standard deviation, in closed form."""
        return self.share, float(np.sqrt(self.share * (1.0 - self.share)))


class Part(Spec):
    """One normal distribution of a mixture."""

    weight: Positive = Field(description="share of the people")
    mean: Number = Field(description="mean")
    sd: Positive = Field(description="standard deviation")


class Mixture(Spec):
    """Mixture of normal distributions."""

    kind: Literal["mixture"] = Field(description="the distribution")
    parts: Annotated[tuple[Part, ...], Field(min_length=1, max_length=20)] = Field(description="its normal parts")

    @cached_property
    def _parts(self) -> tuple[Floats, Floats, Floats]:
        weight, mean, sd = np.array([(p.weight, p.mean, p.sd) for p in self.parts]).T
        return weight / weight.sum(), mean, sd

    def latent(self, x: Floats) -> Floats:
        """Return the standard normal numbers of values."""
        weight, mean, sd = self._parts
        t = (np.asarray(x, dtype=np.float64)[..., None] - mean) / sd
        # The smaller tail is used, so that the far upper tail keeps its precision.
        lower = np.sum(weight * ndtr(t), axis=-1)
        upper = np.sum(weight * ndtr(-t), axis=-1)
        with np.errstate(divide="ignore"):
            above = -ndtri_exp(np.log(np.minimum(upper, 1.0)))
            return np.asarray(np.where(lower < 0.5, ndtri_exp(np.log(lower)), above))

    @cached_property
    def _table(self) -> tuple[Floats, Floats]:
        _, mean, sd = self._parts
        low, high = float(np.min(mean - 12 * sd)), float(np.max(mean + 12 * sd))
        x = np.linspace(low, high, 8001)
        z = self.latent(x)
        rising = np.concatenate([[True], np.diff(z) > 0]) & np.isfinite(z)
        return z[rising], x[rising]

    def at(self, z: Floats) -> Floats:
        """Map standard normal numbers to values."""
        zs, xs = self._table
        z = np.clip(z, zs[0], zs[-1])
        x = np.interp(z, zs, xs)
        weight, mean, sd = self._parts
        for _ in range(3):
            # Newton on latent(x) = z; dz/dx = f(x) / phi(z).
            t = (x[..., None] - mean) / sd
            density = np.sum(weight / sd * np.exp(-t * t / 2), axis=-1)
            gap = self.latent(x) - z
            step = np.where(density > 0, gap * np.exp(-z * z / 2) / np.maximum(density, 1e-300), 0.0)
            x = x - np.clip(step, -0.5, 0.5)
        return np.asarray(x)

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Compute mean and standard deviation, in closed form."""
        weight, mean, sd = self._parts
        centre = float(weight @ mean)
        return centre, float(np.sqrt(weight @ (sd**2 + (mean - centre) ** 2)))


Marginal = Annotated[Fixed | Normal | Lognormal | Uniform | Share | Mixture, ByKind()]


def truncated(z: Floats, low: float, high: float) -> Floats:
    """Truncate standard normal numbers to [low, high]: Phi^-1(Phi(low) + Phi(z) (Phi(high) - Phi(low)))."""
    if low > 0:
        return -truncated(-z, -high, -low)
    log_low, log_high = float(log_ndtr(low)), float(log_ndtr(high))
    share = np.exp(log_low - log_high)
    inside: Any = ndtri_exp(log_high + np.log(share + ndtr(z) * (1.0 - share)))
    return np.asarray(np.clip(inside, low, high))
