"""Scenes with sequences, for tests."""

from __future__ import annotations

from typing import Any

from eyerender.scene import Scene, load_scene
from eyerender.scene.spec import SceneSpec


def in_time(
    name: str = "headset",
    sequence: dict[str, Any] | None = None,
    *,
    camera: dict[str, Any] | None = None,
    led: dict[str, Any] | None = None,
    **fields: Any,
) -> Scene:
    """Return a shipped scene with a sequence at 100 Hz; `camera` and `led` are keys of all of them."""
    data = load_scene(name).spec.to_mapping()
    data.pop("targets", None)
    data.pop("poses", None)
    for one in data["rig"]["cameras"]:
        one.update({"frame_rate_hz": 100.0, **(camera or {})})
    for one in data["rig"]["lights"]:
        one.update(led or {})
    return Scene.of(SceneSpec.from_mapping({**data, "sequence": sequence or {}, **fields}))


def turning(speed_deg_s: float, start_deg: float = 0.0, duration_s: float = 0.1, **keys: Any) -> dict[str, Any]:
    """Return a sequence whose eyes turn to the left at a constant speed, and do nothing else."""
    ends = [-0.05, duration_s + 0.05]
    gaze = {
        "time_s": ends,
        "azimuth_deg": [start_deg + speed_deg_s * t for t in ends],
        "elevation_deg": [0.0, 0.0],
    }
    still = {"lids": {"blinks_per_minute": 0}, "pupil": {"hippus": 0}}
    return {"duration_s": duration_s, "gaze": gaze, **still, **keys}
