"""Feature clouds (the paper's Figure 3): pupil centres and glints of 135 fixations, and findings F1 to F9 on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Floats
from ...eye.catalogue import load_eye
from ...eye.spec import EyeSpec
from ...scene import Scene
from ...scene.observation import Observations
from .findings import Rules
from .literature import CONIC
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


def apart(a: Cloud, b: Cloud, part: str, *, centred: bool = False) -> float:
    """Compute the rms distance between two clouds, over the width of the second."""
    p, q = getattr(a, part), getattr(b, part)
    away = p - q
    if centred:
        away = away - np.nanmean(away, axis=0)
    return float(np.sqrt(np.nanmean((away**2).sum(axis=1)))) / float(np.ptp(q[:, 0]))


def turned_like_e2(eye: str, scene: Scene) -> Scene | None:
    """Turn E1 and E5 about the centre of rotation of E2, to test what the centres cause; None for other models."""
    if eye not in ("E1", "E5"):
        return None
    data = scene.eye_spec.to_mapping()
    data["rotation"] = load_eye("E2").to_mapping()["rotation"]
    return scene.replaced(eye_spec=EyeSpec.from_mapping(data))


def findings(
    clouds: Mapping[str, Cloud], protocol: str, observer: str, turned: Mapping[str, Cloud] | None = None
) -> list[Finding]:
    """Test F1 to F9 for the models that were run; `turned` are clouds of `turned_like_e2`."""
    rule = Rules(protocol, observer)
    found = [one for test in (_size, _aspects, _bows, _four_surfaces) for one in test(rule, clouds)]
    return [*found, *_centres(rule, clouds, turned or {})]


_PARTS = {"pupil": "pupil_px", "glint": "glint_px"}


def _size(rule: Rules, clouds: Mapping[str, Cloud]) -> Iterator[Finding]:
    """Test F1: E1's clouds are small, and its glint stands still."""
    if "E1" in clouds:
        about = "E1 turns about the centre of its spherical cornea"
        yield rule("F1 glint", extent_px(clouds["E1"].glint_px), detail=about)
        sizes = {n: np.ptp(c.pupil_px, axis=0) for n, c in clouds.items()}
        ratios = {n: float((sizes["E1"] / size).max()) for n, size in sizes.items() if n != "E1"}
        if ratios:
            yield rule("F1 size", ratios, max)


def _aspects(rule: Rules, clouds: Mapping[str, Cloud]) -> Iterator[Finding]:
    """Test F2: E5's clouds are flatter."""
    if "E5" in clouds and len(clouds) > 1:
        pupils = {f"{n} pupils": aspect(c.pupil_px) for n, c in clouds.items()}
        # E1's glint is a point, which has no aspect.
        glints = {f"{n} glints": aspect(c.glint_px) for n, c in clouds.items() if n != "E1"}
        ratio = max(
            by.pop(key) / min(by.values(), default=np.inf)
            for by, key in ((dict(pupils), "E5 pupils"), (dict(glints), "E5 glints"))
        )
        yield rule("F2", {**pupils, **glints}, lambda _: ratio)


def _bows(rule: Rules, clouds: Mapping[str, Cloud]) -> Iterator[Finding]:
    """Test F4 to F6: rows of targets bend more with conic corneas, and most with E5."""
    conic = [n for n in CONIC if n in clouds]
    for name, part in _PARTS.items():
        bows = {n: bow(getattr(clouds[n], part)) for n in ("E3", *CONIC, "E5") if n in clouds}
        if conic and "E3" in bows:
            rise = min(bows[n] for n in conic) - bows["E3"]
            yield rule("F4", bows, lambda _, rise=rise: rise, part=name)
        if "E5" in bows and len(bows) > 1:
            ratio = bows["E5"] / max(v for n, v in bows.items() if n != "E5")
            yield rule("F5", bows, lambda _, ratio=ratio: ratio, part=name)
    if conic and "E3" in clouds:
        # The image's y is down, so the top left corner of the figure has the smallest x + y.
        corner = int(np.argmin(clouds["E3"].glint_px.sum(axis=1)))
        middle = COLUMNS // 2 * ROWS + ROWS // 2
        away = {n: np.linalg.norm(clouds[n].glint_px - clouds["E3"].glint_px, axis=1) for n in conic}
        yield rule("F6", {n: float(d[corner] - d[middle]) for n, d in away.items()}, min)


def _four_surfaces(rule: Rules, clouds: Mapping[str, Cloud]) -> Iterator[Finding]:
    """Test F3, F7 and F9: what asphericity, posterior cornea and lens, and the finite model change."""
    if {"E3", "E4"} <= set(clouds):
        found = {name: apart(clouds["E4"], clouds["E3"], part) for name, part in _PARTS.items()}
        yield rule("F3 pupil", found["pupil"])
        yield rule("F3 glint", found, lambda both: both[1] if both[1] > both[0] else np.nan)
    if {"E2", "E4"} <= set(clouds):
        yield rule("F7", {name: apart(clouds["E4"], clouds["E2"], part) for name, part in _PARTS.items()}, max)
    if {"E2", "E4", "E5"} <= set(clouds):
        ratios = {
            name: min(apart(clouds["E5"], clouds[n], part, centred=True) for n in CONIC)
            / apart(clouds["E4"], clouds["E2"], part, centred=True)
            for name, part in _PARTS.items()
        }
        yield rule("F9", ratios, min)


def _centres(rule: Rules, clouds: Mapping[str, Cloud], turned: Mapping[str, Cloud]) -> Iterator[Finding]:
    """Test F8: turned about the centre of E2, E1 and E5 lose most of what distinguishes them from it."""
    measures: dict[str, tuple[str, Callable[[Cloud], float]]] = {
        "E1": ("width of the pupil cloud", lambda c: float(np.ptp(c.pupil_px[:, 0]))),
        "E5": ("aspect of the pupil cloud", lambda c: aspect(c.pupil_px)),
    }
    for model, (what, measure) in measures.items():
        if {model, "E2"} <= set(clouds) and model in turned:
            found = {"E2": clouds["E2"], model: clouds[model], "turned": turned[model]}
            base, own, other = values = [measure(c) for c in found.values()]
            left = abs(other - base) / (abs(own - base) or np.nan)
            shown = dict(zip(found, values, strict=True))
            yield rule("F8", shown, lambda _, left=left: left, model=model, what=what)
