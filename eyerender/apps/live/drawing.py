"""The rig and its rays as coloured line segments for the three-dimensional view, in the reports' colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ...base.arrays import Floats
from ...eye.model import EyeModel
from ...imaging.moments import eye_motion
from ...optics.triangles import sharp_edges
from ...region.limbus import lower
from ...report.style import ANALYTIC, CAMERA, IMAGE, TARGET
from ...rig.camera import PinholeCamera
from ...rig.light import Lamp
from ...rig.rig import RigGeometry
from ...scene import Frames, Scene
from ...scene.observation import EYES, Observations

LIGHT, SIGHT, SCREEN, GLOBE, LIMBUS = "#E69F00", "#CC79A7", "#7A7A7A", "#B9B9B9", "#8A6D4B"
AXIS, OBSTACLE = "#009E73", "#555555"
PUPIL = "#1c1c1c"
LEGEND = (
    ("camera and its window", CAMERA),
    ("pupil's ray", ANALYTIC),
    ("LED", LIGHT),
    ("light to glint to camera", IMAGE),
    ("line of sight", SIGHT),
    ("optic axis", AXIS),
    ("screen and targets", SCREEN),
)
FEW_LIGHTS, MAX_LABELLED_LIGHTS = 4, 24


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a position in the world, (3,) mm."""

    text: str
    place_mm: tuple[float, float, float]
    colour: str


@dataclass(slots=True)
class Strokes:
    """Line segments: ends in mm, colour, and width in screen pixels."""

    ends: list[Floats] = field(default_factory=list)
    colours: list[str] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    def line(self, points_mm: ArrayLike, colour: str, width: float = 1.0) -> None:
        """Add a line through points (n, 3)."""
        points = np.asarray(points_mm, dtype=float)
        self.pairs(np.stack([points[:-1], points[1:]], axis=1), colour, width)

    def pairs(self, ends_mm: ArrayLike, colour: str, width: float = 1.0) -> None:
        """Add segments (n, 2, 3); segments with values that are not finite are skipped."""
        ends = np.asarray(ends_mm, dtype=float).reshape(-1, 2, 3)
        ends = ends[np.isfinite(ends).all(axis=(1, 2))]
        self.ends.append(ends)
        self.colours += [colour] * len(ends)
        self.widths += [width] * len(ends)

    def label(self, text: str, place_mm: ArrayLike, colour: str) -> None:
        """Add a text at a position."""
        x, y, z = np.asarray(place_mm, dtype=float)
        self.labels.append(Label(text, (float(x), float(y), float(z)), colour))

    @property
    def ends_mm(self) -> Floats:
        """All segments, (n, 2, 3)."""
        return np.concatenate(self.ends) if self.ends else np.zeros((0, 2, 3))


def strokes(frames: Frames, truth: Observations, row: int) -> Strokes:
    """Draw the rig of a scene, its eyes in their poses, and the rays of one frame's eye, as line segments.

    `frames`: the frames of one fixation: a row for each camera and eye; `truth`: observations of the analytic observer
    for these frames; `row`: the row whose rays are drawn.
    """
    out, scene = Strokes(), frames.scene
    shown = int(frames.index.camera[row])
    for k, camera in enumerate(scene.rig.cameras):
        _camera(out, camera, k, scene, frames, row, shown=k == shown)
    for k, lamp in enumerate(scene.rig.lights):
        _lamp(out, lamp, k, frames)
    _screen(out, scene, frames)
    for k, body in enumerate(scene.rig.bodies()):
        out.pairs(sharp_edges(body), OBSTACLE, 1.0)
        out.label(f"obstacle {k}", body.vertices[0], OBSTACLE)
    for other in np.flatnonzero(frames.index.camera == shown):
        _eye(out, frames, int(other), shown=int(other) == row)
    _rays(out, frames, truth, row)
    return out


def apex_mm(frames: Frames, row: int) -> Floats:
    """Return the apex of the unrotated eye of a row, (3,) mm in the world."""
    return np.asarray(frames.index.eye_position_mm[row] + frames.index.head_mm[row])


def circle(centre: Floats, first: Floats, second: Floats, count: int = 48) -> Floats:
    """Compute points (count + 1, 3) of a closed ellipse with the given semi-axes."""
    angle = np.linspace(0, 2 * np.pi, count + 1)[:, None]
    return np.asarray(centre + np.cos(angle) * first + np.sin(angle) * second)


def _camera(
    out: Strokes, camera: PinholeCamera, number: int, scene: Scene, frames: Frames, row: int, *, shown: bool
) -> None:
    """Draw the pyramid of a camera's field of view, and for the selected camera the window up to the eye."""
    width, height = camera.resolution_px
    origin = camera.nodal_point_mm
    distance = float(np.linalg.norm(apex_mm(frames, row) - origin))
    field_mm = camera.corners((0, 0, width, height), 0.2 * distance)
    thick = 1.8 if shown else 1.0
    _pyramid(out, origin, field_mm, CAMERA, thick)
    out.line([0.5 * (field_mm[0] + field_mm[1]), origin + (field_mm[0] + field_mm[1] - 2 * origin) * 0.56], CAMERA, 3)
    out.label(f"camera {number}", origin, CAMERA)
    if shown:
        index = frames.index
        window = scene.window(number, 0, int(index.eye[row]))
        depth = float(camera.depth(apex_mm(frames, row)))
        if depth > 0:
            _pyramid(out, origin, camera.corners(window, depth), "#B7A6D6", 1.0)


def _pyramid(out: Strokes, origin: Floats, corners: Floats, colour: str, width: float) -> None:
    out.line(corners, colour, width)
    out.pairs([[origin, corner] for corner in corners[:4]], colour, width)


def _lamp(out: Strokes, lamp: Lamp, number: int, frames: Frames) -> None:
    """Draw a lamp as a disc with its axis, large enough to be visible."""
    distance = float(np.linalg.norm(lamp.position_mm - apex_mm(frames, 0)))
    size = max(lamp.radius_mm, 0.018 * distance)
    first = np.cross(lamp.axis, [0.0, 0.0, 1.0] if abs(lamp.axis[2]) < 0.9 else [0.0, 1.0, 0.0])
    first = size * first / np.linalg.norm(first)
    second = np.cross(lamp.axis, first)
    out.line(circle(lamp.position_mm, first, second, 20), LIGHT, 2.5)
    cross = [[lamp.position_mm - arm, lamp.position_mm + arm] for arm in (first, second)]
    out.pairs([*cross, [lamp.position_mm, lamp.position_mm + 3 * size * lamp.axis]], LIGHT, 1.5)
    if number < MAX_LABELLED_LIGHTS:
        few = len(frames.scene.rig.lights) <= FEW_LIGHTS
        out.label(f"LED {number}" if few else str(number), lamp.position_mm + 1.8 * second, "#8f6200")


def _screen(out: Strokes, scene: Scene, frames: Frames) -> None:
    screen, target = scene.rig.screen, frames.index.target_mm[0]
    if screen is not None:
        w, h = screen.size_mm
        corners = screen.world(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * [w / 2, h / 2])
        out.line(corners, SCREEN, 1.8)
        out.label("screen", corners[3], SCREEN)
    if np.isfinite(target).all():
        distance = float(np.linalg.norm(target - apex_mm(frames, 0)))
        arms = 0.015 * distance * np.array([[0, 1, 0], [0, 0, 1]])
        out.pairs([[target - arm, target + arm] for arm in arms], TARGET, 2.0)
        out.label("target", target, TARGET)


def _eye(out: Strokes, frames: Frames, row: int, *, shown: bool) -> None:
    """Draw globe, limbus, cornea, pupil and axes of an eye in its pose."""
    side = EYES[frames.index.eye[row]]
    eye = frames.scene.eye(side)
    M, t = eye_motion(frames, row)

    def world(points: ArrayLike) -> Floats:
        return np.asarray(np.asarray(points, dtype=float) @ M.T + t)

    wires = _globe(eye)
    for wire in wires:
        out.line(world(wire), GLOBE, 1.0)
    rho = float(eye.limbus_radius_mm)
    limbus = circle(np.zeros(3), np.array([0, rho, 0]), np.array([0, 0, rho]))
    limbus[:, 1], limbus[:, 2] = lower(eye.front[0], limbus[:, 1], limbus[:, 2], frames.scene.spec.look.limbus_aspect)
    out.line(world(_on_cornea(eye, limbus)), LIMBUS, 2.0)
    for turn in np.pi * np.arange(4) / 4:
        reach = np.linspace(-rho, rho, 17)[:, None] * np.array([0.0, np.cos(turn), np.sin(turn)])
        out.line(world(_on_cornea(eye, reach)), "#A9BECB", 1.0)
    margin = eye.stop.boundary(48)
    out.line(world(np.vstack([margin, margin[:1]])), PUPIL, 2.2)
    target = frames.index.target_mm[row]
    length = 30.0
    out.line(world([[-24.0, 0, 0], [length, 0, 0]]), AXIS, 1.4)
    point, way = np.asarray(eye.chief_ray.point_mm), np.asarray(eye.chief_ray.direction)
    start = world([point, point + length * way])
    end = target if np.isfinite(target).all() else start[1]
    out.line([start[0], end], SIGHT, 2.0)
    out.line([world([eye.fovea_mm])[0], start[0]], SIGHT, 1.2)
    if shown:
        out.label(f"{side} eye", world([[eye.sclera.centre_mm[0], 0, eye.sclera.radius_mm + 1]])[0], "#444444")


def _globe(eye: EyeModel) -> list[Floats]:
    """Compute circles of latitude about the optic axis and half circles of longitude, behind the limbus, eye frame."""
    centre, radius = np.asarray(eye.sclera.centre_mm, dtype=float), float(eye.sclera.radius_mm)
    start = np.arcsin(min(1.0, float(eye.limbus_radius_mm) / radius))
    out = []
    for polar in np.radians([60, 90, 120, 150]):
        middle = centre + np.array([radius * np.cos(polar), 0.0, 0.0])
        reach = radius * np.sin(polar)
        out.append(circle(middle, np.array([0, reach, 0]), np.array([0, 0, reach]), 36))
    for turn in np.pi * np.arange(8) / 4:
        polar = np.linspace(start, np.pi, 16)[:, None]
        across = np.array([0.0, np.cos(turn), np.sin(turn)])
        out.append(centre + radius * (np.cos(polar) * [1.0, 0.0, 0.0] + np.sin(polar) * across))
    return out


def _on_cornea(eye: EyeModel, points: Floats) -> Floats:
    """Compute points of the front cornea over local (y, z), eye frame."""
    front = eye.front[0]
    local = np.array(points, dtype=float)
    local[:, 0] = front.sag(local[:, 1], local[:, 2])
    return np.asarray(front.origin_mm + local @ np.asarray(front.rotation).T)


def _rays(out: Strokes, frames: Frames, truth: Observations, row: int) -> None:
    """Draw the rays of the apparent pupil's centre and of each glint, through the cornea."""
    index, scene = frames.index, frames.scene
    camera = scene.rig.cameras[int(index.camera[row])]
    eye = scene.eye(EYES[index.eye[row]])
    M, t = eye_motion(frames, row)
    origin = camera.nodal_point_mm
    if truth.pupil.ok[row]:
        hit = _hit(eye, M, t, origin, camera.rays(truth.pupil.centre_px[row]))
        out.line([origin, hit, M @ np.asarray(eye.stop.centre_mm) + t], ANALYTIC, 1.6)
    for j in np.flatnonzero(truth.glints.ok[row]):
        hit = _hit(eye, M, t, origin, camera.rays(truth.glints.xy_px[row, j]))
        lamp = scene.rig.lights[int(truth.glints.light[row, j])]
        out.line([lamp.position_mm, hit, origin], IMAGE, 1.6)


def _hit(eye: EyeModel, M: Floats, t: Floats, origin: Floats, direction: Floats) -> Floats:
    """Intersect a ray in the world with the front cornea of a posed eye, (3,) mm; NaN if it misses."""
    start, way = (origin - t) @ M, direction @ M
    distance, ok = eye.front[0].intersect(start, way)
    return np.asarray(origin + direction * distance if ok else np.full(3, np.nan))


def extent_mm(drawn: Strokes, eye_mm: Floats, rig: RigGeometry) -> tuple[Floats, float]:
    """Compute centre (3,) and radius of a ball around the drawing, without what is far from the eye.

    Far is three times as far as the farthest camera or LED: a headset is not made small by its distant screen.
    """
    places = [*(camera.nodal_point_mm for camera in rig.cameras), *(lamp.position_mm for lamp in rig.lights)]
    far = 3.0 * float(np.linalg.norm(np.array(places) - eye_mm, axis=1).max())
    points = drawn.ends_mm.reshape(-1, 3)
    points = points[np.linalg.norm(points - eye_mm, axis=1) < far]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.asarray(middle), float(max(20.0, np.linalg.norm(points - middle, axis=1).max()))


def colours_of(names: Sequence[str]) -> Floats:
    """Convert colours "#rrggbb" to numbers (n, 3) from 0 to 1."""
    return np.array([[int(name[k : k + 2], 16) / 255 for k in (1, 3, 5)] for name in names]).reshape(-1, 3)
