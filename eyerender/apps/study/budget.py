"""The composition of the gaze error: algorithm, eye model, images and noise, paired frame by frame.

    error from noisy images of eye M = A + (E - A) + (I - E) + (N - I)
    A   the algorithm's own: exact features of the simplest eye of the run (E1 where it is there)
    E   exact features of eye M:                               E - A: added by the eye model
    I   features of M's images exposed without noise:          I - E: added by image formation and extraction
    N   features of the same images with the sensor's noise:   N - I: added by the noise

Each is a mean over the frames for which all four have an estimate, so the terms add up exactly. These are net effects:
a cause that moves gaze perpendicular to the existing error has nearly none. The rms angle between the paired estimates
measures the total effect; its square is that of the shift (the mean of each eye) plus that of the pattern over the
frames. If the images are exposed several times, these three are means over the noise seeds, and the scatter between
seeds is separated from the pattern: rms^2 = shift^2 + pattern^2 + scatter^2. The net effect is that of the stored
exposure.

A difference has a 95 % interval (Student's t of the paired differences). The frames are a design, not a sample, and a
symmetric rig shows each with its mirror image. The interval of E - A is therefore narrower than for independent frames,
by 2^1/2 at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats, Ints
from ...gaze.budget import displacement, mean_interval, root
from .results import ModelResults

ALGORITHM, EYE, IMAGE, NOISE, BOTH = "algorithm", "eye model", "image", "noise", "image and noise"
# Observers that may follow ray optics, in this order.
_STEPS = ("image-noiseless", "image")


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """A contribution in degrees."""

    name: str  # the cause
    deg: float  # its net effect on the mean error
    low_deg: float | None = None  # lower end of the 95 % interval, if it is a difference
    high_deg: float | None = None  # upper end
    rms_deg: float | None = None  # rms angle between the paired estimates; of the algorithm, between estimate and truth
    shift_deg: float | None = None  # part common to all frames of an eye
    # part that differs between the frames and repeats with every seed; with one exposure it includes noise
    pattern_deg: float | None = None
    scatter_deg: float | None = None  # part that differs between noise seeds; None for one seed
    seeds: int | None = None  # number of exposures with other noise; None for one exposure


@dataclass(frozen=True, slots=True, kw_only=True)
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
        """Return a term by its name."""
        return next((term for term in self.terms if term.name == name), None)


def budgets(parts: Sequence[ModelResults]) -> list[Budget]:
    """Compute the budget of each protocol, estimator and eye model; none without errors by ray optics.

    The reference is the first eye model of the run, which is E1 by default.
    """
    errors = _by_key(parts, "errors")
    vectors, seeds = _by_key(parts, "vectors"), _by_key(parts, "seed_vectors")
    models = list(dict.fromkeys(part.eye_model for part in parts))
    if not models:
        return []
    reference = "E1" if "E1" in models else models[0]
    out = []
    for protocol, name, model in dict.fromkeys(key[:3] for key in errors):
        keys = [(protocol, name, reference, "analytic")]
        keys += [(protocol, name, model, observer) for observer in ("analytic", *_STEPS)]
        keys = [key for k, key in enumerate(keys) if key in errors and (k != 1 or model != reference)]
        first = keys[0]
        if first[2:] != (reference, "analytic") or (protocol, name, model, "analytic") not in errors:
            continue
        if any(len(errors[key]) != len(errors[first]) for key in keys):
            continue
        noisy = seeds.get((protocol, name, model, "image-noiseless"))
        steps = [_Step(k[3], errors[k], vectors.get(k), noisy if k[3] == "image" else None) for k in keys]
        budget = _budget(steps, _eyes(parts, protocol, len(errors[first])))
        if budget is not None:
            n, terms, total = budget
            out.append(
                Budget(
                    protocol=protocol, estimator=name, eye_model=model, reference=reference, n=n, terms=terms,
                    total_deg=total,
                )
            )  # fmt: skip
    return out


@dataclass(frozen=True, slots=True)
class _Step:
    """Errors (n,), error vectors (n, 2), and those of several exposures (s, n, 2) of one observer."""

    observer: str
    errors: Floats
    vectors: Floats | None
    seeds: Floats | None = None


def _by_key(parts: Sequence[ModelResults], kind: str) -> dict[tuple[str, str, str, str], Floats]:
    """Group arrays by (protocol, estimator, eye model, observer)."""
    return {
        (protocol, name, part.eye_model, observer): found
        for part in parts
        for (protocol, observer), by_name in getattr(part, kind).items()
        for name, found in by_name.items()
    }


def _eyes(parts: Sequence[ModelResults], protocol: str, n: int) -> Ints:
    """Return the eye of each error; zeros where an error belongs to a frame of both."""
    for part in parts:
        for (name, _), (_, seen) in part.seen.items():
            if name == protocol and len(seen) == n:
                return seen.index.eye
    return np.zeros(n, np.int64)


def _budget(steps: Sequence[_Step], eye: Ints) -> tuple[int, tuple[Term, ...], float] | None:
    """Compute the number of frames, the terms and the total error."""
    rows = np.all([np.isfinite(step.errors) for step in steps], axis=0)
    n = int(rows.sum())
    if n < 2:
        return None
    observers = [step.observer for step in steps]
    start = _Step("", np.zeros(len(rows)), None if steps[0].vectors is None else np.zeros((len(rows), 2)))
    whole = float(steps[0].errors[rows].mean())
    terms = [Term(name=ALGORITHM, deg=whole, **_moved(start, steps[0], rows, eye))]
    for before, after in pairwise(steps):
        net, low, high = mean_interval((after.errors - before.errors)[rows])
        moved = _moved(before, after, rows, eye)
        terms.append(Term(name=_name(after.observer, observers), deg=net, low_deg=low, high_deg=high, **moved))
    return n, tuple(terms), float(steps[-1].errors[rows].mean())


def _moved(before: _Step, after: _Step, rows: Bools, eye: Ints) -> dict[str, Any]:
    """Compute the displacement part of a `Term`: rms angle, shift, pattern, and scatter over exposures."""
    if before.vectors is None or after.vectors is None:
        return {}
    vectors = after.vectors[None] if after.seeds is None else after.seeds
    rows = rows & np.isfinite(vectors).all(axis=(0, 2))
    if not rows.any():
        return {}
    parts = displacement(before.vectors[None, rows], vectors[:, rows], eye[rows])
    several = {} if after.seeds is None else {"scatter_deg": root(parts.scatter[0]), "seeds": len(after.seeds)}
    found = {f"{name}_deg": root(getattr(parts, name)[0]) for name in ("rms", "shift", "pattern")}
    return {**found, **several}


def _name(observer: str, steps: Sequence[str]) -> str:
    """Name the contribution of the step to an observer."""
    if observer == "analytic":
        return EYE
    if observer == "image-noiseless":
        return IMAGE
    return NOISE if "image-noiseless" in steps else BOTH
