"""Obstacles hide the same glints behind a lens that bends nothing as of the bare eye."""

from __future__ import annotations

import numpy as np

import eyerender as er
from eyerender.scene.spec import SceneSpec

RIG = {
    "cameras": [{"position_mm": [45, -31.5, -30], "look_at_mm": [0, -31.5, 0], "focal_length_mm": 6,
                 "sensor_mm": [4.8, 3.6], "resolution_px": [320, 240]}],
    "lights": [{"position_mm": [40, -31.5 + r * float(np.cos(a)), r * float(np.sin(a))]}
               for r in (26, 42) for a in np.linspace(0, 2 * np.pi, 4, endpoint=False)],
    "obstacles": [{"ring": {"centre_mm": [18, -31.5, 0], "inner_radius_mm": 16, "outer_radius_mm": 26, "depth_mm": 5}}],
}  # fmt: skip


def statuses(**subject):
    scene = {"format": 2, "name": "ring", "subject": {"eyes": ["right"], **subject}, "rig": RIG,
             "poses": [{"azimuth_deg": a, "elevation_deg": 5.0} for a in (-15.0, 0.0, 15.0)]}  # fmt: skip
    return er.trace(er.Scene.of(SceneSpec.from_mapping(scene)).frames()).glints.status


def test_obstacles_hide_the_same_glints_behind_a_lens_of_no_power():
    bare = statuses()
    assert 0 < np.count_nonzero(bare) < bare.size
    worn = statuses(spectacles={"surfaces": {"front_radius_mm": None, "back_radius_mm": None, "thickness_mm": 0.5,
                                             "index": 1.001}, "vertex_mm": 12})  # fmt: skip
    assert np.array_equal(worn, bare)
