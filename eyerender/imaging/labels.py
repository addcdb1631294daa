"""Labels of an image: predictions of ray optics, and measurements in the image.

Labels contain ellipses, glints, points and lines in space, and matrices.

`amodal` ellipses describe outlines without occluders: of the pupil seen through the cornea, and of the iris at the
limbus, where the cornea is half transparent. A `visible` ellipse has the second moments of the visible pixels (of
pupil, or of iris and pupil together): semi-axes 2 sqrt(eigenvalues of covariance + 1/12).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline

from ..analytic.observer import AnalyticObserver
from ..base.arrays import Bools, Bytes, Floats, finite_or_none, remembered
from ..base.errors import InputError
from ..base.status import Status
from ..eye.entrance import entrance_pupil_mm
from ..eye.fixation import fixations
from ..eye.model import EyeModel
from ..optics.ellipse import fit_ellipse_direct
from ..optics.transforms import rotated
from ..region.anatomy import Region
from ..region.limbus import lower
from ..region.mesh import lid_margins
from ..rendering.records.job import globe_of
from ..rendering.scene.pixels import lid_margins_px
from ..rig.camera import PinholeCamera, Window, in_window
from ..rig.rig import RigGeometry
from ..scene.observation import EYES, Index, Observations
from ..scene.parts import IRIS, PUPIL
from ..scene.viewer import past_lenses
from .capture import EyeImage
from .moments import eye_motion, rest_mm
from .renderable import RenderableFrames, RenderableScene

RIM_HIDDEN = "the cornea hides a part of its rim"
_OUTLINE_POINTS = 60
_SAG_STEP_MM = 0.05
_REACH_MM = 20.0  # from the globe's centre: the lids from corner to corner are about 30 mm wide
_ROW_TIMES, _ROW_STEPS = 9, 12  # times of a moving limbus between which it is interpolated, and steps to its own rows
_FAR_MM = 1e9  # a distant observer: the entrance pupil looks larger than from infinity by 3e-9 of its size


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EyeInWindow:
    """An eye in a window, without the image: row `row` of frames (alone `frame`), `camera`, `window`, `rig`, `region`.

    The window is (x0, y0, width, height) in full-sensor pixels. The eye's frame is placed in the world by x_world = M x
    + t; the apex of the unrotated eye is at apex_mm.
    """

    row: int
    camera: int
    window: Window
    eye: EyeModel
    M: Floats
    t: Floats
    apex_mm: Floats
    rig: RigGeometry
    region: Region | None
    frame: RenderableFrames

    @classmethod
    def of(cls, frames: RenderableFrames, row: int) -> EyeInWindow:
        """Create it for row `row` of frames."""
        index, scene = frames.index, frames.scene
        camera, head, side = int(index.camera[row]), int(index.head[row]), int(index.eye[row])
        M, t = eye_motion(frames, row)
        # The file of a head mesh, which has no lids to label, is not read.
        has_lids = scene.spec.region is not None and scene.spec.region.head is None
        return cls(
            row=row,
            camera=camera,
            window=scene.window(camera, head, side),
            eye=scene.eye_at(index, row),
            M=M,
            t=t,
            apex_mm=rest_mm(frames, row),
            rig=scene.rig_at(index, row),
            region=scene.region_at(index, row) if has_lids else None,
            frame=frames.take([row]),
        )


def image_labels(image: EyeImage, truth: Observations) -> dict[str, Any]:
    """Compute all labels of an image, with the same keys for every image.

    Args:
        image: a rendered image, row `image.row` of `truth`.
        truth: observations of the rendered frames by the analytic observer.
    """
    done, part, window = image.rendered, image.parts, image.window
    assert done.labels is not None
    known = known_labels(image.scene, truth, image)
    whole_px = {name: whole_pixels(done.labels.amodal, known, name, window) for name in ("pupil", "iris")}
    points = truth.pupil.points_px[image.row]
    whole = bool(truth.pupil.ok[image.row]) and len(points) > 2
    shifts = glint_shifts_px(image.scene, image, truth)
    return {
        "eye_present": known["eye_present"],
        "pupil": {
            **known["pupil"],
            "visible": moments_ellipse(part == PUPIL, window),
            "visible_fraction": finite_or_none(done.labels.visible_fraction(PUPIL, whole_px["pupil"])),
            "visible_arcs_deg": visible_arcs_deg(part, PUPIL, points, window[:2]) if whole else None,
        },
        "iris": {
            **known["iris"],
            "visible": moments_ellipse((part == PUPIL) | (part == IRIS), window),
            "visible_fraction": finite_or_none(done.labels.visible_fraction(IRIS, whole_px["iris"])),
        },
        "glints": [
            glint | _seen_glint(image, k, reason, shifts[glint["light"]])
            for k, (glint, reason) in enumerate(zip(known["glints"], done.glint_reasons, strict=True))
        ],
        "lid_margins_px": lid_landmarks(image.scene, image)
        if _is_rolling(image.scene, image) and done.lid_margins_px is not None
        else done.lid_margins_px,
        **{key: known[key] for key in ("lid_opening", "space", "globe_radius_mm", "pose", "camera", "lights_mm")},
        "failed_paths": int(done.failed_paths),
    }


def known_labels(scene: RenderableScene, observations: Observations, view: EyeInWindow | EyeImage) -> dict[str, Any]:
    """Compute the labels that follow from pose and parameters, without an image: a part of `image_labels`."""
    camera = view.rig.cameras[view.camera]
    return {
        "eye_present": eye_present(camera, view),
        "pupil": {
            "amodal": _ellipse_of_record(observations, view.row),
            "entrance_diameter_mm": entrance_diameter_mm(view.eye),
            "stop_diameter_mm": stop_diameter_mm(scene, observations.index, view.row),
        },
        "iris": {"amodal": iris_outline(scene, view)},
        "glints": _glints(scene, observations, view),
        "lid_opening": lid_opening(scene, view),
        "space": _space(scene, observations, view, camera),
        "globe_radius_mm": float(view.eye.sclera.radius_mm),
        "pose": {"rotation": view.M.tolist(), "translation_mm": view.t.tolist()},
        "camera": camera.to_mapping("t_mm"),
        "lights_mm": [light.position_mm.tolist() for light in view.rig.lights],
    }


def stop_diameter_mm(scene: RenderableScene, index: Index, row: int) -> float:
    """Return the diameter (mm) of the stop of one row."""
    moved = float(index.stop_mm[row])
    return moved if np.isfinite(moved) else scene.stop_diameter_mm(EYES[int(index.eye[row])])


def eye_present(camera: PinholeCamera, view: EyeInWindow | EyeImage) -> bool:
    """Return whether an eye, open or shut, is within reach of the window: a sphere of `_REACH_MM` about the globe.

    Where a recipe moves the head out of the camera's view, as of a headset that was taken off, it is not.
    """
    centre = rotated(view.M, view.eye.sclera.centre_mm) + view.t
    depth = float((rotated(camera.R, centre) + camera.t)[2])
    if depth <= _REACH_MM:
        return depth > -_REACH_MM
    x, y = camera.project(centre[None])[0][0] - view.window[:2]
    aside = np.maximum([-x, -y], [x - view.window[2] + 1, y - view.window[3] + 1])
    return bool(np.hypot(*np.maximum(aside, 0.0)) <= max(camera.K[0, 0], camera.K[1, 1]) * _REACH_MM / depth)


def lid_opening(scene: RenderableScene, view: EyeInWindow | EyeImage) -> dict[str, float | None] | None:
    """Compute the arc between the lids (`LidMargins.opening_mm`) through the middle of the stop, and its share at rest.

    It is None for a bare eye and for a head mesh. At rest, the person's own lids neither shut nor squint nor are wide,
    and follow the same gaze.
    """
    region, person = view.region, scene.spec.person
    if region is None or region.head is not None:
        return None
    rest = region.with_lids()
    if person is not None:  # a recipe may draw a fissure for each sample, beside the person's own
        rest = rest.model_copy(update={"fissure": person.region().fissure})
    globe = globe_of(view.eye, view.M, view.t - view.apex_mm)
    y = float((rotated(view.M, view.eye.stop.centre_mm) + view.t - view.apex_mm)[1])
    now, before = (lid_margins(spec, globe).opening_mm(globe, y) for spec in (region, rest))
    return {"mm": now, "share": now / before if before > 0 else None}


def moments_ellipse(inside: Bools, window: Window) -> dict[str, Any]:
    """Compute the ellipse with the moments of a mask's pixels, in full-sensor pixels; null if the mask is empty.

    `pixels` is their number, `cut` tells whether they touch the window's edge.
    """
    v, u = np.nonzero(inside)
    out: dict[str, Any] = {"centre_px": None, "semi_axes_px": None, "angle_rad": None, "pixels": len(u), "cut": False}
    if len(u) == 0:
        return out
    h, w = inside.shape
    out["cut"] = bool(u.min() == 0 or v.min() == 0 or u.max() == w - 1 or v.max() == h - 1)
    x, y = float(u.mean()), float(v.mean())
    du, dv = u - x, v - y
    a, b, c = float(np.mean(du * du)) + 1 / 12, float(np.mean(du * dv)), float(np.mean(dv * dv)) + 1 / 12
    half, root = (a + c) / 2, float(np.hypot((a - c) / 2, b))
    angle = 0.5 * float(np.arctan2(2 * b, a - c)) % np.pi
    axes = [2 * float(np.sqrt(half + root)), 2 * float(np.sqrt(max(half - root, 0.0)))]
    return out | {"centre_px": [x + window[0], y + window[1]], "semi_axes_px": axes, "angle_rad": angle}


def whole_pixels(amodal: Bytes, labels: dict[str, Any], name: str, window: Window) -> float:
    """Return the size (px) of the whole pupil, or of the iris without it, also where it leaves the window.

    It is the number of its pixels in the window, or the area of its outline if that is larger and leaves the window.
    """
    outline, pupil = (labels[part]["amodal"] for part in (name, "pupil"))
    count = float(np.count_nonzero(amodal == (IRIS if name == "iris" else PUPIL)))
    if not _leaves(outline, window):
        return count
    within = np.prod(pupil["semi_axes_px"]) if name == "iris" and pupil["centre_px"] is not None else 0.0
    return max(count, float(np.pi * (np.prod(outline["semi_axes_px"]) - within)))


def _leaves(outline: dict[str, Any], window: Window) -> bool:
    """Return whether a part of an ellipse in full-sensor pixels lies outside a window."""
    if outline["centre_px"] is None:
        return False
    c, s = np.cos(outline["angle_rad"]), np.sin(outline["angle_rad"])
    half = np.hypot(*(np.array([[c, s], [-s, c]]) * np.array(outline["semi_axes_px"])[:, None]))
    corners = np.array(outline["centre_px"]) + np.stack([-half, half])
    return not bool(np.all(in_window(window, corners)))


def visible_arcs_deg(
    part: Bytes, pupil: int, points_px: Floats, origin_px: tuple[int, int], reach_px: float = 1.5
) -> list[list[float]]:
    """Compute the visible arcs [from, to] of the pupil's outline, in degrees about its centre (image x towards y).

    A point of the outline counts as visible if a pixel of the pupil lies within reach. Points outside the window are
    not visible. A whole outline is [[0, 360]].

    Args:
        part: (h, w) part of the eye at each pixel of the window.
        pupil: the value of the pupil in `part`.
        points_px: (k, 2) points of the outline in full-sensor pixels.
        origin_px: first pixel of the window on the full sensor.
        reach_px: largest distance of a pixel of the pupil.
    """
    height, width = part.shape
    x, y = points_px[:, 0] - origin_px[0], points_px[:, 1] - origin_px[1]
    k = int(reach_px)
    ball = np.hypot(*np.mgrid[-k : k + 1, -k : k + 1]) <= reach_px
    near = ndimage.binary_dilation(part == pupil, structure=ball)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = np.zeros(len(x), dtype=bool)
    seen[inside] = near[row[inside], column[inside]]
    centre = points_px.mean(axis=0)
    angle = np.degrees(np.arctan2(points_px[:, 1] - centre[1], points_px[:, 0] - centre[0])) % 360
    order = np.argsort(angle)
    angle, seen = angle[order], seen[order]
    if np.all(seen):
        return [[0.0, 360.0]]
    if not np.any(seen):
        return []
    first = int(np.flatnonzero(~seen)[0])
    angle, seen = np.roll(angle, -first), np.roll(seen, -first)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return [[float(angle[a]), float(angle[b - 1])] for a, b in edges.reshape(-1, 2)]


def iris_outline(scene: RenderableScene, view: EyeInWindow | EyeImage) -> dict[str, Any]:
    """Compute the ellipse of the limbus (`limbus_px`), with a status, and a reason if there is none.

    It includes what the cornea hides of the limbus; `rim_hidden` tells whether it hides anything.
    """
    nothing = {"centre_px": None, "semi_axes_px": None, "angle_rad": None}
    pixels, reason = limbus_px(scene, view, _OUTLINE_POINTS)
    hidden = {"rim_hidden": reason == RIM_HIDDEN}
    if reason not in (None, RIM_HIDDEN):
        return {"status": "missing", "reason": reason, **nothing, **hidden}
    fit = fit_ellipse_direct(pixels)
    if not fit.ok:
        return {"status": "missing", "reason": "no ellipse fits the outline", **nothing, **hidden}
    return {
        "status": "ok",
        "reason": None,
        "centre_px": fit.centre_px.tolist(),
        "semi_axes_px": fit.semi_axes_px.tolist(),
        "angle_rad": float(fit.angle_rad),
        **hidden,
    }


def limbus_px(scene: RenderableScene, view: EyeInWindow | EyeImage, count: int) -> tuple[Floats, str | None]:
    """Project the limbus to points (count, 2) in full-sensor px.

    The limbus is the circle of the front cornea whose radius is the limbus radius minus half the limbus' width, made
    lower by the look's `limbus_aspect`.

    Under a rolling shutter each point is that of its own row's time. Returns the projected curve, with the points that
    the cornea hides, and the reason why it is not visible as a whole (None if it is).
    """
    pixels, reason = _limbus_now(scene, view, count)
    return _at_own_rows(scene, view, pixels, lambda one: _limbus_now(scene, one, count)[0]), reason


def _is_rolling(scene: RenderableScene, view: EyeInWindow | EyeImage) -> bool:
    """Return whether the rows of a view are exposed one after the other."""
    return scene.timings[view.camera].is_rolling and bool(np.isfinite(view.frame.index.start_s[0]))


def _at_own_rows(
    scene: RenderableScene, view: EyeInWindow | EyeImage, pixels: Floats, points: Callable[[EyeInWindow], Floats]
) -> Floats:
    """Move points (n, 2) of an image to where they are at the times of their own rows.

    Args:
        scene: the scene.
        view: the eye; without a rolling shutter, its points stay.
        pixels: its points, in full-sensor px.
        points: computes the points at other times.
    """
    if not _is_rolling(scene, view):
        return pixels
    index, timing = view.frame.index, scene.timings[view.camera]
    start = float(index.start_s[0])
    times = np.linspace(start, start + timing.rows * timing.row_s + timing.exposure_s, _ROW_TIMES)
    moving = view.frame.at([0] * _ROW_TIMES, times)
    way = CubicSpline(times, [points(EyeInWindow.of(moving, k)) for k in range(_ROW_TIMES)])
    lights, each = np.array(scene.rig.lights_of(int(index.eye[0])), dtype=np.int64), np.arange(len(pixels))
    for _ in range(_ROW_STEPS):
        own = timing.seen([start], pixels[None, :, 1], lights).time_s[0]
        own = np.where(np.isfinite(own), own, timing.ambient_s(start, pixels[:, 1]))
        pixels = way(own)[each, each]
    return pixels


def lid_landmarks(scene: RenderableScene, view: EyeInWindow | EyeImage) -> dict[str, list[list[float]]] | None:
    """Compute the landmarks along the lids in px, without an image; None for a bare eye and for a head mesh.

    Under a rolling shutter each is that of its own row's time.
    """

    def marks(one: EyeInWindow | EyeImage) -> Floats | None:
        assert one.region is not None
        margins = lid_margins(one.region, globe_of(one.eye, one.M, one.t - one.apex_mm))
        camera = past_lenses(one.rig.cameras[one.camera], one.eye.worn, one.apex_mm)
        both = lid_margins_px(margins, camera, one.apex_mm)
        return None if both is None else np.concatenate([both["upper"], both["lower"]])

    if view.region is None or view.region.head is not None or (now := marks(view)) is None:
        return None

    def then(one: EyeInWindow) -> Floats:
        found = marks(one)
        return np.full_like(now, np.nan) if found is None else found

    own, half = np.round(_at_own_rows(scene, view, now, then), 4), len(now) // 2
    return {"upper": own[:half].tolist(), "lower": own[half:].tolist()}


def glint_shifts_px(scene: RenderableScene, view: EyeInWindow | EyeImage, truth: Observations) -> Floats:
    """Return how far (lights, 2) each light's glint moves from mid-exposure to the time of its own row."""
    count = len(scene.rig.lights)
    if not _is_rolling(scene, view):
        return np.zeros((count, 2))
    middle = AnalyticObserver().at_instants(view.frame).glints_px[0, :, 0]
    own = np.stack([truth.glints.of_light(k)[0][view.row] for k in range(count)])
    return np.nan_to_num(own - middle)


def _limbus_now(scene: RenderableScene, view: EyeInWindow | EyeImage, count: int) -> tuple[Floats, str | None]:
    """Compute `limbus_px` at the time of a view."""
    surface, camera = view.eye.front[0], view.rig.cameras[view.camera]
    rho = float(view.eye.limbus_radius_mm) - 0.5 * scene.spec.look.limbus_width_mm
    angle = 2 * np.pi * np.arange(count) / count
    y, z = lower(surface, rho * np.cos(angle), rho * np.sin(angle), scene.spec.look.limbus_aspect)
    local = np.stack([np.broadcast_to(surface.sag(y, z), y.shape), y, z], axis=-1)
    points = surface.origin_mm + local @ np.asarray(surface.rotation).T
    eyepoint = rotated(view.M.T, camera.nodal_point_mm - view.t)
    facing = np.sum(surface.normal(points) * (eyepoint - points), axis=-1) > 0
    pixels, front = past_lenses(camera, view.eye.worn, view.apex_mm).project(points @ view.M.T + view.t)
    reason = None
    if not front.all():
        reason = "behind the camera"
    elif not facing.any():
        reason = "the eye turns it away"
    elif not facing.all():
        reason = RIM_HIDDEN
    return np.asarray(pixels), reason


@remembered
def entrance_diameter_mm(eye: EyeModel) -> float | None:
    """Compute the diameter (mm) of the entrance pupil (circle of equal area), seen from afar on the optic axis.

    It is None if a ray from the stop's margin does not leave the eye.
    """
    try:
        return entrance_pupil_mm(eye, distance_mm=_FAR_MM)
    except InputError:
        return None


def cornea_centre(eye: EyeModel) -> Floats:
    """Compute the centre of curvature of the front cornea at its apex, eye frame, (3,) mm: apex - mean R times axis."""
    surface = eye.front[0]
    apex = float(surface.sag(0.0, 0.0))
    drop = 2 * apex - float(surface.sag(_SAG_STEP_MM, 0.0)) - float(surface.sag(0.0, _SAG_STEP_MM))
    return np.asarray(surface.origin_mm + surface.rotation[:, 0] * (apex - _SAG_STEP_MM**2 / drop))


def _ellipse_of_record(observations: Observations, row: int) -> dict[str, Any]:
    pupil = observations.pupil
    ok = bool(pupil.ok[row])
    return {
        # The label needs the whole outline, so it is missing for a partially visible pupil.
        "status": "ok" if ok else "missing",
        "reason": pupil.reason[row] or None,
        "centre_px": pupil.centre_px[row].tolist() if ok else None,
        "semi_axes_px": pupil.semi_axes_px[row].tolist() if ok else None,
        "angle_rad": float(pupil.angle_rad[row]) if ok else None,
    }


def _glints(scene: RenderableScene, observations: Observations, view: EyeInWindow | EyeImage) -> list[dict[str, Any]]:
    """Compute the position of the glint's centre by ray optics for each lamp that lights the eye."""
    glints, row = observations.glints, view.row
    out = []
    for k in scene.rig.lights_of(int(observations.index.eye[row])):
        xy, _ = glints.of_light(k)
        found = bool(np.isfinite(xy[row]).all())
        at = (glints.light[row] == k) & (glints.status[row] != Status.NONE)
        slot = int(at.argmax())
        out.append(
            {
                "light": k,
                "status": Status(glints.status[row, slot]).label,
                "reason": glints.reason[row, slot] or None,
                "xy_px": xy[row].tolist() if found else None,
                "in_window": found and bool(in_window(view.window, xy[row])),
            }
        )
    return out


def _seen_glint(image: EyeImage, k: int, hidden_by: str | None, shift_px: Floats) -> dict[str, Any]:
    """Measure the visible part of the k-th glint, which may exist even if the lamp's centre has no mirror point.

    `shift_px` (2,) leads from mid-exposure, when the visible part is known, to the time of the glint's row.
    """
    table = image.rendered.glints
    spot = table.xy_px[k] + shift_px
    lit = bool(np.isfinite(spot).all())
    visible = lit and bool(table.visible[k]) and bool(in_window(image.window, spot))
    if visible:
        column, row = np.rint(np.clip(spot - image.window[:2], 0, np.array(image.window[2:]) - 1)).astype(int)
        if image.lens_reflections[row, column]:
            visible, hidden_by = False, "occluded by lens reflection"
    elif lit and table.visible[k]:
        hidden_by = "outside the picture"
    return {
        "visible": visible,
        "hidden_by": hidden_by,
        "visible_share": float(table.share[k]),
        "spot_xy_px": spot.tolist() if lit else None,
    }


def _space(
    scene: RenderableScene, observations: Observations, view: EyeInWindow | EyeImage, camera: PinholeCamera
) -> dict[str, Any]:
    """Return points (mm) and lines in the world and the camera's frame, and rotation centres in the head's frame.

    The rotation centres are fixed in the head, at their positions in the unrotated eye. (Azimuth turns the eye last, so
    it carries the eye's elevation axis about the azimuth centre.)
    """
    eye, M, t, row = view.eye, view.M, view.t, view.row
    index = observations.index
    point, direction = _line_of_sight(scene, observations, view)
    points = {
        "globe_centre_mm": eye.sclera.centre_mm,
        "cornea_centre_mm": cornea_centre(eye),
        "cornea_apex_mm": np.zeros(3),
        "pupil_centre_mm": eye.stop.centre_mm,
        "line_of_sight_point_mm": point,
    }
    directions = {"optic_axis": np.array([1.0, 0, 0]), "line_of_sight": direction}
    head = {
        name: index.eye_position_mm[row] + np.asarray(getattr(eye.rotation, name))
        for name in ("azimuth_centre_mm", "elevation_centre_mm")
    }
    world = {k: p + index.head_mm[row] for k, p in head.items()}
    world |= {k: rotated(M, p) + t for k, p in points.items()} | {k: rotated(M, d) for k, d in directions.items()}
    axes, offset = camera.sensor_axes, camera.sensor_offset  # x to the right in the image, also behind a mirror
    seen = {k: rotated(axes, v) + (0.0 if k in directions else offset) for k, v in world.items()}
    target = index.target_mm[row]
    there = bool(np.isfinite(target).all())
    return {
        "head": {k: v.tolist() for k, v in head.items()},
        "world": {k: v.tolist() for k, v in world.items()} | {"target_mm": target.tolist() if there else None},
        "camera": {k: v.tolist() for k, v in seen.items()}
        | {"target_mm": (rotated(axes, target) + offset).tolist() if there else None},
    }


def space_labels(frames: RenderableFrames, observations: Observations) -> list[dict[str, Any]]:
    """Compute points and lines in space and the diameters of the pupils for each observation of frames."""
    scene, out = frames.scene, []
    for row in range(len(observations)):
        view = EyeInWindow.of(frames, row)
        diameters = {
            "entrance_diameter_mm": entrance_diameter_mm(view.eye),
            "stop_diameter_mm": stop_diameter_mm(scene, observations.index, row),
        }
        out.append(_space(scene, observations, view, view.rig.cameras[view.camera]) | diameters)
    return out


def _line_of_sight(
    scene: RenderableScene, observations: Observations, view: EyeInWindow | EyeImage
) -> tuple[Floats, Floats]:
    """Return the line of sight of the unrotated eye: the fixed chief ray, or that of the entrance window."""
    index, row = observations.index, view.row
    if scene.spec.eye.line_of_sight == "entrance_window" and np.isfinite(index.target_mm[row]).all():
        place = index.eye_position_mm[[row]] + index.head_mm[[row]]
        eyes = [scene.eye(side) for side in EYES]
        found = fixations(eyes, index.eye[[row]], index.target_mm[[row]], place, "entrance_window")
        return np.asarray(found.line_of_sight_mm[0]), np.asarray(found.line_of_sight_direction[0])
    return np.asarray(view.eye.chief_ray.point_mm), np.asarray(view.eye.chief_ray.direction)
