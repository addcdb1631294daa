#!/usr/bin/env python3
"""Bench of eyes in time: what an event detector finds in drawn gaze, and what frames of a sequence cost.

    bench_sequences.py [--quick] [--json F] [--remodnav PYTHON]

`--remodnav` names a Python that has REMoDNaV 1.1.2 (Dar, Wagner and Hanke 2021, Behav. Res. Methods 53, 399-414), in an
environment of its own; without it, its rows are left out. Its F1 counts saccades of at least a degree.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from typing import Any

from _bench import Report, Row, options_of, row, single_threaded

single_threaded()

import numpy as np

import eyerender as er
from eyerender.imaging.asc import asc_text
from eyerender.scene.observation import correlated
from eyerender.scene.sequence.course import MovingEyes
from eyerender.scene.sequence.habits import Habits
from eyerender.scene.sequence.spec import Sequence

LASTING_S = 30.0
DETECT = """
import json, sys
import numpy as np, remodnav
rate, files = float(sys.argv[1]), sys.argv[2:]
found = []
for name in files:
    data = np.load(name)
    gaze = np.rec.fromarrays([data[:, 0], data[:, 1]], names="x,y")
    classifier = remodnav.EyegazeClassifier(px2deg=1.0, sampling_rate=rate)
    events = classifier(classifier.preproc(gaze, savgol_length=0.019), classify_isp=True, sort_events=True)
    kept = [event for event in events if event["label"] in ("SACC", "ISAC")]
    found.append([[int(e["start_time"] * rate), int(e["end_time"] * rate)] for e in kept])
print(json.dumps(found))
"""


def aimed(targets_mm: Any, head_mm: Any, _torsion_rad: Any, eye: int) -> Any:
    """Turn a simple eye towards targets."""
    gap = targets_mm - head_mm - np.array([0.0, 31.5 if eye else -31.5, 0.0])
    return np.arctan2(gap[:, 1], gap[:, 0]), np.arctan2(gap[:, 2], np.hypot(gap[:, 0], gap[:, 1]))


def eyes_of(person: int, oscillation: bool) -> MovingEyes:
    """Return the moving eyes of a person who looks around."""
    gaze = {"oscillation": oscillation, "microsaccades_per_s": 0}
    keys = {"seed": person, "duration_s": LASTING_S, "lids": {"blinks_per_minute": 0}, "pupil": {"hippus": 0}}
    return MovingEyes.of(Sequence.from_mapping({**keys, "gaze": gaze}), aimed, Habits.drawn((person,)), np.full(2, 4.0))


def detected(
    python: str, rate: int, people: int, *, oscillation: bool, noise_deg: float = 0.0, kind: float = 1.414
) -> float:
    """Return the F1 of saccades that REMoDNaV finds in traces."""
    with tempfile.TemporaryDirectory() as folder:
        files, truth = [], []
        for person in range(people):
            states = eyes_of(person, oscillation).at(np.arange(int(LASTING_S * rate)) / rate)
            gaze = np.degrees(np.stack([states.azimuth_rad[:, 0], states.elevation_rad[:, 0]], axis=-1))
            if oscillation:
                gaze = gaze + 12.0 * states.stop_shift_mm[:, 0]
            white = np.random.default_rng(person).standard_normal(gaze.shape)
            files.append(f"{folder}/{person}.npy")
            np.save(files[-1], gaze + noise_deg / kind * correlated(white, kind))
            edges = np.flatnonzero(np.diff(np.concatenate([[0], states.events[:, 2].astype(int), [0]])))
            truth.append((gaze, edges.reshape(-1, 2).tolist()))
        out = subprocess.run([python, "-c", DETECT, str(rate), *files], capture_output=True, text=True, check=True)
    right = wrong = missed = 0
    for (gaze, own), found in zip(truth, json.loads(out.stdout.splitlines()[-1]), strict=True):
        large = [(a, b) for a, b in own if np.linalg.norm(gaze[b - 1] - gaze[a]) >= 1.0]
        used: set[int] = set()
        for a, b in large:
            hit = next((k for k, (x, y) in enumerate(found) if k not in used and min(b, y) > max(a, x)), None)
            right, missed = (right + 1, missed) if hit is not None else (right, missed + 1)
            used |= set() if hit is None else {hit}
        rest = [pair for k, pair in enumerate(found) if k not in used]
        wrong += sum(int(np.linalg.norm(gaze[min(y, len(gaze) - 1)] - gaze[x]) >= 1.0) for x, y in rest)
    return 2 * right / (2 * right + wrong + missed)


def detector(python: str, quick: bool) -> list[Row]:
    """F1 of an event detector, without and with oscillation and noise."""
    people, rows = (2 if quick else 8), []
    for rate in (500, 1000):
        value = detected(python, rate, people, oscillation=False)
        rows.append(row(f"REMoDNaV, {rate} Hz, drift alone", value, "F1", must=0.95, at_least=True))
        value = detected(python, rate, people, oscillation=True)
        rows.append(row(f"REMoDNaV, {rate} Hz, with oscillation", value, "F1"))
    for noise in (0.02, 0.2):
        for kind in (0.5, 1.0, 1.414):
            value = detected(python, 1000, people, oscillation=False, noise_deg=noise, kind=kind)
            rows.append(row(f"REMoDNaV, 1000 Hz, RMS-S2S {noise:g} deg, over SD {kind:g}", value, "F1"))
    return rows


def scene_of(**sequence: Any) -> Any:
    """Return the shipped headset with a sequence."""
    scene = er.load_scene("headset").with_({"rig.cameras.0.frame_rate_hz": 100.0, "image.spp": 4})
    data = {k: v for k, v in scene.spec.to_mapping().items() if k not in ("targets", "poses")}
    data["image"] = {**data["image"], "window_px": [320, 240]}
    return er.Scene.of(er.SceneSpec.from_mapping({**data, "sequence": sequence}))


def rolling(renderer: Any) -> float:
    """CPU time of frames that an eye crosses at 500 deg/s while rows are read for 10 ms, relative to a still eye."""
    times = []
    for speed, count in ((0.0, 8), (500.0, 3)):
        ends = [-0.05, 0.15]
        gaze = {"time_s": ends, "azimuth_deg": [speed * (t - 0.03) for t in ends], "elevation_deg": [0.0, 0.0]}
        scene = scene_of(duration_s=0.1, gaze=gaze, lids={"blinks_per_minute": 0}, pupil={"hippus": 0}).with_(
            {"rig.cameras.0.shutter": {"rolling": {"row_us": 10e3 / 480}}, "image.spp": 16, "sensor.exposure_ms": 4.0}
        )
        frames = scene.frames().take(slice(1, 1 + count))
        for _ in range(3):  # a kernel is compiled by its first call and recorded by the second one
            before = time.process_time()
            list(er.render_windows(frames, renderer=renderer))
        times.append((time.process_time() - before) / count)
    return times[1] / times[0]


def costs(quick: bool) -> list[Row]:
    """CPU time of frames relative to single frames, and of a trace."""
    still = {"time_s": [0.0], "azimuth_deg": [3.0], "elevation_deg": [0.0]}
    quiet = {"duration_s": 1.0, "gaze": still, "lids": {"blinks_per_minute": 0}}
    own = scene_of(**quiet, pupil={"hippus": 0})
    count = 6 if quick else 20
    renderer = None
    times: dict[str, float] = {}
    single = own.with_(gaze_deg=[[3.0, 0.0]] * count).frames()
    many = {
        "single": single,
        "fixed": own.frames()[:count],
        "pupil": scene_of(**quiet, pupil={"hippus": 0.05}).frames()[:count],
    }
    from eyerender.imaging.capture import make_renderer

    renderer = make_renderer()
    for frames in many.values():
        list(er.render_windows(frames.take(slice(0, 2)), renderer=renderer))
    for name, frames in many.items():
        before = time.process_time()
        list(er.render_windows(frames, renderer=renderer))
        times[name] = time.process_time() - before
    rows = [
        row("CPU of a frame, pupil fixed / single frame", times["fixed"] / times["single"], "ratio", must=1.05),
        row("CPU of a frame, pupil moving / fixed", times["pupil"] / times["fixed"], "ratio", must=1.2),
    ]
    rows.append(
        row("CPU of a frame, rolling shutter of 10 ms at 500 deg/s / still", rolling(renderer), "ratio", must=4.0)
    )
    desktop = er.load_scene("eyelink_desktop").spec.to_mapping()
    data = {k: v for k, v in desktop.items() if k not in ("targets", "poses")}
    data["subject"] = {**data.get("subject", {}), "eyes": ["right", "left"]}
    scene = er.Scene.of(er.SceneSpec.from_mapping({**data, "sequence": {"duration_s": 10.0, "gaze": {"grid": [3, 3]}}}))
    before = time.process_time()
    trace = er.sample_sequence(scene, er.Tracker(rate=1000.0))
    sampled = time.process_time() - before
    for name, write in (
        ("table", lambda: list(trace.rows())),
        ("EyeLink's text", lambda: asc_text(trace, (1920, 1080))),
    ):
        before = time.process_time()
        write()
        rows.append(
            row(f"10 s at 1,000 Hz, both eyes: {name}", sampled + time.process_time() - before, "CPU s", aim=2.0)
        )
    return rows


def main() -> int:
    parser = options_of(__doc__, "fewer frames and people")
    parser.add_argument("--remodnav", metavar="PYTHON", help="a Python that has REMoDNaV")
    options = parser.parse_args()
    report = Report()
    report.extend(costs(options.quick))
    if options.remodnav:
        report.extend(detector(options.remodnav, options.quick))
    return report.finish(options.json, ["numpy", "mitsuba"])


if __name__ == "__main__":
    sys.exit(main())
