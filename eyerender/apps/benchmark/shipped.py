"""Extractors that come with the package: its own, the contour baseline, and wrappers of external detectors."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.status import Status
from ...base.storage.cachefolder import cache_folder
from ...extraction import FAST, REFINED, Extraction, ExtractionSettings, extract, identify
from ...extraction.result import PupilResult
from ...optics.ellipse import Ellipse
from ...rig.camera import PinholeCamera
from .registry import Command

PUPIL_LABS_PYTHON = "EYERENDER_PUPIL_DETECTORS"
CHESHM_PYTHON = "EYERENDER_CHESHM"
PUPIL_LABS = "pupil-detectors"
# Detectors of cheshm by the name of the object here.
_CHESHM = {"pure": "PuRe", "else_": "ElSe", "excuse": "ExCuSe", "swirski": "Swirski2D"}
# Distance of a real eye's reflections from those of a typical eye placed at its pupil.
_PLACE_MM = 1.5


def own_fast(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Extract with this package's extractor: edges and an algebraic fit."""
    return _own(FAST, image, request)


def own_refined(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Extract with this package's extractor, including a maximum-likelihood fit of the pixel model."""
    return _own(REFINED, image, request)


def own_centroid(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Threshold the pupil that this package's extractor finds: its area and centre of mass."""
    return _own(ExtractionSettings(method="centroid"), image, request)


def opencv_contour(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Extract with the contour baseline."""
    from ...extraction.baseline import contour_pupil

    hints = request["hints"]
    found = contour_pupil(image, bit_depth=request["bit_depth"], radius_px=hints["radius_px"])
    if isinstance(found, str):
        return {"pupil": {"status": "missing", "reason": found}}
    (x, y), axes, degrees = found
    return {"pupil": {"status": "ok", "centre_px": [x, y], "axes_px": list(axes), "angle": degrees}}


opencv_contour.conventions = {"axes": "full", "angle_unit": "deg", "angle_of": "first"}  # type: ignore[attr-defined]
opencv_contour.reports = ("pupil",)  # type: ignore[attr-defined]


def pupil_labs_python() -> Path | None:
    """Return the interpreter of the environment with `pupil-detectors`; None if there is none.

    EYERENDER_PUPIL_DETECTORS names it; by default it is where scripts/tools/setup_pupil_detectors.sh puts it.
    """
    return _interpreter(PUPIL_LABS_PYTHON, PUPIL_LABS)


def cheshm_python() -> Path | None:
    """Return the interpreter with `cheshm`: EYERENDER_CHESHM, else that of scripts/tools/setup_cheshm.sh."""
    return _interpreter(CHESHM_PYTHON, "cheshm")


def _interpreter(variable: str, name: str) -> Path | None:
    given = os.environ.get(variable)
    if given:
        return Path(given) if os.access(given, os.X_OK) else None
    cache = cache_folder()
    python = None if cache is None else cache / name / "bin" / "python"
    return python if python is not None and os.access(python, os.X_OK) else None


def _separate(python: Path | None, detector: str, script: str) -> Command:
    if python is None:
        return Command(None, f"not set up; scripts/tools/{script} makes its environment")
    return Command((str(python), str(Path(__file__).with_name("separate.py")), detector))


def __getattr__(name: str) -> Command:
    # Looked up at each use, because the environment may have been created in the meantime.
    if name == "pupil_detectors":
        return _separate(pupil_labs_python(), PUPIL_LABS, "setup_pupil_detectors.sh")
    if name in _CHESHM:
        return _separate(cheshm_python(), _CHESHM[name], "setup_cheshm.sh")
    raise AttributeError(name)


def _own(settings: ExtractionSettings, image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    hints = request["hints"]
    changes: dict[str, Any] = {"polarity": hints["polarity"]}
    if hints["radius_px"] is not None:
        changes |= dict(zip(("radius_min_px", "radius_max_px"), hints["radius_px"], strict=True))
    # A float image has a free scale.
    depth = None if image.dtype.kind == "f" else request["bit_depth"]
    prior = hints.get("prior")
    if prior is not None:
        ellipse = Ellipse(prior["centre_px"], prior["semi_axes_px"], prior["angle_rad"])
        prior = PupilResult(status=Status.OK, ellipse=ellipse, bright=hints["polarity"] == "bright")
    own = settings.model_copy(update=changes)
    found = extract(image, bit_depth=depth, gamma=hints["gamma"], settings=own, prior=prior)
    pupil, lights = found.pupil, _lights(found, hints["rig"])
    out: dict[str, Any] = {
        "status": "ok" if pupil.ok else "missing",
        "reason": pupil.reason,
        "confidence": pupil.confidence,
    }
    if pupil.ellipse is not None:
        out |= {
            "centre_px": pupil.ellipse.centre_px.tolist(),
            "semi_axes_px": pupil.ellipse.semi_axes_px.tolist(),
            "angle_rad": pupil.ellipse.angle_rad,
            "covariance": None if pupil.covariance is None else pupil.covariance.tolist(),
        }
    glints = [
        {"status": "ok", "light": light, "xy_px": glint.xy_px.tolist()}
        for glint, light in zip(found.glints, lights, strict=True)
    ]
    return {"pupil": out, "glints": glints}


def _lights(found: Extraction, rig: Mapping[str, Any] | None) -> list[int | None]:
    """Return the light of each glint, if the rig is known."""
    if rig is None or not found.glints or found.pupil.ellipse is None:
        return [None] * len(found.glints)
    camera = PinholeCamera.of(rig["K"], rig["R"], rig["t_mm"], (1, 1), rig["distortion"])
    camera = replace(camera, mirrored=rig.get("mirrored", False))
    spots, pupil = np.array([g.xy_px for g in found.glints]), found.pupil.ellipse.centre_px
    flat = camera.flattened(pupil)
    assigned = identify(
        camera.ideal(spots, flat),
        camera.ideal(pupil, flat),
        K=flat.K,
        R=flat.sensor_axes,
        t_mm=flat.sensor_offset,
        lights_mm=rig["lights_mm"],
        eye_mm=rig["eye_mm"],
        position_sd_mm=math.hypot(_PLACE_MM, rig.get("eye_sd_mm", 0.0)),
    )
    return [int(k) if k >= 0 else None for k in assigned.light]
