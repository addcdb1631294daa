"""Findings of one dataset."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .dependence import Dependence
from .duplicates import SimilarPair
from .faults import KINDS
from .missing import MissingLabels
from .outliers import Outlier, WorstPicture
from .reading import Contents
from .statistics import Distribution

_LISTED = 100  # images of each kind of fault in the JSON


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """Findings of one dataset."""

    contents: Contents  # what was read
    splits: dict[str, tuple[int, set[int]]]  # split -> number of images and set of subjects
    shared: dict[int, list[str]]  # subject -> splits, of subjects in more than one
    equal: list[list[int]]  # places of pictures with the same pixels, by groups
    near: list[SimilarPair]  # pairs of near-duplicates
    outliers: list[Outlier]  # the most unusual images
    worst: list[WorstPicture]  # the worst pictures by simple figures
    distributions: dict[str, Distribution]  # of each column
    missing: list[MissingLabels]  # labels that more than 2 % of the images lack
    shares: dict[str, dict[str, float]]  # of the images, in ranges of what matters to training
    # pairs of draws and labels that depend on each other; None if there are too few subjects to test
    dependences: list[Dependence] | None

    def faults(self) -> dict[str, list[tuple[int, str]]]:
        """Places and details of the faults of each kind, in the order of `KINDS`."""
        found: dict[str, list[tuple[int, str]]] = defaultdict(list)
        for at in sorted(self.contents.faults):
            for fault in self.contents.faults[at]:
                found[fault.kind].append((at, fault.detail))
        return {kind: found[kind] for kind in KINDS if kind in found}

    def name(self, at: int) -> str:
        """Name of an image, or of its line."""
        return self.contents.names[at] or f"line {int(self.contents.rows[at]) + 1}"

    def to_mapping(self) -> dict[str, Any]:
        """Return what the JSON holds of the dataset."""
        c = self.contents
        return {
            "path": str(c.folder.path),
            "images": len(c.folder.entries),
            "images_read": sum(map(bool, c.names)),
            "unfinished": bool(c.folder.unfinished),
            "splits": {name: {"images": n, "subjects": len(own)} for name, (n, own) in self.splits.items()},
            "subjects_in_two_splits": {str(subject): names for subject, names in self.shared.items()},
            "groups": {name: counts_of(values) for name, values in c.groups.items()},
            "faults": {kind: self._listed(found) for kind, found in self.faults().items()},
            "outliers": [
                {"image": self.name(o.at), "distance": o.distance, "reasons": [asdict(r) for r in o.reasons]}
                for o in self.outliers
            ],
            "worst": [{"image": self.name(w.at), "figure": w.figure, "value": w.value} for w in self.worst],
            "near_duplicates": [[self.name(p.first), self.name(p.second), p.correlation] for p in self.near[:_LISTED]],
            "columns": {name: d.to_mapping() for name, d in self.distributions.items()},
            "shares": self.shares,
            "missing": [one._asdict() for one in self.missing],
            "dependences": None if self.dependences is None else [one._asdict() for one in self.dependences],
        }

    def _listed(self, found: Sequence[tuple[int, str]]) -> dict[str, Any]:
        images = [{"image": self.name(at), "detail": detail} for at, detail in found[:_LISTED]]
        return {"count": len(found), "images": images}


def counts_of(values: Any) -> dict[str, int]:
    """Count the images that have each value of a group."""
    kinds, counts = np.unique([str(v) for v in values if v is not None], return_counts=True)
    return {str(kind): int(count) for kind, count in zip(kinds, counts, strict=True)}
