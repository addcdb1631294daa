"""The specs and folders that the tests of this room share."""

from __future__ import annotations

import copy
import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from eyerender.base.errors import BackendError
from eyerender.dataset.plan import Plan
from eyerender.dataset.run import generate
from eyerender.dataset.spec import DatasetSpec

TINY: dict[str, Any] = {
    "format": 3,
    "kind": "dataset",
    "name": "tiny",
    "count": 24,
    "shard_size": 3,
    "subjects": 4,
    "splits": {"train": 0.5, "validation": 0.25, "test": 0.25},
    "seed": 5,
    "eye_parameters": {"E2": {"cornea.0.shape.radius_mm": {"draw": "uniform", "low": 7.4, "high": 8.2}}},
    "scene": {
        "eye": {
            "model": "E2",
            "pupil_diameter_mm": {"draw": "truncated_normal", "mean": 4.0, "sd": 0.8, "low": 2.5, "high": 6.0},
        },
        "subject": {"eyes": ["right"], "ipd_mm": {"draw": "uniform", "low": 58.0, "high": 68.0}},
        "rig": {
            "cameras": [
                {
                    "position_mm": [615.0, 0.0, -150.5],
                    "look_at_mm": [0.0, -31.5, 0.0],
                    "focal_length_px": 2400.0,
                    "resolution_px": [640, 480],
                }
            ],
            "lights": [
                {"position_mm": [615.0, y, 0.0], "radius_mm": 2.5, "aim_mm": [0, 0, 0], "intensity_mw_sr": 100.0}
                for y in (208.5, -208.5)
            ],
            "screen": {"centre_mm": [650.0, 0.0, 0.0], "size_mm": [377.0, 301.0]},
        },
        "targets": {
            "screen_mm": [[{"draw": "sobol", "low": -120, "high": 120}, {"draw": "sobol", "low": -90, "high": 90}]]
        },
        "image": {"window_px": [96, 72], "spp": 2},
        "sensor": {"f_number": 2.8, "exposure_ms": 15.0, "pixel_pitch_um": 7.5, "full_well_e": 20000.0},
        "look": {"iris_albedo": {"draw": "uniform", "low": 0.2, "high": 0.4}},
    },
}


def mapping(**changes: Any) -> dict[str, Any]:
    """The tiny spec with changes, keys with dots going deeper ('scene.image.spp')."""
    data = copy.deepcopy(TINY)
    for path, value in changes.items():
        node, keys = data, path.replace("__", ".").split(".")
        for key in keys[:-1]:
            node = node[int(key)] if isinstance(node, list) else node[key]
        node[keys[-1]] = value
    return data


def plan(**changes: Any) -> Plan:
    return Plan.of(DatasetSpec.from_mapping(mapping(**changes)), source="tiny.yaml")


def write(path: Path, **changes: Any) -> Path:
    path.write_text(yaml.safe_dump(mapping(**changes)), encoding="utf-8")
    return path


def make(folder: Path, made: Plan, **options: Any) -> dict[str, Any]:
    """A run in this process, silently."""
    said: list[str] = []
    options.setdefault("workers", 1)
    options.setdefault("threads", 1)
    done = generate(made, folder, **options, say=said.append)
    return {**done, "said": said}


def make_or_skip(folder: Path, made: Plan) -> Path:
    """Make a dataset; where there is no backend, the test is skipped."""
    try:
        make(folder, made)
    except BackendError as error:
        pytest.skip(f"nothing to render with: {error}")
    return folder


def tree(folder: Path) -> dict[str, str]:
    """Checksums of all that must be the same in every run."""
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name not in ("log.jsonl", "done.json") and not p.name.startswith(".eyerender-lock")
    }


def command(*argv: str, env: dict[str, str] | None = None, **keys: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "eyerender", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**(env or os.environ), "PYTHONUNBUFFERED": "1"},
        **keys,
    )
