"""Films without labels: how much the answers of an extractor jitter from frame to frame."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import InputError
from ...folders.imagefile import image_files
from ...folders.video import is_video, unpacked
from .asking import ExtractorResults
from .folder import hinted, with_gamma
from .labelled import BenchImage
from .score import Score

FILM_SCHEMA = "eyerender/bench-film/1"
COLUMNS = ("centre_x_px", "centre_y_px", "semi_axis_a_px", "semi_axis_b_px", "angle_rad")


def load_film(path: Path, gamma: float | None) -> list[BenchImage]:
    """Return the frames of a video, of the one in a folder, or the images of a folder in the order of their names.

    Numbers in names are ordered by value. A hints.json in the folder of the frames is used. Raises InputError if there
    are fewer than three frames, or several videos.
    """
    folder = path if path.is_dir() else path.parent
    videos = sorted(p for p in path.iterdir() if is_video(p)) if path.is_dir() else [path]
    if len(videos) > 1:
        raise InputError(f"holds {len(videos)} videos; give one at a time", source=str(path))
    files = unpacked(videos[0]) if videos else [path / name for name in sorted(image_files(path), key=_by_value)]
    if len(files) < 3:
        raise InputError(f"has {len(files)} frames; jitter needs at least three", source=str(path))
    images = hinted(folder, (BenchImage.read(file.name, file, None) for file in files), None)
    return [with_gamma(image, gamma) for image in images]


def _by_value(name: str) -> list[Any]:
    """Return the texts and numbers of a name by turns."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", name))]


def jitter(second: Floats) -> float | None:
    """Compute the noise of a value from frame to frame from its second differences d (n, ...); None if n is 0.

    d_i = v_(i-1) - 2 v_i + v_(i+1), sigma = 1.4826 median |d| / sqrt(6)

    Independent errors of standard deviation sigma give d one of sqrt(1 + 4 + 1) sigma; 1.4826 is the ratio of standard
    deviation and median absolute value of a normal distribution. A steady change gives d = 0, and the median ignores
    saccades, which are rare.
    """
    return 1.4826 * float(np.median(np.abs(second))) / math.sqrt(6.0) if len(second) else None


def film_results(runs: Sequence[ExtractorResults]) -> dict[str, Any]:
    """Return what each extractor found, with its jitter over the triples of frames in all of which it found a pupil.

    `common` is the jitter over those in which all extractors did that have any.
    """
    second = [np.diff(_shapes(run.scores), 2, axis=0) for run in runs]
    own = [np.isfinite(d).all(axis=1) for d in second]
    common = np.logical_and.reduce([one for one in own if one.any()] or own)
    entries = [
        {
            "name": run.extractor.name,
            "given": run.extractor.given,
            "says": run.greeting.name if run.greeting else None,
            "summary": {
                "found": sum(s.ellipse is not None for s in run.scores),
                "errors": sum(s.outcome == "error" for s in run.scores),
                "jitter": _jitters(d[counted]),
                "common": _jitters(d[common & counted]),
            },
        }
        for run, d, counted in zip(runs, second, own, strict=True)
    ]
    return {"schema": FILM_SCHEMA, "extractors": entries}


def film_row(run: ExtractorResults, score: Score) -> dict[str, Any]:
    """Return one line of results.csv: the answer of an extractor for a frame."""
    numbers = [None] * 5 if score.ellipse is None else score.ellipse.numbers()
    told = {"extractor": run.extractor.name, "image": score.image, "reason": score.reason}
    return told | dict(zip(COLUMNS, numbers, strict=True)) | {"confidence": score.confidence}


def _shapes(scores: Sequence[Score]) -> Floats:
    """Return centre and radius sqrt(a b) of each frame (n, 3), px; NaN where no pupil was found."""
    found = [s.ellipse for s in scores]
    return np.array([(np.nan,) * 3 if e is None else (*e.centre_px, np.sqrt(e.semi_axes_px.prod())) for e in found])


def _jitters(second: Floats) -> dict[str, Any]:
    return {"triples": len(second), "centre_px": jitter(second[:, :2]), "radius_px": jitter(second[:, 2])}
