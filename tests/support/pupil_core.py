"""An export of Pupil Core: two eyes with cameras and times of their own, and two detectors in one file."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

import eyerender as er

HEADER = [
    "pupil_timestamp", "world_index", "eye_id", "confidence", "norm_pos_x", "norm_pos_y", "diameter", "method",
    "ellipse_center_x", "ellipse_center_y", "ellipse_axis_a", "ellipse_axis_b", "ellipse_angle", "diameter_3d",
    "model_confidence", "model_id", "sphere_center_x", "sphere_center_y", "sphere_center_z", "sphere_radius",
    "circle_3d_center_x", "circle_3d_center_y", "circle_3d_center_z", "circle_3d_normal_x", "circle_3d_normal_y",
    "circle_3d_normal_z", "circle_3d_radius", "theta", "phi", "projected_sphere_center_x",
    "projected_sphere_center_y", "projected_sphere_axis_a", "projected_sphere_axis_b", "projected_sphere_angle",
]  # fmt: skip
PER_WORLD_FRAME, SAMPLES = 4, 12  # eye samples in a frame of the world camera, and at each target


def write_export(folder: Path) -> None:
    """Write pupil_positions.csv and targets.csv of the scene `headset_binocular`; one sample in ten is unsure."""
    seen = er.trace(er.load_scene("headset_binocular"))
    rows, targets = [], []
    for i in range(len(seen)):
        start, eye = 100.0 + 0.1 * (i // 2), int(seen.index.eye[i])
        if eye == 0:
            targets.append([start - 0.004, *seen.index.target_mm[i].tolist()])
        (x, y), (a, b) = seen.pupil.centre_px[i], 2 * seen.pupil.semi_axes_px[i]
        angle = float(np.degrees(seen.pupil.angle_rad[i]))
        for k in range(SAMPLES):
            time = round(start + 0.008 * k + 0.003 * eye, 6)  # the cameras are not synchronised
            lost = k % 10 == 9
            ellipse = [0.0, 0.0, 30.0, 40.0, 10.0] if lost else [x, y, b, a, angle + 90.0]
            world = int((time - 100.0) / 0.008) // PER_WORLD_FRAME
            common = [time, world, eye, 0.2 if lost else 0.97, x / 640, 1 - y / 480, a]
            rows.append([*common, "2d c++", *ellipse, *[""] * 21])
            rows.append(
                [*common, "pye3d 0.3.0 real-time", *ellipse[:2], 1.1 * b, 1.1 * a, angle + 90.0, 3.9, 1.0, *[0.0] * 19]
            )
    for name, header, lines in (
        ("pupil_positions.csv", HEADER, sorted(rows, key=lambda row: (row[0], row[7]))),
        ("targets.csv", ["time", "target_x", "target_y", "target_z"], targets),
    ):
        with open(folder / name, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(lines)
