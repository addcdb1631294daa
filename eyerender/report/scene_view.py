"""Draw a scene's rig in three dimensions, with the traced rays of one fixation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..analytic.observer import trace
from ..base.arrays import Floats
from ..optics.triangles import sharp_edges
from ..rig.camera import PinholeCamera
from ..scene import Scene
from ..scene.observation import EYES, Observations
from .style import ANALYTIC, CAMERA, IMAGE, TARGET, figure

MAX_NOTES = 4
"""Largest number of reasons for missing rays that a figure lists."""
_LIGHT, _SIGHT, _SCREEN, _OBSTACLE, _LENS = "#E69F00", "#CC79A7", "#777777", "#555555", "#56B4E9"


def scene_view(scene: Scene) -> Any:
    """Draw a scene as a matplotlib figure: eyes, screen with targets, cameras, lights, obstacles.

    For the first fixation of the first head position it adds the lines of sight, the rays of glint and pupil centre to
    each camera (without their bends in spectacles), and the outlines of the spectacles' lenses.
    """
    with figure(9.5, 7.5, 1) as (fig, flat):
        flat.remove()
        ax = fig.add_subplot(projection="3d")
        seen = trace(scene)
        index = seen.index
        at = index.instant if scene.spec.sequence is not None else index.fixation
        rows = np.flatnonzero((index.head == 0) & (at == at[0]))
        _screen(ax, scene)
        for k in range(len(scene.rig.cameras)):
            _camera(ax, scene, k)
        lights = np.array([light.position_mm for light in scene.rig.lights])
        ax.scatter(*lights.T, color=_LIGHT, s=40, depthshade=False, label="infrared LED")
        for k, body in enumerate(scene.rig.bodies()):
            lines = np.pad(sharp_edges(body), [(0, 0), (0, 1), (0, 0)], constant_values=np.nan).reshape(-1, 3)
            ax.plot(*lines.T, color=_OBSTACLE, lw=0.7, label=None if k else "obstacle")
        for n, row in enumerate(rows):
            _eye(ax, scene, seen, int(row), first=n == 0)
        _equal(ax)
        ax.set(xlabel="x, to the screen (mm)", ylabel="y, to the subject's left (mm)", zlabel="z, up (mm)")
        ax.view_init(elev=22, azim=-128)
        fig.legend(loc="outside lower center", ncols=4, frameon=False)
        fig.suptitle("\n".join([scene.name, *_notes(scene, seen.take(rows))]), fontsize=10)
        return fig


def _notes(scene: Scene, seen: Observations) -> list[str]:
    """Describe which pose is shown, and why some rays are missing."""
    index, pose = seen.index, seen.pose
    fixations = int(scene.index().fixation.max()) + 1
    heads = len(scene.spec.subject.head_positions_mm)
    if scene.spec.sequence is not None:
        what = f"the sequence after {index.time_s[0]:.3g} s"
    elif np.isfinite(index.target_mm[0]).all():
        what = f"target 1 of {fixations} at ({', '.join(f'{v:g}' for v in index.target_mm[0])}) mm"
    else:
        azimuth, elevation = np.degrees([pose.azimuth_rad[0], pose.elevation_rad[0]])
        what = f"pose 1 of {fixations}: azimuth {azimuth:g}\N{DEGREE SIGN}, elevation {elevation:g}\N{DEGREE SIGN}"
    missing: dict[str, list[str]] = {}
    for k in range(len(seen)):
        eye = f"{EYES[index.eye[k]]} eye, camera {index.camera[k]}"
        if not seen.pupil.ok[k]:
            missing.setdefault(f"no pupil's ray: {seen.pupil.reason[k]}", []).append(eye)
        for j in np.flatnonzero(~seen.glints.ok[k]):
            name = f"{eye}, light {seen.glints.light[k, j]}"
            missing.setdefault(f"no glint: {seen.glints.reason[k, j]}", []).append(name)
    lines = [
        f"{reason} ({names[0]}{f' and {len(names) - 1} more' if names[1:] else ''})"
        for reason, names in missing.items()
    ]
    rest = [f"and {len(lines) - MAX_NOTES} more reasons"] if len(lines) > MAX_NOTES else []
    return [f"{what}, head position 1 of {heads}", *lines[:MAX_NOTES], *rest]


def _screen(ax: Any, scene: Scene) -> None:
    screen = scene.rig.screen
    targets = scene.targets_mm
    if screen is not None:
        w, h = screen.size_mm
        corners = screen.world(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * [w / 2, h / 2])
        ax.plot(*corners.T, color=_SCREEN, lw=1.6, label="screen")
    if targets is not None:
        ax.scatter(*targets.T, color=TARGET, s=9, marker="+", depthshade=False, label="target")


def _camera(ax: Any, scene: Scene, number: int) -> None:
    """Draw the pyramid of a camera's field, up to an eighth of its distance to the eyes."""
    camera = scene.rig.cameras[number]
    origin = camera.nodal_point_mm
    ends = camera.corners((0, 0, *camera.resolution_px), float(np.linalg.norm(origin)) / 8)
    ax.plot(*ends.T, color=CAMERA, lw=1.0)
    for end in ends[:4]:
        ax.plot(*np.stack([origin, end]).T, color=CAMERA, lw=1.0)
    ax.scatter(*origin, color=CAMERA, s=36, depthshade=False, label="camera" if number == 0 else None)


def _eye(ax: Any, scene: Scene, seen: Observations, row: int, *, first: bool) -> None:
    """Draw globe, line of sight, and the rays from the cornea to the camera.

    The rays are exactly those of the image points.
    """
    index = seen.index
    side = EYES[index.eye[row]]
    eye = scene.eye(side)
    apex = index.eye_position_mm[row] + index.head_mm[row]
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    for k, lens in enumerate(scene.eye(side, tuple(index.head_mm[row])).worn):
        ring = np.stack([0.0 * turn, lens.half_mm[0] * np.cos(turn), lens.half_mm[1] * np.sin(turn)], axis=1)
        outline = apex + lens.centre_mm + ring @ lens.rotation.T
        ax.plot(*outline.T, color=_LENS, lw=1.0, label="spectacles" if first and k == 0 else None)
    centre = apex + eye.sclera.centre_mm
    u, v = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]
    globe = centre[:, None, None] + eye.sclera.radius_mm * np.stack(
        [np.cos(v), np.sin(v) * np.cos(u), np.sin(v) * np.sin(u)]
    )
    ax.plot_wireframe(*globe, color="#bbbbbb", lw=0.35)
    target = index.target_mm[row]
    if np.isfinite(target).all():
        ax.plot(*np.stack([apex, target]).T, color=_SIGHT, lw=1.4, label="line of sight" if first else None)
    camera = scene.rig.cameras[int(index.camera[row])]
    if seen.pupil.ok[row]:
        _ray(ax, camera, seen.pupil.centre_px[row], apex, "-", ANALYTIC, "pupil's ray" if first else None)
    for j in np.flatnonzero(seen.glints.ok[row]):
        name = "light to glint to camera" if first and j == 0 else None
        hit = _ray(ax, camera, seen.glints.xy_px[row, j], apex, "--", IMAGE, name)
        light = scene.rig.lights[int(seen.glints.light[row, j])].position_mm
        ax.plot(*np.stack([light, hit]).T, color=IMAGE, lw=1.0, ls="--")


def _ray(
    ax: Any, camera: PinholeCamera, pixel: Floats, apex: Floats, style: str, colour: str, name: str | None
) -> Floats:
    """Draw the ray of a camera's pixel up to the depth of the eye's apex; return its end."""
    origin, direction = camera.nodal_point_mm, camera.rays(pixel)
    end = origin + direction * float((apex - origin) @ direction)
    ax.plot(*np.stack([origin, end]).T, color=colour, lw=1.0, ls=style, label=name)
    return np.asarray(end)


def _equal(ax: Any) -> None:
    """Give all three axes the same scale."""
    spans = np.array([ax.get_xlim3d(), ax.get_ylim3d(), ax.get_zlim3d()])
    ax.set_box_aspect(np.maximum(spans[:, 1] - spans[:, 0], 1.0))
