#!/usr/bin/env python3
"""Which glints do lids, lashes, obstacles and openings hide? `eyerender rig` against the labels of rendered pictures.

    bench_dropout.py [--quick] [--people N] [--json F]

Adults whose upper lids stand at 60, 80 and 100 % of their own height look in nine directions up to 25 degrees from the
middle. Two rigs have a ring of eight LEDs 16 mm before the eye: one with a camera of 100 degrees below the eye at the
temple, one with a camera before and above it, which looks through the upper lashes. A glint is lost in a label if less
than half of it is visible, behind lids or lashes. Rows state the share of the glints that labels lose which the report
on the rig loses too, and the reverse, for each opening of the lids, each rig, and all.

People before the first camera follow, once with a ring in the way and once with a lens that sees through an opening.
Then comes the loss of data of two estimators on its ring of LEDs: 40 adults look in 81 directions up to 20 degrees
aside and 15 up, and frames without an estimate are compared with those without two glints or a pupil.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np

from _bench import Report, options_of, row, single_threaded

single_threaded()

import eyerender as er
from eyerender.apps.rigs.report import _scene_of
from eyerender.base.arrays import Bools, Floats
from eyerender.design import people
from eyerender.design.unknowns import COUNT, Unknowns
from eyerender.scene.spec import SceneSpec

SHARE = 0.9
UPPER = (0.6, 0.8, 1.0)
CELLS = people.CALIBRATION_CELLS
REASONS = ("lid", "lash")
CAMERAS = {
    "below": {"position_mm": [18.0, -53.5, -14.0], "look_at_mm": [0.0, -31.5, 0.0], "focal_length_px": 168.0},
    "above": {"position_mm": [34.0, -31.5, 16.0], "look_at_mm": [0.0, -31.5, 0.0], "focal_length_px": 300.0},
}
RING = {"centre_mm": [11.0, -38.0, -2.0], "inner_radius_mm": 4.0, "outer_radius_mm": 9.0, "depth_mm": 2.0}
OPENING = {"centre": [0.02, -0.1], "half_size": [2.0, 0.16], "power": 8, "edge_px": 1}
ALMOST_ALL, NEAR = 0.99, 0.01
ESTIMATORS: dict[str, Any] = {"guestrin-eizenman": er.gaze.GuestrinEizenman(), "hennessey": er.gaze.Hennessey()}


def rig_of(name: str) -> dict[str, Any]:
    """The scene of one camera and eight LEDs on a ring of 22 mm."""
    camera = {**CAMERAS[name], "resolution_px": [400, 400]}
    lights = [
        {"position_mm": [16.0, -31.5 + 22 * np.cos(a), 22 * np.sin(a)], "intensity_mw_sr": 1.0, "radius_mm": 0.5}
        for a in (np.arange(8) * np.pi / 4).tolist()
    ]
    data = er.load_scene("head_mounted").spec.to_mapping()
    return {**data, "rig": {"cameras": [camera], "lights": lights}, "image": {"spp": 4}}


def survey_of(scene: dict[str, Any], lids: bool = True) -> people.RigPopulation:
    """Adults in front of the rig, without slippage."""
    return people.RigPopulation(
        scene=scene, population=er.Population("adults").to_mapping(), unknowns=Unknowns.population().to_mapping(),
        azimuth_deg=25.0, elevation_deg=25.0, slippage_mm=0.0, lids=lids,
    )  # fmt: skip


def lost_by_rig(survey: people.RigPopulation, one: people.Someone) -> tuple[Bools, Bools]:
    """Which glints (9, m) exist, and which of them the report loses behind lids, lashes, obstacles or openings."""
    case = people._case(survey, one.scene.rig, [one])
    views, theta = replace(case.instants.take(CELLS), camera=np.zeros(len(CELLS), np.int64)), case.theta[CELLS]
    lids, free, camera = people.lids_of(survey, [one]), np.zeros(COUNT, dtype=bool), one.scene.rig.cameras[0]
    hidden_by = None if lids is None else lids.take(CELLS), survey.occluders
    every, left = (
        people.seen_features(views, theta, camera, hiding, free)[0].glint_ok for hiding in ((None, None), hidden_by)
    )
    return every, every & ~left


def lost_by_labels(survey: people.RigPopulation, one: people.Someone, reasons: tuple[str, ...]) -> list[Bools]:
    """Which glints (9, m) labels call lost for each reason."""
    spec = SceneSpec.from_mapping(survey.scene)
    subject = er.Subject.of(
        er.Population("adults").person(one.subject, 0), eyes=("right",), ipd_mm=63.0, luminance_cd_m2=20.0,
        accommodation_d=0.0, head_positions_mm=(tuple((one.place_mm - [0.0, -31.5, 0.0]).tolist()),),
    )  # fmt: skip
    poses = er.EyeDirection.listed(survey.directions_deg[CELLS])
    scene = er.Scene(subject, spec.rig, poses=poses, image=spec.image, lens=spec.lens)
    if survey.lids:
        scene = scene.with_({"region": one.region.to_mapping()})
    found = [image.rendered for image in er.render(scene)]
    lost = np.array([one.glints.share for one in found]) < 0.5
    return [lost & [[word in text for text in one.glint_reasons] for one in found] for word in reasons]


def obstructed_rows(report: Report, count: int, must: float | None) -> None:
    """Rows of glints, apart from those behind lids and lashes, that an obstacle or an opening of the lens hides."""
    plain = rig_of("below")
    ring = {**plain, "rig": {**plain["rig"], "obstacles": [{"ring": RING}]}}
    for reason, what, scene in (
        ("obstacle", "obstacle", ring),
        ("frame", "opening", {**plain, "lens": {"openings": [OPENING]}}),
    ):
        survey, labels, rig, both = survey_of(scene, lids=False), 0, 0, 0
        for one in people.people_of(survey, 5, count)[0]:
            exist, lost = lost_by_rig(survey, one)
            hidden, *covered = lost_by_labels(survey, one, (reason, *REASONS))
            exist &= ~np.any(covered, axis=0)
            hidden, lost = hidden & exist, lost & exist
            labels, rig, both = labels + hidden.sum(), rig + lost.sum(), both + (hidden & lost).sum()
        report.add(row(f"{what}: glints that labels lose", labels, ""))
        report.add(row(f"{what}: lost by labels, and by rig", both / max(labels, 1), "share", must, at_least=True))
        report.add(row(f"{what}: lost by rig, and by labels", both / max(rig, 1), "share", must, at_least=True))


def data_loss_rows(report: Report, count: int, must: float | None) -> None:
    """Rows of frames in which estimators find no gaze, compared with frames that lack two glints or a pupil."""
    survey = replace(survey_of(rig_of("below"), lids=False), azimuth_deg=20.0, elevation_deg=15.0)
    missing: list[Bools] = []
    lost: dict[str, list[Bools]] = {}
    for subject in range(count):
        scene = _scene_of(survey, subject, np.arange(people.GRID**2))
        seen = er.trace(scene)
        missing.append((seen.glints.ok.sum(axis=1) < 2) | ~seen.pupil.ok)
        for name, estimator in ESTIMATORS.items():
            fitted = estimator.fit(seen.take(np.isin(seen.index.fixation, CELLS)), scene.rig)
            rays = fitted.predict_rays(seen, scene.rig)
            lost.setdefault(name, []).append(~rays.ok)
    report.add(row("ring: frames without two glints or a pupil", float(np.mean(missing)), "share"))
    for name, found in lost.items():  # Hennessey's assumed eye has no pupil in some oblique frames
        bar, aim = (must, None) if name == "guestrin-eizenman" else (None, must)
        off = abs(float(np.mean(found)) - float(np.mean(missing)))
        report.add(row(f"ring: frames without an estimate of {name}, beside these", off, "share", bar, aim))


def main() -> int:
    """Compare both for every person, opening and rig."""
    parser = options_of(__doc__, "one person, without bars")
    parser.add_argument("--people", type=int, default=4, help="people before each rig")
    options = parser.parse_args()
    count, report = 1 if options.quick else options.people, Report()
    must = None if options.quick else SHARE
    sums: dict[tuple[str, float | None], Floats] = {}
    for name in CAMERAS:
        survey = survey_of(rig_of(name))
        for plain in people.people_of(survey, 5, count)[0]:
            for upper in UPPER:
                upper_mm = max(upper * plain.region.fissure.upper_mm, 2.2)
                fissure = plain.region.fissure.model_copy(update={"upper_mm": upper_mm})
                one = replace(plain, region=plain.region.model_copy(update={"fissure": fissure}))
                exist, rig = lost_by_rig(survey, one)
                lid, lash = (exist & hidden for hidden in lost_by_labels(survey, one, REASONS))
                counts = [lid.sum(), lash.sum(), rig.sum(), (rig & (lid | lash)).sum(), (rig & lash).sum()]
                for key in (("both", upper), (name, None), ("both", None)):
                    sums[key] = sums.get(key, np.zeros(5)) + counts
            print(f"camera {name}: person {plain.subject}", file=sys.stderr, flush=True)
    for (name, height), (lid, lash, lost, both, lashes) in sorted(sums.items(), key=lambda one: one[0][1] is None):
        what = f"{name}, upper lids at {'any height' if height is None else f'{100 * height:.0f} %'}"
        report.add(row(f"{what}: glints that labels lose", lid + lash, ""))
        report.add(row(f"{what}: of them behind lashes", lash, ""))
        report.add(row(f"{what}: lost by labels, and by rig", both / max(lid + lash, 1), "share", must, at_least=True))
        report.add(row(f"{what}: lost by rig, and by labels", both / max(lost, 1), "share", must, at_least=True))
        if lash:
            report.add(row(f"{what}: lost by labels behind lashes, and by rig", lashes / lash, "share"))
    obstructed_rows(report, 3 * count, None if options.quick else ALMOST_ALL)
    data_loss_rows(report, 2 if options.quick else 40, None if options.quick else NEAR)
    return report.finish(options.json, ("numpy", "mitsuba"))


if __name__ == "__main__":
    sys.exit(main())
