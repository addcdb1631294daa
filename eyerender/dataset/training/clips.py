"""Clips of a folder of sequences: which images follow each other, and what happens in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats, Ints
from ...base.errors import InputError
from ...folders.imagefolder import ImageFolder
from ...scene.observation import EYES

KINDS_OF_CLIPS = ("blink", "saccade", "slippage")
_SLIPS_MM, _SLIPS_RAD = 0.05, 1e-3  # motion of the rig within a clip that counts as slippage


@dataclass(frozen=True, slots=True, eq=False)
class Clips:
    """Windows of `frames` images of one camera at one person, `stride` frames apart, in order of time."""

    rows: Ints  # (n, eyes, frames) rows of the folder's images; the eyes are right and left, or one
    kinds: Bools  # (n, 3) whether a clip has each of `KINDS_OF_CLIPS`

    @classmethod
    def of(cls, folder: ImageFolder, rows: Ints, *, frames: int, stride: int, both_eyes: bool) -> Clips:
        """Find the clips among some rows of a folder.

        Raises:
            InputError: a number is below 1, or the folder has no such clip.
        """
        for name, value in (("frames", frames), ("stride", stride)):
            if value < 1:
                raise InputError(f"must be >= 1, not {value}", path=name)
        series = _series(folder, rows, both_eyes)
        found, kinds = [], []
        for one in series:
            for last in range((frames - 1) * stride, len(one.moment)):
                at = last - stride * np.arange(frames - 1, -1, -1)
                if one.moment[last] - one.moment[at[0]] == (frames - 1) * stride:
                    found.append(one.rows[:, at])
                    kinds.append(one.kinds(at))
        if not found:
            raise InputError(f"has no clip of {frames} frames", source=str(folder.path))
        return cls(np.array(found, dtype=np.int64), np.array(kinds, dtype=bool))

    def __len__(self) -> int:
        return len(self.rows)

    def shares(self) -> dict[str, float]:
        """Return the share of clips of each kind."""
        return dict(zip(KINDS_OF_CLIPS, self.kinds.mean(axis=0).tolist(), strict=True))

    def weights(self, of_kinds: Mapping[str, float]) -> Floats:
        """Return the weight (n,) of each clip: the product of the weights of its kinds.

        Raises:
            InputError: a kind is unknown, or a weight is negative.
        """
        out = np.ones(len(self))
        for kind, weight in of_kinds.items():
            if kind not in KINDS_OF_CLIPS:
                raise InputError(f"must be one of {', '.join(KINDS_OF_CLIPS)}", path=kind)
            if not 0 <= weight < np.inf:
                raise InputError(f"must be >= 0, not {weight}", path=kind)
            out[self.kinds[:, KINDS_OF_CLIPS.index(kind)]] *= weight
        return out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Recording:
    """Images of one camera in one recording: moments (n,), rows (eyes, n), and what happens in them."""

    moment: Ints
    rows: Ints
    blink: Bools
    saccade: Bools
    rig: Floats

    def kinds(self, at: Ints) -> list[bool]:
        """Return which of `KINDS_OF_CLIPS` the images `at` show."""
        spread = np.ptp(self.rig[at], axis=0) if len(at) else np.zeros(6)
        slips = bool((spread[:3] > _SLIPS_RAD).any() or (spread[3:] > _SLIPS_MM).any())
        return [bool(self.blink[at].any()), bool(self.saccade[at].any()), slips]


def _series(folder: ImageFolder, rows: Ints, both_eyes: bool) -> list[_Recording]:
    """Collect the images of each camera and recording, in order of time."""
    found: dict[tuple[Any, ...], dict[int, dict[str, tuple[int, dict[str, Any]]]]] = {}
    for row in rows.tolist():
        line = folder.entries[row].line
        record = line["records"][0]
        if record["events"] is None or line["instant"] is None:
            raise InputError("has images that are no frames of a sequence", source=str(folder.path))
        own = () if both_eyes else (record["eye"],)
        # The moments of a clip of a dataset follow each other; those of the next clip begin at a time of 0 again.
        found.setdefault((line["subject"], record["camera"], *own), {}).setdefault(int(line["instant"]), {})[
            record["eye"]
        ] = (row, record)
    return [one for images in found.values() for one in _recordings(images)]


def _recordings(images: Mapping[int, Mapping[str, tuple[int, dict[str, Any]]]]) -> list[_Recording]:
    """Divide the images of a camera where time begins anew."""
    eyes = [eye for eye in EYES if any(eye in seen for seen in images.values())]
    moments = [moment for moment in sorted(images) if all(eye in images[moment] for eye in eyes)]
    times = np.array([images[moment][eyes[0]][1]["time_s"] for moment in moments])
    parts = np.split(np.array(moments, dtype=np.int64), np.flatnonzero(np.diff(times) <= 0) + 1)
    return [_one(images, eyes, part) for part in parts if len(part)]


def _one(images: Mapping[int, Mapping[str, Any]], eyes: Sequence[str], moments: Ints) -> _Recording:
    seen = [[images[moment][eye] for moment in moments.tolist()] for eye in eyes]
    events = [[set(record["events"]) for _, record in one] for one in seen]
    poses = [record["rig_pose"] or {"rotation_rad": [0.0] * 3, "translation_mm": [0.0] * 3} for _, record in seen[0]]
    return _Recording(
        moment=moments,
        rows=np.array([[row for row, _ in one] for one in seen]),
        blink=np.array([any("blink" in one[k] for one in events) for k in range(len(moments))]),
        saccade=np.array([any("saccade" in one[k] for one in events) for k in range(len(moments))]),
        rig=np.array([[*pose["rotation_rad"], *pose["translation_mm"]] for pose in poses]),
    )
