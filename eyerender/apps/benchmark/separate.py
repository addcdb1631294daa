"""Run detectors of other packages behind the protocol, in their own environment and without importing this package.

    .../bin/python separate.py pupil-detectors|PuRe|ElSe|ExCuSe|Swirski2D

The first needs pupil-detectors, the others need cheshm, and all need numpy and Pillow. The detectors take 8-bit images;
deeper ones are scaled down. All of them report cv2.fitEllipse's rotated rectangles.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from PIL import Image

SCHEMA = "eyerender/extractor/1"
PUPIL_LABS = "pupil-detectors"


def main(name: str) -> int:
    """Serve requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    package = PUPIL_LABS if name == PUPIL_LABS else "cheshm"
    make = _pupil_labs if name == PUPIL_LABS else lambda radii: _cheshm(name)
    greeting = {
        "schema": SCHEMA,
        "name": f"{name} {version(package)}" if name == package else f"{name} ({package} {version(package)})",
        "conventions": {"pixel_origin": "centre", "axes": "full", "angle_unit": "deg", "angle_of": "first"},
        "reports": ["pupil"],
        "warms_up": True,
    }
    print(json.dumps(greeting), file=answers, flush=True)
    detect: Callable[[Any], dict[str, Any]] | None = None
    told: Any = None
    for line in sys.stdin:
        request = json.loads(line)
        image = eight_bits(request["image"], request["bit_depth"])
        radii = request["hints"].get("radius_px")
        if detect is None or radii != told:
            told, detect = radii, make(radii)
            detect(image.copy())
        wall, cpu = time.perf_counter(), time.process_time()
        found = detect(image)
        spent = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        print(json.dumps({"id": request["id"], "record": {"pupil": found}, **spent}), file=answers, flush=True)
    return 0


def _pupil_labs(radii: Any) -> Callable[[Any], dict[str, Any]]:
    """Return Pupil Labs' 2-D detector, set to a range of radii in px."""
    from pupil_detectors import Detector2D  # type: ignore[import-not-found,unused-ignore]

    size = {} if radii is None else {"pupil_size_min": 2 * radii[0], "pupil_size_max": 2 * radii[1]}
    detector = Detector2D(size)
    return lambda image: pupil_of(detector.detect(image))


def pupil_of(found: dict[str, Any]) -> dict[str, Any]:
    """Convert the detector's result to the record's pupil; a confidence of 0 or an empty ellipse means "none"."""
    ellipse = found["ellipse"]
    if found["confidence"] <= 0.0 or min(ellipse["axes"]) <= 0.0:
        return {"status": "missing", "reason": "no pupil detected (confidence 0)"}
    return _rectangle(ellipse["center"], ellipse["axes"], ellipse["angle"], found["confidence"])


def _cheshm(name: str) -> Callable[[Any], dict[str, Any]]:
    """Return a detector of cheshm with default settings, ignoring the hints."""
    module: Any = importlib.import_module(f"cheshm.pupil_detectors.{name}")
    return lambda image: cheshm_pupil(module.detect_pupil(image))


def cheshm_pupil(found: dict[str, Any] | None) -> dict[str, Any]:
    """Convert a result of cheshm to the record's pupil; a position without an ellipse counts as none."""
    centre, axes, angle = (found or {}).get("ellipse") or ((0.0, 0.0), (0.0, 0.0), 0.0)
    if not (min(axes) > 0.0 and np.isfinite([*centre, *axes, angle]).all()):
        return {"status": "missing", "reason": "no ellipse" if found else "no pupil detected"}
    return _rectangle(centre, axes, angle, (found or {}).get("confidence"))


def _rectangle(centre: Any, axes: Any, angle: Any, confidence: Any) -> dict[str, Any]:
    return {
        "status": "ok",
        "centre_px": [float(v) for v in centre],
        "axes_px": [float(v) for v in axes],
        "angle": float(angle),
        "confidence": None if confidence is None else float(confidence),
    }


def eight_bits(path: str, bit_depth: int) -> Any:
    """Read an image as a writable (h, w) uint8 array."""
    with Image.open(path) as file:
        data = np.array(file)
    if data.dtype != np.uint8:
        data = np.clip(np.rint(data.astype(float) * (255.0 / (2**bit_depth - 1))), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(data if data.ndim == 2 else data[..., 0])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
