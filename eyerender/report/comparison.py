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
from .page import Card, Content, Figure, Gallery, Key, Listing, Page, Section, Table, number, write_page
from .style import ANALYTIC, ANALYTIC_ON_DARK, IMAGE, IMAGE_ON_DARK, TARGET, error_panel, figure, svg


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
    title = f"{scene.name}: two observers compared"
    sections = [
        _images(scene, comparison, entries),
        Section(
            "Feature errors",
            "The figure shows image-derived minus analytic features. The apparent pupil is not exactly an ellipse, "
            "and the image has noise, so the centres of the two fits differ slightly.",
            Figure(feature_figure(comparison), "The cross is the mean."),
        ),
        Section("Gaze errors", *_gaze(scene, comparison)),
        Section("Every image", Table(_HEADER, _rows(comparison))),
        Section(
            "How this was made",
            ", ".join(f"{t.step} {t.seconds:.1f} s" for t in timings) + "." if timings else None,
            ", ".join(f"{name} {version}" for name, version in versions().items()) + ".",
            Listing("The scene, with every default filled in", scene.spec.to_yaml()),
        ),
    ]
    lead = [
        scene.spec.description,
        "The analytic observer computes the apparent pupil and the glints by ray optics through the cornea of eye "
        f"model {scene.eye_name}. The image observer recovers them from the pixels of the rendered "
        f"{scene.spec.wavelength_nm:g} nm images. The same gaze estimator uses both.",
    ]
    write_page(path, Page(title, lead, _cards(comparison, len(entries)), sections))


def _cards(comparison: Comparison, images: int) -> list[Card]:
    data = comparison.to_mapping()
    features, gaze = data["features"], data["gaze"]
    pupils, glints, centre, glint = (features[key] for key in ("pupils", "glints", "pupil_centre_px", "glint_px"))
    cards = [
        Card(f"{pupils['found']} of {pupils['expected']}", f"pupils found in {images} images"),
        Card(_median(centre), f"pupil centre error, median{_most(centre)}"),
        Card(_median(glint), f"glint error, median{_most(glint)}; {glints['found']} of {glints['expected']} found"),
    ]
    for key in ("analytic", "image") if gaze else ():
        mean = (gaze[key] or {}).get("mean_deg")
        cards.append(Card("-" if mean is None else f"{mean:.3f}°", f"gaze error from {key} features, mean"))
    return cards


def _median(errors: dict[str, Any]) -> str:
    return f"{errors['median']:.3f} px" if errors["n"] else "-"


def _most(errors: dict[str, Any]) -> str:
    return f" (max {errors['max']:.3f})" if errors["n"] else ""


def _images(scene: Scene, comparison: Comparison, entries: Sequence[ImageEntry]) -> Section:
    """Show the images of each eye; those of a grid of targets, which is listed by columns, are placed like it."""
    grid = scene.spec.targets.grid if scene.spec.targets else None
    text = (
        "The pictures are enlarged around the eye. The numbers are measured in the "
        f"{scene.spec.sensor.bit_depth}-bit images."
    )
    if grid:
        text += " Each picture is placed like its target on the screen, as the subject sees it."
    key = (
        (ANALYTIC_ON_DARK, "analytic: pupil ellipse, its centre and the glints (upright crosses)"),
        (IMAGE_ON_DARK, "recovered from the image (dashed, diagonal crosses; small and faint: a reflection that does "
         "not belong to a light)"),
    )  # fmt: skip
    galleries = [
        Gallery(pictures, f"{side} eye", 20.0, grid[1] if grid else None)
        for side, pictures in _pictures(scene, comparison, entries).items()
    ]
    return Section("The images", text, Key(key, ("analytic", "found")), *galleries)


def _gaze(scene: Scene, comparison: Comparison) -> list[Content]:
    data, drawn = comparison.to_mapping(), gaze_figure(scene, comparison)
    if drawn is None or not data["gaze"]:
        return [f"None: {data['gaze_reason'] or 'the scene has no screen'}."]
    return [
        f"Estimator: {data['gaze']['estimator']}. Each target is estimated with a calibration on all other targets "
        "(leave one target out). The estimate is the mean of both eyes, and the error is the angle at the mid-point of "
        "the eyes.",
        Figure(drawn, ""),
    ]


def feature_figure(comparison: Comparison) -> str:
    """Draw error vectors of pupil centre and glint, image-derived minus analytic, as SVG."""
    errors = comparison.features
    with figure(8.4, 3.6, 2) as (fig, axes):
        error_panel(axes[0], errors.centre_px, "pupil centre", IMAGE)
        error_panel(axes[1], errors.glint_px.reshape(-1, 2), "glint", IMAGE)
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


def _pictures(
    scene: Scene, comparison: Comparison, entries: Sequence[ImageEntry]
) -> dict[str, list[tuple[str, list[str]]]]:
    out: dict[str, list[tuple[str, list[str]]]] = {}
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
        out.setdefault(side, []).append((picture, [name, _error(comparison, row)]))
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


_HEADER = (
    "frame", "eye", "target (mm)", "pupil centre (px)", "semi-axis (px)", "glint (px)", "gaze, analytic (deg)",
    "gaze, image (deg)",
)  # fmt: skip


def _rows(comparison: Comparison) -> list[tuple[str, ...]]:
    errors, index = comparison.features, comparison.truth.index
    gaze = []
    for g in (comparison.gaze_truth, comparison.gaze_found):
        gaze.append({} if g is None else dict(zip(g.frame.astype(int).tolist(), g.error_deg.tolist(), strict=True)))
    rows = []
    for i in range(len(index)):
        frame = int(index.frame[i])
        glint = np.linalg.norm(errors.glint_px[i], axis=-1)
        sizes = (
            float(np.linalg.norm(errors.centre_px[i])),
            float(np.abs(errors.semi_axes_px[i]).max()),
            float(np.max(glint, initial=-np.inf, where=np.isfinite(glint))),
            *(known.get(frame) for known in gaze),
        )
        rows.append((str(frame), EYES[int(index.eye[i])], _triple(index.target_mm[i]), *map(number, sizes)))
    return rows


def _triple(values: Any) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")" if np.isfinite(values).all() else "-"
