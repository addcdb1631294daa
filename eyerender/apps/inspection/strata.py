"""Strata of a dataset, with some images of each for a contact sheet, and the shares that matter to training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Ints, Objects
from ...dataset.selection import scrambled
from ...rig.plausibility import SATURATED_SHARE
from .figures import DRAW, EYE_PRESENT, GAZE_ANGLE, LIDS_SHUT, PUPIL_VISIBLE, SATURATED
from .reading import Contents, spread

_KINDS = 8  # values of a group, or of a drawn whole number, that are strata
_DRAWS = 6
_EACH, _SUBJECTS = 6, 24
_TAIL = 0.1
_CONDITIONS = (
    "label pupil visible (share)",
    "label pupil radius (px)",
    "label gaze yaw (deg)",
    "label gaze pitch (deg)",
    "label opening of the lids (px)",
    "picture mean level",
)


@dataclass(frozen=True, slots=True)
class Stratum:
    """Images that have something in common: their number, and the places of some of them."""

    name: str
    images: int
    shown: tuple[int, ...]


def strata(contents: Contents) -> list[tuple[str, list[Stratum]]]:
    """Divide a dataset by subjects, by groups, by drawn alternatives and by conditions, one after another."""
    readable = np.array([bool(name) for name in contents.names]) & np.array([bool(d) for d in contents.digests])
    found = [("subjects", _subjects(contents, readable))]
    found += [(name, list(_values(contents, values, readable))) for name, values in contents.groups.items()]
    draws = 0
    for name, column in contents.columns.items():
        values = np.unique(column[np.isfinite(column)])
        if name.startswith(DRAW) and 2 <= len(values) <= _KINDS and np.array_equal(values, np.round(values)):
            draws += 1
            if draws <= _DRAWS:
                texts = np.array([f"{v:g}" if np.isfinite(v) else None for v in column.tolist()], dtype=object)
                found.append((name, list(_values(contents, texts, readable))))
    found += [(name, list(_tails(contents, name, readable))) for name in _CONDITIONS if name in contents.columns]
    kept: dict[tuple[tuple[int, tuple[int, ...]], ...], tuple[str, list[Stratum]]] = {}
    for name, parts in found:
        if len(parts) > 1 or (name == "subjects" and parts):
            kept.setdefault(tuple((part.images, part.shown) for part in parts), (name, parts))  # each division once
    return list(kept.values())


def _subjects(contents: Contents, readable: Bools) -> list[Stratum]:
    """One stratum, of one image of each of some subjects."""
    places = np.flatnonzero(readable & (contents.subjects >= 0))
    subjects, first = np.unique(contents.subjects[places], return_index=True)
    if not len(subjects):
        return []
    shown = places[first[spread(len(subjects), _SUBJECTS)]]
    return [Stratum(f"one image of each of {len(shown)} of {len(subjects)} subjects", len(places), _places(shown))]


def _values(contents: Contents, values: Objects, readable: Bools) -> Iterator[Stratum]:
    """A stratum for each value of a group."""
    kinds = sorted({str(v) for v in values if v is not None})
    if not 2 <= len(kinds) <= _KINDS:
        return
    for kind in kinds:
        own = values == kind
        yield Stratum(kind, int(own.sum()), _some(contents, np.flatnonzero(own & readable)))


def _tails(contents: Contents, name: str, readable: Bools) -> Iterator[Stratum]:
    """The lowest tenth of a column, the middle one and the highest."""
    column = contents.columns[name].astype(float)
    if not np.isfinite(column).any() or np.nanmin(column) == np.nanmax(column):
        return
    for text, low, high in (
        ("lowest", 0.0, _TAIL),
        ("middle", 0.5 - _TAIL / 2, 0.5 + _TAIL / 2),
        ("highest", 0.9, 1.0),
    ):
        start, end = np.nanquantile(column, (low, high))
        own = (column >= start) & (column <= end)
        label = f"{text} tenth: {start:.4g}" + (f" to {end:.4g}" if end > start else "")
        yield Stratum(label, int(own.sum()), _some(contents, np.flatnonzero(own & readable)))


def _some(contents: Contents, places: Ints) -> tuple[int, ...]:
    """Some of the places, mixed in a way that depends on the rows alone."""
    order = np.argsort(scrambled(contents.rows[places], 0), kind="stable")[:_EACH]
    return _places(np.sort(places[order]))


def _places(places: Ints) -> tuple[int, ...]:
    return tuple(int(at) for at in places)


# What is shared out: its column, and the names of the ranges that end below the given numbers.
_RANGES = {
    "gaze": (GAZE_ANGLE, {"to 10 deg": 10, "to 20 deg": 20, "to 35 deg": 35, "beyond": np.inf}),
    "lids": (LIDS_SHUT, {"open": 0.25, "half shut": 0.75, "shut": np.inf}),
    "pupil": (PUPIL_VISIBLE, {"hidden": 1e-9, "half hidden": 0.5, "visible": np.inf}),
    "eye": (EYE_PRESENT, {"none": 0.5, "there": np.inf}),
    "saturated pixels": (SATURATED, {"to 20 %": SATURATED_SHARE + 1e-9, "more": np.inf}),
}


def shares_of(contents: Contents) -> dict[str, dict[str, float]]:
    """Return the shares of the images in ranges of each quantity, among the images that have it."""
    out = {}
    for name, (column, ends) in _RANGES.items():
        values = contents.columns.get(column, np.zeros(0))
        values = values[np.isfinite(values)]
        if len(values):
            counts = np.bincount(np.searchsorted(list(ends.values()), values, side="right"), minlength=len(ends))
            out[name] = dict(zip(ends, (counts / len(values)).tolist(), strict=True))
    return out
