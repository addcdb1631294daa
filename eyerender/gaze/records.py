"""Read records of features and their rig, for `gaze fit` and `gaze predict`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Floats, frozen
from ..base.errors import InputError, Problems
from ..base.spec import LARGEST, FileSpec, read_yaml
from ..base.storage.files import parse_json, read_text
from ..rig.camera import CameraCalibration, PinholeCamera
from ..rig.light import MAX_LIGHTS, Lamp
from ..rig.rig import MAX_CAMERAS, Rig, RigGeometry, RigLike
from ..rig.screen import ScreenPlane
from ..scene import Scene, load_scene
from ..scene.observation import Observations
from .columns import CsvColumns
from .table import observations_from_csv

ReadArray = Callable[[Any, tuple[int, ...], str], Floats]
"""Function that converts a value to an array of a shape; raises `InputError` with the path."""

TABLES = (".csv", ".tsv")
"""Suffixes of files that are read as tables."""

# About 40,000 observations. All of them are held in memory at once.
MAX_RECORDS_BYTES = 128 * 2**20


def load_observations(
    path: str | Path,
    scene: str | Scene | None = None,
    *,
    rig: str | Path | RigLike | None = None,
    columns: str | Path | Mapping[str, Any] | CsvColumns | None = None,
) -> tuple[Observations, RigGeometry]:
    """Load observations and their rig from a file of records, or from a table.

    Args:
        path: JSON as `features` writes it, which includes the rig; JSONL with one record a line; or a table (.csv or
            .tsv, see `observations_from_csv`).
        scene: scene whose rig is used if the file has none.
        rig: the rig to use instead, or a file that `load_rig` reads.
        columns: meaning of a table's columns.

    Raises:
        InputError: naming the file and the key.
    """
    source = str(path)
    if scene is not None and rig is not None:
        raise InputError("give either a scene or a rig", source="--rig")
    given: RigGeometry | None = None
    if scene is not None:
        given = (scene if isinstance(scene, Scene) else load_scene(scene)).rig
    elif rig is not None:
        given = load_rig(rig) if isinstance(rig, str | Path) else rig.build()
    if columns is not None or Path(path).suffix.lower() in TABLES:
        if given is None:
            raise InputError("holds no rig; give --rig or --scene", source=source)
        return observations_from_csv(path, columns, given), given
    records, own = _read(read_text(path, limit=MAX_RECORDS_BYTES), source)
    if not records:
        raise InputError("holds no records", source=source)
    if given is None and own is None:
        raise InputError("holds no rig; give --scene or --rig", source=source)
    problems = Problems(source)
    built = given or problems.attempt(lambda: rig_from_mapping(own, source=source))
    observations = problems.attempt(lambda: Observations.from_records(records, source=source))
    problems.check()
    return observations, built


class RigFile(FileSpec, Rig):
    """A rig in a separate file: `format: 1` and the keys of `rig` in a scene."""


def load_rig(path: str | Path) -> RigGeometry:
    """Read the rig of a scene (a file, or the name of a shipped one) or of a rig file.

    Raises:
        InputError: naming the file and the key.
    """
    if Path(path).suffix.lower() in (".yaml", ".yml") and "cameras" in read_yaml(path):
        return RigFile.load(path).resolved(Path(path).parent).build()
    return load_scene(path).rig


def _read(text: str, source: str) -> tuple[list[Any], Any]:
    """Parse records and rig (None if there is none) from the text of a file."""
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip()]
    # In a file with one record per line, the first line is a complete object and more lines follow.
    if len(lines) > 1 and lines[0][1].rstrip().endswith("}"):
        problems = Problems(source)
        objects = [problems.attempt(partial(parse_json, line, source=source, path=f"line {k}")) for k, line in lines]
        problems.check()
        # A line of a folder's metadata contains the records of its image.
        return [r for o in objects for r in (o["records"] if _is_image_line(o) else [o])], None
    if not lines:
        return [], None
    data = parse_json(text, source=source)
    if not isinstance(data, dict):
        raise InputError("must be a JSON object", source=source)
    if "records" not in data:
        return [data], None
    if not isinstance(data["records"], list):
        raise InputError("must be a list", source=source, path="records")
    return data["records"], data.get("rig")


def rig_from_mapping(data: Any, *, source: str = "") -> RigGeometry:
    """Read a rig as `features --json` writes it.

    Raises:
        InputError: naming the part that is wrong.
    """

    def array(value: Any, shape: tuple[int, ...], path: str) -> Floats:
        try:
            out = np.asarray(value)
        except (ValueError, OverflowError):  # rows of unequal length
            out = np.zeros(0)
        if out.shape != shape or out.dtype.kind not in "iuf" or not (np.abs(out) <= LARGEST).all():
            raise InputError(f"must be {' x '.join(map(str, shape))} numbers", source=source, path=path)
        return frozen(out)

    if not isinstance(data, dict) or not isinstance(data.get("cameras"), list):
        raise InputError("must hold cameras", source=source, path="rig")
    if len(data["cameras"]) > MAX_CAMERAS:
        raise InputError(f"are more than {MAX_CAMERAS}", source=source, path="rig.cameras")
    places = data.get("lights_mm") or []
    if not isinstance(places, list) or len(places) > MAX_LIGHTS:
        raise InputError(f"must be a list of at most {MAX_LIGHTS} points", source=source, path="rig.lights_mm")
    problems = Problems(source)
    cameras = [
        problems.attempt(partial(_camera, c, array, source, f"rig.cameras.{k}")) for k, c in enumerate(data["cameras"])
    ]
    lights = [problems.attempt(partial(_light, array, p, f"rig.lights_mm.{k}")) for k, p in enumerate(places)]
    screen = problems.attempt(lambda: _screen(data.get("screen"), array, source))
    problems.check()
    return RigGeometry(tuple(cameras), tuple(lights), screen)


def _light(array: ReadArray, place: Any, at: str) -> Lamp:
    axis = frozen([1.0, 0.0, 0.0])
    return Lamp(position_mm=array(place, (3,), at), axis=axis, radius_mm=0.0, intensity_mw_sr=1.0, lobe_exponent=0.0)


def _camera(data: Any, array: ReadArray, source: str, at: str) -> PinholeCamera:
    if not isinstance(data, dict):
        raise InputError("must be a camera", source=source, path=at)
    size = array(data.get("resolution_px"), (2,), f"{at}.resolution_px")
    if not ((size >= 1) & (size <= 65536) & (size == np.floor(size))).all():
        raise InputError("must be whole numbers from 1 to 65536", source=source, path=f"{at}.resolution_px")
    K, R, t = (array(data.get(key), (3, 3)[: 1 + (key != "t")], f"{at}.{key}") for key in ("K", "R", "t"))
    distortion = array(data.get("distortion", [0.0] * 5), (5,), f"{at}.distortion")
    # The rules are those of a camera in a scene.
    calibration = {"K": K.tolist(), "R": R.tolist(), "t_mm": t.tolist(), "distortion": distortion.tolist()}
    try:
        CameraCalibration.from_mapping(calibration)
    except InputError as error:
        raise InputError(error.reason, source=source, path=at) from None
    mirrored = data.get("mirrored", False)
    if not isinstance(mirrored, bool):
        raise InputError("must be true or false", source=source, path=f"{at}.mirrored")
    camera = PinholeCamera.of(K, R, t, (int(size[0]), int(size[1])), distortion)
    return replace(camera, mirrored=mirrored)


def _screen(data: Any, array: ReadArray, source: str) -> ScreenPlane | None:
    if data is None:
        return None
    if not isinstance(data, dict):
        raise InputError("must be null or a screen", source=source, path="rig.screen")
    w, h = array(data.get("size_mm"), (2,), "rig.screen.size_mm")
    if not (w > 0 and h > 0):
        raise InputError("must be > 0", source=source, path="rig.screen.size_mm")
    right = array(data.get("right", [0, -1, 0]), (3,), "rig.screen.right")
    up = array(data.get("up", [0, 0, 1]), (3,), "rig.screen.up")
    axes = np.stack([right, up])
    if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-6):
        raise InputError("right and up must be unit vectors at a right angle", source=source, path="rig.screen")
    centre = array(data.get("centre_mm"), (3,), "rig.screen.centre_mm")
    return ScreenPlane(centre, right, up, (float(w), float(h)))


def _is_image_line(line: Any) -> bool:
    return isinstance(line, dict) and isinstance(line.get("records"), list)
