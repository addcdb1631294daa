"""Populations in Python code: people as arrays, and each of them as a subject of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.errors import InputError
from ..base.spec import EYES
from ..population.people import Person, PopulationSpec
from .subject import Subject

CHUNK = 4096
"""Number of people drawn at once; their values take 5 MB."""


class Population(PopulationSpec):
    """A population: one of the table's presets, with changed distributions and conditions.

    >>> len(er.Population("myopes").draw(3, seed=1))
    3
    """

    POSITIONAL: ClassVar[tuple[str, ...]] = ("preset",)
    if TYPE_CHECKING:

        def __init__(self, preset: str = "adults", **fields: Any) -> None: ...

    def draw(self, n: int, seed: int = 0, *, first: int = 0) -> People:
        """Draw subjects `first` to `first + n - 1`; each depends only on (this population, seed, subject).

        Raises:
            InputError: n < 1, or hardly anybody meets the conditions.
        """
        if n < 1:
            raise InputError(f"must be >= 1, not {n}", path="n")
        parts = [part.values for part in self.chunks(n, seed, first=first)]
        values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return People(self, seed, np.arange(first, first + n), values)

    def chunks(self, n: int, seed: int = 0, *, first: int = 0, size: int = CHUNK) -> Iterator[People]:
        """Draw the same people in pieces of at most `size`, so that memory does not grow with n."""
        for start in range(first, first + n, size):
            count = min(size, first + n - start)
            yield People(self, seed, np.arange(start, start + count), self.numbers(count, seed, first=start))


@dataclass(frozen=True, slots=True, eq=False)
class People:
    """People as arrays: `people["axial_length_mm"]` is (n, 2) for right and left, `people["age_years"]` is (n,)."""

    population: PopulationSpec  # the population from which they are drawn
    seed: int
    number: Ints  # (n,) number of each subject
    values: Mapping[str, Floats]  # name -> (n,) or (n, 2); see `PopulationSpec.numbers`

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, name: str) -> Floats:
        """Return one quantity, (n,) or (n, 2). Raises InputError if there is no such quantity."""
        if name not in self.values:
            raise InputError(f"no such quantity; there are {', '.join(self.values)}", path=name)
        return self.values[name]

    def person(self, row: int) -> Person:
        """Create the person of a row."""
        row = range(len(self))[row]
        numbers = {name: column[row] for name, column in self.values.items()}
        return Person.of(self.population.preset, self.seed, int(self.number[row]), numbers)

    def subject(self, row: int, **fields: Any) -> Subject:
        """Create the subject of a scene from a row, with lids, a face, and a separate eye for each side.

        `fields`: further fields of `Subject`: `eyes`, `luminance_cd_m2`, `accommodation_d`, ...
        """
        return Subject.of(self.person(row), **fields)

    def columns(self) -> dict[str, Floats]:
        """Return every number as a column (n,) for a table; columns of an eye end with `.right` and `.left`."""
        out: dict[str, Floats] = {}
        for name, column in self.values.items():
            if column.ndim == 1:
                out[name] = column
            else:
                out |= {f"{name}.{side}": column[:, k] for k, side in enumerate(EYES)}
        return out
