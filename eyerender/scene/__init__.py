"""Scenes (who looks where, and which rig and camera settings observe it) and their frames with poses."""

from .scene import Frame, Frames, Scene, as_frames
from .shipped import is_dataset, is_shipped_dataset, load_scene, refuse_folder, shipped_files, shipped_scenes

__all__ = [
    "Frame",
    "Frames",
    "Scene",
    "as_frames",
    "is_dataset",
    "is_shipped_dataset",
    "load_scene",
    "refuse_folder",
    "shipped_files",
    "shipped_scenes",
]
