"""Three-dimensional view of the rig: strokes and their labels."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.elements.scene.scene_object3d import Object3D

from ...base.arrays import Floats
from ...rig.rig import RigGeometry
from .drawing import Label, Strokes, colours_of, extent_mm

_CM = 0.1
"""The view's unit is 1 cm, which suits its near plane and mouse wheel."""
_FIELD_DEG = 40.0
_IDLE_FPS, _TURNED_FPS = 4, 30


class Segments(Object3D, component="segments.js"):  # type: ignore[call-arg]
    """Line segments with individual colours and widths in pixels."""

    def __init__(self, drawn: Strokes) -> None:
        super().__init__(*_packed(drawn))

    def draw(self, drawn: Strokes) -> None:
        """Replace the segments."""
        self.args = _packed(drawn)  # for a browser that reconnects
        self.scene.run_method("run_method_on_component", self.id, "draw", *self.args)


class RigView:
    """The three-dimensional view of one tab."""

    def __init__(self) -> None:
        camera = ui.scene.perspective_camera(fov=_FIELD_DEG, near=0.05, far=5000)
        with ui.scene(
            grid=False, camera=camera, background_color="#ffffff", click_events=[], fps=_IDLE_FPS
        ) as self._scene:
            self._segments = Segments(Strokes())
            self._labels: list[Any] = []
        self._scene.classes("rig-view").props('aria-label="the rig in three dimensions"')
        # It is drawn continuously, and without a graphics card that takes time from the renderer.
        self._scene.on("pointerenter", lambda: self._draw_at(_TURNED_FPS))
        self._scene.on("pointerleave", lambda: self._draw_at(_IDLE_FPS))
        self._shown: list[Label] = []

    def show(self, drawn: Strokes) -> None:
        """Show a drawing."""
        self._segments.draw(drawn)
        if [label.text for label in drawn.labels] != [label.text for label in self._shown]:
            for text in self._labels:
                text.delete()
            with self._scene:
                self._labels = [ui.scene.text(label.text, _style(label)) for label in drawn.labels]
        for text, label in zip(self._labels, drawn.labels, strict=True):
            text.move(*(_CM * v for v in label.place_mm))
        self._shown = drawn.labels

    def look_at_rig(self, drawn: Strokes, eye_mm: Floats, rig: RigGeometry) -> None:
        """Turn the view to the whole rig."""
        middle, radius = extent_mm(drawn, eye_mm, rig)
        self._look(middle, 1.25 * radius / np.sin(np.radians(_FIELD_DEG / 2)), np.array([0.45, -0.75, 0.5]))

    def look_at_eye(self, apex_mm: Floats) -> None:
        """Turn the view to an eye."""
        self._look(apex_mm - np.array([6.0, 0, 0]), 70.0, np.array([0.75, -0.6, 0.35]))

    def look_from(self, place_mm: Floats, target_mm: Floats) -> None:
        """Look from a position, such as that of a camera, at a target."""
        (x, y, z), (u, v, w) = _CM * place_mm, _CM * target_mm
        self._scene.move_camera(x=x, y=y, z=z, look_at_x=u, look_at_y=v, look_at_z=w, duration=0.4)

    def _draw_at(self, fps: int) -> None:
        self._scene.props["fps"] = fps

    def _look(self, middle: Floats, distance: float, way: Floats) -> None:
        self.look_from(middle + distance * way / np.linalg.norm(way), middle)


def _packed(drawn: Strokes) -> list[str]:
    """Encode ends, colours and widths as little-endian single floats in base64."""
    parts = (_CM * drawn.ends_mm, colours_of(drawn.colours), np.array(drawn.widths))
    return [base64.b64encode(np.ascontiguousarray(part, "<f4").tobytes()).decode() for part in parts]


def _style(label: Label) -> str:
    return f"color:{label.colour};font:600 11px system-ui,sans-serif;text-shadow:0 0 3px #fff,0 0 3px #fff;padding:2px"
