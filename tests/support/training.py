"""Lines and pictures for training without a renderer: analytic labels, and masks of whole ellipses."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np

import eyerender as er
from eyerender.imaging.labels import EyeInWindow, known_labels, moments_ellipse
from eyerender.imaging.lines import image_line
from eyerender.optics.ellipse import Ellipse, signed_distance
from eyerender.region.mesh import lid_margins
from eyerender.rendering.records.job import globe_of
from eyerender.rendering.scene.pixels import lid_margins_px
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec

F, S = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
SIZE = (200, 150)
K = [[900.0, 0.0, 93.0], [0.0, 900.0, 81.0], [0.0, 0.0, 1.0]]
CAMERA = er.Camera(
    position_mm=(70.0, 12.0, -25.0), look_at_mm=(0.0, 31.5, 0.0), roll_deg=7.0, focal_length_px=900, resolution_px=SIZE
).build()
TREE: dict[str, Any] = {
    "format": 2,
    "name": "training",
    "eye": {"model": "E2", "pupil_diameter_mm": 4.0},
    "subject": {"eyes": ["left"], "head_positions_mm": [[1.0, 0.5, -0.7]]},
    "rig": {
        "cameras": [
            {
                "resolution_px": list(SIZE),
                "calibration": {"K": K, "R": CAMERA.R.tolist(), "t_mm": CAMERA.t.tolist()},
            }
        ],
        "lights": [{"position_mm": [70.0, y, z]} for y, z in ((20.0, -12.0), (-20.0, -12.0), (0.0, -30.0))],
        "screen": {"centre_mm": [650.0, 0.0, 0.0], "size_mm": [377.0, 301.0]},
    },
    "region": {"blink": 0.2},
    "targets": {"world_mm": [[600.0, -40.0, 90.0]]},
}


def scene_tree(**camera: Any) -> dict[str, Any]:
    """The tree of a left eye before one camera near it, with changed keys of the calibration."""
    tree = copy.deepcopy(TREE)
    tree["rig"]["cameras"][0]["calibration"] |= camera
    return tree


def mirrored_tree(tree: dict[str, Any], lamps: tuple[int, ...]) -> dict[str, Any]:
    """The mirrored scene; lamp k becomes number `lamps[k]`."""
    out = copy.deepcopy(tree)
    (camera,) = out["rig"]["cameras"]
    own = camera["calibration"]
    own["K"][0][2] = camera["resolution_px"][0] - 1 - own["K"][0][2]
    own["R"], own["t_mm"] = (F @ own["R"] @ S).tolist(), (F @ own["t_mm"]).tolist()
    k = own.get("distortion")
    if isinstance(k, dict):
        k["p"] = [k["p"][0], -k["p"][1]]
    elif k is not None:
        k[3] = -k[3]
    for number, light in zip(lamps, tree["rig"]["lights"], strict=True):
        out["rig"]["lights"][number] = {**light, "position_mm": (S @ light["position_mm"]).tolist()}
    mount = out["rig"].get("mount")
    if mount is not None:
        x, y, z = mount["rotation_deg"]
        mount["rotation_deg"], mount["translation_mm"] = [-x, y, -z], (S @ mount["translation_mm"]).tolist()
    out["targets"] = {"world_mm": [(S @ point).tolist() for point in tree["targets"]["world_mm"]]}
    out["subject"] = {"eyes": ["right"], "head_positions_mm": [(S @ [1.0, 0.5, -0.7]).tolist()]}
    return out


def line_of(tree: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The line of the scene's only picture, and its pictures by kind."""
    scene = Scene.of(SceneSpec.from_mapping(tree))
    frames = scene.frames()
    found = er.trace(frames)
    view = replace(EyeInWindow.of(frames, 0), window=(0, 0, *scene.rig.cameras[0].resolution_px))
    labels = known_labels(scene, found, view)
    x0, y0, w, h = view.window
    mask = np.zeros((h, w), np.uint8)
    v, u = np.mgrid[y0 : y0 + h, x0 : x0 + w]
    for part, value in (("iris", 2), ("pupil", 3)):
        own = labels[part]["amodal"]
        ellipse = Ellipse(np.array(own["centre_px"]), np.array(own["semi_axes_px"]), own["angle_rad"])
        mask[signed_distance(ellipse, np.stack([u, v], axis=-1)) <= 0] = value
    for part, inside in (("pupil", mask == 3), ("iris", mask > 0)):
        labels[part] |= {"visible": moments_ellipse(inside, view.window), "visible_fraction": 0.8}
    for glint in labels["glints"]:
        glint |= {"visible": glint["in_window"], "spot_xy_px": None}
    globe = globe_of(view.eye, view.M, view.t - view.apex_mm)
    labels["lid_margins_px"] = lid_margins_px(lid_margins(scene.spec.region, globe), scene.rig.cameras[0], view.apex_mm)
    labels["lid_opening"] = {"mm": 9.5, "share": 1.1}
    (record,) = found.records()
    line = image_line(scene, record, view.window, labels)
    image = np.random.default_rng(0).integers(0, 65536, (h, w)).astype(np.uint16)
    normals = np.random.default_rng(1).normal(size=(h, w, 3)).astype(np.float32)
    if scene.spec.subject.eyes == ("right",):
        image, normals = image[:, ::-1], (normals * [-1, 1, 1]).astype(np.float32)[:, ::-1]
    return line, {"images": image, "masks": mask, "normals": normals}
