"""The report of a comparison of the two observers: images, feature errors, gaze errors, provenance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..folders.imagefolder import ImageEntry, versions
from ..imaging.comparison import Comparison
from ..scene import Scene
from ..scene.observation import EYES
from .overlay import eye_picture
from .page import write_template
from .style import ANALYTIC, IMAGE, TARGET, figure, svg


@dataclass(frozen=True, slots=True)
class Timing:
    """Duration of a step of the job, s."""

    step: str
    seconds: float


def write_report(
    path: Path, scene: Scene, comparison: Comparison, entries: Sequence[ImageEntry], timings: Sequence[Timing] = ()
) -> None:
    """Write one self-contained HTML file.

    >>> er.write_report("report.html", scene, er.apps.compare_folder("out")[0], [])  # doctest: +SKIP
    """
    values = {
        "scene": scene.spec,
        "scene_yaml": scene.spec.to_yaml(),
        "data": comparison.to_mapping(),
        "rows": _rows(comparison),
        "pictures": _pictures(scene, comparison, entries),
        # A grid of targets is listed column by column; other lists are filled row by row.
        "grid": scene.spec.targets.grid if scene.spec.targets and scene.spec.targets.grid else (3, None),
        "feature_figure": feature_figure(comparison),
        "gaze_figure": gaze_figure(scene, comparison),
        "timings": timings,
        "versions": versions(),
    }
    write_template(path, "comparison.html.j2", values)


def feature_figure(comparison: Comparison) -> str:
    """Draw error vectors of pupil centre and glint, image-derived minus analytic, as SVG."""
    errors = comparison.features
    with figure(8.4, 3.6, 2) as (fig, axes):
        panels = ((axes[0], errors.centre_px, "pupil centre"), (axes[1], errors.glint_px.reshape(-1, 2), "glint"))
        for ax, vectors, name in panels:
            good = vectors[np.isfinite(vectors).all(axis=-1)]
            limit = max(0.01, 1.15 * float(np.abs(good).max())) if len(good) else 0.1
            ax.axhline(0, color="#888888", lw=0.8)
            ax.axvline(0, color="#888888", lw=0.8)
            ax.scatter(good[:, 0], good[:, 1], s=22, color=IMAGE, edgecolor="white", linewidth=0.5)
            if len(good):
                ax.scatter(*good.mean(axis=0), marker="+", s=110, color=TARGET, label="mean")
                ax.legend(frameon=False, loc="upper right")
            ax.set(
                xlim=(-limit, limit),
                ylim=(limit, -limit),
                aspect="equal",
                title=f"{name} (n = {len(good)})",
                xlabel="image - analytic, x (px)",
                ylabel="y (px, down)",
            )
        return svg(fig)


def gaze_figure(scene: Scene, comparison: Comparison) -> str | None:
    """Draw targets and both observers' binocular estimates on the screen, as SVG.

    None without a screen or estimates.
    """
    screen = scene.rig.screen
    parts = (
        (comparison.gaze_truth, ANALYTIC, "s", "analytic features"),
        (comparison.gaze_found, IMAGE, "o", "features from the images"),
    )
    shown = [(errors, colour, mark, name) for errors, colour, mark, name in parts if errors is not None]
    if screen is None or not shown:
        return None
    with figure(8.4, 5.0) as (fig, ax):
        ax.scatter(*screen.flat(shown[0][0].target_mm).T, marker="+", s=120, color=TARGET, label="target")
        hollow: dict[str, Any] = {"s": 34, "facecolor": "none", "linewidth": 1.4}
        for errors, colour, marker, name in shown:
            mean = errors.mean_deg
            label = f"{name}, mean {mean:.3f} deg" if mean is not None else f"{name}, no estimate"
            ax.scatter(*screen.flat(errors.point_mm).T, marker=marker, edgecolor=colour, label=label, **hollow)
        w, h = screen.size_mm
        ax.plot(np.array([-1, 1, 1, -1, -1]) * w / 2, np.array([-1, -1, 1, 1, -1]) * h / 2, color="#aaaaaa", lw=1)
        ax.set(aspect="equal", xlabel="on the screen, to the subject's right (mm)", ylabel="up (mm)")
        fig.legend(loc="outside upper center", ncols=3, frameon=False)
        return svg(fig)


def _pictures(scene: Scene, comparison: Comparison, entries: Sequence[ImageEntry]) -> dict[str, list[dict[str, Any]]]:
    out: dict[str, list[dict[str, Any]]] = {}
    # Matte parts are well below full scale, to leave headroom for glints. This level is white enough for viewing.
    full = 0.7 * scene.spec.sensor.full_scale_dn
    truth, found = comparison.truth, comparison.found
    for row, entry in enumerate(entries):
        image = entry.image()
        side = EYES[int(truth.index.eye[row])]
        name = f"{side} eye, fixation {int(truth.index.fixation[row]) + 1}"
        # The iris of an adult is at most 12 mm wide, so three widths of the pupil around it show it as a whole.
        axis = truth.pupil.semi_axes_px[row, 0] if truth.pupil.ok[row] else np.nan
        width = int(np.clip(2 * np.ceil(4.6 * axis), 64, image.shape[1])) if np.isfinite(axis) else image.shape[1]
        crop = (width, min(image.shape[0], width * 3 // 4))
        scale = max(1, round(400 / width))
        picture = eye_picture(image, entry.window[:2], full, truth, found, row, crop_px=crop, scale=scale, title=name)
        out.setdefault(side, []).append({"svg": picture, "name": name, "error": _error(comparison, row)})
    return out


def _error(comparison: Comparison, row: int) -> str:
    errors = comparison.features
    if not errors.pupil_found[row]:
        return f"pupil not found: {comparison.found.pupil.reason[row]}"
    centre = float(np.linalg.norm(errors.centre_px[row]))
    glints = np.linalg.norm(errors.glint_px[row], axis=-1)
    glints = glints[np.isfinite(glints)]
    glint = f", glint {glints.max():.3f} px" if len(glints) else ", no glint found"
    return f"pupil centre {centre:.3f} px{glint}"


def _rows(comparison: Comparison) -> list[dict[str, Any]]:
    errors, index = comparison.features, comparison.truth.index
    gaze = []
    for g in (comparison.gaze_truth, comparison.gaze_found):
        gaze.append({} if g is None else dict(zip(g.frame.astype(int).tolist(), g.error_deg.tolist(), strict=True)))
    rows = []
    for i in range(len(index)):
        frame = int(index.frame[i])
        glint = np.linalg.norm(errors.glint_px[i], axis=-1)
        rows.append(
            {
                "frame": frame,
                "eye": EYES[int(index.eye[i])],
                "target": _triple(index.target_mm[i]),
                "centre": _number(float(np.linalg.norm(errors.centre_px[i]))),
                "axes": _number(float(np.abs(errors.semi_axes_px[i]).max())),
                "glint": _number(float(glint[np.isfinite(glint)].max()) if np.isfinite(glint).any() else np.nan),
                "gaze_analytic": _number(gaze[0].get(frame, np.nan)),
                "gaze_image": _number(gaze[1].get(frame, np.nan)),
            }
        )
    return rows


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else "-"


def _triple(values: Any) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")" if np.isfinite(values).all() else "-"
