"""Stereo: two cameras, with and without a posterior cornea, each with the whole eye or the pupil alone turned: 2 x 2.

The paper's reference [26] reports that a posterior cornea causes errors of stereo trackers as the head moves. The
paper suspects its procedure: there, the pupil alone turned, within an eye that stayed. Here the same people look at the
same targets in all four ways: the stop is moved to where the turned eye has it, while cornea and globe stay; and the
cornea's back surface is left out, with one index (1.3375) behind its front.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import frozen
from ...eye.batch import stack_stops, take_stops
from ...eye.model import EyeModel
from ...eye.pose import Poses, rigid_motion
from ...gaze.twocamera import ShihWuLiu
from ...scene import Frames, Scene
from ...scene.observation import PoseTruth
from .calibration_study import grid, means_of, rig_scene, tested
from .findings import RISE
from .over_people import Groups, OtherEyes, differs
from .results import Finding, ModelResults
from .study import Study, StudyJob, changed, of_person

HEADS_MM = ((0.0, 0.0, 0.0), (0.0, 30.0, 0.0), (0.0, -30.0, 0.0), (40.0, 0.0, 0.0), (-40.0, 0.0, 0.0))
SINGLE_INDEX = 1.3375
REACH, PUPIL_MM = 0.45, 3.0
"""Share of the half screen, and the stop: farther out or wider, a pupil that turns alone leaves the cornea."""
KEY = ("own", "analytic")
CELLS = {
    f"{cornea}, {turned}": (cornea == "posterior cornea", turned == "whole eye")
    for cornea in ("posterior cornea", "single cornea")
    for turned in ("whole eye", "pupil alone")
}
"""Condition -> whether there is a posterior cornea, and whether the whole eye turns."""


def single_cornea(eye: EyeModel) -> EyeModel:
    """Leave out the back of the cornea."""
    return replace(eye, front=eye.front[:1], front_indices=(SINGLE_INDEX,))


def turned(frames: Frames, eye: EyeModel, whole: bool, change: Callable[[EyeModel], EyeModel]) -> Frames:
    """Turn a changed eye; or its stop alone, while the rest of the eye stays as it is straight ahead."""
    if whole:
        return OtherEyes.frames(frames, change)
    n, pose = len(frames), frames.pose
    turn, shift = rigid_motion(Poses(pose.azimuth_rad, pose.elevation_rad, pose.torsion_rad), eye)
    stop = take_stops(stack_stops([eye.stop]), np.zeros(n, np.int64))
    moved = replace(stop, centre_mm=(turn @ stop.centre_mm[..., None])[..., 0] + shift, rotation=turn @ stop.rotation)
    zero = frozen(np.zeros(n))
    still = PoseTruth(azimuth_rad=zero, elevation_rad=zero, torsion_rad=zero, residual_mm=zero)
    return OtherEyes.frames(Frames(frames.scene, frames.index, still), change, moved)


class StereoStudy(Study):
    """Head movement before two cameras, for two corneas and two ways to turn an eye."""

    title = "Stereo, posterior cornea and the turning of the eye"
    about = (
        "Two cameras and five lights; the estimator of Shih, Wu and Liu with nine targets at the central head "
        "position, tested there (H1) and at four others (H2), 30 mm to the sides and 40 mm in depth.",
    )
    eyes = ()
    people = 24
    observers = ("analytic",)

    def scenes(self, job: StudyJob, protocol: str) -> Mapping[str, Scene]:
        """Build the remote rig with the person."""
        scene = of_person(rig_scene("remote", HEADS_MM, grid(3, REACH)), job.person or {})
        return {"": changed(scene, {"eye": {"pupil_diameter_mm": PUPIL_MM}})}

    def part(self, job: StudyJob) -> ModelResults:
        """Calibrate and test all four conditions of one person."""
        scene = self.scenes(job, "own")[""]
        frames, eye = scene.frames(), scene.eye("right")
        out = ModelResults(eye_model=job.who, person=job.person)
        errors = out.errors[KEY] = {}
        for name, (posterior, whole) in CELLS.items():
            seen = trace(turned(frames, eye, whole, (lambda same: same) if posterior else single_cornea))
            fitted = ShihWuLiu().fit(seen.take(seen.index.head == 0), scene.rig)
            for head, rows in (("H1", seen.index.head == 0), ("H2", seen.index.head > 0)):
                errors[f"{name}, {head}"] = tested(fitted, seen.take(rows), scene.rig).error_deg
        return out

    def groups(self, part: ModelResults) -> Groups:
        """Add the rise from H1 to H2."""
        own = part.errors[KEY]
        rises = {
            f"{name}, {RISE}": own[f"{name}, H2"].mean(keepdims=True) - own[f"{name}, H1"].mean() for name in CELLS
        }
        return {KEY: {**own, **rises}}

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test [26] (a posterior cornea adds a rise, in either way) and the paper's explanation."""
        rise = {name: means_of(parts, f"{name}, H2") - means_of(parts, f"{name}, H1") for name in CELLS}
        both, single = "posterior cornea", "single cornea"
        compared = {
            "T1": (f"{both}, pupil alone", f"{single}, pupil alone", "a posterior cornea adds a rise, pupil alone"),
            "T2": (f"{both}, whole eye", f"{single}, whole eye", "a posterior cornea adds a rise, whole eye"),
            "T3": (f"{both}, pupil alone", f"{both}, whole eye", "turning the pupil alone adds a rise"),
        }
        return [
            differs(id, KEY, f"rise of '{a}' less that of '{b}' (deg)", rise[a] - rise[b], claim)
            for id, (a, b, claim) in compared.items()
        ]
