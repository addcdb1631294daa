"""Read records of features and their rig, for `gaze fit` and `gaze predict`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from ..base.arrays import frozen
from ..base.errors import InputError, Problems
from ..base.spec import EYES, FileSpec, Positive, Spec, Vec3, read_yaml
from ..base.storage.files import opened, parse_json, read_text
from ..folders.foreign import not_records
from ..rig.camera import CameraCalibration, EyeNames, PinholeCamera
from ..rig.light import MAX_LIGHTS, Lamp
from ..rig.rig import MAX_CAMERAS, Rig, RigGeometry, RigLike
from ..rig.screen import ScreenPlane
from ..scene import Scene, load_scene
from ..scene.observation import Observations
from .columns import CsvColumns
from .table import observations_from_csv

TABLES = (".csv", ".tsv")
"""Suffixes of files that are read as tables."""


def is_table(path: str | Path) -> bool:
    """Return whether a file of this name is a table."""
    return Path(path).suffix.lower() in TABLES


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

    >>> seen, rig = er.gaze.load_observations("recording.csv", rig="rig.yaml")  # doctest: +SKIP

    Args:
        path: JSON as `features` writes it, which includes the rig; JSONL with one record per line; or a table (.csv or
            .tsv, see `observations_from_csv`).
        scene: scene whose rig is used if the file has none. Its subject also places eyes whose place is not recorded.
        rig: the rig to use instead, or a file that `load_rig` reads.
        columns: meaning of a table's columns.

    Raises:
        InputError: naming the file and the key.
    """
    source = str(path)
    with opened(path, limit=MAX_RECORDS_BYTES) as file:
        known = not_records(file.read(512))
    if known is not None:
        raise InputError(known, source=source)
    if scene is not None and rig is not None:
        raise InputError("give either a scene or a rig", source="--rig")
    given: RigGeometry | None = None
    whole = load_scene(scene) if isinstance(scene, str) else scene
    if whole is not None:
        given = whole.rig
    elif rig is not None:
        given = load_rig(rig) if isinstance(rig, str | Path) else rig.build()
    if columns is not None or is_table(path):
        if given is None:
            raise InputError("holds no rig; give --rig or --scene", source=source)
        return _placed(observations_from_csv(path, columns, given), whole), given
    records, own = _read(read_text(path, limit=MAX_RECORDS_BYTES), source)
    if not records:
        raise InputError("holds no records", source=source)
    if given is None and own is None:
        raise InputError("holds no rig; give --scene or --rig", source=source)
    problems = Problems(source)
    built = given or problems.attempt(lambda: rig_from_mapping(own, source=source))
    observations = problems.attempt(lambda: Observations.from_records(records, source=source))
    problems.check()
    return _placed(observations, whole), built


def _placed(observations: Observations, scene: Scene | None) -> Observations:
    """Place eyes whose place is not recorded where the scene has them, and targets of a moving rig in its frame."""
    sequence = None if scene is None else scene.spec.sequence
    if scene is not None and sequence is not None and getattr(sequence.gaze, "frame", "world") == "rig":
        mount = scene.spec.rig.mount
        observations = observations.in_rig(None if mount is None else mount.motion())
    index = observations.index
    if scene is None or not (lost := np.isnan(index.eye_position_mm).any(axis=1) & (index.eye >= 0)).any():
        return observations
    eyes = np.array([scene.eye_position_mm(name) for name in EYES]) + scene.spec.subject.head_positions_mm[0]
    head = np.where(lost[:, None], np.nan_to_num(index.head_mm), index.head_mm)
    place = np.where(lost[:, None], eyes[index.eye] - head, index.eye_position_mm)
    return replace(observations, index=replace(index, eye_position_mm=frozen(place), head_mm=frozen(head)))


class RigFile(FileSpec, Rig):
    """A rig in a separate file: `format: 1` and the keys of `rig` in a scene."""


def load_rig(path: str | Path) -> RigGeometry:
    """Read the rig of a scene (a file, or the name of a shipped one) or of a rig file.

    >>> rig = er.gaze.load_rig("rig.yaml")  # doctest: +SKIP

    Raises:
        InputError: naming the file and the key.
    """
    return RigFile.load(path).resolved(Path(path).parent).build() if is_rig_file(path) else load_scene(path).rig


def is_rig_file(path: str | Path) -> bool:
    """Return whether a file is that of a rig, not of a scene."""
    return Path(path).suffix.lower() in (".yaml", ".yml") and bool({"cameras", "calibration"} & read_yaml(path).keys())


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


_Pixels = Annotated[int, Field(strict=False, gt=0, le=65536)]  # JSON may have them as 640.0


class _CameraData(CameraCalibration):
    """A camera in JSON."""

    model_config = ConfigDict(extra="ignore")

    t_mm: Vec3 = Field(alias="t")
    resolution_px: tuple[_Pixels, _Pixels]
    mirrored: bool | None = None
    flip: Literal["horizontal"] | None = None
    eyes: EyeNames | None = None

    def build(self) -> PinholeCamera:
        camera = PinholeCamera.of(self.K, self.R, self.t_mm, self.resolution_px, self.distortion)
        camera = replace(camera, mirrored=bool(self.mirrored), eyes=self.eyes)
        return camera if self.flip is None else camera.flipped()


class _ScreenData(Spec):
    """A screen in JSON."""

    model_config = ConfigDict(extra="ignore")

    centre_mm: Vec3
    size_mm: tuple[Positive, Positive]
    right: Vec3 = (0, -1, 0)
    up: Vec3 = (0, 0, 1)

    @model_validator(mode="after")
    def _check(self) -> Self:
        axes = np.array([self.right, self.up])
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-6):
            raise ValueError("right and up must be unit vectors at a right angle")
        return self

    def build(self) -> ScreenPlane:
        return ScreenPlane(frozen(self.centre_mm), frozen(self.right), frozen(self.up), self.size_mm)


class _RigData(Spec):
    """A rig in JSON."""

    model_config = ConfigDict(extra="ignore")

    cameras: Annotated[tuple[_CameraData, ...], Field(max_length=MAX_CAMERAS)]
    lights_mm: Annotated[tuple[Vec3, ...], Field(max_length=MAX_LIGHTS)] | None = None
    light_eyes: Annotated[tuple[EyeNames | None, ...], Field(max_length=MAX_LIGHTS)] | None = None
    screen: _ScreenData | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.light_eyes is not None and len(self.light_eyes) != len(self.lights_mm or ()):
            raise ValueError("light_eyes: must have an entry for each of lights_mm")
        return self

    def build(self) -> RigGeometry:
        plain = Lamp(
            position_mm=frozen([0.0, 0.0, 0.0]),
            axis=frozen([1.0, 0.0, 0.0]),
            radius_mm=0.0,
            intensity_mw_sr=1.0,
            lobe_exponent=0.0,
        )
        places = self.lights_mm or ()
        of_eyes = self.light_eyes or (None,) * len(places)
        lights = [
            replace(plain, position_mm=frozen(place), eyes=eyes) for place, eyes in zip(places, of_eyes, strict=True)
        ]
        screen = None if self.screen is None else self.screen.build()
        return RigGeometry(tuple(camera.build() for camera in self.cameras), tuple(lights), screen)


def rig_from_mapping(data: Any, *, source: str = "") -> RigGeometry:
    """Read a rig as `features --json` writes it; unknown keys are ignored. InputError names the part that is wrong."""
    try:
        return _RigData.from_mapping(data).build()
    except InputError as error:
        raise error.placed(source=source, under="rig") from None


def _is_image_line(line: Any) -> bool:
    return isinstance(line, dict) and isinstance(line.get("records"), list)
