"""Records of features and their rig as input: what `gaze fit` and `gaze predict` read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats, frozen
from ..errors import InputError
from ..observation import Observations
from ..rig.camera import Camera
from ..rig.light import Light
from ..rig.rig import Rig
from ..rig.screen import Screen
from ..scene import load_scene


def load_observations(path: str | Path, scene: str | None = None) -> tuple[Observations, Rig]:
    """Observations and rig of a file of records.

    The file is JSON as `features` writes it, with the rig inside, or JSONL with one record a line; `scene` gives the
    rig otherwise, and wins.

    Raises:
        InputError: naming the file and the key.
    """
    source = str(path)
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError("no such file", source=source) from None
    except (OSError, UnicodeDecodeError):
        raise InputError("cannot be read as text", source=source) from None
    rig, records = None, []
    try:
        data = json.loads(text)
    except ValueError:
        data = None
    if isinstance(data, dict) and "records" in data:
        if not isinstance(data["records"], list):
            raise InputError("must be a list", source=source, path="records")
        records, rig = data["records"], data.get("rig")
    elif isinstance(data, dict):
        records = [data]
    else:
        for k, line in enumerate(text.splitlines()):
            if line.strip():
                try:
                    records.append(json.loads(line))
                except ValueError:
                    raise InputError("is not valid JSON", source=source, path=f"line {k + 1}") from None
        # A line of a folder's metadata holds the records of its image.
        records = [r for line in records for r in (line["records"] if _is_image_line(line) else [line])]
    if not records:
        raise InputError("holds no records", source=source)
    observations = Observations.from_records(records, source=source)
    if scene is not None:
        return observations, load_scene(scene).rig
    if rig is None:
        raise InputError("holds no rig; give --scene", source=source)
    return observations, rig_from_mapping(rig, source=source)


def rig_from_mapping(data: Any, *, source: str = "") -> Rig:
    """The rig as `features --json` writes it; raises `InputError` naming the part that is wrong."""

    def array(value: Any, shape: tuple[int, ...], path: str) -> Floats:
        try:
            out = np.array(value, dtype=float)
        except (TypeError, ValueError):
            out = np.zeros(0)
        if out.shape != shape or not np.isfinite(out).all():
            raise InputError(f"must be {' x '.join(map(str, shape))} numbers", source=source, path=path)
        return frozen(out)

    if not isinstance(data, dict) or not isinstance(data.get("cameras"), list):
        raise InputError("must hold cameras", source=source, path="rig")
    cameras = []
    for k, c in enumerate(data["cameras"]):
        at = f"rig.cameras.{k}"
        if not isinstance(c, dict):
            raise InputError("must be a camera", source=source, path=at)
        size = array(c.get("resolution_px"), (2,), f"{at}.resolution_px")
        cameras.append(
            Camera.of(
                array(c.get("K"), (3, 3), f"{at}.K"),
                array(c.get("R"), (3, 3), f"{at}.R"),
                array(c.get("t"), (3,), f"{at}.t"),
                (int(size[0]), int(size[1])),
                array(c.get("distortion", [0.0] * 5), (5,), f"{at}.distortion"),
            )
        )
    places = data.get("lights_mm") or []
    lights = tuple(
        Light(array(p, (3,), f"rig.lights_mm.{k}"), frozen([1.0, 0.0, 0.0]), 0.0, 1.0, 0.0)
        for k, p in enumerate(places)
    )
    s = data.get("screen")
    screen = None
    if isinstance(s, dict):
        w, h = array(s.get("size_mm"), (2,), "rig.screen.size_mm")
        screen = Screen(
            array(s.get("centre_mm"), (3,), "rig.screen.centre_mm"),
            array(s.get("right", [0, -1, 0]), (3,), "rig.screen.right"),
            array(s.get("up", [0, 0, 1]), (3,), "rig.screen.up"),
            (float(w), float(h)),
        )
    return Rig(tuple(cameras), lights, screen)


def _is_image_line(line: Any) -> bool:
    return isinstance(line, dict) and isinstance(line.get("records"), list)
