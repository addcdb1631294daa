"""Making samples: one renderer, used for every sample of a worker."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..capture import BackendName, WindowImage, make_renderer, noiseless, render_windows
from ..observation import EYES
from ..scene import Scene
from .labels import image_labels
from .plan import Plan
from .realise import Realised, Rejection, realise

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer


@dataclass(frozen=True)
class MadeImage:
    """An image of a sample: its name without ending, its pictures by kind (`LabelsSpec.pictures`), and its line of
    metadata (without files)."""

    name: str
    pictures: dict[str, NDArray[Any]]
    line: dict[str, Any]


@dataclass(frozen=True)
class MadeSample:
    """The images of one sample (none where it was given up), and the attempts that could not be made."""

    index: int
    images: tuple[MadeImage, ...]
    rejections: tuple[Rejection, ...]


class Maker:
    """Makes samples of one plan on one backend."""

    def __init__(self, plan: Plan, frames: int, *, backend: BackendName = "auto", threads: int | None = None) -> None:
        self.plan = plan
        self.frames = frames
        self.renderer: Renderer = make_renderer(backend, threads)

    @property
    def backend(self) -> dict[str, Any]:
        """What renders: name, device, versions."""
        b = self.renderer.backend
        return {"name": b.name, "device": b.device, "threads": b.threads, **b.versions}

    def make(self, index: int) -> MadeSample:
        """Sample `index` with its images."""
        found = realise(self.plan, index, self.frames)
        return MadeSample(index, tuple(self._images(found)), found.rejections)

    def _images(self, found: Realised) -> Iterator[MadeImage]:
        sample, scene, observations = found.sample, found.scene, found.observations
        if sample is None or scene is None or observations is None:
            return
        records = list(observations.records())
        turn = sample.turn
        many = self.frames > 1
        for image in render_windows(scene, observations, renderer=self.renderer):
            record = records[image.row]
            frame = record["frame"]
            # A frame's number is its own in the whole dataset.
            record = {**record, "frame": turn.sample * self.frames + frame}
            side = EYES[int(observations.index.eye[image.row])]
            name = f"{turn.sample:08d}-{f'{frame:03d}-' if many else ''}{side}"
            line = {
                "sample": turn.sample,
                "subject": turn.subject,
                "split": sample.split,
                "sequence_index": turn.sequence,
                "window_px": dict(zip(("x0", "y0", "width", "height"), image.window, strict=True)),
                "bit_depth": scene.spec.sensor.bit_depth,
                "records": [record],
                "labels": image_labels(scene, observations, image),
                "parameters": {
                    "eye_model": scene.eye_spec.name,
                    "pupil_diameter_mm": scene.pupil_diameter_mm,
                    "wavelength_nm": scene.spec.wavelength_nm,
                    "spp": scene.spec.image.spp,
                    "seed": scene.spec.seed,
                    "camera": image.camera,
                    "attempt": turn.attempt,
                    "subject_attempt": turn.subject_attempt,
                    "draws": sample.draws,
                    # As text: what is nested in them may differ from sample to sample, the columns must not.
                    "scene_json": json.dumps(sample.scene, sort_keys=True),
                    "eye_json": json.dumps({k: v for k, v in sample.eye.items() if k != "sources"}, sort_keys=True),
                },
            }
            kinds = self.plan.spec.labels.pictures
            yield MadeImage(name, {kind: _PICTURES[kind](scene, image) for kind in kinds}, line)


def _amodal(scene: Scene, image: WindowImage) -> NDArray[np.uint8]:
    labels = image.rendered.labels
    assert labels is not None
    return labels.amodal


_PICTURES: dict[str, Callable[[Scene, WindowImage], NDArray[Any]]] = {
    "images": lambda _, image: image.dn,
    "masks": lambda _, image: image.mask,
    "amodal_masks": _amodal,
    "noiseless": noiseless,
}
