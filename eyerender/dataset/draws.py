"""Distributions ("draws") that may replace any value of a scene template.

A draw is a mapping with the key `draw`. Its value is a pure function of the dataset's seed, the draw's dotted path in
the template, the unit it belongs to (a sample or a subject) and the attempt:

    u = (m + 1/2) / 2^53,   m = the first 53 bits of SHA-256("seed/path/unit/number/attempt")

It therefore depends neither on other draws nor on the process that makes the sample. Grids form one joint full
factorial design.

Sobol draws form one joint scrambled sequence (Owen 1998, as in `scipy.stats.qmc.Sobol`). Its points go to the first
samples of all subjects, then to their second ones, and so on; each 16 in a row are permuted by a hash. So 16 subjects
cover every range evenly, and no point depends on whether a sample's or a subject's number is even, nor on sequences.
Each subject enters sequences at a place of its own; of n subjects in a row each enters one with n values elsewhere.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator
from scipy.special import betaincinv, log_ndtr, ndtri, ndtri_exp

from ..base.errors import InputError
from ..base.spec import Positive, Spec

Unit = Literal["sample", "clip", "subject"]
MARK = "draw"
RUN = 16  # points of a Sobol sequence that are permuted
# The largest numbers that may be drawn are Cauchy's coefficients of an eye's media; the largest integers are seeds.
Drawn = Annotated[float, Field(ge=-1e20, le=1e20)]
Whole = Annotated[int, Field(ge=-(2**63), lt=2**63)]


class _Draw(Spec):
    per: Unit | None = Field(
        default=None,
        description="drawn once per sample, per clip of a sequence, or per subject; default: depends on the path",
    )


class _RangeDraw(_Draw):
    low: Drawn
    high: Drawn

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low must be < high, not {self.low:g} and {self.high:g}")
        return self


class FixedDraw(_Draw):
    """A constant value; unlike a plain value, it allows `per` and comments beside it."""

    draw: Literal["fixed"]
    value: Any


class UniformDraw(_RangeDraw):
    """Uniform distribution: low + (high - low) u."""

    draw: Literal["uniform"]


class LogUniformDraw(_RangeDraw):
    """Uniform distribution of the logarithm: low (high / low)^u, for numbers that span orders of magnitude."""

    draw: Literal["log_uniform"]
    low: Annotated[Positive, Field(le=1e20)]
    high: Annotated[Positive, Field(le=1e20)]


class IntegerDraw(_RangeDraw):
    """Whole number from low to high, both included."""

    draw: Literal["integer"]
    low: Whole
    high: Whole


class NormalDraw(_RangeDraw):
    """Normal distribution truncated at `low` and `high`."""

    draw: Literal["truncated_normal"]
    mean: Drawn
    sd: Positive


class GaussianDraw(_Draw):
    """Normal distribution without truncation."""

    draw: Literal["normal"]
    mean: Drawn
    sd: Positive


class BetaDraw(_Draw):
    """Beta distribution of the shapes `a` and `b`, from `low` to `high`."""

    draw: Literal["beta"]
    a: Annotated[Positive, Field(le=1e6)]
    b: Annotated[Positive, Field(le=1e6)]
    low: Drawn = 0.0
    high: Drawn = 1.0


class MultivariateNormalDraw(_Draw):
    """Correlated normal numbers, a list: mean + L z, where L is the Cholesky factor of the covariance."""

    draw: Literal["multivariate_normal"]
    mean: Annotated[tuple[Drawn, ...], Field(min_length=1, max_length=100)]
    covariance: Annotated[tuple[tuple[Drawn, ...], ...], Field(min_length=1, max_length=100)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = len(self.mean)
        if any(len(row) != n for row in self.covariance) or len(self.covariance) != n:
            raise ValueError(f"covariance: must be {n} x {n}, as there are {n} means")
        matrix = np.array(self.covariance)
        if not np.array_equal(matrix, matrix.T):
            raise ValueError("covariance: must be symmetric")
        try:
            np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            raise ValueError("covariance: must be positive definite") from None
        return self

    def at(self, numbers: Sequence[float]) -> list[float]:
        """Return the value for one number in (0, 1) per dimension."""
        factor = np.linalg.cholesky(np.array(self.covariance))
        return [float(v) for v in np.array(self.mean) + factor @ ndtri(np.array(numbers))]


class MixtureDraw(_Draw):
    """One of several draws, chosen by weight; it is converted to a choice of draws."""

    draw: Literal["mixture"]
    components: Annotated[tuple[Any, ...], Field(min_length=1)]

    def as_choice(self) -> ChoiceDraw:
        """Return the choice of the components; InputError if a component is not a draw, or has no weight."""
        data: dict[str, Any] = {MARK: "choice", "values": [], "weights": []}
        for k, component in enumerate(self.components):
            if not is_draw(component) or "weight" not in component:
                raise InputError("must be a draw with a weight", path=f"components.{k}")
            data["weights"].append(component["weight"])
            # Each component may state for what it is drawn; by default as the mixture.
            data["values"].append({"per": self.per, **{k: v for k, v in component.items() if k != "weight"}})
        for value in data["values"]:
            if value["per"] is None:
                del value["per"]
        return ChoiceDraw.from_mapping({**data, **({} if self.per is None else {"per": self.per})})


class ChoiceDraw(_Draw):
    """One of `values`, which may be anything, including mappings with draws of their own."""

    draw: Literal["choice"]
    values: Annotated[tuple[Any, ...], Field(min_length=1)]
    weights: tuple[Annotated[float, Field(ge=0, le=1e20)], ...] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.weights is not None:
            if len(self.weights) != len(self.values):
                raise ValueError("weights: give one for each value")
            if not sum(self.weights) > 0:
                raise ValueError("weights: at least one must be > 0")
        return self


class GridDraw(_Draw):
    """Evenly spaced numbers or given values, taken in order; several grids form their full product."""

    draw: Literal["grid"]
    low: Drawn | None = None
    high: Drawn | None = None
    steps: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        spaced = (self.low, self.high, self.steps)
        if (self.values is None) == all(v is None for v in spaced) or (
            self.values is None and any(v is None for v in spaced)
        ):
            raise ValueError("give either low, high and steps, or values")
        return self

    @property
    def size(self) -> int:
        """Number of values of the grid."""
        return len(self.values) if self.values is not None else self.steps or 1

    def point(self, k: int) -> Any:
        """Return value number k of the grid."""
        if self.values is not None:
            return self.values[k]
        if self.low is None or self.high is None or self.steps is None or self.steps == 1:
            return self.low
        return self.low + (self.high - self.low) * (k / (self.steps - 1))


class SobolDraw(_RangeDraw):
    """Quasi-random number low + (high - low) s; s is one dimension of the joint Sobol sequence of all such draws."""

    draw: Literal["sobol"]


class SequenceDraw(_Draw):
    """Consecutive values for consecutive samples of a subject, cyclically; the first one differs between subjects."""

    draw: Literal["sequence"]
    values: Annotated[tuple[Any, ...], Field(min_length=1)]


Draw = (
    FixedDraw
    | UniformDraw
    | LogUniformDraw
    | IntegerDraw
    | NormalDraw
    | GaussianDraw
    | BetaDraw
    | MultivariateNormalDraw
    | ChoiceDraw
    | GridDraw
    | SobolDraw
    | SequenceDraw
)
_KINDS: dict[str, type[Draw]] = {str(get_args(kind.model_fields[MARK].annotation)[0]): kind for kind in get_args(Draw)}
KINDS = (*_KINDS, "mixture", "table")


def is_draw(node: object) -> bool:
    """Return whether a node of a template is a distribution."""
    return isinstance(node, dict) and MARK in node


def parse_draw(node: dict[str, Any], *, source: str, path: str) -> Draw:
    """Parse a node of a template as a distribution; InputError with the path of the wrong key."""
    kind: type[Draw | MixtureDraw] | None = MixtureDraw if node[MARK] == "mixture" else _KINDS.get(str(node[MARK]))
    if node[MARK] == "table":
        raise InputError("a table is read with the file of a spec; give its rows as a choice", source=source, path=path)
    if kind is None:
        raise InputError(f"must be one of {', '.join(KINDS)}, not {node[MARK]!r}", source=source, path=f"{path}.draw")
    try:
        draw = kind.from_mapping(node)
        return draw.as_choice() if isinstance(draw, MixtureDraw) else draw
    except InputError as error:
        raise error.placed(source=source, under=path) from None


def unit_number(seed: int, path: str, unit: str, number: int, attempt: int) -> float:
    """Compute the number u in (0, 1) of a draw; see the module."""
    digest = hashlib.sha256(f"{seed}/{path}/{unit}/{number}/{attempt}".encode()).digest()
    return ((int.from_bytes(digest[:8], "big") >> 11) + 0.5) / 2.0**53


def mixed(seed: int, what: str, number: int, run: int) -> int:
    """Permute whole numbers within consecutive runs of `run`, in an order drawn for each run."""
    first = number // run * run
    return first + _order(seed, what, first, run)[number - first]


@lru_cache(maxsize=4096)
def _order(seed: int, what: str, first: int, run: int) -> list[int]:
    return sorted(range(run), key=lambda k: unit_number(seed, what, "order", first + k, 0))


def random_value(draw: Draw, u: float) -> Any:
    """Return the value of a random draw at u; for a choice, the index of the chosen value."""
    if isinstance(draw, UniformDraw | SobolDraw):
        return draw.low + (draw.high - draw.low) * u
    if isinstance(draw, LogUniformDraw):
        return draw.low * (draw.high / draw.low) ** u
    if isinstance(draw, IntegerDraw):
        return min(draw.low + int(u * (draw.high - draw.low + 1)), draw.high)
    if isinstance(draw, NormalDraw):
        return truncated_normal(u, mean=draw.mean, sd=draw.sd, low=draw.low, high=draw.high)
    if isinstance(draw, GaussianDraw):
        return draw.mean + draw.sd * float(ndtri(u))
    if isinstance(draw, BetaDraw):
        return draw.low + (draw.high - draw.low) * float(betaincinv(draw.a, draw.b, u))
    if isinstance(draw, ChoiceDraw):
        weights = draw.weights or (1.0,) * len(draw.values)
        level, total = u * math.fsum(weights), 0.0
        for k, weight in enumerate(weights):
            total += weight
            if level < total:
                return k
        return max(k for k, weight in enumerate(weights) if weight > 0)
    raise TypeError(type(draw).__name__)


def truncated_normal(u: float, *, mean: float, sd: float, low: float, high: float) -> float:
    """Compute the quantile Phi^-1(Phi(a) + u (Phi(b) - Phi(a))), in logarithms, so that tails are accurate."""
    a, b = (low - mean) / sd, (high - mean) / sd
    if a > 0:
        # The upper tail is computed by symmetry, because Phi is indistinguishable from 1 there.
        return -truncated_normal(1 - u, mean=-mean, sd=sd, low=-high, high=-low)
    log_a, log_b = float(log_ndtr(a)), float(log_ndtr(b))
    # log(Phi(a) + u (Phi(b) - Phi(a))) = log Phi(b) + log(r + u (1 - r)),  r = Phi(a) / Phi(b)
    r = math.exp(log_a - log_b)
    x = mean + sd * float(ndtri_exp(log_b + math.log(r + u * (1 - r))))
    return min(max(x, low), high)
