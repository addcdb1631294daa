"""The live page: the content of a tab, and the actions of its knobs."""

from __future__ import annotations

import asyncio
import html
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Request, Response
from nicegui import Client, app, ui

from ...analytic.observer import trace
from ...base.errors import EyerenderError, InputError, one_line
from ...eye.catalogue import catalogue_names
from ...report.overlay import feature_marks
from ...report.style import ANALYTIC, IMAGE
from ...scene import Frames, Scene
from ...scene.observation import Observations
from ...scene.spec import SceneSpec
from .drawing import LEGEND, Strokes, apex_mm, strokes
from .painter import GOAL_SPP, MAX_REASON, Order, Painter, Shown, line_of
from .readout import Estimator, calibrated, exposure_line, feature_table, gaze_line, poses_line
from .rig_view import RigView
from .setup import Setup, directions, half_width_deg, lobe_exponent, named, ring_note
from .source import python_source

MAX_UNDO = 50
SETTLED_S = 0.8
"""Changes in faster succession, such as those of a dragged slider, are undone together."""
MAX_TABS = 20
"""Largest number of pages, including those that have not connected yet. Each takes some megabytes."""
STYLE = Path(__file__).with_name("page.css")
Change = Callable[[Setup], Setup]


class Slider(ui.slider):
    """A slider that does not wait for the server's response while it is dragged."""

    LOOPBACK = False


class Knob:
    """A number with a name, a slider, and a field for exact values, which may lie beyond the slider's ends.

    Without a `step`, the slider has some 500 steps.
    """

    def __init__(
        self, name: str, unit: str, step: float | None, act: Callable[[float], None], *, digits: int = 1
    ) -> None:
        self._step = step
        self._act, self._quiet, self._digits, self._value = act, False, digits, 0.0
        self._number: Any
        with ui.element("div").classes("knob") as self.row:
            ui.label(f"{name} ({unit})").classes("name")
            self._slider = Slider(min=0, max=1, step=step or 1, on_change=lambda e: self._moved(e.value, self._number))
            self._slider.props(f'aria-label="{name}" dense')
            self._number = ui.number(step=step, on_change=lambda e: self._moved(e.value, self._slider))
            self._number.props(f'aria-label="{name}, exact" dense borderless debounce=300 hide-bottom-space')

    @property
    def value(self) -> float:
        """Return the displayed value."""
        return self._value

    def set(self, value: float, low: float, high: float) -> None:
        """Display a value between two ends, without triggering an action."""
        low, high, value = min(low, value), max(high, value), round(value, self._digits)
        self._quiet, self._value = True, value
        self._slider.props["min"], self._slider.props["max"] = low, high
        if self._step is None:
            self._slider.props["step"] = _round_up(high - low) / 500
        self._slider.set_value(value)
        self._number.set_value(value)
        self._quiet = False

    def enable(self, on: bool) -> None:
        """Enable or disable the knob."""
        for part in (self._slider, self._number):
            part.set_enabled(on)

    def _moved(self, value: Any, other: Any) -> None:
        if self._quiet or not isinstance(value, int | float) or not np.isfinite(value):
            return
        self._quiet, self._value = True, float(value)
        other.set_value(round(value, self._digits))
        self._quiet = False
        self._act(float(value))


@dataclass(eq=False)
class Studio:
    """State shared by all tabs: the loaded scene, the painter, and the images to be fetched.

    A page whose WebSocket does not connect within `connect_s` is deleted.
    """

    scene: Scene
    painter: Painter
    connect_s: float
    tabs: dict[str, Tab] = field(default_factory=dict)

    def register(self) -> None:
        """Add the page and its images to NiceGUI's application."""

        @app.get("/picture/{key}")  # type: ignore[untyped-decorator]
        async def picture(key: str) -> Response:
            tab = self.tabs.get(key)
            if tab is None or tab.shown is None:
                return Response(status_code=404)
            return Response(tab.shown.data, media_type=tab.shown.kind, headers={"Cache-Control": "no-store"})

        @app.exception_handler(404)  # type: ignore[untyped-decorator]
        async def missing(_request: Request, _error: Exception) -> Response:
            # NiceGUI's own response would be a page that is kept for a minute.
            return Response("404: no such page\n", 404, media_type="text/plain")

        @ui.page("/", title=f"{self.scene.name} · eyerender live", response_timeout=30)  # type: ignore[untyped-decorator]
        def page() -> Response | None:
            client = ui.context.client
            if len(Client.instances) > MAX_TABS:
                client.delete()
                wait = f"{self.connect_s:.0f}"
                reason = f"503: too many tabs: {MAX_TABS} are open; close one, wait {wait} s and try again\n"
                return Response(reason, 503, {"Retry-After": wait}, "text/plain")
            tab = Tab(self)
            self.tabs[tab.key] = tab
            client.on_connect(tab.wake)
            client.on_disconnect(lambda: None if client.has_socket_connection else tab.rest())
            client.on_delete(tab.close)
            asyncio.get_running_loop().call_later(self.connect_s, lambda: None if tab.woken else _delete(client))
            return None


def _delete(client: Client) -> None:
    if not client.is_deleted:
        client.delete()


class Tab:
    """One browser tab: its setup, its knobs and its displays."""

    def __init__(self, studio: Studio) -> None:
        self.key = secrets.token_urlsafe(16)
        self.shown: Shown | None = None
        self.woken = False  # whether its page has ever connected
        self._awake = False  # whether it is connected
        self._studio, self._loop = studio, asyncio.get_event_loop()
        self._setup = Setup.of(studio.scene)
        self._orders = 0
        self._light = self._lens = 0  # the light and the camera that the knobs move
        self._before: deque[Setup] = deque(maxlen=MAX_UNDO)
        self._changed = 0.0
        self._estimator: Estimator | None = None
        self._summing: asyncio.TimerHandle | None = None
        self._frames: Frames
        self._truth: Observations
        self._row = 0
        self._drawn = Strokes()
        self._quiet = False
        self._build()
        self._apply(lambda setup: setup)
        self._look_at_rig()
        self._refresh()

    def _deliver(self, shown: Shown) -> None:
        """Pass an image from the painter's thread to the event loop."""
        with suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(self._receive, shown)

    def wake(self) -> None:
        """Request an image, because the page has connected or reconnected."""
        self.woken = self._awake = True
        self._studio.painter.open(self.key, self._deliver)
        self._order()

    def rest(self) -> None:
        """Free the images, because the page has disconnected."""
        self._studio.painter.drop(self.key)
        self._awake, self.shown = False, None

    def close(self) -> None:
        """Free the tab's resources."""
        self.rest()
        if self._summing is not None:
            self._summing.cancel()
        self._studio.tabs.pop(self.key, None)

    # What the page consists of

    def _build(self) -> None:
        ui.colors(primary=ANALYTIC)
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        spec = self._setup.origin
        with ui.element("header").classes("top"):
            ui.label(spec.name).classes("title")
            ui.label(spec.description).classes("lead")
            ui.space()
            with ui.element("div").classes("buttons"):
                _button("Save YAML", lambda: self._save(SceneSpec.to_yaml, "yaml", "application/yaml"))
                _button("Save Python", lambda: self._save(python_source, "py", "text/x-python"))
                self._undo_button = _button("Undo", self._undo)
                _button("Start again", lambda: self._apply(lambda _: Setup.of(self._studio.scene), refresh=True))
        with ui.element("div").classes("desk"):
            with ui.element("section").classes("picture"):
                self._build_picture()
            with ui.element("section").classes("rig"):
                self._build_rig()
            with ui.element("section").classes("knobs"):
                self._build_knobs()

    def _build_picture(self) -> None:
        with ui.element("div").classes("frame") as self._frame:
            self._image = ui.interactive_image(events=[]).classes("image")
            self._wait = ui.label("The first picture takes some seconds.").classes("wait")
        self._status = ui.label("").classes("status").props('role="status"')
        self._problem = ui.label("").classes("problem").props('role="alert"')
        with ui.element("div").classes("line"):
            self._analytic = ui.checkbox("analytic", value=True, on_change=self._draw_features)
            self._analytic.props("dense").style(f"--q-primary: {ANALYTIC}; color: {ANALYTIC}")
            self._found = ui.checkbox("extracted from the picture", value=True, on_change=lambda: self._order())
            self._found.props("dense").style(f"--q-primary: {IMAGE}; color: {IMAGE}")
        self._gaze = ui.label("").classes("gaze")
        self._poses = ui.label("").classes("gaze")
        self._exposed = ui.label("").classes("gaze")
        self._table = ui.html("", sanitize=False).classes("features")

    def _build_rig(self) -> None:
        self._rig = RigView()
        with ui.element("div").classes("line"):
            _button("Whole rig", self._look_at_rig)
            _button("Eye", lambda: self._rig.look_at_eye(apex_mm(self._frames, self._row)))
            _button("From the camera", self._look_from_camera)
            ui.label("Drag to turn, wheel to zoom, right button to move.").classes("hint")
        items = "".join(f'<li><i style="background:{colour}"></i>{html.escape(name)}</li>' for name, colour in LEGEND)
        ui.html(f'<ul class="legend">{items}</ul>', sanitize=False)

    def _build_knobs(self) -> None:
        spec = self._setup.origin
        with _group("Frame") as group:
            eyes = list(spec.subject.eyes)
            self._eye = _choice("Eye", {eye: eye for eye in eyes}, lambda v: self._show(eye=v))
            self._camera = _choice("Camera", dict(enumerate(named(spec.rig.cameras))), lambda v: self._show(camera=v))
            heads = {k: f"{k}" for k in range(len(spec.subject.head_positions_mm))}
            self._head = _choice("Head", heads, lambda v: self._apply(lambda s: s.with_head(v), refresh=True))
        self._choices = group
        with _group("Head against the rig"):
            names = ("Closer to the rig (eye relief)", "To the subject's left", "Up")
            self._shift = [Knob(name, "mm", 0.1, lambda _: self._move_head(), digits=2) for name in names]
        with _group("Gaze"):
            name = "target" if spec.targets is not None else "pose"
            choices = {-1: "set by hand", **{k: f"{name} {k + 1}" for k in range(min(self._setup.fixations, 500))}}
            self._fixation = _choice(f"Follows {name}", choices, self._follow)
            self._azimuth = Knob("Azimuth, to the subject's left", "°", 0.5, lambda _: self._turn(), digits=2)
            self._elevation = Knob("Elevation, up", "°", 0.5, lambda _: self._turn(), digits=2)
        with _group("Eye"):
            models = {name: name for name in catalogue_names()}
            own = spec.eye.model if isinstance(spec.eye.model, str) else ""
            self._model = _choice("Eye model", models if own in models else {own: own, **models}, self._choose_model)
            self._model.set_visibility(spec.person is None and spec.population is None and bool(own))
            self._pupil = Knob("Pupil", "mm", 0.1, lambda v: self._change("eye.pupil_diameter_mm", v), digits=2)
            self._lids = {
                "blink": Knob("Lid opening", "%", 1, lambda v: self._apply(lambda s: s.with_opening(v / 100))),
                "squint": Knob("Squint", "%", 1, lambda v: self._change("region.squint", v / 100)),
                "wide": Knob("Wide open", "%", 1, lambda v: self._change("region.wide", v / 100)),
            }
        with _group("LED"):
            count = len(self._setup.scene.rig.lights)
            self._lamp = _choice("LED", _numbers(count), self._choose_light)
            self._lamp_place = [Knob(axis, "mm", 0.5, lambda _: self._move_light()) for axis in AXES]
            self._power = Knob("Intensity", "mW/sr", None, lambda _: self._move_light(), digits=3)
            self._size = Knob("Radius", "mm", 0.05, lambda v: self._light_changed(radius_mm=v), digits=3)
            self._lobe = Knob("Half-width of its lobe", "°", 0.5, self._widen_lobe, digits=2)
            self._ring = ui.label("").classes("hint")
            with ui.element("div").classes("line"):
                _button("Aim at the eye", lambda: self._light_changed(aim_mm=self._setup.apex_mm.tolist()))
                _button("Add an LED", self._add_light)
                _button("Remove it", lambda: self._apply(lambda s: s.without_light(self._light), refresh=True))
        with _group("Camera"):
            self._chosen = _choice("Camera", dict(enumerate(named(spec.rig.cameras))), self._choose_camera)
            self._camera_place = [Knob(axis, "mm", 0.5, lambda _: self._move_camera()) for axis in AXES]
            self._focal = Knob("Focal length", "mm or px", None, self._lengthen)
            self._field = Knob("Field of view, horizontal", "°", 0.5, self._widen, digits=2)
            self._width = Knob("Width of all pictures", "px", 10, self._resize, digits=0)
            with ui.element("div").classes("line"):
                self._aim = _button(
                    "Aim at the eye", lambda: self._apply(lambda s: s.with_camera_aimed(self._lens), refresh=True)
                )
                _button("Add a camera", self._add_camera)
                _button("Remove it", lambda: self._apply(lambda s: s.without_camera(self._lens), refresh=True))
        with _group("Exposure, all cameras"):
            self._exposure = Knob(
                "Exposure time", "ms", None, lambda v: self._change("sensor.exposure_ms", v), digits=3
            )
            self._aperture = Knob("f-number", "f/", None, lambda v: self._change("sensor.f_number", v), digits=2)

    # What the knobs do

    def _apply(self, change: Change, *, refresh: bool = False) -> None:
        """Change the setup, draw the rig, and request an image; bad input changes nothing."""
        if self._quiet:
            return
        try:
            setup = change(self._setup)
            frames = setup.frames()
            row = setup.row(frames)
            truth = trace(frames)
            drawn = strokes(frames, truth, row)
            estimator = calibrated(setup)
        except EyerenderError as error:
            self._complain(f"Not applied: {line_of(_unplaced(error))}")
            return
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            self._complain(f"Not applied: no ray can be traced ({one_line(str(error), MAX_REASON)})")
            return
        self._remember(setup)
        self._setup, self._frames, self._truth, self._row, self._drawn = setup, frames, truth, row, drawn
        self._estimator = estimator
        warnings = [str(warning.at("")) for warning in setup.scene.warnings()]
        self._complain(one_line("; ".join(warnings), MAX_REASON))
        self._rig.show(drawn)
        self._order()
        self._sum_up()
        if refresh:
            self._refresh()

    def _sum_up(self) -> None:
        """Describe all poses, and the light on the eye once nothing has changed for a moment."""
        if self._summing is not None:
            self._summing.cancel()
        self._summing = self._loop.call_later(SETTLED_S / 2, self._show_sums)

    def _show_sums(self) -> None:
        setup = self._setup
        with suppress(EyerenderError, ValueError, ArithmeticError, np.linalg.LinAlgError):
            self._poses.set_text(poses_line(setup))
            self._exposed.set_text(exposure_line(setup))

    def _remember(self, setup: Setup) -> None:
        """Store the current setup for `_undo`, unless it lasted less than `SETTLED_S` or does not change."""
        now = time.monotonic()
        if setup is not self._setup and now - self._changed > SETTLED_S:
            self._before.append(self._setup)
        self._changed = now
        self._undo_button.set_enabled(bool(self._before))

    def _undo(self) -> None:
        """Restore the setup before the last change; dragging a slider counts as one change."""
        if self._before:
            last = self._before.pop()
            self._changed = time.monotonic()  # so that undoing is not remembered itself
            self._apply(lambda _: last, refresh=True)

    def _change(self, path: str, value: float) -> None:
        """Change a key of the scene."""
        self._apply(lambda setup: setup.changed({path: value}))

    def _show(self, **fields: Any) -> None:
        """Show another eye, or another camera's image."""
        self._apply(lambda setup: setup.showing(**fields), refresh=True)

    def _follow(self, fixation: int) -> None:
        if fixation >= 0:
            self._apply(lambda setup: setup.following(fixation), refresh=True)

    def _turn(self) -> None:
        self._apply(lambda setup: setup.looking(self._azimuth.value, self._elevation.value))
        with self._silence():
            self._fixation.set_value(-1)

    def _move_head(self) -> None:
        x, y, z = (knob.value for knob in self._shift)
        self._apply(lambda setup: setup.with_shift((x, y, z)))

    def _choose_model(self, name: str) -> None:
        if name != self._setup.scene.spec.eye.model:
            self._apply(lambda setup: setup.changed({"eye.model": name}), refresh=True)

    def _lengthen(self, focal_length: float) -> None:
        self._apply(lambda setup: setup.with_focal_length(self._lens, focal_length))
        self._refresh_field()

    def _widen(self, field_deg: float) -> None:
        self._apply(lambda setup: setup.with_field(self._lens, field_deg))
        self._refresh_focal()

    def _resize(self, width_px: float) -> None:
        self._apply(lambda setup: setup.with_width(round(width_px)))
        self._refresh_focal()

    def _light_changed(self, **fields: Any) -> None:
        self._apply(lambda setup: setup.with_light(self._light, **fields))
        self._note_ring()

    def _widen_lobe(self, half_width: float) -> None:
        self._apply(lambda setup: setup.with_light(self._light, lobe_exponent=lobe_exponent(half_width)))
        self._note_ring()

    def _note_ring(self) -> None:
        """Say whether the chosen LED belongs to a ring, which a change of it ends."""
        self._ring.set_text(ring_note(self._setup.scene.spec.rig, self._light))

    def _choose_light(self, light: int) -> None:
        self._light = light
        self._refresh()

    def _choose_camera(self, camera: int) -> None:
        self._lens = camera
        self._refresh()

    def _add_light(self) -> None:
        """Copy the chosen LED and choose the copy."""
        count = len(self._setup.scene.rig.lights)
        self._apply(lambda setup: setup.with_light_added(self._light))
        if len(self._setup.scene.rig.lights) > count:
            self._choose_light(count)

    def _add_camera(self) -> None:
        """Copy the chosen camera and choose the copy."""
        count = len(self._setup.scene.rig.cameras)
        self._apply(lambda setup: setup.with_camera_added(self._lens))
        if len(self._setup.scene.rig.cameras) > count:
            self._choose_camera(count)

    def _move_light(self) -> None:
        place, power = [knob.value for knob in self._lamp_place], self._power.value
        self._light_changed(position_mm=place, intensity_mw_sr=power)

    def _move_camera(self) -> None:
        place = [knob.value for knob in self._camera_place]
        self._apply(lambda setup: setup.with_camera_at(self._lens, place))
        self._refresh_light()  # rings move with their camera

    def _look_at_rig(self) -> None:
        self._rig.look_at_rig(self._drawn, apex_mm(self._frames, self._row), self._setup.scene.rig)

    def _look_from_camera(self) -> None:
        camera = self._setup.scene.rig.cameras[self._setup.camera]
        place, apex = camera.nodal_point_mm, apex_mm(self._frames, self._row)
        self._rig.look_from(place, place + camera.axis * float((apex - place) @ camera.axis))

    def _save(self, text: Callable[[SceneSpec], str], suffix: str, kind: str) -> None:
        try:
            name = "".join(c if c.isalnum() or c in "-_" else "_" for c in self._setup.origin.name)
            ui.download.content(text(self._setup.saved()).encode(), f"{name}.{suffix}", kind)
        except EyerenderError as error:
            self._complain(f"Not saved: {line_of(error)}")

    # What the tab shows

    def _refresh(self) -> None:
        """Update the knobs with the values of the setup."""
        setup, scene = self._setup, self._setup.scene
        self._light = min(self._light, len(scene.rig.lights) - 1)
        self._lens = min(self._lens, len(scene.rig.cameras) - 1)
        with self._silence():
            cameras = dict(enumerate(named(scene.spec.rig.cameras)))
            for box, choices in (
                (self._lamp, _numbers(len(scene.rig.lights))),
                (self._camera, cameras),
                (self._chosen, cameras),
            ):
                _offer(box, choices)
            self._choices.set_visibility(any(box.visible for box in (self._eye, self._camera, self._head)))
            self._eye.set_value(setup.eye)
            self._camera.set_value(setup.camera)
            self._head.set_value(setup.head)
            self._fixation.set_value(-1 if setup.fixation is None else setup.fixation)
            self._lamp.set_value(self._light)
            self._chosen.set_value(self._lens)
        gaze = directions(setup)
        self._azimuth.set(gaze.azimuth_deg, -40, 40)
        self._elevation.set(gaze.elevation_deg, -30, 30)
        self._pupil.set(scene.pupil_diameter_mm, 1.5, 8)
        region = None if scene.spec.region is None else scene.spec.region.of_side(setup.eye)
        for name, knob in self._lids.items():
            share = 0.0 if region is None else region.moved(name)
            knob.enable(region is not None and region.head is None)
            knob.set(100 * (1 - share if name == "blink" else share), 0, 100)
        self._refresh_light()
        apex = apex_mm(self._frames, self._row)
        _set_place(self._camera_place, scene.rig.cameras[self._lens].nodal_point_mm, apex)
        self._aim.set_enabled(scene.spec.rig.cameras[self._lens].calibration is None)
        self._refresh_focal()
        self._refresh_field()
        size = scene.spec.image.window_px or scene.spec.rig.cameras[0].resolution_px
        self._width.set(size[0], 40, 2 * size[0])
        for knob, value in ((self._exposure, scene.spec.sensor.time_ms), (self._aperture, scene.spec.sensor.f_number)):
            knob.set(value, value / 3, 3 * value)
        for knob, shift in zip(self._shift, setup.shift_mm, strict=True):
            knob.set(shift, -10, 10)
        if isinstance(scene.spec.eye.model, str):
            with self._silence():
                self._model.set_value(scene.spec.eye.model)

    def _refresh_focal(self) -> None:
        _, focal = self._setup.focal_length(self._lens)
        self._focal.enable(focal is not None)
        if focal is not None:
            self._focal.set(focal, focal / 3, 3 * focal)

    def _refresh_field(self) -> None:
        field_deg = self._setup.field_deg(self._lens)
        self._field.enable(field_deg is not None)
        if field_deg is not None:
            self._field.set(field_deg, 1, 120)

    def _refresh_light(self) -> None:
        lamp = self._setup.scene.rig.lights[self._light]
        _set_place(self._lamp_place, lamp.position_mm, apex_mm(self._frames, self._row))
        self._power.set(lamp.intensity_mw_sr, 0, _round_up(3 * lamp.intensity_mw_sr))
        self._size.set(lamp.radius_mm, 0, max(3.0, 2 * lamp.radius_mm))
        self._lobe.set(half_width_deg(lamp.lobe_exponent), 2, 90)
        self._note_ring()

    @contextmanager
    def _silence(self) -> Iterator[None]:
        self._quiet = True
        yield
        self._quiet = False

    def _order(self) -> None:
        self._orders += 1
        self._frame.classes(add="busy")
        frame = self._frames.take([self._row])
        self._studio.painter.ask(self.key, Order(self._orders, frame, extract=bool(self._found.value)))

    def _receive(self, shown: Shown) -> None:
        """Display an image from the painter."""
        if not self._awake:
            return
        self._wait.set_visibility(False)
        if shown.number == self._orders:
            self._frame.classes(remove="busy")
        if shown.problem:
            self._complain(shown.problem)
            return
        self.shown = shown
        self._image.set_source(f"/picture/{self.key}?{shown.number}.{shown.samples}.{shown.coarse}")
        self._draw_features()
        width, height = shown.size_px
        coarse = f", pixels {shown.coarse} x {shown.coarse}" if shown.coarse > 1 else ""
        more = "" if shown.samples >= GOAL_SPP else f" of {GOAL_SPP}"
        full = " · saturated" if shown.saturated else ""
        self._status.set_text(
            f"{width} x {height} px · {shown.samples}{more} samples per pixel{coarse} · "
            f"rendered in {1000 * shown.seconds:.0f} ms{full}"
        )

    def _draw_features(self) -> None:
        shown = self.shown
        if shown is None:
            return
        current = shown.number == self._orders
        shift = np.array([shown.window[0] - 0.5, shown.window[1] - 0.5])
        scale = max(shown.size_px) / 200
        truth = self._truth.take([self._row])
        marks = ""
        if self._analytic.value and current:
            marks += feature_marks(truth, 0, shift, analytic=True, scale=scale)
        if self._found.value and shown.found is not None:
            marks += feature_marks(shown.found, 0, shift, analytic=False, scale=scale)
        self._image.set_content(marks)
        waits = self._found.value and shown.found is None  # features arrive shortly after the image
        if current and not waits:
            found = shown.found if self._found.value else None
            self._table.set_content(feature_table(truth, found, shown.hidden, shown.coarse))
            self._gaze.set_text(gaze_line(self._setup, self._estimator, truth, found))

    def _complain(self, text: str) -> None:
        self._problem.set_text(text)
        self._problem.set_visibility(bool(text))


AXES = ("x, to the screen", "y, to the subject's left", "z, up")


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10 ** np.floor(np.log10(value))
    return float(power * next(k for k in (1, 2, 5, 10) if k * power >= value * 0.999))


def _set_place(knobs: list[Knob], place_mm: Any, apex: Any) -> None:
    """Show a position on three knobs, which reach up to a third of its distance to the eye."""
    reach = _round_up(max(10.0, float(np.linalg.norm(place_mm - apex)) / 3))
    for knob, value in zip(knobs, place_mm, strict=True):
        knob.set(float(value), float(np.floor(value - reach)), float(np.ceil(value + reach)))


def _unplaced(error: EyerenderError) -> EyerenderError:
    """Remove the scene file's name from an error, because the value came from a knob."""
    return InputError(error.reason, path=error.path) if isinstance(error, InputError) else error


def _numbers(count: int) -> dict[Any, str]:
    return {k: str(k) for k in range(count)}


def _offer(box: ui.select, choices: dict[Any, str]) -> None:
    """Offer choices; a box with a single choice is hidden."""
    if box.options != choices:
        box.set_options(choices)
        box.set_visibility(len(choices) > 1)


def _button(text: str, act: Callable[[], None]) -> ui.button:
    return ui.button(text, on_click=lambda: act()).props("dense flat no-caps").classes("action")


def _choice(name: str, choices: dict[Any, str], act: Callable[[Any], None]) -> ui.select:
    first = next(iter(choices))
    box = ui.select(choices, value=first, label=name, on_change=lambda e: act(e.value)).props("dense options-dense")
    box.set_visibility(len(choices) > 1)
    return box


@contextmanager
def _group(name: str) -> Iterator[ui.element]:
    with ui.element("div").classes("group") as group:
        ui.label(name).classes("heading")
        yield group
