"""Pupil Labs' 2D detector behind the protocol; it runs in its own environment and does not import this package.

    .../bin/python pupil_labs.py

It needs pupil-detectors, numpy and Pillow. The detector takes 8-bit images; deeper ones are scaled down.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.metadata import version
from typing import Any

import numpy as np
from PIL import Image

SCHEMA = "eyerender/extractor/1"


def main() -> int:
    """Serve requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    from pupil_detectors import Detector2D  # type: ignore[import-not-found,unused-ignore]

    greeting = {
        "schema": SCHEMA,
        "name": f"pupil-detectors {version('pupil-detectors')}",
        # cv2.fitEllipse's rotated rectangle, minor axis first.
        "conventions": {"pixel_origin": "centre", "axes": "full", "angle_unit": "deg", "angle_of": "first"},
        "reports": ["pupil"],
    }
    print(json.dumps(greeting), file=answers, flush=True)
    detector: Any = None
    told: Any = None
    for line in sys.stdin:
        request = json.loads(line)
        image = eight_bits(request["image"], request["bit_depth"])
        radius = request["hints"].get("radius_px")
        if detector is None or radius != told:
            told, size = radius, {}
            if radius is not None:
                size = {"pupil_size_min": 2 * radius[0], "pupil_size_max": 2 * radius[1]}
            detector = Detector2D(size)
            detector.detect(image.copy())
        wall, cpu = time.perf_counter(), time.process_time()
        found = detector.detect(image)
        spent = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        answer = {"id": request["id"], "record": {"pupil": pupil_of(found)}, **spent}
        print(json.dumps(answer), file=answers, flush=True)
    return 0


def pupil_of(found: dict[str, Any]) -> dict[str, Any]:
    """Pupil of the record; the detector reports "none" by a confidence of 0 or an empty ellipse."""
    ellipse = found["ellipse"]
    if found["confidence"] <= 0.0 or min(ellipse["axes"]) <= 0.0:
        return {"status": "missing", "reason": "no pupil detected (confidence 0)"}
    return {
        "status": "ok",
        "centre_px": [float(v) for v in ellipse["center"]],
        "axes_px": [float(v) for v in ellipse["axes"]],
        "angle": float(ellipse["angle"]),
        "confidence": float(found["confidence"]),
    }


def eight_bits(path: str, bit_depth: int) -> Any:
    """Image as a writable (h, w) uint8 array."""
    with Image.open(path) as file:
        data = np.array(file)
    if data.dtype != np.uint8:
        data = np.clip(np.rint(data.astype(float) * (255.0 / (2**bit_depth - 1))), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(data if data.ndim == 2 else data[..., 0])


if __name__ == "__main__":
    sys.exit(main())
