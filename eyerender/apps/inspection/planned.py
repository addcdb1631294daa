"""Which draws and labels of a folder depend on each other, and which draws of a plan, without rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...base.arrays import Floats, Ints, Objects, Reals
from ...base.errors import InputError
from ...base.progress import Progress, notify
from ...dataset.draws import GridDraw, SequenceDraw
from ...dataset.plan import Plan
from ...dataset.spec import DatasetSpec
from .dependence import Dependence, dependences
from .figures import DRAW, LABEL, PERSON, draws_of
from .missing import levels
from .reading import Contents
from .statistics import Distribution, distribution

_AZIMUTH = f"{LABEL}eye azimuth (deg)"
_LABELS = (_AZIMUTH, f"{LABEL}eye elevation (deg)", f"{LABEL}pupil stop diameter (mm)")
_SPLIT, _CAMERA, _EYE = _GROUPS = ("split", "camera", "eye")
_ORDER = "order"
_NUMBERED = (f"{PERSON}seed", f"{PERSON}subject")  # say who a person is
# Kinds of names that belong together, or of which one follows from the other by physics.
_ALONE = ({PERSON}, {_EYE}, {_CAMERA}, {_SPLIT})
_RELATED = (*_ALONE, {LABEL, PERSON}, {LABEL, DRAW}, {PERSON, _EYE}, {PERSON, _CAMERA}, {_EYE, _CAMERA})


def dependences_of(contents: Contents) -> list[Dependence] | None:
    """Test the draws, people, poses and pupils, splits, cameras, eyes and the order of a folder's images."""
    try:
        spec = DatasetSpec.from_mapping(contents.folder.dataset.get("spec") or {})
        ordered = ordered_draws(Plan(spec=spec, eyes={}, files={}, base=Path()))
    except InputError:
        ordered = set()  # a folder that `render` wrote
    numbers = _tested(contents.columns, contents.groups, contents.frames)
    return dependences(numbers, contents.subjects, may_depend(ordered))


class PlannedDraws(NamedTuple):
    """Draws of `read` of the `images` samples of a plan; the rest is as of an `Inspection`."""

    path: str
    images: int
    read: int
    splits: dict[str, tuple[int, set[int]]]
    distributions: dict[str, Distribution]
    dependences: list[Dependence] | None

    def to_mapping(self) -> dict[str, Any]:
        """Return what the JSON holds of the plan."""
        return {
            "path": self.path,
            "images": self.images,
            "images_read": self.read,
            "splits": {name: {"images": n, "subjects": len(own)} for name, (n, own) in self.splits.items()},
            "columns": {name: d.to_mapping() for name, d in self.distributions.items()},
            "dependences": None if self.dependences is None else [one._asdict() for one in self.dependences],
        }


def draw_plan(given: str | Path | Plan, limit: int, progress: Progress | None) -> PlannedDraws:
    """Draw up to `limit` samples of a spec or a plan, spread evenly over it, without rendering.

    Raises:
        InputError: the spec cannot be read, or a sample not be drawn.
    """
    plan = Plan.load(given)
    samples = plan.spread(limit)
    columns: dict[str, Floats] = {}
    subjects, splits = np.zeros(len(samples), dtype=np.int64), np.full(len(samples), None, dtype=object)
    for at, index in enumerate(samples):
        sample = plan.draw(index)
        subjects[at], splits[at] = sample.turn.subject, sample.split
        for name, value in draws_of(sample.draws):
            columns.setdefault(name, np.full(len(samples), np.nan))[at] = value
        notify(progress, at + 1, len(samples), "samples")
    numbers = _tested(columns, {_SPLIT: splits}, np.array(samples))
    own = {name: splits == name for name in sorted(set(splits.tolist()))}
    return PlannedDraws(
        path=plan.spec.name if isinstance(given, Plan) else str(given),
        images=plan.spec.count,
        read=len(samples),
        splits={name: (int(rows.sum()), set(subjects[rows].tolist())) for name, rows in own.items()},
        distributions={name: distribution(name, column) for name, column in sorted(columns.items())},
        dependences=dependences(numbers, subjects, may_depend(ordered_draws(plan))),
    )


def ordered_draws(plan: Plan) -> set[str]:
    """Return the names of draws that follow the order of a subject's samples: sequences and grids."""
    drawn = {**plan.scene_template.draws, **plan.variable_template.draws}
    return {f"{DRAW}{path}" for path, placed in drawn.items() if isinstance(placed.draw, SequenceDraw | GridDraw)}


def may_depend(ordered: set[str]) -> Callable[[str, str], bool]:
    """Return the test of whether two names depend on each other by the spec or by physics.

    Sequences and grids depend on each other and on the order, and so do eyes and cameras that follow them. The azimuth
    of an eye depends on which eye it is (vergence), and which eye is seen on the camera. A person's numbers are those
    of the eye that is seen. See also `_RELATED`.
    """
    follows = any("eyes" in name or "cameras" in name for name in ordered)

    def declared(a: str, b: str) -> bool:
        kinds = {next((k for k in (LABEL, DRAW, PERSON, *_GROUPS) if name.startswith(k)), _ORDER) for name in (a, b)}
        if PERSON in kinds and {a, b} & ordered:
            return True
        if all(name in ordered or name == _ORDER or (follows and name.startswith((_EYE, _CAMERA))) for name in (a, b)):
            return True
        if kinds == {DRAW}:  # numbers of one draw, such as a multivariate normal one
            return a.partition("[")[0] == b.partition("[")[0]
        return kinds in _RELATED or (_AZIMUTH in (a, b) and bool(kinds & {_EYE, _CAMERA}))

    return declared


def _tested(columns: Mapping[str, Reals], groups: Mapping[str, Objects], order: Ints) -> dict[str, Floats]:
    numbers = {n: v.astype(float) for n, v in columns.items() if n.startswith((DRAW, PERSON)) or n in _LABELS}
    numbers = {name: values for name, values in numbers.items() if name not in _NUMBERED}
    return numbers | levels({k: groups[k] for k in _GROUPS if k in groups}) | {_ORDER: order.astype(float)}
