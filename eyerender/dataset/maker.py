"""Make samples, with one renderer for all samples of a worker."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, islice
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.progress import one_behind
from ..imaging.autoexposure import settled_exposure_ms
from ..imaging.capture import BegunImage, EyeImage, begin_each, make_renderer, noiseless
from ..imaging.labels import image_labels
from ..rig.plausibility import is_saturated
from ..scene import Scene
from .plan import Plan
from .realise import Realised, Rejection, realise, sample_line
from .validation.problems import differences

if TYPE_CHECKING:
    from ..rendering.renderer import Renderer
    from ..scene import Frames


_SUBJECTS = 64  # whose exposure times are kept


@dataclass(frozen=True)
class MadeImage:
    """An image of a sample."""

    name: str  # file name without its suffix
    pictures: dict[str, NDArray[Any]]  # pixels by kind (`LabelsSpec.pictures`)
    line: dict[str, Any]  # metadata, without the names of files
    saturated: bool  # whether the image is saturated (`is_saturated`)


@dataclass(frozen=True)
class MadeSample:
    """Images of one sample (none if it was given up), and the attempts that failed."""

    index: int
    images: tuple[MadeImage, ...]
    rejections: tuple[Rejection, ...]


class Maker:
    """Maker of the samples of one plan on one backend."""

    def __init__(self, plan: Plan, frames: int, *, backend: BackendChoice = "auto", threads: int | None = None) -> None:
        self.plan = plan
        self.frames = frames
        self.renderer: Renderer = make_renderer(backend, threads)
        self._beside = ThreadPoolExecutor(1, "sample")
        self._settled: dict[int, float | None] = {}  # exposure times of the last subjects

    @property
    def backend(self) -> dict[str, Any]:
        """Name, device and versions of the backend."""
        b = self.renderer.backend
        return {"name": b.name, "device": b.device, "threads": b.threads, **b.versions}

    def make(self, index: int) -> MadeSample:
        """Make sample `index` with its images."""
        return next(self.make_all([index]))

    def make_all(self, indices: Iterable[int]) -> Iterator[MadeSample]:
        """Make samples in order, tracing each while the previous one is finished."""
        for begun in one_behind(self._begun(indices)):
            yield begun.result()

    def _begun(self, indices: Iterable[int]) -> Iterator[Future[MadeSample]]:
        """Trace the frames of samples in turn, while a second thread completes them."""
        waiting: deque[Realised] = deque()

        def frames() -> Iterator[Frames]:
            for index in indices:
                waiting.append(self._exposed(realise(self.plan, index, self.frames)))
                if found := waiting[-1].frames:
                    yield found

        labels = self.plan.spec.labels
        images = begin_each(
            frames(),
            self.renderer,
            highlights=labels.highlights,
            annotated=labels.as_annotated,
            geometry=labels.geometry or (),
        )
        for first in images:
            while not waiting[0].frames:
                yield self._rest(waiting.popleft(), ())
            yield self._rest(waiting.popleft(), (first, *islice(images, len(first.frames) - 1)))
        for found in waiting:
            yield self._rest(found, ())

    def _rest(self, found: Realised, begun: tuple[BegunImage, ...]) -> Future[MadeSample]:
        images = self._labelled(found, (b.image() for b in begun))  # whose work is done where it is read
        return self._beside.submit(lambda: MadeSample(found.index, tuple(images), found.rejections))

    def _exposed(self, found: Realised) -> Realised:
        """Set the exposure of the sample's subject; if the subject's images are dark, keep that of the scene."""
        level = self.plan.spec.auto_exposure
        if level is None or found.sample is None:
            return found
        subject = found.sample.turn.subject
        if subject not in self._settled:
            # Whatever sample of a subject is made, the first that can be made decides.
            before = (realise(self.plan, k, self.frames) for k in range(self.plan.first_of(subject), found.index))
            first = next((r.scene for r in before if r.scene is not None), found.scene)
            assert first is not None
            if len(self._settled) >= _SUBJECTS:
                self._settled.clear()
            self._settled[subject] = settled_exposure_ms(first, level, self.renderer)
        time_ms = self._settled[subject]
        return found if time_ms is None else found.exposed(time_ms)

    def made_of(self, index: int, images: Sequence[EyeImage]) -> MadeSample:
        """Make sample `index` of images that are rendered already, one for each row of its frames.

        Raises:
            InputError: they are not the images of its scene.
        """
        found = realise(self.plan, index, self.frames)
        if found.frames is None:
            return MadeSample(index, (), found.rejections)
        if [image.row for image in images] != list(range(len(found.frames))):
            raise InputError(f"must be {len(found.frames)}, one for each eye in each frame, in order", path="images")
        for image in images:
            _refuse_another(found.frames, image)
        return MadeSample(index, tuple(self._labelled(found, images)), found.rejections)

    def _labelled(self, found: Realised, images: Iterable[EyeImage]) -> Iterator[MadeImage]:
        for image in images:
            assert found.observations is not None
            labels = image_labels(image, found.observations)
            name, line = sample_line(found, image.row, self.frames, image.window, labels)
            kinds = self.plan.spec.labels.pictures
            pictures = {kind: _PICTURES[kind](image) for kind in kinds}
            if self.plan.spec.labels.half_precision:
                pictures |= {k: v.astype(np.float16) for k, v in pictures.items() if v.dtype.kind == "f"}
            yield MadeImage(name, pictures, line, is_saturated(image.counts, image.scene.spec.sensor))


def _refuse_another(frames: Frames, image: EyeImage) -> None:
    """Check that a picture is of one of the frames, whatever its counts are.

    Raises:
        InputError: it shows another scene, eye or frame.
    """
    mine, other = frames.scene, image.frame.scene
    path = f"images.{image.row}"
    if not isinstance(other, Scene):
        raise InputError("must show a Scene", path=path)
    a, b = ({**s.located().to_mapping(), "eye_file": s.eye_file("right").to_mapping()} for s in (mine, other))
    change = next(chain(differences(a, b, 0.0), differences(b, a, 0.0)), None)
    if change is not None:
        raise InputError(f"shows another scene: {change}", path=path)
    own = frames[image.row]
    if own.index != image.frame.index or own.pose != image.frame.pose:
        raise InputError("shows another frame", path=path)


_PICTURES: dict[str, Callable[[EyeImage], NDArray[Any]]] = {
    "images": attrgetter("counts"),
    "masks": attrgetter("parts"),
    "amodal_masks": attrgetter("rendered.labels.amodal"),
    "as_annotated": attrgetter("rendered.labels.annotated"),
    "noiseless": noiseless,
    "highlights": lambda image: np.asarray(image.rendered.highlights, np.uint8),
    "lens_reflections": attrgetter("lens_reflections"),
    "depth": attrgetter("rendered.geometry.depth"),
    "normals": attrgetter("rendered.geometry.normals"),
    "iris_coordinates": attrgetter("rendered.geometry.iris_coordinates"),
    "instances": attrgetter("rendered.geometry.instances"),
}
