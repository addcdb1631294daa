#!/usr/bin/env python3
"""
Pupil Labs' pye3d on simulated eyes
===================================

pye3d fits a sphere with a pupil to the ellipses of many frames. This script gives it exact ellipses and compares what
it finds with what is there: the direction of gaze, the centre of the globe and the diameter of the pupil. The eyes are
pye3d's own schematic eye, and drawn adults.

pye3d 0.3.2 needs NumPy 1, so it has an environment of its own. The two share the files that ``eyerender features``
writes, and nothing else::

    python examples/pye3d.py make out/pye3d              # in the environment of eyerender
    python3.11 -m venv out/env
    out/env/bin/pip install pye3d==0.3.2 "numpy<2" "opencv-python-headless<4.11"
    out/env/bin/python examples/pye3d.py compare out/pye3d
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

# Python looks for modules beside the script first, and would take this file for pye3d.
sys.path = [path for path in sys.path if Path(path).resolve() != Path(__file__).resolve().parent]

import numpy as np  # noqa: E402

ADULTS = 10
GAZE_DEG = [(float(azimuth), float(elevation)) for elevation in range(-18, 19, 4) for azimuth in range(-24, 25, 4)]
# A camera like that of Pupil Core, 49 mm from the centre of the right eye.
CAMERA = {
    "position_mm": [30, -41.5, -20], "look_at_mm": [-13, -31.5, 0], "focal_length_px": 280, "resolution_px": [400, 400],
}  # fmt: skip
LIGHT = {"position_mm": [30, -25, -20]}  # scenes need one, pye3d does not
# A cornea of one sphere, and a stop 10.392 mm in front of the centre of the globe (12 mm), 6 mm from which it ends.
GLOBE_MM, CORNEA_MM, STOP_MM = 12.0, 7.8, (12.0**2 - 6.0**2) ** 0.5
APEX_MM = STOP_MM - (CORNEA_MM**2 - 6.0**2) ** 0.5 + CORNEA_MM
CENTRE = [-APEX_MM, 0.0, 0.0]
SCHEMATIC = {
    "format": 3,
    "name": "schematic eye of pye3d",
    "cornea": [{"shape": {"kind": "sphere", "radius_mm": CORNEA_MM}, "medium": {"index": 1.3375}}],
    "retina": {"shape": {"kind": "sphere", "radius_mm": -GLOBE_MM}, "position_mm": [-APEX_MM - GLOBE_MM, 0.0, 0.0]},
    "stop": {"diameter_mm": 4.0, "position_mm": [STOP_MM - APEX_MM, 0.0, 0.0]},
    "limbus_radius_mm": 6.0,
    "iris": {"root_radius_mm": 5.9},
    "sclera": {"radius_mm": GLOBE_MM, "centre_mm": CENTRE},
    "rotation": {"azimuth_centre_mm": CENTRE, "elevation_centre_mm": CENTRE},
    "fovea": {},
}


def make(folder: Path) -> None:
    """Write scenes of the schematic eye and of adults, and their features; this needs eyerender and not pye3d."""
    import yaml

    folder.mkdir(parents=True, exist_ok=True)
    people = {f"adult_{k}": {"population": {"preset": "adults", "seed": 60, "subject": k}} for k in range(ADULTS)}
    for name, who in ({"schematic": {"eye": {"model": SCHEMATIC}}} | people).items():
        scene = {
            "format": 2, "name": name, **who, "subject": {"eyes": ["right"]},
            "rig": {"cameras": [CAMERA], "lights": [LIGHT]},
            "poses": [{"azimuth_deg": azimuth, "elevation_deg": elevation} for azimuth, elevation in GAZE_DEG],
        }  # fmt: skip
        path = folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(scene), encoding="utf-8")
        command = [sys.executable, "-m", "eyerender", "features", str(path), "--json", str(folder / f"{name}.json")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def detect(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Let pye3d see all frames to fit its model, then freeze the model and see them again."""
    from pye3d.camera import CameraModel
    from pye3d.detector_3d import Detector3D

    (camera,) = data["rig"]["cameras"]
    width, height = camera["resolution_px"]
    detector = Detector3D(CameraModel(focal_length=camera["K"][0][0], resolution=(width, height)))
    blank = np.zeros((height, width), np.uint8)
    for frozen in (False, True):
        detector.is_long_term_model_frozen = frozen
        found = []
        for k, record in enumerate(data["records"]):
            pupil = record["pupil"]
            ellipse = {
                # The middle of the corner pixel is (0, 0) here, and (0.5, 0.5) in pye3d.
                "center": [value + 0.5 for value in pupil["centre_px"]],
                "axes": [2.0 * pupil["semi_axes_px"][1], 2.0 * pupil["semi_axes_px"][0]],
                "angle": np.degrees(pupil["angle_rad"]) + 90.0,
            }
            datum = {"ellipse": ellipse, "confidence": 1.0, "timestamp": (len(data["records"]) * frozen + k) / 30.0}
            found.append(detector.update_and_detect(datum, blank))
    return found


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors, (n, 3) each."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def one_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Turn the unit vectors a so that they fit b best, as a calibration with targets does."""
    u, _, v = np.linalg.svd(a.T @ b)
    return a @ u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def compare(folder: Path) -> None:
    """Print how far pye3d's eyes are from the true ones; this needs pye3d and not eyerender."""
    print(f"{'median over frames':20} {'optic axis':>11} {'line of sight':>14} {'globe':>8} {'pupil':>8}")
    print(f"{'':20} {'deg':>11} {'turned, deg':>14} {'mm':>8} {'%':>8}")
    for path in sorted(folder.glob("*.json"), key=lambda p: (p.stem != "schematic", p.stem)):
        data = json.loads(path.read_text(encoding="utf-8"))
        found, space = detect(data), [one["camera"] for one in data["space"]]
        gaze = np.array([one["circle_3d"]["normal"] for one in found])
        axis, sight = (np.array([one[key] for one in space]) for key in ("optic_axis", "line_of_sight"))
        centres = ("azimuth_centre_mm", "elevation_centre_mm")
        centre = np.array([np.mean([one[key] for key in centres], axis=0) for one in space])
        globe = np.linalg.norm([one["sphere"]["center"] for one in found] - centre, axis=1)
        true_mm = np.array([one["stop_diameter_mm"] for one in data["space"]])
        wider = 100.0 * np.abs(np.array([one["diameter_3d"] for one in found]) / true_mm - 1.0)
        turned = angles_deg(one_rotation(gaze, sight), sight)
        values = [np.median(angles_deg(gaze, axis)), np.median(turned), np.median(globe), np.median(wider)]
        print("{:20} {:11.2f} {:14.2f} {:8.2f} {:8.2f}".format(path.stem, *values))


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in ("make", "compare"):
        sys.exit("usage: pye3d.py make DIR | pye3d.py compare DIR")
    {"make": make, "compare": compare}[sys.argv[1]](Path(sys.argv[2]))
