"""Metadata of one image of a sample, without the names of its files, and the image's name."""

from __future__ import annotations

import json
from typing import Any

from ..population.table import default_table
from ..rig.camera import Window
from ..scene import Scene
from ..scene.observation import EYES
from .realise import Realised


def image_name(sample: int, frame: int, frames: int, side: str) -> str:
    """Return the name of an image without suffix; `frame` counts within the sample, which has `frames` frames."""
    return f"{sample:08d}-{f'{frame:03d}-' if frames > 1 else ''}{side}"


def image_line(
    found: Realised, row: int, frames: int, window: Window, labels: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return name and metadata of observation `row` of a sample; `frames` is the number of frames per sample."""
    sample, scene, observations = found.sample, found.scene, found.observations
    assert sample is not None
    assert scene is not None
    assert observations is not None
    turn = sample.turn
    (record,) = observations.take([row]).records()
    frame = record["frame"]
    side = EYES[int(observations.index.eye[row])]
    eye = sample.eye or scene.eye_file(side).to_mapping()
    line = {
        "sample": turn.sample,
        "subject": turn.subject,
        "split": sample.split,
        "sequence_index": turn.sequence,
        "window_px": dict(zip(("x0", "y0", "width", "height"), window, strict=True)),
        "bit_depth": scene.spec.sensor.bit_depth,
        "gamma": scene.spec.sensor.gamma,
        # Keys of version 4 that no scene fills yet: time within the sequence, movements, and what the eye wears.
        **dict.fromkeys(("time_s", "event", "rig_pose")),
        # A frame's number is unique in the whole dataset.
        "records": [{**record, "frame": turn.sample * frames + frame}],
        "labels": labels,
        "parameters": {
            "eye_model": scene.eye_name,
            "pupil_diameter_mm": scene.stop_diameter_mm(side),
            "wavelength_nm": scene.spec.wavelength_nm,
            "spp": scene.spec.image.spp,
            "seed": scene.spec.seed,
            "camera": int(observations.index.camera[row]),
            "attempt": turn.attempt,
            "subject_attempt": turn.subject_attempt,
            "draws": sample.draws,
            "spectacles": None,
            "contact_lens": None,
            **_person(scene, side),
            # Stored as text, because their nested keys may differ between samples, which table columns do not allow.
            "scene_json": json.dumps(sample.scene, sort_keys=True),
            "eye_json": json.dumps({k: v for k, v in eye.items() if k != "sources"}, sort_keys=True),
        },
    }
    return image_name(turn.sample, frame, frames, side), line


def _person(scene: Scene, side: str) -> dict[str, Any]:
    """Return the metadata `person`; its entrance pupil is that at the table's luminance, not that of the image."""
    found: dict[str, Any] = scene.person_numbers(side)
    if "entrance_pupil_mm" not in found.get("person", {}):
        return found
    luminance = default_table().constant("luminance_cd_m2")
    named = {"entrance_pupil_mm": f"entrance_pupil_at_{luminance:g}_cd_m2_mm"}
    return {"person": {named.get(key, key): value for key, value in found["person"].items()}}
