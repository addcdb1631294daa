"""Feature clouds (the paper's Figure 3): pupil centres and glints of 135 fixations, and findings F1 to F4 on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Floats
from ...scene.observation import Observations
from .literature import SENTENCES
from .results import Finding

COLUMNS, ROWS = 15, 9


@dataclass(frozen=True, slots=True)
class Cloud:
    """Features of the right eye, one per target in the scene's order: pupil centres and glints, (135, 2) px."""

    pupil_px: Floats
    glint_px: Floats

    @classmethod
    def of(cls, observations: Observations) -> Cloud:
        """Create the cloud of the right eye's features; NaN if one is missing."""
        seen = observations.take(observations.index.eye == 0)
        glint, _ = seen.glints.of_light(0)
        return cls(np.asarray(seen.pupil.centre_px), glint)


def extent_px(points: Floats) -> float:
    """Compute the largest distance (px) of a point from the cloud's mean."""
    good = points[np.isfinite(points).all(axis=1)]
    return float(np.linalg.norm(good - good.mean(axis=0), axis=1).max()) if len(good) else float("nan")


def aspect(points: Floats) -> float:
    """Compute the ratio of the spreads across and along the cloud's long axis (singular values)."""
    good = points[np.isfinite(points).all(axis=1)]
    values = np.linalg.svd(good - good.mean(axis=0), compute_uv=False)
    return float(values[1] / values[0]) if values[0] > 0 else float("nan")


def bow(points: Floats) -> float:
    """Compute how rows of targets bend: largest distance from the chord over its length, averaged over the rows."""
    grid = points.reshape(COLUMNS, ROWS, 2)
    out = []
    for row in range(ROWS):
        p = grid[:, row]
        chord = p[-1] - p[0]
        length = float(np.linalg.norm(chord))
        across = (p - p[0]) @ np.array([-chord[1], chord[0]]) / length
        out.append(float(np.abs(across).max() / length))
    return float(np.mean(out))


def findings(clouds: Mapping[str, Cloud], protocol: str, observer: str) -> list[Finding]:
    """Test F1 to F4 for the models that were run."""
    out = []

    def add(name: str, rule: str, value: float, threshold: str, verdict: bool, detail: str) -> None:
        out.append(
            Finding(name, protocol, observer, rule, float(value), threshold, bool(verdict), detail, SENTENCES[name])
        )

    if "E1" in clouds:
        moved = extent_px(clouds["E1"].glint_px)
        add(
            "F1", "E1's glint does not move when the eye turns: largest distance from its mean (px)", moved,
            "< 0.001", moved < 1e-3, "E1 turns about the centre of its spherical cornea",
        )  # fmt: skip
    if "E5" in clouds and len(clouds) > 1:
        shapes = {n: (aspect(c.pupil_px), aspect(c.glint_px)) for n, c in clouds.items()}
        # E1's glint is a point, which has no aspect.
        others = [min(s[0] for n, s in shapes.items() if n != "E5")]
        others += [min((s[1] for n, s in shapes.items() if n not in ("E1", "E5")), default=np.inf)]
        ratio = max(shapes["E5"][0] / others[0], shapes["E5"][1] / others[1])
        detail = "; ".join(
            f"{n} pupil {s[0]:.3f}" + (f", glint {s[1]:.3f}" if n != "E1" else "") for n, s in shapes.items()
        )
        add(
            "F2", "E5's clouds are flatter than every other model's: its aspect over the smallest other one", ratio,
            "< 1", ratio < 1, detail,
        )  # fmt: skip
    if {"E3", "E4"} <= set(clouds):
        a, b = clouds["E3"].pupil_px, clouds["E4"].pupil_px
        apart = float(np.sqrt(np.nanmean(((a - b) ** 2).sum(axis=1)))) / float(np.ptp(a[:, 0]))
        add(
            "F3", "the pupil clouds of E3 and E4 nearly coincide: rms distance over the cloud's width", apart, "< 0.02",
            apart < 0.02, "",
        )  # fmt: skip
    order = [n for n in ("E3", "E2", "E4", "E5") if n in clouds]
    if len(order) > 1:
        bows = [bow(clouds[n].glint_px) for n in order]
        rise = float(min(np.diff(bows)))
        add(
            "F4",
            "the glint clouds bend more with the cornea's asphericity (Q 0, -.25, -.26, -.27/-.36 for E3, E2, E4, E5): "
            "smallest rise of the rows' bow from one to the next",
            rise, "> 0", bool(rise > 0), ", ".join(f"{n} {v:.4f}" for n, v in zip(order, bows, strict=True)),
        )  # fmt: skip
    return out
