"""Recompute metadata, from the plan of a dataset or from the scene of a rendered folder.

This covers the values that do not depend on pixels: the image's identity, what was drawn, the names of its files, the
analytic record, and the labels that follow from pose and parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...analytic.observer import trace
from ...base.arrays import Bools, Floats, finite_or_none
from ...base.errors import WRONG, InputError
from ...base.storage.files import parse_json, shown
from ...folders.imagefolder import DATASET, FILE_KEYS, KINDS, RESULTS, ImageFolder, shard_name, versions
from ...imaging.labels import EyeInWindow, glint_shifts_px, known_labels, lid_landmarks, limbus_px
from ...imaging.lines import image_line
from ...rendering.glints.tracing import GlintScene, glint_table
from ...rendering.records.job import film_index
from ...scene import Frames, Scene
from ...scene.observation import EYES, Observations
from ...scene.spec import SceneSpec
from ..done import picture_file
from ..ownscenes import GivenScene
from ..plan import Plan, plan_digest
from ..realise import Realised, frames_of, image_name, realise, sample_line
from .problems import FolderProblems, differences

# Rays are traced to 1e-9 mm, and mathematical functions of other machines change the last digits: 1e-8 px at the
# sharpest of the shipped cameras. A number may differ by this times 1 + its size.
TOLERANCE = 1e-7
# The centre of a lamp's image is a mean of equally exact points; hidden points may be missing.
SPOT_PX = 1e-3
# Landmarks of the lids are written with four decimals.
ROUNDED = 1e-6
_LIMBUS_POINTS = 360
_SHOWN = 2


class NoTruth(Exception):
    """Nothing can be recomputed, for a reason that is not a fault of the folder."""


@dataclass(frozen=True, slots=True)
class Again:
    """A recomputed image: the differences of its metadata, and its limbus (k, 2) px if it is visible as a whole."""

    problems: tuple[str, ...]
    limbus_px: Floats | None = None


@dataclass
class StoredScenes:
    """The scenes that lines of metadata hold, in the place of the user's code that made them."""

    lines: dict[int, dict[str, Any]] = field(default_factory=dict)
    is_told: bool = False  # whether the lines say whose the images are, which otherwise follows from the plan

    def __call__(self, _seed: int, sample: int, attempt: int) -> GivenScene:
        """Return the scene of a sample, whose line must be in `lines`; raises one of `WRONG`."""
        line = self.lines[sample]
        parameters = line["parameters"]
        if attempt < parameters["attempt"]:
            raise InputError("an earlier attempt, which was rejected")
        tree, eye = parse_json(parameters["scene_json"]), parse_json(parameters["eye_json"])
        drawn = tree.get("person") is not None or tree.get("population") is not None
        whose: dict[str, Any] = {"subject": line["subject"], "split": line["split"]} if self.is_told else {}
        return GivenScene(tree=tree, eye={} if drawn else eye, draws=parameters["draws"], **whose)


@dataclass(kw_only=True)
class DatasetTruth:
    """Reference for the metadata of a generated dataset, from its plan; `frames` is the number of frames per sample.

    Where a user's code gave the scenes, those of the lines are used, and `stored` must hold the lines.
    `stale` is the reason why records and labels cannot be computed again, None where they can.
    """

    plan: Plan
    frames: int
    stale: str | None
    stored: StoredScenes | None = None
    _last: Realised | None = field(default=None, init=False)

    @classmethod
    def of(
        cls, dataset: Mapping[str, Any], problems: FolderProblems, first: Mapping[str, Any] | None = None
    ) -> DatasetTruth | None:
        """Read the plan in dataset.json, whose first line is `first`; what is wrong is added to the problems."""
        try:
            plan = Plan.from_mapping(dataset, Path())
            if dataset["digest"] != plan_digest({k: dataset[k] for k in plan.to_mapping()}):
                problems.add(f"{DATASET}: its digest does not match its spec, eyes and files")
            if plan.scenes is not None and first is not None:
                return cls._of_stored(plan, dict(first), _other_results(dataset))
            return cls(plan=plan, frames=frames_of(plan), stale=_other_results(dataset))
        except InputError as error:
            problems.add(f"{DATASET}: its plan cannot be used: {error}")
        except WRONG as error:
            problems.add(f"{DATASET}: holds no plan ({type(error).__name__}: {error})")
        return None

    @classmethod
    def _of_stored(cls, plan: Plan, first: dict[str, Any], stale: str | None) -> DatasetTruth:
        """Compute the truth from the scenes that the lines hold; raises one of `WRONG`, `InputError`."""
        assert plan.scenes is not None
        stored = StoredScenes({int(first["sample"]): first}, is_told=not plan.scenes.reference)
        # The exposure that a subject got is in its scenes.
        spec = plan.spec.model_copy(update={"auto_exposure": None})
        plan = replace(plan, spec=spec, scenes=replace(plan.scenes, function=stored))
        scene = plan.draw(first["sample"], first["parameters"]["attempt"]).build()
        return cls(plan=plan, frames=scene.frame_count, stale=stale, stored=stored)

    def whose(self, line: dict[str, Any]) -> dict[str, Any]:
        """Return the subject, split and file names that a line must have; raise one of `WRONG` or `InputError`."""
        sample, record = line["sample"], line["records"][0]
        subject, sequence = self.plan.subject_of(sample)
        name = image_name(sample, record["frame"] - sample * self.frames, self.frames, record["eye"])
        shard = shard_name(self.plan.spec.selection.shard_of(sample))
        files = {KINDS[kind]: f"{kind}/{shard}/{picture_file(kind, name)}" for kind in self.plan.spec.labels.pictures}
        if self.plan.scenes is not None and not self.plan.scenes.reference:
            return files  # the user's code said the rest
        return {**files, "subject": subject, "sequence_index": sequence, "split": self.plan.split_of(subject)}

    def again(self, line: dict[str, Any]) -> Again:
        """Recompute a line; raise one of `WRONG` if it is not a line of a dataset."""
        number, record = line["sample"], line["records"][0]
        if self.stored is not None:
            self.stored.lines = {number: line}
        if self._last is None or self._last.index != number:
            self._last = self._exposed(realise(self.plan, number, self.frames), line)
        found = self._last
        frames, observations = found.frames, found.observations
        if frames is None or observations is None:
            return Again((f"the plan gives up sample {number}",))
        first = int(observations.index.frame[0]) // self.frames * self.frames  # a clip's frames are numbered on
        row = _row(observations, first + record["frame"] - number * self.frames, record["eye"])
        if row is None:
            return Again((f"sample {number} has no such image",))
        scene, view = frames.scene, EyeInWindow.of(frames, row)
        _, expected = sample_line(found, row, self.frames, view.window, known_labels(scene, observations, view))
        problems = _differences(_open(expected), _open(line))
        problems += [*_spots(scene, view, observations, line), *_lids(scene, view, line)]
        return Again(tuple(problems), _limbus(scene, view))

    def remember(self, lines: Mapping[int, dict[str, Any]]) -> None:
        """Keep the lines of some samples, where their scenes are needed."""
        if self.stored is not None:
            self.stored.lines = dict(lines)

    def _exposed(self, found: Realised, line: dict[str, Any]) -> Realised:
        """Return the sample with the exposure in its line, because automatic exposure depends on the pixels."""
        if self.plan.spec.auto_exposure is None or found.sample is None:
            return found
        return found.exposed(parse_json(line["parameters"]["scene_json"], path="scene_json")["sensor"]["exposure_ms"])


@dataclass
class SceneTruth:
    """Reference for the metadata of a rendered folder, from its scene."""

    frames: Frames
    observations: Observations
    stale: None = None

    @classmethod
    def of(cls, dataset: Mapping[str, Any], problems: FolderProblems) -> SceneTruth:
        """Read the scene in dataset.json.

        Raises:
            NoTruth: a file of the scene is missing, another version rendered it, or the folder has no scene.
        """
        stale = _other_results(dataset)
        if stale is not None:
            raise NoTruth(stale)
        if not isinstance(dataset.get("spec"), dict):
            raise NoTruth(f"{DATASET} has no scene")
        try:
            scene = Scene.of(SceneSpec.from_mapping(dataset["spec"], source=DATASET))
            digest = scene.digest()
            frames = scene.frames()
        except InputError as error:
            raise NoTruth(str(error)) from None
        if digest != dataset.get("digest"):
            # Another version of the package may have keys that this digest lacks.
            made_by = dataset.get("versions")
            if isinstance(made_by, dict) and made_by.get("eyerender") != versions()["eyerender"]:
                raise NoTruth("another version of the package made it")
            problems.add(f"{DATASET}: its digest does not match its scene, its eye and its files")
        return cls(frames, trace(frames, occluded=False))

    def whose(self, line: dict[str, Any]) -> dict[str, Any]:
        """Return the file names that a line must have; raise one of `WRONG`."""
        name = f"{line['records'][0]['frame']:06d}_{line['records'][0]['eye']}"
        return {"file_name": f"images/{name}.png", "mask_file_name": f"masks/{name}.png"}

    def again(self, line: dict[str, Any]) -> Again:
        """Recompute a line; raise one of `WRONG` if it is not a line of a rendered folder."""
        scene, found = self.frames.scene, self.observations
        record = line["records"][0]
        row = _row(found, record["frame"], record["eye"])
        if row is None:
            return Again(("the scene has no such image",))
        view = EyeInWindow.of(self.frames, row)
        (own,) = found.take([row]).records()
        stored = {"timestamp_s": finite_or_none(found.index.timestamp_s[row])}
        expected = image_line(scene, own, view.window, known_labels(scene, found, view), sample=stored)
        problems = [*_differences(_open(expected), _open(line)), *_spots(scene, view, found, line)]
        problems += _lids(scene, view, line)
        return Again(tuple(problems), _limbus(scene, view))


def truth_of(folder: ImageFolder, problems: FolderProblems) -> DatasetTruth | SceneTruth | None:
    """Return the reference for a folder's metadata; None if dataset.json is damaged. Raises `NoTruth`."""
    if folder.dataset.get("kind") == "dataset":
        return DatasetTruth.of(folder.dataset, problems, folder.entries[0].line)
    return SceneTruth.of(folder.dataset, problems)


def _other_results(dataset: Mapping[str, Any]) -> str | None:
    """Return a note if a version with other results made the folder; None otherwise."""
    made_by = dataset.get("versions")
    results = made_by.get("results", RESULTS) if isinstance(made_by, dict) else RESULTS
    return None if str(results) == str(RESULTS) else f"it has results of version {shown(results)}, not {RESULTS}"


def _row(observations: Observations, frame: int, eye: str) -> int | None:
    index = observations.index
    rows = np.flatnonzero((index.frame == frame) & (index.eye == EYES.index(eye)))
    return int(rows[0]) if len(rows) else None


def _open(line: dict[str, Any]) -> dict[str, Any]:
    """Parse the JSON texts in a line into values."""
    parameters = line["parameters"]
    texts = {key: parse_json(parameters[key]) for key in ("scene_json", "eye_json")}
    return {**line, "parameters": {**parameters, **texts}}


def _differences(expected: dict[str, Any], line: dict[str, Any]) -> list[str]:
    # `whose` gives the names of files.
    return _summed(differences({k: v for k, v in expected.items() if k not in FILE_KEYS}, line, TOLERANCE))


def _summed(texts: Iterator[str]) -> list[str]:
    """Return the first of several differences, and the number of further ones."""
    found = list(texts)
    if len(found) > _SHOWN:
        found = [*found[:_SHOWN], f"{len(found) - _SHOWN} more values differ"]
    return [f"computed again: {text}" for text in found]


def _limbus(scene: Scene, view: EyeInWindow) -> Floats | None:
    points, reason = limbus_px(scene, view, _LIMBUS_POINTS)
    return points if reason is None else None


def _spots(scene: Scene, view: EyeInWindow, truth: Observations, line: dict[str, Any]) -> Iterator[str]:
    """Check the spots of the glints: each is the mean of the lamp's image, or lies within it if a part is hidden."""
    eye, camera = view.eye, view.rig.cameras[view.camera]
    lenses = tuple(lens.behind(view.M, view.t - view.apex_mm) for lens in eye.worn)
    mirror = GlintScene.of(eye, film_index(eye, scene.spec.look), view.M, view.t, camera, None, lenses)
    lights = [view.rig.lights[k] for k in view.rig.lights_of(EYES.index(eye.side))]
    images = mirror.images(lights, scene.spec.sensor.psf_sigma_px)
    glints = mirror.glints(lights, images, _all_clear)
    picture = scene.spec.image
    # The glints of a meshed cornea are off by some thousandths of a pixel at the default edge of 0.1 mm.
    shifts = glint_shifts_px(scene, view, truth)
    spare = SPOT_PX + (2 * picture.mesh_edge_mm**2 if picture.surfaces == "mesh" else 0.0)
    for place, whole, glint in zip(glint_table(glints).xy_px, glints, line["labels"]["glints"], strict=True):
        spot, spots = glint["spot_xy_px"], whole.spots
        if spot is None:
            continue
        shift = shifts[glint["light"]]
        if len(spots.energy) == 0:
            yield f"the spot of light {glint['light']} is at {spot}, but its cornea reflects nothing to the camera"
            continue
        low = high = place + shift
        if "occluded" in str(glint["hidden_by"]):
            reach = np.concatenate([spots.xy_px, whole.image.xy_px[whole.image.there]])
            low, high = reach.min(axis=0) + shift, reach.max(axis=0) + shift
        if not (np.all(spot >= low - spare) and np.all(spot <= high + spare)):
            x, y = (float(v) for v in (low + high) / 2)
            yield f"computed again: the spot of light {glint['light']} is at {spot}, not at [{x:.3f}, {y:.3f}]"


def _lids(scene: Scene, view: EyeInWindow, line: dict[str, Any]) -> Iterator[str]:
    """Check the landmarks along the lids; for a head mesh they are unknown and null."""
    expected = lid_landmarks(scene, view)
    yield from _summed(differences(expected, line["labels"]["lid_margins_px"], ROUNDED, "labels.lid_margins_px"))


def _all_clear(a: Floats, b: Floats) -> Bools:
    del b
    return np.ones(len(a), dtype=bool)
