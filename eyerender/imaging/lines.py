"""The line of metadata of an image, the same for rendered folders and datasets (docs/formats.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ..eye.spectacles import lenses_of
from ..folders.imagefolder import FILE_KEYS, IMAGE_SCHEMA
from ..rig.camera import Window
from ..scene import Scene

SAMPLE_KEYS = ("sample", "split", "sequence_index")
DRAWN_KEYS = ("attempt", "subject_attempt", "draws")
"""Keys of a line and of its `parameters` that only a dataset's lines fill."""


def image_line(
    scene: Scene,  # the rendered scene
    record: Mapping[str, Any],  # the record of the eye that it shows
    window: Window,  # (x0, y0, width, height) in full-sensor pixels
    labels: Mapping[str, Any],  # its labels
    *,
    # `timestamp_s`, the time that the camera stored, and in a dataset values of `SAMPLE_KEYS`
    sample: Mapping[str, Any] | None = None,
    drawn: Mapping[str, Any] | None = None,  # values of `DRAWN_KEYS`, in a dataset
    tree: Mapping[str, Any] | None = None,  # keys of the scene; default: all
    eye: Mapping[str, Any] | None = None,  # keys of the eye file; default: those of the scene's eye
) -> dict[str, Any]:
    """Return the line of an image; the keys of files are null."""
    tree = scene.spec.to_mapping() if tree is None else tree
    eye = scene.eye_file(record["eye"]).to_mapping() if eye is None else eye
    spec, contact = scene.spec, scene.contact_lens(record["eye"])
    return {
        "schema": IMAGE_SCHEMA,
        **dict.fromkeys(FILE_KEYS),
        **dict.fromkeys(SAMPLE_KEYS),
        **{key: record[key] for key in ("subject", "instant", "time_s", "rig_pose")},
        "timestamp_s": None,
        **(sample or {}),
        "window_px": dict(zip(("x0", "y0", "width", "height"), window, strict=True)),
        "bit_depth": spec.sensor.bit_depth,
        "gamma": spec.sensor.gamma,
        "records": [record],
        "labels": labels,
        "parameters": {
            "eye_model": scene.eye_name,
            "pupil_diameter_mm": labels["pupil"]["stop_diameter_mm"],
            "wavelength_nm": spec.wavelength_nm,
            "spp": spec.image.spp,
            "seed": spec.seed,
            "camera": record["camera"],
            **dict.fromkeys(DRAWN_KEYS),
            **(drawn or {}),
            "spectacles": _worn(scene, record["eye"]),
            "contact_lens": None if contact is None else json.dumps(contact.to_mapping(), sort_keys=True),
            **scene.person_numbers(record["eye"]),
            # Stored as text, because their nested keys may differ between images, which table columns do not allow.
            "scene_json": json.dumps(tree, sort_keys=True),
            "eye_json": json.dumps({key: value for key, value in eye.items() if key != "sources"}, sort_keys=True),
        },
    }


def _worn(scene: Scene, side: str) -> str | None:
    """Return the lenses in front of one eye as text, from the eye on; None without any."""
    lenses = lenses_of(scene.spec.subject.spectacles, side)
    return json.dumps([lens.to_mapping() for lens in lenses], sort_keys=True) if lenses else None
