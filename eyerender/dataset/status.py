"""Log of a run, and its status from the log and the names of its shards: rates by host, time left, retries, disk.

Only small files are read, so this is quick for large runs, and may be called while they are at work.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from calendar import timegm
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import WRONG, InputError
from ..base.storage.files import appended, opened, parse_json, printable
from ..folders.imagefolder import DATASET, LOG, RUN, finished, read_run
from .done import read_done
from .partial import checkpoints
from .runfile import check_work
from .shard import fits
from .spec import DatasetSpec

SCHEMA = "eyerender/status/1"
SILENT_S = 180.0
"""A part at work writes to the log once a minute; after this silence it counts as stalled or killed."""
_MAX_LOG_BYTES, _MAX_EVENT_BYTES = 64 * 2**20, 2**16
_TIME = "%Y-%m-%dT%H:%M:%SZ"


class Log:
    """Writer of the log of one part of a run, from its start on."""

    def __init__(self, folder: Path, part: tuple[int, int]) -> None:
        self._path, self._part, self._start = folder / LOG, part, time.monotonic()
        self.written = 0.0  # when an event was last written

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    def write(self, event: str, **data: Any) -> None:
        """Append an event."""
        line = {
            "time": time.strftime(_TIME, time.gmtime()),
            "host": socket.gethostname(),
            "part": f"{self._part[0]}/{self._part[1]}",
            "event": event,
            "seconds": round(self.seconds, 3),
            **data,
        }
        self.written = time.monotonic()
        with appended(self._path) as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a power cut may have truncated the last line
                    file.write(b"\n")
            file.write(json.dumps(line).encode() + b"\n")


@dataclass(slots=True, kw_only=True)
class _Part:
    """The last run of one part of the dataset on a host."""

    host: str
    part: str
    state: str = "running"
    images: int = 0
    seconds: float = 0.0
    retries: int = 0
    last: str = ""
    bytes: int = 0
    shard_images: int = 0  # images in shards whose size is known

    def take(self, event: dict[str, Any]) -> None:
        """Process an event of the log.

        Raises KeyError if the event lacks a key; ValueError if a number is not plausible.
        """
        kind = event["event"]
        self.last, self.seconds = printable(str(event["time"])[:40]), _number(event["seconds"])
        if kind == "start":
            self.state, self.images, self.retries = "running", 0, 0
        elif kind in ("end", "stop"):
            self.state = "finished" if kind == "end" else "stopped"
        elif kind == "retry":
            self.retries += 1
        elif kind == "shard":
            self.bytes += int(_number(event.get("bytes", 0)))
            self.shard_images += int(_number(event["images"]))
        self.images = max(self.images, int(_number(event.get("made", 0))))

    @property
    def rate(self) -> float | None:
        """Return the images per second of a part that is at work."""
        return self.images / self.seconds if self.state == "running" and self.images and self.seconds else None

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        rate = None if self.rate is None else round(self.rate, 4)
        own = {"host": self.host, "part": self.part, "state": self.state, "images": self.images}
        return {**own, "images_per_s": rate, "retries": self.retries, "last": self.last}


def status(path: str | Path) -> dict[str, Any]:
    """Return the state of a dataset's folder (schema eyerender/status/1); InputError if the folder holds no run."""
    folder = Path(path)
    run = read_run(folder)
    try:
        spec = DatasetSpec.from_mapping(run["spec"])
    except (InputError, *WRONG) as error:
        raise InputError(f"has no spec that can be read ({error})", source=str(folder / RUN), path="spec") from None
    check_work(spec, folder)
    selection = spec.selection
    parts = _parts(folder)
    shards, there = selection.shards, finished(folder)
    done = there.intersection(shards)
    if run.get("resized"):  # some of them get more or fewer samples
        done = {shard for shard in done if fits(folder, shard, spec.shard_samples(shard))}
    kept = checkpoints(folder)
    missing = frozenset(shards).difference(done)
    for shard in missing & there:
        with suppress(InputError):
            kept[shard] = max(kept.get(shard, 0), read_done(folder, shard)["images"])
    at_work = sum(images for shard, images in kept.items() if shard in missing)
    samples = sum(map(selection.shard_count, done))
    is_finished = (folder / DATASET).is_file()
    left = 0 if is_finished else selection.count - samples - at_work
    rates = [part.rate for part in parts if part.rate is not None]
    images = sum(part.shard_images for part in parts)
    size = sum(part.bytes for part in parts) / images if images else None
    running = any(part.state == "running" for part in parts)
    return {
        "schema": SCHEMA,
        "path": str(folder),
        "state": "finished" if is_finished else "running" if running else "stopped",
        "samples": selection.count,
        "samples_finished": selection.count if is_finished else samples,
        "samples_in_partial_shards": 0 if is_finished else at_work,
        "shards": len(shards),
        "shards_finished": len(done),
        "images_per_s": round(sum(rates), 4) if rates else None,
        "seconds_left": round(left / sum(rates), 1) if rates and left > 0 else None,
        "retries": sum(part.retries for part in parts),
        "stalled": [f"{part.host}, part {part.part}" for part in parts if part.state == "stalled"],
        "bytes_left": None if size is None else round(size * max(left, 0)),
        "bytes_free": shutil.disk_usage(folder).free,
        "parts": [part.to_mapping() for part in parts],
    }


def _parts(folder: Path) -> list[_Part]:
    found: dict[tuple[str, str], _Part] = {}
    for event in _events(folder / LOG):
        with suppress(*WRONG):
            key = printable(str(event["host"])[:80]), printable(str(event.get("part", "1/1"))[:40])
            found.setdefault(key, _Part(host=key[0], part=key[1])).take(event)
    now = time.time()
    for part in found.values():
        with suppress(ValueError):
            if part.state == "running" and now - timegm(time.strptime(part.last, _TIME)) > SILENT_S:
                part.state = "stalled"
    return list(found.values())


def _number(value: Any) -> float:
    """Convert a number of the log."""
    number = float(value)
    if not 0 <= number <= 1e15:
        raise ValueError("not plausible")
    return number


def _events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the events of a log; lines truncated by a power cut are skipped."""
    if not path.is_file():
        return
    with opened(path, limit=_MAX_LOG_BYTES, follow=False) as file:
        while raw := file.readline(_MAX_EVENT_BYTES):
            with suppress(InputError):
                event = parse_json(raw)
                if isinstance(event, dict):
                    yield event
