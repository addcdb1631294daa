"""CSV: labels.csv with one row per image, beside the images and masks."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path
from typing import Any

from ...base.storage.files import write_bytes
from .gaze import gaze_of, pupil_of
from .item import Item, Items

_COLUMNS = (
    *("sample", "subject", "split", "sequence_index"),
    *("bit_depth", "encoding", "gamma", "gain", "source_bit_depth"),
)
_ELLIPSE = ("x_px", "y_px", "a_px", "b_px", "angle_rad")


def write(items: Items, out: Path) -> None:
    """Write images/, masks/ and labels.csv; a missing position is an empty field."""
    (out / "images").mkdir()
    (out / "masks").mkdir()
    writer = None
    with open(out / "labels.csv", "w", newline="", encoding="utf-8") as file:
        for files, row in items.map(partial(_files, lights=items.lights)):
            for name, data in files.items():
                write_bytes(out / name, data, sync=False)
            if writer is None:
                writer = csv.DictWriter(file, list(row))
                writer.writeheader()
            writer.writerow(row)


def _files(item: Item, lights: int) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the files of an image by name, and its row."""
    files = {"images": item.encode(), "masks": item.encode("mask_file_name")}
    named = {f"{kind}/{item.name}.png": data for kind, data in files.items() if data is not None}
    return named, row_of(item, lights)


def row_of(item: Item, lights: int) -> dict[str, Any]:
    """Return the labels of an image as one flat row."""
    line = item.exported_line()
    record, labels = line["records"][0], line["labels"]
    x0, y0 = item.entry.window[:2]
    row: dict[str, Any] = {
        "file_name": f"images/{item.name}.png",
        "mask_file_name": f"masks/{item.name}.png" if line.get("mask_file_name") else None,
        **{key: line[key] for key in _COLUMNS},
        "eye": record["eye"],
        "eye_model": record["eye_model"],
        **item.camera,
        "window_x0_px": x0,
        "window_y0_px": y0,
    }
    for part in ("pupil", "iris"):
        for kind in ("amodal", "visible"):
            ellipse = item.ellipse(part, kind)
            values = [None] * len(_ELLIPSE) if ellipse is None else ellipse.numbers()
            row |= {f"{part}_{kind}_{key}": value for key, value in zip(_ELLIPSE, values, strict=True)}
        row[f"{part}_cut"] = int(labels[part]["visible"]["cut"])
        row[f"{part}_visible_fraction"] = labels[part]["visible_fraction"]
    spots = {light: (x, y, int(visible)) for light, x, y, visible in item.glints()}
    for k in range(lights):
        x, y, visible = spots.get(k, (None, None, 0))
        row |= {f"glint{k}_x_px": x, f"glint{k}_y_px": y, f"glint{k}_visible": visible}
    for name in ("azimuth_deg", "elevation_deg", "torsion_deg"):
        row[name] = record["pose"][name]
    for frame in ("world", "camera"):
        for name, value in labels["space"][frame].items():
            for axis, number in zip("xyz", value or [None] * 3, strict=True):
                row[f"{frame}_{name}_{axis}"] = number
    row["pupil_diameter_mm"] = line["parameters"]["pupil_diameter_mm"]
    row |= pupil_of(line) | gaze_of(line)
    return row
