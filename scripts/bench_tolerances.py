#!/usr/bin/env python3
"""What deviations of a rig's parts cost: `eyerender rig --tolerances` against least squares solved again on moved rigs.

    bench_tolerances.py [--quick] [--people N] [--json F]

Three rigs, 20 adults each, who look in one direction beside the nine of their calibration, another for each. For each
axis of each tolerance, before and after the calibration, a part of the rig is moved by one standard deviation, the
features are traced again, and one problem of least squares is solved by Gauss-Newton steps on exact traces: the person,
nine frames with targets and one without, with the priors and weights of the report. Its error of the line of sight in
the last frame is compared with that of equation (8) (docs/rig_design.md), which is linear. Rows state, for each
tolerance, the relative difference of the standard deviations of gaze (median over people), as the report states them,
and the median relative difference of single errors.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

import eyerender as er
from eyerender.apps.rigs.options import RigSize
from eyerender.apps.rigs.report import survey_of
from eyerender.base.arrays import Floats, Ints
from eyerender.design import people
from eyerender.design.information import whitened_rows
from eyerender.design.noise import FeatureNoise
from eyerender.design.people import POINTS
from eyerender.design.tolerances import Tolerances, axes_of, unit_errors
from eyerender.design.unknowns import LOCAL, Unknowns
from eyerender.design.varied import (
    FeatureSlopes,
    Views,
    images_of,
    lines_of_sight,
    slopes_of,
    tangents,
    target_misses,
    target_slopes,
)
from eyerender.gaze.likelihood import GLINT_PX, OUTLINE_PX

RIGS = ("eyelink_desktop", "headset", "head_mounted")
BAR = 0.05
STEPS = 5
SIZES = (
    ("camera", "rotation_deg", 0.2),
    ("camera", "position_mm", 0.1),
    ("camera", "focal_length_percent", 0.5),
    ("camera", "principal_point_px", 1.0),
    ("led", "position_mm", 0.1),
)


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Ten frames of one person for each of c cases: views (10 c), true unknowns, targets, free unknowns, weights."""

    views: Views
    theta: Floats
    target_mm: Floats
    free: Any
    noise: FeatureNoise
    precision: Floats
    fixed: dict[int, FeatureSlopes]
    data: dict[int, tuple[Floats, Floats]]

    def residuals(self, theta: Floats) -> tuple[Floats, Floats]:
        """Whitened residuals (10 c, r) and their derivatives (10 c, r, free)."""
        rest, slopes = [], []
        for number, fixed in self.fixed.items():
            views = replace(self.views, camera=np.full(len(theta), number))
            now = slopes_of(views, theta, POINTS)
            gaps = [
                np.nan_to_num(px - seen)
                for px, seen in zip((now.images.outline_px, now.images.glints_px), self.data[number], strict=True)
            ]
            gap = replace(fixed, outline=gaps[0][..., None], glints=gaps[1][..., None])
            moves = replace(fixed, outline=now.outline[..., self.free], glints=now.glints[..., self.free])
            rest.append(whitened_rows(gap, self.noise, views.camera)[..., 0])
            slopes.append(whitened_rows(moves, self.noise, views.camera))
        sigma = np.radians(self.noise.fixation_deg)
        aimed = (np.arange(len(theta)) % 10 < 9)[:, None]  # the last of ten frames has no target
        rest.append(aimed * target_misses(self.views, theta, self.target_mm) / sigma)
        slopes.append(aimed[..., None] * target_slopes(self.views, theta, self.target_mm)[..., self.free] / sigma)
        return np.concatenate(rest, axis=1), np.concatenate(slopes, axis=1)

    def solved(self) -> Floats:
        """Unknowns (10 c, 35) of least squares."""
        theta, cases = np.array(self.theta), len(self.theta) // 10
        local = int((self.free < LOCAL).sum())
        shared = len(self.free) - local
        size = 10 * local + shared
        places = [[*range(k * local, (k + 1) * local), *range(10 * local, size)] for k in range(10)]
        diagonal = np.concatenate([np.tile(self.precision[self.free[:local]], 10), self.precision[self.free[local:]]])
        for _ in range(STEPS):
            rest, slopes = self.residuals(theta)
            change = (theta - self.theta)[:, self.free].reshape(cases, 10, -1)
            moved = np.concatenate([change[:, :, :local].reshape(cases, -1), change[:, 0, local:]], axis=1)
            matrix, right = np.tile(np.diag(diagonal), (cases, 1, 1)), -diagonal * moved
            for k, at in enumerate(places):
                J, r = slopes[k::10], rest[k::10]
                matrix[:, np.array(at)[:, None], at] += np.swapaxes(J, 1, 2) @ J
                right[:, at] -= np.einsum("cra,cr->ca", J, r)
            scale = 1.0 / np.sqrt(np.einsum("caa->ca", matrix))
            scaled = matrix * scale[:, :, None] * scale[:, None, :]
            step = np.linalg.solve(scaled, (right * scale)[..., None])[..., 0] * scale
            for k, at in enumerate(places):
                theta[k::10, self.free] += step[:, at]
        return theta


def tolerances() -> Tolerances:
    """Every camera, and one LED; each once before and once after the calibration."""
    rows = [
        {"part": part, "quantity": quantity, "sd": sd, "when": when, **({"number": 0} if part == "led" else {})}
        for part, quantity, sd in SIZES
        for when in ("before", "after")
    ]
    return Tolerances.from_mapping({"tolerances": rows})


def solved_deg(group: Any, survey: people.RigPopulation, axes: Any, noise: FeatureNoise, cell: int) -> Floats:
    """Errors (e, 2) deg of the line of sight in a direction, one for each axis."""
    scene, case, lids = group
    rows = np.array([*people.CALIBRATION_CELLS, cell])
    views, theta = case.instants.take(rows), case.theta[rows]
    point, way = lines_of_sight(views, theta)
    fixed, data = {}, {}
    for number, camera in enumerate(scene.rig.cameras):
        own = replace(views, camera=np.full(10, number))
        seen, _ = people.seen_features(own, theta, camera, (lids.take(rows), survey.occluders))
        clean, parts = images_of(own, theta, POINTS), []
        for axis in axes:
            other = images_of(replace(own, rig=axis.moved(axis.sd)), theta, POINTS) if number in axis.cameras else clean
            moved = (np.arange(10) >= (0 if axis.before else 9))[:, None, None]
            pairs = ((other.outline_px, clean.outline_px), (other.glints_px, clean.glints_px))
            parts.append([np.where(moved, a, b) for a, b in pairs])
        data[number] = (np.concatenate([one for one, _ in parts]), np.concatenate([one for _, one in parts]))
        fixed[number] = _tiled(seen, len(axes))
    unknowns = Unknowns.from_mapping(survey.unknowns)
    problem = Problem(
        views=views.take(np.tile(np.arange(10), len(axes))), theta=np.tile(theta, (len(axes), 1)),
        target_mm=np.tile(point + 1000.0 * way, (len(axes), 1)), free=np.flatnonzero(unknowns.free()), noise=noise,
        precision=unknowns.precision(), fixed=fixed, data=data,
    )  # fmt: skip
    _, found = lines_of_sight(problem.views, problem.solved())
    return np.asarray(np.degrees(np.einsum("ij,ej->ei", tangents(way[-1:])[0], found[9::10])))


def _tiled(seen: FeatureSlopes, times: int) -> FeatureSlopes:
    def tile(values: Any) -> Any:
        return np.tile(values, (times, *[1] * (values.ndim - 1)))

    images = replace(seen.images, **{name: tile(getattr(seen.images, name)) for name in seen.images.__slots__})
    arrays = {name: tile(getattr(seen, name)) for name in seen.__slots__ if name != "images"}
    return replace(seen, images=images, **arrays)


def compared(name: str, count: int) -> tuple[Any, Floats, Floats]:
    """Axes, and errors (p, e, 2) deg of equation (8) and of solved problems, of people in front of a rig."""
    scene = er.load_scene(name).of_first_eye()
    survey = survey_of(scene, er.Population("adults"), RigSize(people=count))
    noise = FeatureNoise.of(OUTLINE_PX, GLINT_PX, rig=scene.rig)
    given = tolerances()
    axes = list(axes_of(scene, given))
    cells = np.setdiff1d(np.arange(people.GRID**2), people.CALIBRATION_CELLS)
    everyone, _ = people.people_of(survey, 0, count)
    linear_of = _by_subject(unit_errors(survey, given, noise, count).errors_deg, everyone)
    linear, again = [], []
    for k, one in enumerate(everyone):
        cell = int(cells[(29 * k + 7) % len(cells)])
        case = people._case(survey, one.scene.rig, [one])
        group = one.scene, case, people.lids_of(survey, [one])
        again.append(solved_deg(group, survey, axes, noise, cell))
        linear.append(linear_of[one.subject][cell])
        print(f"{name}: {k + 1}/{len(everyone)} people", file=sys.stderr, flush=True)
    return axes, np.array(linear), np.array(again)


def _by_subject(errors: Floats, everyone: list[people.Someone]) -> dict[int, Floats]:
    order: Ints = np.concatenate([[one.subject for one in some] for some in people._groups(everyone)])
    return dict(zip(order.tolist(), errors, strict=True))


def main() -> int:
    """Compare all rigs and print the rows."""
    parser = options_of(__doc__, "two people before each rig, without bars")
    parser.add_argument("--people", type=int, default=20, help="people before each rig")
    options = parser.parse_args()
    count, report = 2 if options.quick else options.people, Report()
    for name in RIGS:
        axes, linear, again = compared(name, count)
        numbers = np.array([axis.tolerance for axis in axes])
        for k, one in enumerate(tolerances().tolerances):
            own = numbers == k
            stated, solved = (np.median(np.sqrt((v[:, own] ** 2).sum(axis=(1, 2)))) for v in (linear, again))
            single = np.linalg.norm(again[:, own] - linear[:, own], axis=2) / np.linalg.norm(linear[:, own], axis=2)
            what = f"{name}: {one.part} {one.quantity} {one.when}"
            report.add(row(f"{what}, stated", stated, "deg"))
            report.add(row(f"{what}, difference", abs(solved / stated - 1), "share", None if options.quick else BAR))
            report.add(row(f"{what}, single errors", float(np.median(single)), "share"))
    return report.finish(options.json, ("numpy",))


if __name__ == "__main__":
    sys.exit(main())
