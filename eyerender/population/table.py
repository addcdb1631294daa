"""The table of a population: marginals, regressions, correlations and presets, each with its source."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..base.spec import ByKind, FileSpec, Number, Positive, Spec
from .marginals import Fixed, Lognormal, Marginal, Mixture, Normal, Share, Uniform

FOLDER = Path(__file__).parent / "tables"
ROOTS = ("age_years", "male", "refraction_d")
"""Predictors of the regressions."""

Mark = Literal["read", "abstract", "memory", "chosen"]
Correlation = Annotated[float, Field(gt=-1, lt=1)]


class Source(Spec):
    """Source of a number."""

    what: str = Field(description="the keys that it is for, or all")
    mark: Mark = Field(description="how well the source is known")
    text: str = Field(description="the source, and what it says")


class QuantityRegression(Spec):
    """Mean + sum of slopes (predictor - its `about`) + a normal residual."""

    kind: Literal["regression"] = Field(default="regression", description="the distribution")
    mean: Number = Field(description="mean where the predictors have the values `about`")
    residual_sd: Positive = Field(description="standard deviation about the regression")
    slopes: dict[str, Number] = Field(default_factory=dict, description="predictor -> change per unit")
    about: dict[str, Number] = Field(default_factory=dict, description="predictor -> value at which the mean holds")

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in (*self.slopes, *self.about):
            if name not in ROOTS:
                raise ValueError(f"slopes: predictors are {', '.join(ROOTS)}, not {name}")
        if self.slopes.keys() - self.about.keys():
            raise ValueError("about: give the value of every predictor at which the mean holds")
        return self


Distribution = Annotated[Fixed | Normal | Lognormal | Uniform | Share | Mixture | QuantityRegression, ByKind()]


class Quantity(Spec):
    """One quantity: a marginal, or a regression on refraction, age and sex."""

    of: Literal["subject", "eye"] = Field(description="whether each eye has its own")
    marginal: Marginal | None = Field(default=None, description="its distribution, if no regression")
    mean: Number | None = Field(default=None, description="mean of the reference population")
    sd: Positive | None = Field(default=None, description="standard deviation of the reference population")
    residual_sd: Positive | None = Field(default=None, description="standard deviation about the regression")
    slopes: dict[str, Number] = Field(default_factory=dict, description="predictor -> change per unit")
    eyes: Correlation = Field(default=0.9, description="correlation of the two eyes' residuals")
    age_r: Correlation = Field(
        default=0.0, description="correlation of the latent number of `refraction_d` with that of `age_years`"
    )
    sources: Annotated[tuple[Source, ...], Field(min_length=1)] = Field(description="where the numbers come from")

    @model_validator(mode="after")
    def _check(self) -> Self:
        regression = self.mean is not None
        if (self.marginal is None) != regression:
            raise ValueError("give either a marginal or a mean")
        if regression and (self.sd is None) == (self.residual_sd is None):
            raise ValueError("give either sd or residual_sd")
        if not self.slopes.keys() <= set(ROOTS):
            raise ValueError(f"slopes: predictors are {', '.join(ROOTS)}")
        return self


class CorrelatedPair(Spec):
    """Correlation of two quantities of one eye."""

    pair: tuple[str, str] = Field(description="the two quantities")
    r: Correlation = Field(description="correlation")
    of: Literal["values", "residuals"] = Field(description="of the quantities, or of what their regressions leave")
    mark: Mark = Field(description="how well the source is known")
    text: str = Field(description="the source, and what it says")


class Constant(Spec):
    """A number that is the same in all people."""

    value: Number = Field(description="the number")
    mark: Mark = Field(description="how well the source is known")
    text: str = Field(description="the source, and what it says")


class Preset(Spec):
    """A population: the reference population with other distributions."""

    description: str = Field(description="description of the people")
    replace: dict[str, Distribution] = Field(default_factory=dict, description="quantity -> its distribution")
    age_r: Correlation | None = Field(default=None, description="replaces `age_r` of `refraction_d`")
    sources: tuple[Source, ...] = Field(default=(), description="where the numbers come from")


class PopulationTable(FileSpec):
    """A table of people."""

    name: str = Field(description="name of the table")
    reference: str = Field(description="the preset of which means, spreads and correlations are those of the table")
    quantities: dict[str, Quantity] = Field(description="name -> quantity")
    correlations: tuple[CorrelatedPair, ...] = Field(description="correlations within one eye")
    constants: dict[str, Constant] = Field(description="name -> number")
    presets: dict[str, Preset] = Field(description="name -> population")

    @model_validator(mode="after")
    def _check(self) -> Self:
        known = self.quantities
        for name in ROOTS:
            if name not in known or known[name].marginal is None:
                raise ValueError(f"quantities.{name}: missing, or without a marginal")
        eyes = {name for name, q in known.items() if q.of == "eye"}
        for k, pair in enumerate(self.correlations):
            if not set(pair.pair) <= eyes - set(ROOTS) or len(set(pair.pair)) != 2:
                raise ValueError(f"correlations.{k}.pair: name two quantities of an eye that are no predictors")
        if self.reference not in self.presets or self.presets[self.reference].replace:
            raise ValueError("reference: must be a preset that replaces nothing")
        for name, preset in self.presets.items():
            unknown = preset.replace.keys() - known.keys()
            if unknown:
                raise ValueError(f"presets.{name}.replace: unknown quantity {min(unknown)}")
        return self

    @model_validator(mode="after")
    def _check_age_r(self) -> Self:
        for name, quantity in self.quantities.items():
            if quantity.age_r and name != "refraction_d":
                raise ValueError(f"quantities.{name}.age_r: only refraction_d may have it; give others a slope")
        return self

    @property
    def age_r(self) -> float:
        """Correlation of the latent numbers of age and refraction."""
        return self.quantities["refraction_d"].age_r

    def constant(self, name: str) -> float:
        """Return the value of a constant."""
        return self.constants[name].value

    def median(self, name: str) -> float:
        """Return the median of a quantity with a marginal."""
        marginal = self.quantities[name].marginal
        assert marginal is not None
        return float(marginal.at(np.zeros(())))


@cache
def default_table() -> PopulationTable:
    """Return the table that comes with the package."""
    return PopulationTable.load(FOLDER / "default.yaml")
