"""From sample i to a scene with its analytic observations; a sample that cannot be made is drawn again by a fixed rule.

Attempt a of sample i draws every random value of the sample again. Grids and sequences stay, because they are the
design; a Sobol draw becomes a random one; the subject's identity stays. The first attempt that can be made is the
sample. After `attempts` of them, or at once where nothing random is left to draw, the sample is given up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..analytic.observer import trace
from ..arrays import Bools, Floats
from ..capture import check_windows
from ..errors import InputError
from ..observation import Observations
from ..rig.camera import Window
from ..scene import Frames, Scene
from .plan import Plan, Sample


@dataclass(frozen=True, slots=True)
class Rejection:
    """A failed attempt and its reason; it concerns the sample, or its subject's identity."""

    sample: int
    attempt: int
    reason: str
    of: str = "sample"


@dataclass(frozen=True)
class Realised:
    """A sample with its analytic observations; `sample` is None where it was given up."""

    index: int
    sample: Sample | None
    frames: Frames | None
    observations: Observations | None
    rejections: tuple[Rejection, ...]

    @property
    def scene(self) -> Scene | None:
        """The sample's scene."""
        return None if self.frames is None else self.frames.scene


def realise(plan: Plan, index: int, frames: int | None = None) -> Realised:
    """Make sample `index` by the first attempt that succeeds.

    `frames` is the number of frames that each sample must have.
    """
    spec = plan.spec
    subject, sequence = plan.subject_of(index)
    rejections: list[Rejection] = []
    try:
        reasons = plan.identity(subject)[1]
    except InputError as error:
        return Realised(index, None, None, None, (Rejection(index, 0, str(error), "subject"),))
    if sequence == 0:
        rejections += [Rejection(index, k, reason, "subject") for k, reason in enumerate(reasons)]
    last = None
    for attempt in range(spec.attempts):
        sample = plan.draw(index, attempt)
        if last is not None and sample.draws == last.draws:
            break
        last = sample
        try:
            scene = sample.build()
            check_windows(scene)
            posed = scene.frames()
            found = trace(posed, boundary_points=spec.labels.boundary_points)
            count = int(found.index.frame.max()) + 1
            if frames is not None and count != frames:
                raise InputError(f"has {count} frames, sample 0 has {frames}")
            if spec.require == "pupil":
                _require_pupils(scene, found)
        except InputError as error:
            reason = f"{error.path}: {error.reason}" if error.path else error.reason
            rejections.append(Rejection(index, attempt, reason))
            continue
        return Realised(index, sample, posed, found, tuple(rejections))
    return Realised(index, None, None, None, tuple(rejections))


def frames_of(plan: Plan) -> int:
    """Number of frames of each sample, from sample 0.

    Raises:
        InputError: sample 0 cannot be made at all.
    """
    first = realise(plan, 0)
    if first.observations is None:
        reason = first.rejections[-1].reason if first.rejections else "no reason known"
        raise InputError(f"sample 0 cannot be made ({len(first.rejections)} attempts): {reason}", source=plan.source)
    return int(first.observations.index.frame.max()) + 1


def windows_of(scene: Scene, observations: Observations) -> list[Window]:
    """Rendered window of each observation."""
    index, windows = observations.index, scene.windows()
    return [windows[int(index.camera[r]), int(index.head[r]), int(index.eye[r])] for r in range(len(observations))]


def _require_pupils(scene: Scene, found: Observations) -> None:
    for row, (x0, y0, w, h) in enumerate(windows_of(scene, found)):
        if not found.pupil.ok[row]:
            raise InputError(f"no apparent pupil: {found.pupil.reason[row]}")
        inside = _inside(found.pupil.points_px[row], x0, y0, w, h)
        if not inside.all():
            raise InputError("the apparent pupil leaves the window")


def _inside(xy: Floats, x0: int, y0: int, w: int, h: int) -> Bools:
    x, y = xy[:, 0], xy[:, 1]
    return np.asarray((x >= x0 - 0.5) & (x <= x0 + w - 0.5) & (y >= y0 - 0.5) & (y <= y0 + h - 0.5))
