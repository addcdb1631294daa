"""Hypothesis' strategies for scenes, and scenes after a motion, in the mirror and in other units."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

MODELS = ("E1", "E2", "E3", "E4", "E5", "E5-published")
RESOLUTION_PX = (1600, 1200)
MIRROR = np.array([1.0, -1.0, 1.0])


def number(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers from `low` to `high`."""
    return st.floats(low, high, allow_nan=False)


def points(*bounds: tuple[float, float]) -> st.SearchStrategy[list[float]]:
    """Points whose coordinates keep within their bounds."""
    return st.tuples(*(number(*pair) for pair in bounds)).map(list)


@st.composite
def cameras(draw: st.DrawFn) -> dict[str, Any]:
    """A camera at a table, or one on the head that sees the right eye; with distortion, rolled or neither."""
    shared = {
        "resolution_px": list(RESOLUTION_PX),
        "principal_point_px": draw(points((700.0, 900.0), (500.0, 700.0))),
        "roll_deg": draw(st.sampled_from([0.0, -7.0, 20.0])),
        "distortion": draw(st.sampled_from([[0.0] * 5, [-0.12, 0.03, 0.001, -0.002, 0.0]])),
    }
    if draw(st.booleans()):
        place = draw(points((450.0, 750.0), (-150.0, 150.0), (-350.0, 100.0)))
        return {
            **shared,
            "position_mm": place,
            "look_at_mm": [0.0, 0.0, 0.0],
            "focal_length_px": draw(number(2e3, 5e3)),
        }
    place = draw(points((25.0, 40.0), (-60.0, -15.0), (-30.0, 10.0)))
    return {**shared, "position_mm": place, "look_at_mm": [0.0, -31.5, 0.0], "focal_length_px": draw(number(5e2, 2e3))}


@st.composite
def mappings(draw: st.DrawFn, models: tuple[str, ...] = MODELS) -> dict[str, Any]:
    """What a scene's file holds: one camera, one to three lights, one or two targets that both eyes can fixate."""
    lights = st.lists(points((450.0, 700.0), (-250.0, 250.0), (-300.0, 250.0)), min_size=1, max_size=3)
    targets = st.lists(points((500.0, 900.0), (-250.0, 250.0), (-200.0, 200.0)), min_size=1, max_size=2)
    return {
        "format": 2,
        "name": "drawn",
        "eye": {"model": draw(st.sampled_from(models)), "pupil_diameter_mm": draw(number(2.0, 7.0))},
        "subject": {"ipd_mm": draw(number(54.0, 72.0)), "head_positions_mm": [draw(points(*[(-20.0, 20.0)] * 3))]},
        "rig": {
            "cameras": [draw(cameras())],
            "lights": [{"position_mm": place, "aim_mm": [0.0, 0.0, 0.0]} for place in draw(lights)],
            "screen": {"centre_mm": [650.0, 0.0, 0.0], "size_mm": [377.0, 301.0]},
        },
        "targets": {"world_mm": draw(targets)},
    }


def scene_of(data: dict[str, Any]) -> Scene:
    """The scene of a mapping."""
    return Scene.of(SceneSpec.from_mapping(data))


def mapped(data: dict[str, Any], change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """The same scene with every point of the world changed; the head moves by the change of the origin."""
    out = copy.deepcopy(data)

    def apply(place: list[float]) -> list[float]:
        return [float(x) for x in change(np.array(place, dtype=float))]

    camera = out["rig"]["cameras"][0]
    for key in ("position_mm", "look_at_mm"):
        camera[key] = apply(camera[key])
    for light in out["rig"]["lights"]:
        light["position_mm"], light["aim_mm"] = apply(light["position_mm"]), apply(light["aim_mm"])
    out["rig"]["screen"]["centre_mm"] = apply(out["rig"]["screen"]["centre_mm"])
    out["targets"]["world_mm"] = [apply(place) for place in out["targets"]["world_mm"]]
    out["subject"]["head_positions_mm"] = [apply(place) for place in out["subject"]["head_positions_mm"]]
    return out


def mirrored(data: dict[str, Any]) -> dict[str, Any]:
    """The scene in the mirror y = 0, whose picture runs the other way: x_px becomes width - 1 - x_px."""
    out = mapped(data, lambda place: MIRROR * place)
    camera = out["rig"]["cameras"][0]
    x, y = camera["principal_point_px"]
    k1, k2, p1, p2, k3 = camera["distortion"]
    camera["principal_point_px"] = [RESOLUTION_PX[0] - 1 - x, y]
    camera["roll_deg"] = -camera["roll_deg"]
    camera["distortion"] = [k1, k2, p1, -p2, k3]
    return out
