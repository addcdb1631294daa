"""Draw the figures of the page of conventions: python -m docs.tools.figures [FOLDER] (default: docs/images)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Ellipse, Rectangle
from numpy.typing import ArrayLike

import eyerender as er
from eyerender.base.arrays import Floats

INK, EYE, CAMERA, SCREEN = "#333333", "#1f6fb4", "#c2571a", "#4a8a3c"


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], text: str = "", colour: str = INK) -> None:
    """An arrow with its name at the tip."""
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4})
    x, y = np.add(end, 0.1 * np.subtract(end, start))
    ax.text(x, y, text, color=colour, ha="center", va="center")


def frames(path: Path) -> None:
    """The world frame, from above and from the subject's left."""
    scene = er.load_scene("quickstart")
    rig = scene.rig
    camera, light, screen = rig.cameras[0], rig.lights[0].position_mm, rig.screen
    assert screen is not None
    nodal = camera.nodal_point_mm
    fig = Figure(figsize=(9, 3.8), layout="constrained")
    for ax, (across, title, name) in zip(
        fig.subplots(1, 2), ((1, "from above", "+y (left)"), (2, "from the subject's left", "+z (up)")), strict=True
    ):
        if across == 1:
            for y in (-31.5, 31.5):
                ax.add_patch(Circle((-12, y), 12, fc="white", ec=EYE, lw=1.6))
            ax.text(-20, -80, "right eye", color=EYE, ha="right")
            ax.text(-20, 60, "left eye", color=EYE, ha="right")
            half = np.array([-1.0, 1.0]) * screen.size_mm[0] / 2
            corners = np.array([screen.centre_mm + h * screen.right for h in half])
        else:
            ax.add_patch(Circle((-12, 0), 12, fc="white", ec=EYE, lw=1.6))
            ax.text(-20, 30, "eyes", color=EYE, ha="right")
            half = np.array([-1.0, 1.0]) * screen.size_mm[1] / 2
            corners = np.array([screen.centre_mm + h * screen.up for h in half])
        ax.plot(corners[:, 0], corners[:, across], color=SCREEN, lw=3)
        ax.text(corners[:, 0].max() + 25, corners[:, across].max(), "screen", color=SCREEN, va="top")
        ax.plot(nodal[0], nodal[across], "s", color=CAMERA, ms=8)
        tip = nodal + 130 * camera.axis
        arrow(ax, (nodal[0], nodal[across]), (tip[0], tip[across]), colour=CAMERA)
        ax.text(nodal[0], nodal[across] - 35, "camera, z forward", color=CAMERA, ha="center", va="top")
        ax.plot(light[0], light[across], "*", color="#a3297a", ms=10)
        ax.text(light[0] + 22, light[across] + 12, "LED", color="#a3297a")
        arrow(ax, (0, 0), (190, 0), "+x")
        arrow(ax, (0, 0), (0, 190), name)
        ax.plot(0, 0, "o", color=INK, ms=4)
        ax.set(title=title, aspect="equal", xlim=(-210, 960), ylim=(-330, 330))
        ax.axis("off")
    save(fig, path)


def eye_angles(path: Path) -> None:
    """Azimuth and elevation of an eye, with the optic axis."""
    fig = Figure(figsize=(9, 3.4), layout="constrained")
    views = (("right eye from above: azimuth", "+y (left; nasal)", 25), ("from the left: elevation", "+z (up)", 20))
    for ax, (title, name, angle) in zip(fig.subplots(1, 2), views, strict=True):
        turn = np.radians(angle)
        centre = np.array([-13.5, 0.0])
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

        def placed(x: ArrayLike, y: ArrayLike, c: Floats = centre, m: Floats = rotation) -> Floats:
            return np.asarray((m @ (np.array([x, y], dtype=float) - c[:, None])) + c[:, None])

        t = np.linspace(-np.pi, np.pi, 200)
        globe = placed(-12.5 + 11.5 * np.cos(t), 11.5 * np.sin(t))
        a = np.linspace(-0.82, 0.82, 60)
        cornea = placed(-7.8 + 7.8 * np.cos(a), 7.8 * np.sin(a))
        iris = placed([-3.6, -3.6, -3.6, -3.6], [-6.0, -2.0, 2.0, 6.0])
        ax.plot(*globe, color=EYE, lw=1.4)
        ax.plot(*cornea, color=EYE, lw=2.2)
        ax.plot(*iris[:, :2], color=CAMERA, lw=3)
        ax.plot(*iris[:, 2:], color=CAMERA, lw=3)
        axis = placed([-26.0, 22.0], [0.0, 0.0])
        ax.plot(*axis, color=EYE, ls="--", lw=1.2)
        ax.text(*(axis[:, 1] + (0.5, 1.5)), "optic axis", color=EYE, ha="center")
        arrow(ax, (centre[0], 0), (22, 0), "+x")
        arrow(ax, (0, 0), (0, 17), name)
        ax.plot(*centre, "o", color=INK, ms=4)
        ax.text(centre[0], -2.6, "centre of\nrotation", color=INK, ha="center", va="top", fontsize=8)
        ax.plot(0, 0, "o", color=INK, ms=4)
        ax.text(1.2, -1.2, "origin: apex of the\nunrotated eye", color=INK, va="top", fontsize=8)
        ax.add_patch(Arc(tuple(centre), 56, 56, theta1=0, theta2=angle, color=INK, lw=1.2))
        ax.text(centre[0] + 30, 5.2, f"{angle}°", color=INK)
        ax.set(title=title, aspect="equal", xlim=(-30, 30), ylim=(-16, 21))
        ax.axis("off")
    save(fig, path)


def pixels(path: Path) -> None:
    """The camera's axes and the pixel convention."""
    fig = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = fig.subplots(1, 2)
    left.add_patch(Rectangle((-2, -1.4), 4, 2.8, fill=False, ec=CAMERA, lw=1.6))
    left.plot(0, 0, "o", color=INK, ms=4)
    arrow(left, (0, 0), (1.6, 0), "x", CAMERA)
    arrow(left, (0, 0), (0, -1.1), "y", CAMERA)
    left.text(-0.15, 0.2, "z away from the viewer", color=CAMERA, ha="center")
    left.text(2.1, 0, "subject's left", color=INK, rotation=-90, va="center")
    left.text(0, 1.5, "up (+z of the world)", color=INK, ha="center")
    left.set(title="image of a camera at rest", aspect="equal", xlim=(-2.6, 2.8), ylim=(-1.9, 2.0))
    left.axis("off")
    for i in range(9):
        right.plot((i - 0.5, i - 0.5), (-0.5, 5.5), color="#cccccc", lw=0.8)
    for j in range(7):
        right.plot((-0.5, 7.5), (j - 0.5, j - 0.5), color="#cccccc", lw=0.8)
    right.plot(0, 0, ".", color=INK)
    right.text(0.05, -0.62, "(0, 0)", color=INK, ha="center", va="bottom", fontsize=8)
    right.add_patch(Ellipse((3.6, 2.7), 4.4, 2.6, angle=30, fill=False, ec=EYE, lw=1.6))
    turn = np.radians(30)
    arrow(right, (3.6, 2.7), (3.6 + 2.2 * np.cos(turn), 2.7 + 2.2 * np.sin(turn)), "a", EYE)
    arrow(right, (3.6, 2.7), (3.6 - 1.3 * np.sin(turn), 2.7 + 1.3 * np.cos(turn)), "b", EYE)
    right.plot((3.6, 6.6), (2.7, 2.7), color=INK, lw=0.8, ls=":")
    right.add_patch(Arc((3.6, 2.7), 2.2, 2.2, theta1=0, theta2=30, color=INK, lw=1.2))
    right.text(4.95, 3.05, "angle", color=INK, fontsize=8)
    arrow(right, (-0.5, -0.5), (8.3, -0.5), "u")
    arrow(right, (-0.5, -0.5), (-0.5, 6.2), "v")
    right.set(title="pixels: centres at integers", aspect="equal", xlim=(-1.3, 9), ylim=(7, -1.4))
    right.axis("off")
    save(fig, path)


def save(fig: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    FigureCanvasAgg(fig)
    fig.savefig(path, dpi=100, metadata={"Software": None})


def main(folder: Path) -> None:
    """Draw all figures."""
    frames(folder / "frames.png")
    eye_angles(folder / "eye_angles.png")
    pixels(folder / "pixels.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "images"))
