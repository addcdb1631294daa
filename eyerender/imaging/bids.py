"""BIDS eye tracking (Brain Imaging Data Structure 1.11) of series of gaze: one recording for each eye.

    dataset_description.json, participants.tsv, participants.json, README.md
    sub-01/beh/sub-01_task-TASK_run-01_recording-eye1_physio.tsv.gz         samples of the right eye (eye2: left)
    sub-01/beh/sub-01_task-TASK_run-01_recording-eye1_physioevents.tsv.gz   what happens, from the truth
    sub-01/beh/sub-01_task-TASK_run-01_events.tsv                           the run, and in its JSON the screen

Tables in .tsv.gz have no header; the JSON beside each names its columns. Times are seconds. Gaze is in pixels from the
screen's upper left corner where the scene has a screen, else the azimuth (to the subject's left) and the elevation of
the line of sight in degrees. Missing values are `n/a`.
"""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.storage.files import write_bytes, write_json, write_text
from ..base.versions import __version__ as VERSION
from ..scene.events import has_event
from ..scene.observation import EYES
from .gazeseries import GazeSeries, gaze_series, runs
from .trace import Trace

BIDS_VERSION = "1.11.0"
EVENTS = {
    "fixation": "the eye fixates",
    "microsaccade": "a small saccade within a fixation",
    "saccade": "the eye jumps",
    "oscillation": "the pupil oscillates in the eye after a saccade",
    "pursuit": "the eye follows a moving target",
    "blink": "the lids move or are shut in a blink",
}
_ONSET = {"LongName": "Onset", "Description": "time of the first sample", "Units": "s"}
_DURATION = {"LongName": "Duration", "Description": "number of samples over their rate", "Units": "s"}


class Recording(NamedTuple):
    """Numbers of a participant and of a run, from 1, and the name of the task."""

    subject: int
    run: int
    task: str

    def stem(self) -> str:
        """Return the beginning of the names of its files, without the folder."""
        task = "".join(c for c in self.task if c.isalnum() and c.isascii()) or "eyes"
        return f"sub-{self.subject:02d}_task-{task}_run-{self.run:02d}"


def write_recording(root: Path, recording: Recording, eyes: Sequence[GazeSeries]) -> None:
    """Write the samples and events of a run.

    `root`: the folder of the dataset; `recording`: its numbers and task; `eyes`: series of one eye, or of both.
    """
    folder = root / f"sub-{recording.subject:02d}" / "beh"
    folder.mkdir(parents=True, exist_ok=True)
    stem = recording.stem()
    for series in eyes:
        name = f"{stem}_recording-eye{EYES.index(series.eye) + 1}"
        task = {"TaskName": recording.task}
        _write_table(folder / f"{name}_physio", _samples(series), task | _about_samples(series))
        _write_table(folder / f"{name}_physioevents", _events(series), task | _about_events())
    first = eyes[0]
    run = [[_number(first.time_s[0]), _number(len(first.time_s) / first.rate_hz), "viewing"]]
    write_text(folder / f"{stem}_events.tsv", _tsv([["onset", "duration", "trial_type"], *run]), sync=False)
    write_json(folder / f"{stem}_events.json", _about_run(first, recording.task), sync=False)


def write_dataset(root: Path, name: str, participants: Mapping[int, Mapping[str, Any]], licence: str | None) -> None:
    """Write the description of the dataset and its participants, whose columns are those of the first one."""
    description = {
        "Name": name,
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "raw",
        **({"License": licence} if licence else {}),
        "Authors": ["eyerender, a simulator"],
        "GeneratedBy": [{"Name": "eyerender", "Version": VERSION}],
    }
    write_json(root / "dataset_description.json", description, sync=False)
    columns = list(next(iter(participants.values())))
    rows = [[f"sub-{number:02d}", *(str(v) for v in one.values())] for number, one in sorted(participants.items())]
    write_text(root / "participants.tsv", _tsv([["participant_id", *columns], *rows]), sync=False)
    about = {column: {"Description": f"{column} of the simulated person in the dataset"} for column in columns}
    write_json(root / "participants.json", about, sync=False)


def write_trace(root: Path, trace: Trace, screen_px: tuple[int, int]) -> None:
    """Write a trace as a BIDS dataset of one participant. Raises InputError if several cameras see an eye."""
    eyes = [series for series, _ in gaze_series(trace, screen_px)]
    name = trace.scene.name
    write_recording(root, Recording(1, 1, name), eyes)
    write_dataset(root, name, {1: {"species": "homo sapiens"}}, None)
    tracker = trace.tracker
    text = (
        f"# {name}\n\nSimulated gaze of eyes with exact truth, made by eyerender {VERSION}: {tracker.rate:g} samples\n"
        f"per second, noise of {tracker.noise_deg:g} degrees, {tracker.loss:.1%} of the samples lost. Nobody was "
        "recorded.\n\n"
    )
    write_text(root / "README.md", text + (__doc__ or "").split("\n\n", 1)[1], sync=False)


def _samples(series: GazeSeries) -> list[list[str]]:
    """Return the rows of the samples."""
    lids = [series.lid_opening_mm] if np.isfinite(series.lid_opening_mm).any() else []
    columns = [series.time_s, *series.place.T, series.pupil_mm, *lids]
    return [[_number(value) for value in row] for row in zip(*(c.tolist() for c in columns), strict=True)]


def _about_samples(series: GazeSeries) -> dict[str, Any]:
    """Describe the samples of an eye."""
    display, unit = series.display, "deg" if series.display is None else "pixel"
    where = (
        ("azimuth of the line of sight, positive to the subject's left", "elevation of the line of sight, positive up")
        if display is None
        else ("x of the gaze, to the right from the screen's left edge", "y of the gaze, down from its upper edge")
    )
    columns: dict[str, Any] = {
        "timestamp": {"LongName": "Time", "Description": "time of the sample in the sequence", "Units": "s"},
        "x_coordinate": {"LongName": "Gaze position (x)", "Description": where[0], "Units": unit},
        "y_coordinate": {"LongName": "Gaze position (y)", "Description": where[1], "Units": unit},
        "pupil_size": {"LongName": "Pupil", "Description": "true diameter of the stop of the iris", "Units": "mm"},
    }
    if np.isfinite(series.lid_opening_mm).any():
        columns["lid_opening"] = {"LongName": "Lids", "Description": "true arc between the lids", "Units": "mm"}
    return {
        "SamplingFrequency": series.rate_hz,
        "StartTime": float(series.time_s[0]),
        "Columns": list(columns),
        "PhysioType": "eyetrack",
        "RecordedEye": series.eye,
        "SampleCoordinateSystem": "eye-in-head" if display is None else "gaze-on-screen",
        "EyeTrackingMethod": "simulated",
        "Manufacturer": "eyerender",
        "SoftwareVersions": VERSION,
        **columns,
    }


def _events(series: GazeSeries) -> list[list[str]]:
    """Return the rows of the events, in the order of their onsets."""
    found = []
    for word in EVENTS:
        for kind, first, last in runs(np.where(has_event(series.events, word), word, "").astype(object)):
            if kind:
                found.append((series.time_s[first], (last - first + 1) / series.rate_hz, word))
    return [[_number(onset), _number(duration), word] for onset, duration, word in sorted(found)]


def _about_events() -> dict[str, Any]:
    """Describe the events of an eye."""
    return {
        "Columns": ["onset", "duration", "trial_type"],
        "Description": "True events of the simulated eye; several may hold at a time",
        "OnsetSource": "timestamp",
        "onset": _ONSET,
        "duration": _DURATION,
        "trial_type": {"LongName": "Event", "Description": "what happens", "Levels": EVENTS},
    }


def _about_run(series: GazeSeries, task: str) -> dict[str, Any]:
    """Describe the run, and the screen that the gaze is on."""
    display, shown = series.display, dict[str, Any]()
    if display is not None:
        shown = {
            "ScreenDistance": float(np.linalg.norm(display.plane.centre_mm - series.origin_mm[0])) * 1e-3,
            "ScreenOrigin": ["top", "left"],
            "ScreenResolution": list(display.size_px),
            "ScreenSize": [side * 1e-3 for side in display.plane.size_mm],
            "SoftwareName": "none: nothing was shown to the simulated eye",
        }
    return {
        "TaskName": task,
        "TaskDescription": "A simulated person looks about, as the sequence of the scene says",
        "onset": _ONSET,
        "duration": _DURATION,
        "trial_type": {
            "LongName": "Trial",
            "Description": "what the eye does",
            "Levels": {"viewing": "it looks about"},
        },
        "StimulusPresentation": shown or {"ScreenDistance": "n/a", "ScreenResolution": "n/a", "ScreenSize": "n/a"},
    }


def _write_table(path: Path, rows: Sequence[Sequence[str]], about: Mapping[str, Any]) -> None:
    """Write a table without header, and the JSON beside it."""
    write_bytes(path.with_name(path.name + ".tsv.gz"), gzip.compress(_tsv(rows).encode(), 6, mtime=0), sync=False)
    write_json(path.with_name(path.name + ".json"), about, sync=False)


def _tsv(rows: Iterable[Sequence[str]]) -> str:
    return "".join("\t".join(row) + "\n" for row in rows)


def _number(value: float) -> str:
    """Write a number with six digits after the point, which are microseconds, or n/a."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if np.isfinite(value) else "n/a"
