"""A scene template, in which any value may be a draw, and the evaluation of its draws."""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError, Problems
from .draws import (
    MARK,
    RUN,
    ChoiceDraw,
    Draw,
    FixedDraw,
    GridDraw,
    MultivariateNormalDraw,
    SequenceDraw,
    SobolDraw,
    Unit,
    is_draw,
    mixed,
    parse_draw,
    random_value,
    unit_number,
)
from .expressions import REFERENCE, evaluate, is_reference, names_of

# Values that identify a subject, drawn once per subject unless the draw says otherwise.
IDENTITY = (
    "eye.model", "eye.margin", "look", "region", "subject.ipd_mm", "subject.eyes", "subject.spectacles",
    "subject.contact_lens", "eye_parameters",
)  # fmt: skip
# Exceptions, which change with every frame.
PASSING = ("region.blink", "region.squint", "region.wide")
# Values of the eye, which never change between frames, whatever the draw says.
FIXED_IDENTITY = ("eye.model", "eye.margin", "eye_parameters")
_BLOCK = 256
# Each draw becomes a column of the run, and all Sobol draws form one sequence of as many dimensions.
MAX_DRAWS = 1000
_CHOSEN = re.compile(r"#\d+")
# Keys that occur beside a key like "draw" only in draws, never in a scene's mapping.
_PARTS = frozenset(("low", "high", "mean", "sd", "weights", "steps", "covariance", "components", "value", "values"))


@dataclass(frozen=True, slots=True)
class PlacedDraw:
    """A draw and the unit for which it is drawn."""

    draw: Draw
    unit: Unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """Identity of the sample being drawn: index, subject, position in the subject's sequence, and both attempts.

    `place` is its position where the first samples of all subjects come first (`Selection.place_of`). In a dataset of
    sequences, `frames` consecutive samples are a clip.
    """

    sample: int
    subject: int
    sequence: int
    attempt: int
    subject_attempt: int
    place: int = 0
    frames: int = 1

    @property
    def clip(self) -> int:
        """Number of the sample's clip."""
        return self.sample // self.frames

    @property
    def frame(self) -> int:
        """Place of the sample in its clip."""
        return self.sample % self.frames


@dataclass(frozen=True, slots=True)
class Template:
    """A tree of plain values and draws; `draws` by their dotted path (a choice's k-th value is `path#k`)."""

    tree: Mapping[str, Any]
    draws: Mapping[str, PlacedDraw]
    seed: int

    @classmethod
    def of(
        cls,
        tree: Mapping[str, Any],
        seed: int,
        *,
        source: str = "",
        prefix: str = "",
        variables: Mapping[str, Unit] = MappingProxyType({}),
        clips: bool = False,
    ) -> Template:
        """Collect and check all draws, and all references to `variables`, which are drawn per sample or subject.

        With `clips`, what would be drawn per sample is drawn per clip. Raises InputError, with the path of the draw
        (after `prefix`).
        """
        draws: dict[str, PlacedDraw] = {}
        problems = Problems(source)
        _collect(tree, "", draws, problems, prefix)
        _check_references(tree, "", variables, problems, prefix)
        problems.check()
        refused = (
            {"sample": "would change within a clip; use clip"} if clips else {"clip": "needs a sequence in the scene"}
        )
        for path, placed in draws.items():
            if (reason := refused.get(str(placed.draw.per))) is not None:
                raise InputError(reason, source=source, path=f"{_join(prefix, path)}.per")
        if clips:
            draws = {path: _of_clip(placed) for path, placed in draws.items()}
        # Draws are sorted by name, so that the order of keys in a file has no effect.
        return cls(tree, dict(sorted(draws.items())), seed)

    def values(
        self, turn: Turn, variables: Mapping[str, Any] = MappingProxyType({})
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the tree of plain values of one sample, and every draw's value (None if it was not used)."""
        drawn: dict[str, Any] = dict.fromkeys(self.draws)
        tree = self._resolve(self.tree, "", turn, drawn)
        return _with_variables(tree, variables) if variables else tree, drawn

    def _resolve(self, node: Any, path: str, turn: Turn, drawn: dict[str, Any]) -> Any:
        if path in self.draws and is_draw(node):
            placed = self.draws[path]
            value, k = self._value(placed, path, turn)
            drawn[path] = _label(placed.draw, value, k)
            return self._resolve(value, f"{path}#{k}", turn, drawn)
        if isinstance(node, Mapping):
            return {key: self._resolve(v, _join(path, key), turn, drawn) for key, v in node.items()}
        if isinstance(node, list | tuple):
            return [self._resolve(v, _join(path, k), turn, drawn) for k, v in enumerate(node)]
        return node

    def _value(self, placed: PlacedDraw, path: str, turn: Turn) -> tuple[Any, int]:
        """Return the value of a draw, and its index among the draw's values (0 if it has no list of values)."""
        draw, unit = placed.draw, placed.unit
        number = {"sample": turn.sample, "clip": turn.clip, "subject": turn.subject}[unit]
        attempt = {"sample": turn.attempt, "clip": 0, "subject": turn.subject_attempt}[unit]
        if isinstance(draw, FixedDraw):
            return draw.value, 0
        if isinstance(draw, SequenceDraw):
            count = len(draw.values)
            k = (
                turn.sequence // (turn.frames if unit == "clip" else 1)
                + mixed(self.seed, "sequence", turn.subject, count)
            ) % count
            return draw.values[k], k
        if isinstance(draw, GridDraw):
            k = self._grid_index(path, unit, number)
            return draw.point(k), k
        if isinstance(draw, SobolDraw) and attempt == 0:
            dimensions = tuple(p for p, d in self.draws.items() if isinstance(d.draw, SobolDraw) and d.unit == unit)
            at = mixed(self.seed, f"sobol {unit} {dimensions}", turn.subject if unit == "subject" else turn.place, RUN)
            points = sobol_block(self.seed, unit, dimensions, at // _BLOCK)
            return random_value(draw, float(points[at % _BLOCK, dimensions.index(path)])), 0
        if isinstance(draw, MultivariateNormalDraw):
            places = (f"{path}[{k}]" for k in range(len(draw.mean)))
            return draw.at([unit_number(self.seed, place, unit, number, attempt) for place in places]), 0
        value = random_value(draw, unit_number(self.seed, path, unit, number, attempt))
        if isinstance(draw, ChoiceDraw):
            return draw.values[value], value
        return value, 0

    def _grid_index(self, path: str, unit: Unit, number: int) -> int:
        """Return the index in one grid of the full factorial product; the last grid by name varies fastest."""
        grids = [(p, d.draw) for p, d in self.draws.items() if isinstance(d.draw, GridDraw) and d.unit == unit]
        for name, grid in reversed(grids):
            size = grid.size
            if name == path:
                return number % size
            number //= size
        raise KeyError(path)


def _of_clip(placed: PlacedDraw) -> PlacedDraw:
    """Return a draw that is made per clip, unless it is made per subject."""
    return PlacedDraw(placed.draw, "clip") if placed.unit == "sample" else placed


def _with_variables(node: Any, variables: Mapping[str, Any]) -> Any:
    """Replace references to variables by their values."""
    if is_reference(node):
        return evaluate(str(node[REFERENCE]), variables)
    if isinstance(node, Mapping):
        return {key: _with_variables(value, variables) for key, value in node.items()}
    return [_with_variables(value, variables) for value in node] if isinstance(node, list | tuple) else node


def possible(node: Any) -> list[Any]:
    """Return every value that a node of a template can take; none for random numbers and invalid draws."""
    if not is_draw(node):
        return [node]
    values = [node.get("value")] if node.get("draw") == "fixed" else node.get("values")
    return [leaf for value in values for leaf in possible(value)] if isinstance(values, list | tuple) else []


def _label(draw: Draw, value: Any, k: int) -> Any:
    """Return a drawn value as recorded, of one type for every sample: the value, or its index if types differ."""
    if isinstance(draw, FixedDraw):
        every: tuple[Any, ...] = (draw.value,)
    elif isinstance(draw, GridDraw) and draw.values is None:
        return float(value)
    elif isinstance(draw, ChoiceDraw | SequenceDraw | GridDraw):
        every = draw.values or ()
    else:
        return value
    if all(isinstance(v, str) for v in every) or all(isinstance(v, bool) for v in every):
        return value
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in every):
        return value if all(isinstance(v, int) for v in every) else float(value)
    return k


@lru_cache(maxsize=16)
def sobol_block(seed: int, unit: str, dimensions: tuple[str, ...], block: int) -> Floats:
    """Return the points block * 256 .. + 255 of a scrambled Sobol sequence in (0, 1), (256, number of `dimensions`)."""
    from scipy.stats import qmc  # its import takes half a second

    generator = np.random.default_rng([seed, 1 if unit == "subject" else 0, zlib.crc32("/".join(dimensions).encode())])
    engine = qmc.Sobol(len(dimensions), scramble=True, rng=generator)
    if block:
        # This is `fast_forward`, which takes a step for each point that it skips: point n is the shift and, for each
        # bit of n's Gray code, a direction number, all combined by exclusive or (Antonov and Saleev 1979).
        last = block * _BLOCK - 1
        gray = last ^ (last >> 1)
        for bit in range(gray.bit_length()):
            if gray >> bit & 1:
                engine._quasi ^= engine._sv[:, bit]
        engine.num_generated = last + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about counts that are not powers of two; a sequence may stop anywhere
        return np.asarray(engine.random(_BLOCK))


def _collect(node: Any, path: str, draws: dict[str, PlacedDraw], problems: Problems, prefix: str) -> None:
    if is_draw(node):
        try:
            placed = draws[path] = _placed(node, path, problems.source, _join(prefix, path))
        except InputError as error:
            problems.include(error)
            return
        if len(draws) > MAX_DRAWS:
            raise InputError(f"holds more than {MAX_DRAWS} draws", source=problems.source, path=prefix)
        for k, value in enumerate(_values_of(placed.draw)):
            _collect(value, f"{path}#{k}", draws, problems, prefix)
    elif isinstance(node, Mapping):
        try:
            _refuse_misspelt(node, problems.source, _join(prefix, path))
        except InputError as error:
            problems.include(error)
            return
        for key, value in node.items():
            _collect(value, _join(path, key), draws, problems, prefix)
    elif isinstance(node, list | tuple):
        for k, value in enumerate(node):
            _collect(value, _join(path, k), draws, problems, prefix)


def _check_references(node: Any, path: str, variables: Mapping[str, Unit], problems: Problems, prefix: str) -> None:
    """Check every reference to variables."""
    if is_reference(node):
        try:
            _check_reference(node, path, variables)
        except InputError as error:
            problems.include(error.placed(source=problems.source, under=_join(prefix, path)))
        return
    children = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list | tuple) else ()
    for key, value in children:
        _check_references(value, _join(path, key), variables, problems, prefix)


def _check_reference(node: Mapping[str, Any], path: str, variables: Mapping[str, Unit]) -> None:
    """Check that an expression can be parsed, and that eyes do not depend on variables that change per frame.

    Raises:
        InputError: the expression is not allowed; the error has no path yet.
    """
    if set(node) != {REFERENCE}:
        raise InputError(f"no other key may be combined with {REFERENCE!r}")
    for name in names_of(str(node[REFERENCE])):
        if name not in variables:
            known = ", ".join(sorted(variables)) or "none"
            raise InputError(f"there is no variable {name!r}; the spec has {known}")
        if variables[name] != "subject" and _under(_CHOSEN.sub("", path), FIXED_IDENTITY):
            raise InputError(f"the eye must be drawn once per subject; write 'per: subject' for {name!r}")


def _refuse_misspelt(node: Mapping[str, Any], source: str, shown: str) -> None:
    """Raise an error for a mapping that looks like a draw but misspells the key `draw`; InputError naming the key."""
    keys = [key for key in node if isinstance(key, str)]
    if _PARTS.intersection(keys):
        for key in get_close_matches(MARK, [key for key in keys if key not in _PARTS], 1, 0.6):
            raise InputError(f"unknown key; did you mean {MARK!r}?", source=source, path=_join(shown, key))


def _placed(node: Any, path: str, source: str, shown: str) -> PlacedDraw:
    """Parse the draw at a path; messages use `shown` as its path."""
    draw = parse_draw(node, source=source, path=shown)
    bare = _CHOSEN.sub("", path)  # a place has the same meaning inside a choice
    identity = _under(bare, IDENTITY) and not _under(bare, PASSING)
    unit: Unit = draw.per or ("subject" if identity else "sample")
    if unit != "subject" and _under(bare, FIXED_IDENTITY):
        raise InputError("the eye must be drawn once per subject", source=source, path=f"{shown}.per")
    if isinstance(draw, SequenceDraw) and unit == "subject":
        raise InputError(
            "a sequence runs over the frames of a subject, so it cannot be drawn once per subject",
            source=source,
            path=shown,
        )
    return PlacedDraw(draw, unit)


def _values_of(draw: Draw) -> tuple[Any, ...]:
    """Return the values that a draw lists, which may contain further draws."""
    if isinstance(draw, FixedDraw):
        return (draw.value,)
    if isinstance(draw, ChoiceDraw | SequenceDraw | GridDraw):
        return draw.values or ()
    return ()


def _under(path: str, places: tuple[str, ...]) -> bool:
    return any(path == place or path.startswith(place + ".") for place in places)


def _join(path: str, key: object) -> str:
    return f"{path}.{key}" if path else str(key)
