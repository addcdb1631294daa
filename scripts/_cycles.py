"""Renders a baked eye with Blender's Cycles, by a Python that has `bpy`: _cycles.py FOLDER SAMPLES THREADS.

FOLDER holds what `bake_meshes` writes, and `view.json` with the camera and the lamps in the eye's frame. Shadow
caustics are on, so Cycles lights the iris through the cornea by manifold next-event estimation. It prints the CPU
seconds of the second frame, and the mean and the relative noise of a part of the iris.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import bpy  # type: ignore[import-not-found]
import mathutils  # type: ignore[import-not-found]
import numpy as np

ALBEDO = {"iris": 0.3, "sclera": 0.45}


def material(name: str, entry: dict[str, Any]) -> tuple[Any, bool]:
    """Make a matte or refracting material for a patch of the eye, and say whether it refracts."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    out = nodes.new("ShaderNodeOutputMaterial")
    if entry["interior_index"] and entry["exterior_index"] and entry["interior_index"] != entry["exterior_index"]:
        shader = nodes.new("ShaderNodeBsdfGlass")
        shader.inputs["IOR"].default_value = entry["interior_index"] / entry["exterior_index"]
        shader.inputs["Roughness"].default_value = 0.0
    else:
        shader = nodes.new("ShaderNodeBsdfDiffuse")
        shader.inputs["Color"].default_value = (*3 * [ALBEDO.get(name, 0.0)], 1.0)
    links.new(shader.outputs[0], out.inputs["Surface"])
    return made, shader.bl_idname == "ShaderNodeBsdfGlass"


def main() -> None:
    """Build the scene, render it twice, and print."""
    folder, samples, threads = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for file, entry in json.loads((folder / "manifest.json").read_text())["files"].items():
        bpy.ops.wm.ply_import(filepath=str(folder / file), forward_axis="Y", up_axis="Z")
        body = bpy.context.object
        made, clear = material(Path(file).stem, entry)
        body.data.materials.clear()
        body.data.materials.append(made)
        body.data.shade_smooth()
        body.cycles.is_caustics_caster, body.cycles.is_caustics_receiver = clear, not clear
    view = json.loads((folder / "view.json").read_text())
    for lamp in view["lamps"]:
        light = bpy.data.lights.new("lamp", "AREA")
        light.shape, light.size, light.energy = "DISK", 2 * lamp["radius_mm"], 1.0
        light.cycles.is_caustics_light = True
        shown = bpy.data.objects.new("lamp", light)
        shown.location = lamp["position_mm"]
        shown.rotation_euler = mathutils.Vector(lamp["axis"]).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(shown)
    camera = bpy.data.cameras.new("camera")
    width, height = view["resolution_px"]
    camera.sensor_width, camera.lens, camera.clip_start = 36.0, 36.0 * view["focal_px"] / width, 0.1
    eye = bpy.data.objects.new("camera", camera)
    eye.location = view["position_mm"]
    eye.rotation_euler = mathutils.Vector(view["axis"]).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(eye)
    scene.camera, scene.render.engine = eye, "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = samples, False, False
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "cycles.exr")
    spent = 0.0
    for _ in range(2):
        start = os.times()
        bpy.ops.render.render(write_still=True)
        now = os.times()
        spent = now.user + now.system - start.user - start.system
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(image.pixels[:], dtype=float).reshape(height, width, -1)[..., 0][::-1]
    x0, y0, x1, y1 = view["iris_box"]
    part = pixels[y0:y1, x0:x1]
    noise = np.std(np.diff(part, axis=1)) / np.sqrt(2) / part.mean()
    print(json.dumps({"cpu_s": spent, "mean": part.mean(), "noise": noise}))


if __name__ == "__main__":
    main()
