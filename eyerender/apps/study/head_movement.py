"""The rise of the error from H1 to H2 in guestrin2006, and what each cause in the images does to it.

Guestrin and Eizenman (2006) blame images for it: changes of the light, and glints that deform. Drawn people are
rendered before that rig without and with each cause, features are extracted, and the right eye is calibrated at H1 on
images with the same cause. With r_p(c) the rise of person p, the effect of cause c is the mean of r_p(c) - r_p(none),
paired by person. The sizes of the causes are chosen, large for a laboratory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...scene import Scene
from ...scene.observation import Observations, concatenate
from . import guestrin
from .findings import RISE
from .observing import Observing
from .over_people import Experiment, Groups, differs, interval
from .results import Finding, ModelResults, known_mean
from .study import Study, StudyJob, StudyPlan, changed, of_person

KEY = ("corrected", "image")
WINDOW_PX = (128, 96)
TARGETS_MM = [[0.0, 0.0], *([a, b] for a in (-188.5, 188.5) for b in (-150.5, 150.5))]
LATER_MM = [[0.0, 30.0, 0.0], [-40.0, 0.0, 0.0]]
"""Of the rig's nine targets the centre and the corners, and of its four later head positions one aside and one back."""
NONE, ALL, RAYS = "none", "all together", "ray optics"
CAUSES: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    NONE: {},
    "glare": {"lens": {"glare": 0.09, "ghost": 0.001}},
    "uneven light": {"intensity": 0.5, "ambient": {"panels": [
        {"centre_mm": [300, 800, 200], "size_mm": [600, 800], "radiance_w_m2_sr": 0.8}]}},
    "glint deformation": {"radius_mm": 12.0},
    "pupil size": {"later_mm": 4.5},
    "lids": {"lids": True},
})  # fmt: skip
"""Cause -> changes: keys of the scene, of its lamps (share of the second one's power, radius), stop at H2, and lids."""


def scene_of(base: Scene, causes: Mapping[str, Any], later: bool) -> Scene:
    """Build the scene of some causes at the central head position, or at the later ones."""
    rig = base.spec.rig.to_mapping()
    for light in rig["lights"]:
        light["radius_mm"] = causes.get("radius_mm", light["radius_mm"])
    rig["lights"][1]["intensity_mw_sr"] *= causes.get("intensity", 1.0)
    changes: dict[str, Any] = {
        "rig": rig, "image": {"window_px": WINDOW_PX},
        "targets": {"screen_mm": TARGETS_MM},
        "subject": {"eyes": ["right"], "head_positions_mm": LATER_MM if later else [[0.0, 0.0, 0.0]]},
        **{name: causes[name] for name in ("lens", "ambient") if name in causes},
    }  # fmt: skip
    if later and "later_mm" in causes:
        changes["eye"] = {"pupil_diameter_mm": causes["later_mm"]}
    if "lids" not in causes:
        changes["region"] = None
    return changed(base, changes)


def observed(
    base: Scene, causes: Mapping[str, Any], observing: Observing, known: dict[str, Observations]
) -> Observations:
    """Observe all head positions with some causes; `known` keeps what several causes share."""
    out = []
    for later in (False, True):
        scene = scene_of(base, causes, later)
        key = observing.kind + json.dumps(scene.spec.to_mapping(), sort_keys=True)
        if key not in known:
            known[key] = observing.observe(scene, facing=True)
        seen = known[key]
        out.append(replace(seen, index=replace(seen.index, head=seen.index.head + later)))
    return concatenate(out)


class HeadMovementStudy(Study):
    """The rise of the error from H1 to H2, and causes in the images."""

    title = "Head movement and images"
    about = (
        "The right eyes of drawn people before the rig of Guestrin and Eizenman (2006), in noiseless images: a bare "
        "eye and an ideal lens, then one cause more, then all causes. Each is calibrated at H1 with the same cause. Of "
        "the rig's targets there are five, of its later head positions two, so that many people can be rendered.",
        "The causes are glare of .09 with a ghost of .001; uneven light, from a second lamp of half the power and a "
        "window at the side; lamps of 12 mm radius instead of 2.5 mm, whose glints the cornea deforms; a stop that is "
        ".5 mm wider at H2; and lids with lashes.",
    )
    eyes = ()
    people = 24
    observers = ("image",)
    protocols = ("corrected",)

    def jobs(self, plan: StudyPlan) -> list[StudyJob]:
        """Observe without the sensor's noise, unless it is asked for alone."""
        kind = "image" if plan.options.noise == "on" else "image-noiseless"
        return [job for job in super().jobs(plan) if job.observing.kind == kind]

    def part(self, job: StudyJob) -> ModelResults:
        """Calibrate and test one person with each cause."""
        base = of_person(guestrin.scene("E2", guestrin.CORRECTED), job.person or {})
        out, known = ModelResults(eye_model=job.who, person=job.person), dict[str, Observations]()
        every: dict[str, Any] = {key: value for one in CAUSES.values() for key, value in one.items()}
        errors = out.errors[KEY] = {}
        told = {f"{RAYS}, {name}": (CAUSES[name], Observing()) for name in (NONE, "pupil size")}
        told |= {name: (causes, job.observing) for name, causes in {**CAUSES, ALL: every}.items()}
        for name, (causes, observing) in told.items():
            done = guestrin.run(observed(base, causes, observing, known), base.rig, guestrin.CORRECTED)
            errors |= {f"{name}, {head}": done.error_deg[done.rows(head)] for head in guestrin.HEADS}
        return out

    def groups(self, part: ModelResults) -> Groups:
        """Add the rise."""
        own = part.errors[KEY]
        names = dict.fromkeys(name.rpartition(", ")[0] for name in own)
        return {KEY: {**own, **{f"{name}, {RISE}": np.array([_rise(part, name)]) for name in names}}}

    def measured(self) -> Mapping[str, Experiment]:
        """Return the four participants."""
        return guestrin.experiment()

    def tables(self, parts: Sequence[ModelResults]) -> dict[str, Any]:
        """Add the effect of each cause on the rise."""
        rows = [{"cause": name, "people": len(values), **interval(values, "adds to the rise, deg")}
                for name in (*CAUSES, ALL) if name != NONE and len(values := _effects(parts, name)) > 1]  # fmt: skip
        return {"causes": rows, **super().tables(parts)}

    def findings(self, parts: Sequence[ModelResults]) -> list[Finding]:
        """Test each cause, and the conjecture: all together make people rise as the experiment's did."""
        found = {name: values for name in (*CAUSES, ALL) if name != NONE and len(values := _effects(parts, name)) > 1}
        return [differs("M1", KEY, f"{name} adds to the rise (deg)", values, "images cause the rise")
                for name, values in found.items()]  # fmt: skip


def _rise(part: ModelResults, name: str) -> float:
    ends = [known_mean(part.errors[KEY][f"{name}, {head}"]) for head in guestrin.HEADS]
    return np.nan if None in ends else float(ends[1] or 0.0) - float(ends[0] or 0.0)


def _effects(parts: Sequence[ModelResults], name: str) -> Floats:
    """Return the change of the rise (p,) by a cause, over the frames with an estimate with and without it."""
    found = []
    for part in parts:
        added = (part.errors[KEY][f"{name}, {head}"] - part.errors[KEY][f"{NONE}, {head}"] for head in guestrin.HEADS)
        first, later = (known_mean(one) for one in added)
        if first is not None and later is not None:
            found.append(later - first)
    return np.array(found)
