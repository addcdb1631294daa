"""From sample i to a scene with its analytic observations; a failed sample is drawn again by a fixed rule.

Attempt a of sample i draws every random value of the sample again. Grids and sequences stay, because they are the
design; a Sobol draw becomes a random one; the subject's identity stays. The first attempt that succeeds is the sample.
After `attempts` failures, or at once if nothing random is left to draw, the sample is given up.

`sample_line` gives the metadata of one image of a sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..analytic.observer import trace
from ..base.arrays import finite_or_none
from ..base.errors import EyerenderError, InputError, InputWarning
from ..folders.outfolder import refuse_non_empty
from ..imaging.capture import check_windows
from ..imaging.lines import image_line
from ..rig.camera import Window, beyond_window
from ..scene import Frames, Scene
from ..scene.observation import EYES, Observations
from .plan import Plan, Sample, is_function
from .spec import DatasetSpec


@dataclass(frozen=True, slots=True)
class Rejection:
    """A failed attempt and its reason, which lies in the sample or in its subject's identity."""

    sample: int
    attempt: int
    reason: str
    of: str = "sample"


@dataclass(frozen=True, kw_only=True)
class Realised:
    """A sample with its analytic observations; `sample` is None if it was given up, and `error` why."""

    index: int
    sample: Sample | None = None
    frames: Frames | None = None
    observations: Observations | None = None
    rejections: tuple[Rejection, ...]
    error: InputError | None = None
    source: str = ""

    @property
    def scene(self) -> Scene | None:
        """Scene of the sample."""
        return None if self.frames is None else self.frames.scene

    def exposed(self, exposure_ms: float) -> Realised:
        """Return the sample with another exposure time, and with the gain that its scene has set."""
        assert self.sample is not None
        assert self.scene is not None
        tree, gain = self.sample.scene, self.scene.spec.sensor.gain_dn_per_e
        sensor = {**tree.get("sensor", {}), "exposure_ms": exposure_ms}
        sensor |= {} if gain is None else {"gain_dn_per_e": gain}
        sample = replace(self.sample, scene={**tree, "sensor": sensor})
        return replace(self, sample=sample, frames=sample.build().frames())

    def warnings(self) -> list[InputWarning]:
        """Return probable mistakes in the scene (see `Scene.warnings`)."""
        return [] if self.scene is None else [warning.at(self.source) for warning in self.scene.warnings()]

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the mapping that `sample --json` writes: schema eyerender/sample/1."""
        drawn = {} if self.sample is None else self.sample.to_mapping()
        rejections = [f"{r.of}, attempt {r.attempt}: {r.reason}" for r in self.rejections]
        return {"schema": "eyerender/sample/1", **drawn, "rejections": rejections}

    def write(self, path: str | Path) -> None:
        """Write scene.yaml and eye.yaml of the sample into a new folder, as input of other commands.

        If a person was drawn, scene.yaml describes the person and its eyes, and there is no eye.yaml.

        Raises:
            InputError: the sample was given up, or the folder is not empty.
            EyerenderError: the folder cannot be written.
        """
        if self.scene is None:
            raise InputError(f"sample {self.index} was given up: {self.rejections[-1].reason}")
        folder = Path(path)
        refuse_non_empty(folder, False)
        spec = self.scene.located()
        drawn = spec.person is not None
        if not drawn:
            spec = spec.model_copy(update={"eye": spec.eye.named("eye.yaml")})
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not drawn:
                self.scene.eye_spec.dump(folder / "eye.yaml")
            spec.dump(folder / "scene.yaml")
        except OSError as error:
            raise EyerenderError(f"{folder}: cannot be written ({error.strerror or error})") from None


def sample(
    spec: str | Path | DatasetSpec | Plan, index: int, *, eye: str | None = None, seed: int | None = None
) -> Realised:
    """Draw sample `index`, from 0, of a dataset as `generate` does: values, scene and analytic observations.

    >>> er.sample("dataset_quick", 0).scene.spec.image.spp
    4

    Raises:
        InputError: there is no such sample, or it was given up.
    """
    plan = Plan.load(spec, eye=eye, seed=seed, count=max(index, 0) + 1 if is_function(spec) else None)
    end = plan.spec.selection.end
    if not 0 <= index < end:
        name = spec if isinstance(spec, str | Path) else plan.spec.name
        raise InputError(
            f"must be 0 to {end - 1}, not {index}: {name} has {end} samples; "
            "choose one of them, or raise 'count' in the spec",
            source="I",
        )
    found = realise(plan, index)
    if found.sample is None:
        raise InputError(f"sample {index} was given up: {found.rejections[-1].reason}", source=plan.source)
    return replace(found, source=plan.source)


def realise(plan: Plan, index: int, frames: int | None = None) -> Realised:
    """Draw sample `index` by the first attempt that succeeds.

    `frames` is the number of frames required of each sample.
    """
    spec = plan.spec
    subject, sequence = plan.subject_of(index)
    rejections: list[Rejection] = []
    try:
        reasons = plan.identity(subject)[1]
    except InputError as error:
        return Realised(index=index, rejections=(Rejection(index, 0, str(error), "subject"),), error=error)
    if sequence == 0:
        rejections += [Rejection(index, k, reason, "subject") for k, reason in enumerate(reasons)]
    last, failed = None, None
    for attempt in range(spec.attempts):
        try:
            sample = plan.draw(index, attempt)
        except InputError as error:
            if plan.scenes is None and spec.population is None:
                raise
            failed = error
            rejections.append(Rejection(index, attempt, str(error)))
            if plan.scenes is not None and not plan.scenes.takes_attempt:
                break
            continue
        if last is not None and not _drawn_again(plan, last, sample):
            break
        last = sample
        try:
            posed, found = _observed(plan, sample, frames)
        except InputError as error:
            failed = error
            reason = f"{error.path}: {error.reason}" if error.path else error.reason
            rejections.append(Rejection(index, attempt, reason))
            continue
        return Realised(index=index, sample=sample, frames=posed, observations=found, rejections=tuple(rejections))
    return Realised(index=index, rejections=tuple(rejections), error=failed)


def _observed(plan: Plan, sample: Sample, frames: int | None) -> tuple[Frames, Observations]:
    """Trace a sample that was drawn; InputError if its scene is not as the dataset requires."""
    scene = sample.build()
    check_windows(scene)
    posed = scene.frames()
    found = trace(posed, boundary_points=plan.spec.labels.boundary_points, occluded=False)
    count = scene.frame_count
    if frames is not None and count != frames:
        raise InputError(f"has {count} frames, sample 0 has {frames}")
    if plan.spec.require == "pupil" and scene.spec.sequence is None:
        _require_pupils(scene, found)
    return posed, found


def _drawn_again(plan: Plan, last: Sample, sample: Sample) -> bool:
    """Whether an attempt may differ from the last one."""
    return last.draws != sample.draws if plan.scenes is None else plan.scenes.takes_attempt


def frames_of(plan: Plan) -> int:
    """Return the number of frames of each sample, from sample 0; InputError if sample 0 cannot be made at all."""
    first = realise(plan, 0)
    if first.scene is None:
        last = first.rejections[-1].reason if first.rejections else "no reason known"
        more = () if first.error is None else first.error.others
        others = [InputError(other.reason, source=plan.source, path=f"scene.{other.path}") for other in more]
        reason = f"sample 0 cannot be made ({len(first.rejections)} attempts): {last}"
        raise InputError(reason, source=plan.source, others=others)
    return first.scene.frame_count


def windows_of(scene: Scene, observations: Observations) -> list[Window]:
    """Return the rendered window (x0, y0, width, height) of each observation."""
    index, windows = observations.index, scene.windows()
    return [windows[int(index.camera[r]), int(index.head[r]), int(index.eye[r])] for r in range(len(observations))]


def _require_pupils(scene: Scene, found: Observations) -> None:
    index = found.index
    for row, window in enumerate(windows_of(scene, found)):
        camera = int(index.camera[row])
        who = f"the {EYES[index.eye[row]]} eye in camera {camera} ({scene.rig.cameras[camera].name}), frame "
        who += str(index.frame[row])
        if not found.pupil.ok[row]:
            raise InputError(f"no apparent pupil of {who}: {found.pupil.reason[row]}")
        beyond = beyond_window(window, found.pupil.points_px[row])
        if beyond > 0:
            raise InputError(f"the apparent pupil of {who}, leaves the window by {beyond:.1f} px")


def image_name(sample: int, frame: int, frames: int, side: str) -> str:
    """Return the name of an image without suffix; `frame` counts within the sample, which has `frames` frames."""
    return f"{sample:08d}-{f'{frame:03d}-' if frames > 1 else ''}{side}"


def sample_line(
    found: Realised, row: int, frames: int, window: Window, labels: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return name and metadata, without the names of its files, of observation `row` of a sample.

    `frames` is the number of frames per sample.
    """
    sample, scene, observations = found.sample, found.scene, found.observations
    assert sample is not None
    assert scene is not None
    assert observations is not None
    turn = sample.turn
    (record,) = observations.take([row]).records()
    # Numbers of frames and instants are unique in the whole dataset.
    instants = frames // len(scene.rig.cameras)
    frame, instant, side = record["frame"] % frames, record["instant"] % instants, record["eye"]
    exposed = scene.spec.sensor.model_dump(include={"exposure_ms", "gain_dn_per_e"}, exclude_none=True)
    record |= {
        "frame": turn.sample * frames + frame,
        "instant": turn.sample * instants + instant,
        "subject": turn.subject,
    }
    line = image_line(
        scene,
        record,
        window,
        labels,
        sample={
            "sample": turn.sample,
            "split": sample.split,
            "sequence_index": turn.sequence,
            "timestamp_s": finite_or_none(observations.index.timestamp_s[row]),
        },
        drawn={"attempt": turn.attempt, "subject_attempt": turn.subject_attempt, "draws": sample.draws},
        tree={**sample.scene, "sensor": {**sample.scene.get("sensor", {}), **exposed}},
        eye=sample.eye or None,
    )
    return image_name(turn.sample, frame, frames, side), line
