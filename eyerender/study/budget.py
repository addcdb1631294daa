"""The composition of the gaze error: algorithm, eye model, images and noise, paired frame by frame.

    error from noisy images of eye M = A + (E - A) + (I - E) + (N - I)
    A   the algorithm's own: exact features of the simplest eye of the run (E1 where it is there)
    E   exact features of eye M:                               E - A is what the eye model adds
    I   features of M's images exposed without noise:          I - E is what forming and reading an image adds
    N   features of the same images with the sensor's noise:   N - I is what the noise adds

Each is a mean over the frames for which all four have an estimate, so the terms add up exactly. A difference has a 95 %
interval (Student's t of the paired differences). The frames are a design, not a sample, and a symmetric rig shows each
with its mirror image. The interval of E - A is therefore narrower than for independent frames, by 2^1/2 at most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..gaze.budget import mean_interval
from .results import ModelResults

ALGORITHM, EYE, IMAGE, NOISE, BOTH = "algorithm", "eye model", "image", "noise", "image and noise"
# Observers that may follow ray optics, in this order.
_STEPS = ("image-noiseless", "image")


@dataclass(frozen=True, slots=True)
class Term:
    """A contribution in degrees, with its interval if it is a difference."""

    name: str
    deg: float
    low_deg: float | None = None
    high_deg: float | None = None


@dataclass(frozen=True, slots=True)
class Budget:
    """Terms of one eye model's error with one estimator; they add up to `total_deg`."""

    protocol: str
    estimator: str
    eye_model: str
    reference: str
    n: int
    terms: tuple[Term, ...]
    total_deg: float

    def term(self, name: str) -> Term | None:
        """Find a term by its name."""
        return next((term for term in self.terms if term.name == name), None)


def budgets(parts: Sequence[ModelResults]) -> list[Budget]:
    """Budget of each protocol, estimator and eye model; none where there are no errors by ray optics.

    The reference is the first eye model of the run, which is E1 by default.
    """
    errors: dict[tuple[str, str, str, str], Floats] = {
        (protocol, name, part.eye_model, observer): found
        for part in parts
        for (protocol, observer), by_name in part.errors.items()
        for name, found in by_name.items()
    }
    models = list(dict.fromkeys(part.eye_model for part in parts))
    reference = "E1" if "E1" in models else models[0]
    out = []
    for protocol, name, model in dict.fromkeys(key[:3] for key in errors):
        first = errors.get((protocol, name, reference, "analytic"))
        own = {observer: errors.get((protocol, name, model, observer)) for observer in ("analytic", *_STEPS)}
        steps = {observer: found for observer, found in own.items() if found is not None}
        if first is None or "analytic" not in steps or any(len(v) != len(first) for v in steps.values()):
            continue
        budget = _budget(protocol, name=name, model=model, reference=reference, first=first, steps=steps)
        if budget is not None:
            out.append(budget)
    return out


def _budget(
    protocol: str, *, name: str, model: str, reference: str, first: Floats, steps: Mapping[str, Floats]
) -> Budget | None:
    rows = np.isfinite(first) & np.all([np.isfinite(v) for v in steps.values()], axis=0)
    n = int(rows.sum())
    if n < 2:
        return None
    before = first[rows]
    terms = [Term(ALGORITHM, float(before.mean()))]
    for observer, errors in steps.items():
        after = errors[rows]
        if observer != "analytic" or model != reference:
            terms.append(Term(_name(observer, steps), *mean_interval(after - before)))
        before = after
    return Budget(protocol, name, model, reference, n, tuple(terms), float(before.mean()))


def _name(observer: str, steps: Mapping[str, Floats]) -> str:
    """Name of the contribution of the step to an observer."""
    if observer == "analytic":
        return EYE
    if observer == "image-noiseless":
        return IMAGE
    return NOISE if "image-noiseless" in steps else BOTH
