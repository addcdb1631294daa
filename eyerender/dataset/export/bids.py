"""BIDS eye tracking (1.11): the true gaze of each person and recording, one table for each eye, and no pictures.

    dataset_description.json, participants.tsv, participants.json
    sub-01/beh/sub-01_task-NAME_run-01_recording-eye1_physio.tsv.gz         the right eye (eye2: the left one)
    sub-01/beh/sub-01_task-NAME_run-01_recording-eye1_physioevents.tsv.gz   what happens
    sub-01/beh/sub-01_task-NAME_run-01_events.tsv                           the run, and in its JSON the screen

Tables in .tsv.gz have no header; the JSON beside each names its columns. Times are seconds, one row for each frame of
the first camera that sees the eye. Gaze is where the line of sight meets the screen, in pixels from its upper left
corner, or without a screen the azimuth (to the subject's left) and the elevation of the line of sight, in degrees. Gaze
and pupil are `n/a` while under a tenth of the pupil shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...base.storage.files import write_text
from ...folders.exported import EXPORT
from ...imaging.bids import Recording, write_dataset, write_recording
from ...imaging.gazeseries import Display, GazeSeries, places_of, screen_warnings
from ...rig.screen import Screen
from .item import Items
from .recordings import Moment, Recordings, moment_of


def write(items: Items, out: Path) -> None:
    """Write the recordings of every person."""
    counter, participants = Recordings(), dict[int, dict[str, Any]]()
    current: dict[tuple[int, str], list[Moment]] = {}
    key: tuple[int, int] | None = None

    def finish() -> None:
        if key is None:
            return
        first = {eye: min(camera for camera, side in current if side == eye) for _, eye in current}
        series = [_series(current[camera, eye], items.screen_px) for eye, camera in first.items()]
        for one in series:
            items.warn([] if one.display is None else screen_warnings(one.display.plane, items.screen_px))
        write_recording(out, Recording(key[0] + 1, key[1], items.name), series)
        current.clear()

    for moment in items.map(moment_of):
        own = moment.subject, counter.number(moment)
        if own != key:
            finish()
            key = own
            participants.setdefault(moment.subject + 1, {"subject": moment.subject, "split": moment.split})
        current.setdefault((moment.camera, moment.eye), []).append(moment)
    finish()
    write_dataset(out, items.name, participants, items.licence)
    write_text(out / ".bidsignore", f"{EXPORT}\n", sync=False)


def _series(moments: Sequence[Moment], screen_px: tuple[int, int]) -> GazeSeries:
    """Return the series of one eye in one recording."""
    first = moments[0]
    screen = first.screen
    display = None if screen is None else Display(Screen.from_mapping(screen).build(), screen_px)
    origin = np.array([one.sight_mm for one in moments])
    direction = np.array([one.sight for one in moments])
    shown = np.array([one.shown for one in moments])
    _, _, stop, lids, events, _ = zip(*(one.truth for one in moments), strict=True)
    return GazeSeries(
        eye=first.eye,
        rate_hz=first.rate_hz,
        time_s=np.array([one.time_s for one in moments]),
        place=np.where(shown[:, None], places_of(origin, direction, display), np.nan),
        direction=direction,
        origin_mm=origin,
        pupil_mm=np.where(shown, np.array(stop, dtype=float), np.nan),
        lid_opening_mm=np.array(lids, dtype=float),
        events=np.array(events, dtype=object),
        display=display,
    )
