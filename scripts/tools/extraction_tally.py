"""Results of a row of images: errors of every image against its label, bounds, distances, times; and the limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np

from eyerender.base.arrays import Bools, Floats
from eyerender.extraction import Extraction
from eyerender.optics.ellipse import Ellipse, iou
from make_ideal_images import Drawing

MATCH_PX = 2.0  # a glint within this of a true one is that one

# condition -> centre error allowed: median, 95th percentile, px
CENTRE = {
    "clean": (0.005, 0.01),
    "noise2": (0.015, 0.03),
    "noise2-17px": (0.018, 0.04),
    "noise2-13px": (0.021, 0.045),
    "noise8": (0.05, 0.10),
    "noise16": (0.09, 0.20),
    "blur4": (0.04, 0.08),
    "texture6": (0.04, 0.08),
    "shading": (0.02, 0.045),
    "edge-glint": (0.02, 0.04),
    "lid": (0.15, 0.5),
}


@dataclass(slots=True)
class Tally:
    """What one row of images gave."""

    centre: list[float] = field(default_factory=list)
    offset: list[Floats] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    axes: list[Floats] = field(default_factory=list)
    iou: list[float] = field(default_factory=list)
    distance: dict[int, list[float]] = field(default_factory=lambda: {2: [], 5: []})
    glint: list[tuple[int, float]] = field(default_factory=list)
    glint_distance: list[float] = field(default_factory=list)
    glints_true: int = 0
    glints_found: int = 0
    confidence: list[float] = field(default_factory=list)
    missing: int = 0
    cpu_s: list[float] = field(default_factory=list)

    @property
    def images(self) -> int:
        return self.missing + len(self.iou)

    @property
    def right(self) -> int:
        return sum(value > 0.9 for value in self.iou)


def compare(tally: Tally, found: Extraction, drawing: Drawing) -> None:
    """Add one image's result."""
    label, parameters = drawing.label["pupil"], drawing.parameters
    truth = Ellipse(label["centre_px"], label["semi_axes_px"], label["angle_rad"])
    ellipse = found.pupil.ellipse
    if ellipse is None:
        tally.missing += 1
        tally.confidence.append(0.0)
        return
    tally.confidence.append(found.pupil.confidence)
    tally.iou.append(iou(ellipse, truth))
    offset = ellipse.centre_px - truth.centre_px
    tally.offset.append(offset)
    tally.centre.append(float(np.hypot(*offset)))
    tally.axes.append(ellipse.semi_axes_px - truth.semi_axes_px)
    noise = math.hypot(parameters["noise_dn"], 1.0 / math.sqrt(12.0) if parameters["bit_depth"] == 8 else 0.0)
    blur = math.sqrt(parameters["blur_px"] ** 2 + 1.0 / 12.0)
    radius = math.sqrt(float(truth.semi_axes_px.prod()))
    tally.bound.append(noise / abs(parameters["step_dn"]) * math.sqrt(2.0 * blur / (math.sqrt(math.pi) * radius)))
    if found.pupil.covariance is not None:
        full = found.pupil.covariance
        tally.distance[2].append(float(offset @ np.linalg.solve(full[:2, :2], offset)))
        error, covariance = _shape_error(ellipse, truth, full)
        tally.distance[5].append(float(error @ np.linalg.solve(covariance, error)))
    true_glints = [g["xy_px"] for g in drawing.label["glints"] if g["status"] == "ok"]
    tally.glints_true += len(true_glints)
    tally.glints_found += len(found.glints)
    for index, xy in enumerate(true_glints):
        near = [g for g in found.glints if g.xy_px is not None and np.hypot(*(g.xy_px - xy)) < MATCH_PX]
        if near and near[0].xy_px is not None and near[0].covariance is not None:
            error = near[0].xy_px - xy
            tally.glint.append((index, float(np.hypot(*error))))
            tally.glint_distance.append(float(error @ np.linalg.solve(near[0].covariance, error)))


def near(places: Floats, others: Floats) -> Bools:
    """Which of the places (n, 2) have one of the others (m, 2) near."""
    apart = np.linalg.norm(places[:, None] - others.reshape(1, -1, 2), axis=-1)
    return np.asarray(apart.min(axis=1, initial=np.inf) < MATCH_PX)


def _shape_error(ellipse: Ellipse, truth: Ellipse, covariance: Floats) -> tuple[Floats, Floats]:
    """Error and covariance of (cx, cy, shape matrix aa, bb, ab in the found axes), well defined for circles too."""
    turn = truth.angle_rad - ellipse.angle_rad
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    shape = rotation @ np.diag(truth.semi_axes_px) @ rotation.T
    a, b = ellipse.semi_axes_px
    error = np.array([*(ellipse.centre_px - truth.centre_px), a - shape[0, 0], b - shape[1, 1], -shape[0, 1]])
    scale = np.diag([1.0, 1.0, 1.0, 1.0, max(float(a - b), 1e-9)])
    return error, scale @ covariance @ scale


def merge(into: Tally, other: Tally) -> None:
    """Add the images of another row."""
    for one in fields(Tally):
        mine, theirs = getattr(into, one.name), getattr(other, one.name)
        if isinstance(mine, list):
            mine.extend(theirs)
        elif isinstance(mine, dict):
            for key, values in theirs.items():
                mine[key].extend(values)
        else:
            setattr(into, one.name, mine + theirs)
