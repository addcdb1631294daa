"""A small study whose images take seconds."""

from __future__ import annotations

from collections.abc import Sequence

from eyerender.apps.study import guestrin
from eyerender.apps.study.images import shots
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec


def small_scenes(eyes: Sequence[str] = ("E1", "E2")) -> list[Scene]:
    """Three targets, both eyes, with and without noise: twelve windows a model."""
    out = []
    for eye in eyes:
        data = guestrin.scene(eye, guestrin.CORRECTED).spec.to_mapping()
        data["targets"] = {"grid": [3, 1]}
        data["image"] = {"window_px": [160, 120], "spp": 4}
        data["subject"]["head_positions_mm"] = [[0, 0, 0]]
        scene = Scene.of(SceneSpec.from_mapping(data))
        out += [s.scene for noise in (True, False) for s in shots(scene, noise=noise, facing=True)]
    return out
