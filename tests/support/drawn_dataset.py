"""Datasets whose pictures are drawn, not rendered: an ellipse in an ellipse, with labels that fit them exactly."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from eyerender.dataset.packing import pack
from eyerender.folders.imagefile import write_png
from eyerender.folders.imagefolder import DATASET_SCHEMA, PACKED_SCHEMA, packed_index
from eyerender.imaging.labels import moments_ellipse
from eyerender.optics.ellipse import Ellipse, signed_distance
from eyerender.scene.parts import IRIS, PUPIL, SCLERA

FRAMES = 10  # images of a subject
SPLITS = ("train", "train", "train", "validation", "test")
LIGHTS = 2


def draw(
    folder: Path, rows: int, *, size: tuple[int, int] = (96, 72), shift: float = 0.0, pool: int = 0, text: int = 2
) -> None:
    """Write a dataset with files for each picture.

    Args:
        folder: where.
        rows: number of images.
        size: width and height.
        shift: is added to the diameter of every pupil, mm.
        pool: draw only so many pictures, and use them again for further lines as hard links; 0: draw all.
        text: bytes of the text of a scene in each line.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    pool = pool or rows
    labels: list[dict[str, Any]] = []
    with open(folder / "metadata.jsonl", "w", encoding="utf-8") as file:
        for row in range(rows):
            name = f"{row:08d}-right.png"
            if row < pool:
                picture, mask, own = _drawn(row, size, shift)
                labels.append(own)
                write_png(folder / "images" / name, picture)
                write_png(folder / "masks" / name, mask)
            else:
                for kind in ("images", "masks"):
                    os.link(folder / kind / f"{row % pool:08d}-right.png", folder / kind / name)
            file.write(json.dumps(_line(row, name, size, labels[row % pool], text)) + "\n")
    dataset = {"schema": DATASET_SCHEMA, "kind": "dataset", "digest": "drawn", "spec": {"name": "drawn"}}
    (folder / "dataset.json").write_text(json.dumps(dataset))


def packed(folder: Path, source: Path) -> None:
    """Write the same dataset with one packed shard."""
    stage = folder / "stage"
    (stage / "shard").mkdir(parents=True)
    for kind in ("images", "masks"):
        shutil.copytree(source / kind, stage / kind)
    shutil.copy(source / "metadata.jsonl", stage / "shard" / "lines.jsonl")
    done = pack(stage, {"shard": 0, "images": len(list((source / "images").iterdir()))}, seed=1)
    (folder / "shards").mkdir()
    os.rename(stage / "shard", folder / "shards" / "00000")
    (folder / "shards" / "00000" / "done.json").write_text(json.dumps(done))
    shutil.rmtree(stage)
    np.save(folder / "index.npy", packed_index(done, 0, done["splits"], "done.json"))
    dataset = json.loads((source / "dataset.json").read_text()) | {"schema": PACKED_SCHEMA, "splits": done["splits"]}
    (folder / "dataset.json").write_text(json.dumps(dataset))


def _drawn(row: int, size: tuple[int, int], shift: float) -> tuple[Any, Any, dict[str, Any]]:
    """Picture, mask and labels of an image: all that its line needs beyond numbers of its own."""
    rng = np.random.default_rng([row, 7])
    width, height = size
    scale = width / 96
    yaw, pitch = rng.uniform(-20, 20), rng.uniform(-12, 12)
    diameter = float(np.clip(rng.normal(4, 0.7), 2.2, 6)) + shift
    centre = np.array([width / 2 + 0.9 * scale * yaw, height / 2 + 0.9 * scale * pitch])
    iris = Ellipse(centre, np.array([20.0, 19.0]) * scale, 0.3)
    pupil = Ellipse(centre, np.array([1.0, 0.95]) * 1.7 * diameter * scale, 0.3)
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u, v], axis=-1).astype(float)
    mask = np.full((height, width), SCLERA, dtype=np.uint8)
    mask[signed_distance(iris, pixels) <= 0] = IRIS
    mask[signed_distance(pupil, pixels) <= 0] = PUPIL
    skin = rng.uniform(0.35, 0.6) + rng.uniform(-0.1, 0.1) * (u / width) + rng.uniform(-0.1, 0.1) * (v / height)
    levels = np.choose(mask, [skin, skin + 0.1, skin - rng.uniform(0.12, 0.2), np.full(mask.shape, 0.06)])
    glints = [centre + scale * np.array([x, -4.0]) for x in (-6.0, 6.0)]
    for x, y in glints:
        levels = levels + 0.9 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * (0.8 * scale) ** 2))
    picture = np.clip(255 * (levels + rng.normal(0, 0.012, levels.shape)), 0, 255).astype(np.uint8)
    window = (0, 0, width, height)
    labels = {
        "pupil": {
            **_part(pupil, moments_ellipse(mask == PUPIL, window)),
            "entrance_diameter_mm": 1.13 * diameter,
            "stop_diameter_mm": diameter,
        },
        "iris": _part(iris, moments_ellipse(mask >= IRIS, window)),
        "glints": [
            {"light": k, "status": "ok", "xy_px": [float(x), float(y)], "spot_xy_px": [float(x), float(y)],
             "in_window": True, "visible": True, "visible_share": 1.0}
            for k, (x, y) in enumerate(glints)
        ],
        "space": {"camera": {"line_of_sight": _gaze(yaw, pitch), "cornea_apex_mm": [0.0, 0.0, 40.0]}},
        "yaw": yaw, "pitch": pitch, "diameter": diameter,
    }  # fmt: skip
    return picture, mask, labels


def _part(outline: Ellipse, visible: dict[str, Any]) -> dict[str, Any]:
    x, y, a, b, angle = outline.numbers()
    own = {"status": "ok", "reason": None, "centre_px": [x, y], "semi_axes_px": [a, b], "angle_rad": angle}
    return {"amodal": own, "visible": visible, "visible_fraction": 1.0}


def _gaze(yaw: float, pitch: float) -> list[float]:
    a, b = np.radians([yaw, pitch])
    return [float(-np.cos(b) * np.sin(a)), float(-np.sin(b)), float(-np.cos(b) * np.cos(a))]


def _line(row: int, name: str, size: tuple[int, int], given: dict[str, Any], text: int) -> dict[str, Any]:
    labels = {key: value for key, value in given.items() if key not in ("yaw", "pitch", "diameter")}
    subject, outline = row // FRAMES, labels["pupil"]["amodal"]
    record = {
        "schema": "eyerender/record/3", "frame": row, "camera": 0, "eye": "right",
        "pose": {"azimuth_deg": given["yaw"], "elevation_deg": given["pitch"]},
        "pupil": {key: outline[key] for key in ("status", "centre_px", "semi_axes_px", "angle_rad")},
        "glints": [{"light": g["light"], "status": "ok", "xy_px": g["xy_px"]} for g in labels["glints"]],
    }  # fmt: skip
    draws = {
        "eye.pupil_diameter_mm": given["diameter"],
        "sensor.exposure_ms": float(np.random.default_rng([row, 8]).uniform(4, 6)),
        "look.iris_albedo": float(np.random.default_rng([subject, 9]).uniform(0.2, 0.4)),
        "lens.star": row % 3,
    }
    return {
        "schema": "eyerender/image/5", "file_name": f"images/{name}", "mask_file_name": f"masks/{name}",
        "sample": row, "subject": subject, "split": SPLITS[subject % len(SPLITS)], "sequence_index": row % FRAMES,
        "window_px": dict(zip(("x0", "y0", "width", "height"), (0, 0, *size), strict=True)),
        "bit_depth": 8, "gamma": 1.0, "records": [record], "labels": labels,
        "parameters": {"draws": draws, "scene_json": "{" + " " * (text - 2) + "}", "eye_json": "{}"},
    }  # fmt: skip
