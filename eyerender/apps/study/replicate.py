"""Replicate a study with one eye model: every protocol and variant, the waterfall, the restarts, the misprints."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...scene import Scene
from ...scene.observation import Observations
from . import blignaut, guestrin
from .featureclouds import Cloud
from .literature import CALIBRATION_SETS
from .observing import Observing
from .results import ModelResults, WaterfallStep, over_seeds


@dataclass(slots=True, kw_only=True)
class GuestrinPart(ModelResults):
    """Results of one eye model: calibrations with restarts; means and errors at H1 by (protocol, observer)."""

    calibrations: list[dict[str, Any]] = field(default_factory=list)
    means: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    h1_errors: dict[tuple[str, str], Floats] = field(default_factory=dict)
    waterfall: list[WaterfallStep] = field(default_factory=list)
    misprints: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(slots=True, kw_only=True)
class BlignautPart(ModelResults):
    """Results of one eye model: outcomes and feature clouds by (protocol, observer), the waterfall."""

    outcomes: dict[tuple[str, str], list[blignaut.FunctionErrors]] = field(default_factory=dict)
    centred: dict[tuple[str, str], list[blignaut.FunctionErrors]] = field(default_factory=dict)
    clouds: dict[tuple[str, str], Cloud] = field(default_factory=dict)
    waterfall: list[WaterfallStep] = field(default_factory=list)


class _Scenes:
    """Scenes and observations of one eye model and study, each computed only once."""

    def __init__(self, module: Any, eye: str, observing: Observing) -> None:
        self.module, self.eye, self.observing = module, eye, observing
        self._seen: dict[frozenset[str], tuple[Scene, Observations]] = {}

    def __call__(self, departures: Collection[str]) -> tuple[Scene, Observations]:
        key = self.module.scene_key(departures)
        if key not in self._seen:
            scene = self.module.scene(self.eye, key)
            self._seen[key] = scene, self.observing.observe(scene, facing=facing(self.module))
        return self._seen[key]

    def run(self, departures: Collection[str]) -> Any:
        """Run the study with some departures."""
        scene, seen = self(departures)
        return self.module.run(seen, scene.rig, departures)


def departures_of(module: Any, protocol: str) -> frozenset[str]:
    """Return the departures of a protocol, given by name."""
    return frozenset(module.PUBLISHED if protocol == "published" else module.CORRECTED)


def facing(module: Any) -> bool:
    """Return whether a study's cameras are turned to the eyes for their images."""
    return module is guestrin


def scenes_of(module: Any, eyes: Sequence[str], protocols: Sequence[str]) -> list[Scene]:
    """Return the scenes that a study observes in images."""
    keys = dict.fromkeys(module.scene_key(departures_of(module, protocol)) for protocol in protocols)
    return [module.scene(eye, key) for eye in eyes for key in keys]


def guestrin_part(
    eye: str, protocols: Sequence[str], observing: Observing, *, starts: int = guestrin.STARTS
) -> GuestrinPart:
    """Replicate Guestrin & Eizenman (2006) with one eye model and one observer."""
    scenes = _Scenes(guestrin, eye, observing)
    analytic = observing.kind == "analytic"
    out = GuestrinPart(eye_model=eye)
    exposures = [_Scenes(guestrin, eye, one) for one in observing.exposures()]
    for protocol in protocols:
        departures = departures_of(guestrin, protocol)
        out.seed_vectors[protocol, observing.kind] = over_seeds([_guestrin_vectors(s, departures) for s in exposures])
        scene, seen = scenes(departures)
        for variant, free in (("index fixed", False), ("index free", True)):
            if free and "index" in departures:
                continue
            done = guestrin.run(seen, scene.rig, departures, free_index=free)
            keys = {"protocol": protocol, "observer": observing.kind, "variant": variant, "eye_model": eye}
            out.rows += guestrin.rows_of(done, **keys)
            out.errors.setdefault((protocol, observing.kind), {})[f"model-based, {variant}"] = done.error_deg
            out.vectors.setdefault((protocol, observing.kind), {})[f"model-based, {variant}"] = done.vector_deg
            if not free:
                out.seen[protocol, observing.kind] = scene.rig, seen
                out.means[protocol, observing.kind] = {h: np.nan if m is None else m for h, m in done.means.items()}
                out.h1_errors[protocol, observing.kind] = done.error_deg[done.rows("H1")]
            if analytic:
                # The left eye is the right eye's mirror image, and so are its calibrations.
                spread = guestrin.restarts(done, scene.rig, departures, starts=starts)
                out.calibrations.append({**keys, **spread})
    if analytic and len(protocols) == 2:
        out.waterfall = _waterfall(eye, guestrin, lambda d: scenes.run(d).means)
    if analytic and "corrected" in protocols:
        out.misprints = _misprints(eye)
    return out


def _guestrin_vectors(scenes: _Scenes, departures: frozenset[str]) -> dict[str, Floats]:
    """Compute error vectors (n, 2) by variant."""
    scene, seen = scenes(departures)
    variants = {"index fixed": False} if "index" in departures else {"index fixed": False, "index free": True}
    return {
        f"model-based, {name}": guestrin.run(seen, scene.rig, departures, free_index=free).vector_deg
        for name, free in variants.items()
    }


def blignaut_part(eye: str, protocols: Sequence[str], observing: Observing) -> BlignautPart:
    """Replicate Blignaut (2014) with one eye model and one observer."""
    scenes = _Scenes(blignaut, eye, observing)
    out = BlignautPart(eye_model=eye)
    exposures = [_Scenes(blignaut, eye, one) for one in observing.exposures()]
    for protocol in protocols:
        departures = departures_of(blignaut, protocol)
        seeds = [_blignaut_vectors(s.run(departures)) for s in exposures]
        out.seed_vectors[protocol, observing.kind] = over_seeds(seeds)
        scene, seen = scenes(departures)
        done = blignaut.run(seen, scene.rig, departures)
        key = protocol, observing.kind
        out.outcomes[key] = done
        out.clouds[key] = Cloud.of(seen)
        out.seen[key] = scene.rig, seen
        out.errors[key] = {f"{o.function} on {o.calibration}": o.error_deg for o in done if len(o.error_deg)}
        out.vectors[key] = _blignaut_vectors(done)
        keys = {"protocol": protocol, "observer": observing.kind, "eye_model": eye}
        out.rows += blignaut.rows_of(done, variant="vector", **keys)
        if protocol == "corrected":
            centred = blignaut.run(seen, scene.rig, departures, centred=True)
            out.centred[key] = centred
            out.rows += blignaut.rows_of(centred, variant="centred vector", **keys)
    if observing.kind == "analytic" and len(protocols) == 2:
        out.waterfall = _waterfall(eye, blignaut, lambda d: _best_means(scenes.run(d)))
    return out


def _blignaut_vectors(done: list[blignaut.FunctionErrors]) -> dict[str, Floats]:
    """Compute error vectors (n, 2) by function and calibration set."""
    return {f"{o.function} on {o.calibration}": o.vector_deg for o in done if len(o.error_deg)}


def _best_means(done: list[blignaut.FunctionErrors]) -> dict[str, float | None]:
    """Compute the mean error of the best function for each set."""
    found = {c: blignaut.best(done, c) for c in CALIBRATION_SETS}
    return {c: b.mean_deg if b else None for c, b in found.items()}


def _waterfall(eye: str, module: Any, measure: Any) -> list[WaterfallStep]:
    """Correct the departures of `published` one after the other; also correct each of them alone."""
    start = measure(module.PUBLISHED)
    steps = [WaterfallStep(eye, "published", start, start)]
    left = set(module.PUBLISHED)
    for departure in module.DEPARTURES:
        left.discard(departure.id)
        steps.append(
            WaterfallStep(eye, departure.id, measure(frozenset(left)), measure(module.PUBLISHED - {departure.id}))
        )
    return steps


def _misprints(eye: str) -> dict[str, dict[str, Any]]:
    """Run the corrected protocol with each of the misprints of Table 4 or the text."""
    cases: dict[str, dict[str, Any]] = {
        "camera at x = 315": {"position_mm": [315.0, 0.0, -150.5], "tilt_deg": 13.8},
        "head positions in cm": {
            "head_positions_mm": [[0, 0, 0], [0, 300, 0], [0, -300, 0], [400, 0, 0], [-400, 0, 0]]
        },
    }
    out: dict[str, dict[str, Any]] = {}
    for name, changes in cases.items():
        try:
            scene = guestrin.scene(eye, guestrin.CORRECTED, changes)
            seen = Observing().observe(scene)
            done = guestrin.run(seen, scene.rig, guestrin.CORRECTED)
        except InputError as error:
            out[name] = {"H1": None, "H2": None, "reason": str(error)}
            continue
        inside = seen.pupil.in_image & seen.glints.in_image.all(axis=1)
        out[name] = {
            **done.means,
            "in_image": int(inside.sum()),
            "n": len(seen),
            "missing": int((~np.isfinite(done.error_deg)).sum()),
        }
    return out
