"""A study's images as a dataset: a subject is an eye model, and a sample is one eye at one head position.

If an eye leaves the camera's image, the camera is turned about its nodal point to face it, in a separate sample.
Everything that differs between samples is a `sequence` of the dataset's spec. A study's images are therefore a dataset
like any other: made by several workers, shard by shard, resumed after a kill, and valid (`eyerender validate`). Images
are identified by their scene and eye file, so a finished dataset also serves a study that needs a part of it. Rendering
is the expensive step: a scene that is needed with and without sensor noise is rendered once and exposed twice.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Ints, frozen
from ...base.errors import WRONG, InputError
from ...base.progress import Progress, Say
from ...base.storage.files import read_json
from ...base.storage.jsonlines import JsonLines
from ...folders.imagefolder import DATASET, METADATA, RUN, ImageEntry
from ...imaging.causes import without_noise
from ...rig.exposure import expose_again
from ...scene import Scene
from ...scene.observation import EYES, Observations
from ...scene.spec import SceneSpec
from .options import StudyOptions

_SHARD_IMAGES = 27  # two or three seconds of work, the largest loss by a kill
_PATIENCE_S = 60.0  # per image, after which a silent worker counts as dead


@dataclass(frozen=True, slots=True)
class EyeShot:
    """A scene whose images form one sample, and the rows (n,) of the study's scene that they show."""

    scene: Scene
    rows: Ints


@dataclass(frozen=True, slots=True)
class StudyImages:
    """Images of a finished dataset, in frame order, by the digest of their scene."""

    entries: Mapping[str, tuple[ImageEntry, ...]]
    spp: int | None = None
    auto_exposure: float | None = None

    def of(self, scene: Scene) -> tuple[ImageEntry, ...]:
        """Return the images of a shot's scene, in frame order; empty if they were not made."""
        return self.entries.get(_digest(scene, self.auto_exposure is not None), ())

    def holds(self, scene: Scene) -> bool:
        """Return whether every image of a shot's scene exists."""
        found = self.of(scene)
        return len(found) == len(scene.index()) and all(entry.path.is_file() for entry in found)

    def observe(self, scene: Scene, noise_seed: int | None = None) -> Observations:
        """Extract the features of a shot's images, or of other exposures of them with the noise of a seed.

        Raises:
            InputError: the images do not exist.
        """
        from ...imaging.imageobserver import ImageObserver

        if not self.holds(scene):
            raise InputError("the images of this scene are not in the study's dataset", source=scene.name)

        def exposed(codes: NDArray[Any], entry: ImageEntry) -> NDArray[Any]:
            name = zlib.crc32(entry.path.name.encode())
            draw = np.random.SeedSequence([scene.spec.seed, name, 0 if noise_seed is None else noise_seed])
            seed = int(draw.generate_state(1, np.uint64)[0])
            return expose_again(scene.spec.sensor, codes, seed, entry.window[:2])

        again = None if noise_seed is None else exposed
        index = scene.index()
        return ImageObserver().observe_entries(self.of(scene), index, [scene.rig] * len(index), exposed=again)


def shots(scene: Scene, *, noise: bool, facing: bool = False, spp: int | None = None) -> list[EyeShot]:
    """Create one shot per eye; with `facing`, one per eye and head position, with the cameras turned to the eye."""
    data = scene.spec.with_image(spp=spp).to_mapping()
    data["sensor"]["noise"] = noise
    index, out = scene.index(), []
    heads = scene.spec.subject.head_positions_mm
    for head in range(len(heads)) if facing else (None,):
        for side in sorted(scene.spec.subject.eyes, key=EYES.index):
            rows = index.eye == EYES.index(side)
            data["subject"]["eyes"] = [side]
            one = scene.replaced(SceneSpec.from_mapping(data))
            if head is not None:
                rows = rows & (index.head == head)
                one = facing_scene(one, heads[head], side)
            out.append(EyeShot(one, frozen(np.flatnonzero(rows), np.int64)))
    return out


def facing_scene(scene: Scene, head_mm: tuple[float, float, float], side: str) -> Scene:
    """Create the scene of one head position and one eye, with every camera turned on the spot to face it."""
    data = scene.spec.to_mapping()
    apex = scene.eye_position_mm(side) + np.array(head_mm)
    data["subject"]["eyes"] = [side]
    data["subject"]["head_positions_mm"] = [list(head_mm)]
    for camera in data["rig"]["cameras"]:
        if camera.get("calibration"):
            raise InputError("a calibrated camera cannot be turned", path="rig.cameras")
        for key in ("pan_deg", "tilt_deg"):
            camera.pop(key, None)
        camera["look_at_mm"] = [float(v) for v in apex]
    spec = SceneSpec.from_mapping(data)
    return scene.replaced(spec)


def make_images(
    study: str,
    scenes: Sequence[Scene],
    folder: Path,
    options: StudyOptions,
    progress: Progress | None = None,
    say: Say | None = None,
) -> StudyImages:
    """Return the images of all shots' scenes from the folder's dataset; make the missing ones.

    The folder belongs to the study: a dataset of other settings or of another version of the package is replaced. With
    `options.auto_exposure`, each eye model has its own exposure (see `DatasetSpec`). Raises BackendError if no backend
    can render; EyerenderError if the disk is full, or a worker died repeatedly.
    """
    from ...dataset.plan import Plan
    from ...dataset.run import generate

    scenes = list({_digest(scene): scene for scene in scenes}.values())
    found, level = read_images(folder), options.auto_exposure
    if found is None or found.auto_exposure != level or not all(found.holds(scene) for scene in scenes):
        plan = Plan.of(dataset_spec(study, scenes, level), source=str(folder))
        generate(
            plan,
            folder,
            workers=options.workers,
            backend=options.backend,
            threads=options.threads,
            timeout_s=600.0 + _PATIENCE_S * len(scenes[0].index()),
            overwrite=not _begun(folder, plan),
            progress=progress,
            say=say,
        )
        found = read_images(folder)
    if found is None or not all(found.holds(scene) for scene in scenes):
        raise InputError("its dataset lacks images of this study", source=str(folder))
    return replace(found, spp=options.spp)


def dataset_spec(study: str, scenes: Sequence[Scene], auto_exposure: float | None = None) -> Any:
    """Create the dataset spec of scenes, the same for each eye model: a grid of models, a sequence of scenes.

    If a scene is needed with and without noise, one sample holds both kinds of images.
    """
    from ...dataset.spec import DatasetSpec

    wanted = len(scenes)
    beside = {_digest(without_noise(scene)) for scene in scenes if scene.spec.sensor.noise}
    scenes = [scene for scene in scenes if scene.spec.sensor.noise or _digest(scene) not in beside]
    by_model: dict[str, list[dict[str, Any]]] = {}
    for scene in scenes:
        data = scene.spec.to_mapping()
        by_model.setdefault(data["eye"].pop("model"), []).append(data)
    sequences = list(by_model.values())
    if any(sequence != sequences[0] for sequence in sequences):
        raise InputError("the eye models' scenes differ", source=study)
    template = in_sequence(sequences[0])
    template["eye"]["model"] = {"draw": "grid", "per": "subject", "values": list(by_model)}
    return DatasetSpec.from_mapping(
        {
            "format": DatasetSpec.FORMAT,
            "kind": "dataset",
            "name": f"{study}, images",
            "description": "What the image observer of a study sees. A subject is an eye model; a sample is one eye at "
            "one head position, all its fixations.",
            "count": len(scenes),
            "subjects": len(by_model),
            "shard_size": max(1, _SHARD_IMAGES // len(scenes[0].index())),
            "splits": {"study": 1.0},
            "require": "nothing",
            "attempts": 1,
            "labels": {"noiseless": len(scenes) < wanted},
            "scene": template,
            **({} if auto_exposure is None else {"auto_exposure": auto_exposure}),
        }
    )


def in_sequence(values: Sequence[Any]) -> Any:
    """Create a template that yields the values in order: plain where they agree, else a `sequence`, leaf by leaf."""
    first = values[0]
    if all(json.dumps(v) == json.dumps(first) for v in values):
        return first
    if all(isinstance(v, dict) and v.keys() == first.keys() for v in values):
        return {key: in_sequence([v[key] for v in values]) for key in first}
    if all(isinstance(v, list) and len(v) == len(first) for v in values):
        return [in_sequence([v[k] for v in values]) for k in range(len(first))]
    return {"draw": "sequence", "per": "sample", "values": list(values)}


def read_images(folder: Path) -> StudyImages | None:
    """Open the images of a finished dataset that this version made; None if there is none."""
    from ...dataset.done import run_versions

    try:
        dataset = read_json(folder / DATASET, follow=False)
        if dataset["versions"] != run_versions():
            return None
        level = dataset["spec"].get("auto_exposure")
        found: dict[str, list[tuple[int, ImageEntry]]] = {}
        lines = JsonLines.index(folder / METADATA)
        for line in lines.read(range(len(lines))):
            eye, frame = line["parameters"]["eye_json"], line["records"][0]["frame"]
            # Only the keys that extraction needs are kept; a line's labels take many times as much memory.
            kept = {key: line[key] for key in ("window_px", "bit_depth")} | {"records": [{}]}
            for scene, name in _exposures(line):
                entry = ImageEntry(folder=folder, line={"file_name": name, **kept})
                found.setdefault(_digest_of(scene, eye, level is not None), []).append((frame, entry))
    except (InputError, *WRONG):
        return None
    # A dataset's lines need not be in the order of its samples.
    in_order = {key: sorted(those, key=lambda pair: pair[0]) for key, those in found.items()}
    entries = {key: tuple(entry for _, entry in those) for key, those in in_order.items()}
    return StudyImages(entries, auto_exposure=level)


def _begun(folder: Path, plan: Any) -> bool:
    """Return whether a folder holds a run of this plan and version, or nothing yet."""
    from ...dataset.done import run_versions

    if not folder.exists():
        return True
    try:
        found = read_json(folder / RUN, follow=False)
        return bool(found["digest"] == plan.digest and found["versions"] == run_versions())
    except (InputError, KeyError):
        return False


def _exposures(line: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Yield the scenes, as JSON, that the images in a line of metadata show, each with the image's name."""
    scene = line["parameters"]["scene_json"]
    out = [(scene, line["file_name"])]
    if line.get("noiseless_file_name"):
        data = json.loads(scene)
        data["sensor"]["noise"] = False
        out.append((json.dumps(data, sort_keys=True), line["noiseless_file_name"]))
    return out


def _digest(scene: Scene, auto: bool = False) -> str:
    """Compute the digest of a scene's images, as in metadata; with `auto`, without the exposure."""
    eye = {key: value for key, value in scene.eye_spec.to_mapping().items() if key != "sources"}
    return _digest_of(json.dumps(scene.spec.to_mapping(), sort_keys=True), json.dumps(eye, sort_keys=True), auto)


def _digest_of(scene_json: str, eye_json: str, auto: bool) -> str:
    if auto:
        data = json.loads(scene_json)
        del data["sensor"]["exposure_ms"]
        scene_json = json.dumps(data, sort_keys=True)
    return hashlib.sha256(f"{scene_json}\n{eye_json}".encode()).hexdigest()
