"""Images in time: what extractors are told of the frame before, how late they are, and what they lose."""

from __future__ import annotations

import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eyerender.apps.benchmark.asking import ask_extractors
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.labelled import BenchImage
from eyerender.apps.benchmark.options import BenchOptions
from eyerender.apps.benchmark.recordings import in_time, pieces, previous
from eyerender.apps.benchmark.registry import ExtractorCommand
from eyerender.apps.benchmark.score import Score
from eyerender.optics.ellipse import Ellipse

COUNTS = """
    import json, sys
    print(json.dumps({"schema": "eyerender/extractor/1", "name": "counts", "reports": ["pupil"]}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        prior = request["hints"]["prior"]
        x = prior["centre_px"][0] + 1 if prior else 10
        pupil = {"status": "ok", "centre_px": [x, 20], "semi_axes_px": [9, 8], "angle_rad": 0}
        if x == 12 and request["id"] == 4:
            pupil = {"status": "missing", "reason": "blinked"}
        print(json.dumps({"id": request["id"], "record": {"pupil": pupil}}), flush=True)
"""


def test_an_extractor_is_told_the_pupil_that_it_found_last(drawn, tmp_path):
    """In two eyes' recordings by turns, and after a gap; whatever the number of processes, and across a lost frame."""
    script = tmp_path / "counts.py"
    script.write_text(textwrap.dedent(COUNTS))
    some = (load_labelled(drawn) * 12)[:12]
    times = [0.0, 0.0, 0.01, 0.01, 0.02, 0.02, 0.03, 0.03, 0.0, 0.0, 0.01, 0.01]
    images = [replace(i, recording="RL"[k % 2], time_s=t) for k, (i, t) in enumerate(zip(some, times, strict=True))]
    assert previous(images) == [None, None, 0, 1, 2, 3, 4, 5, None, None, 8, 9]
    assert pieces(previous(images), 4) == [range(8), range(8, 12)]
    command = ExtractorCommand("counts", "counts", (sys.executable, str(script)))
    for jobs in (1, 3):
        scores = ask_extractors([command], images, BenchOptions(jobs=jobs))[0].scores
        found = [None if s.ellipse is None else s.ellipse.centre_px[0] for s in scores]
        assert found == [10, 10, 11, 11, None, 12, 12, 13, 10, 10, 11, 11]


def moving(delay_s: float, count: int = 200) -> tuple[list[BenchImage], list[Score]]:
    """Return frames at 250 Hz of a pupil that jumps, and the answers of an extractor that is late."""
    times = np.arange(count) / 250.0

    def x(at):
        there, back = (np.clip((at % 0.4 - begin) / 0.04, 0.0, 1.0) for begin in (0.1, 0.3))
        return 100.0 + 30.0 * (there - back)

    images, scores = [], []
    for k, t in enumerate(times.tolist()):
        events = ("saccade",) if 0.1 <= t % 0.2 < 0.14 else ("fixation",)
        true = Ellipse(np.array([x(t), 50.0]), np.array([20.0, 18.0]), 0.0)
        images.append(BenchImage(name=str(k), path=Path(), bit_depth=8, size=(200, 100), pupil=true, conditions=events,
                                 recording="one", time_s=t))  # fmt: skip
        late = Ellipse(np.array([x(t - delay_s) + 0.3, 50.0]), np.array([20.0, 18.0]), 0.0)
        lost = k % 50 == 30
        scores.append(Score("none" if lost else "right", ellipse=None if lost else late, conditions=events))
    return images, scores


@pytest.mark.parametrize("delay_s", [0.0, 0.006])
def test_the_delay_of_a_filter_shows_around_saccades(delay_s):
    found = in_time(*moving(delay_s))
    assert found["delay_ms"] == pytest.approx(1e3 * delay_s, abs=0.6)
    assert (found["recordings"], found["frames"]) == (1, 200)
    assert sum(loss["lost"] for loss in found["loss"].values()) == 4
    assert in_time([replace(i, time_s=None) for i in moving(0.0)[0]], moving(0.0)[1]) is None
