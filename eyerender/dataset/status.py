"""Status of a run, from its log and the names of its shards: rates by host, time left, retries, disk.

Only small files are read, so this is quick for large runs, and may be called while they are at work.
"""

from __future__ import annotations

import shutil
import time
from calendar import timegm
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.storage.files import MAX_FILE_BYTES, opened, parse_json, read_json
from ..folders.imagefolder import DATASET, LOG, PACKED_RUN_SCHEMA, RUN, RUN_SCHEMA, finished
from .partial import checkpoints
from .selection import Selection

SCHEMA = "eyerender/status/1"
SILENT_S = 180.0
"""A part at work writes to the log once a minute; after this silence it counts as stalled or killed."""
_TIME = "%Y-%m-%dT%H:%M:%SZ"


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
        """Process an event of the log."""
        kind = event["event"]
        self.last, self.seconds = str(event["time"]), float(event["seconds"])
        if kind == "start":
            self.state, self.images, self.retries = "running", 0, 0
        elif kind in ("end", "stop"):
            self.state = "stopped"
        elif kind == "retry":
            self.retries += 1
        elif kind == "shard":
            self.bytes += int(event.get("bytes", 0))
            self.shard_images += int(event["images"])
        self.images = max(self.images, int(event.get("made", 0)))

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
    """Return the state of a dataset's folder (schema eyerender/status/1).

    Raises:
        InputError: the folder holds no run.
    """
    folder = Path(path)
    run = read_json(folder / RUN, limit=MAX_FILE_BYTES, follow=False)
    if run.get("schema") not in (RUN_SCHEMA, PACKED_RUN_SCHEMA):
        raise InputError("does not describe a run of this version", source=str(folder / RUN))
    selection = _selection(run, str(folder / RUN))
    parts = _parts(folder)
    shards, there = selection.shards, finished(folder)
    done = sorted(there.intersection(shards))
    kept = checkpoints(folder)
    missing = frozenset(shards) - there
    at_work = sum(images for shard, images in kept.items() if shard in missing)
    samples = (
        sum(len(selection.shard_samples(shard)) for shard in done)
        if selection.spread or (selection.interleave is not None and selection.count % selection.planned)
        else _plain(selection, done)
    )
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


def _selection(run: dict[str, Any], source: str) -> Selection:
    spec = run.get("spec")
    try:
        assert isinstance(spec, dict)
        count = int(spec["count"])
        planned = int(spec.get("planned") or count)
        return Selection(
            count=count,
            planned=planned,
            subjects=int(spec.get("subjects") or planned),
            shard_size=int(spec["shard_size"]),
            spread=spec.get("choice") == "spread" and count % planned > 0,
            interleave=int(spec["seed"]) if spec.get("layout") == "webdataset" else None,
        )
    except (AssertionError, KeyError, TypeError, ValueError, ZeroDivisionError):
        raise InputError("has no count and shard_size", source=source, path="spec") from None


def _plain(selection: Selection, shards: list[int]) -> int:
    """Count the samples of some shards, each of which has all its samples."""
    if selection.interleave is not None:
        per_block = -(-selection.planned // selection.shard_size)
        short = per_block * selection.shard_size - selection.planned
        return len(shards) * selection.shard_size - short * sum((shard + 1) % per_block == 0 for shard in shards)
    last = (selection.count - 1) // selection.shard_size
    short = selection.shard_size * (last + 1) - selection.count if last in shards[-1:] else 0
    return len(shards) * selection.shard_size - short


def _parts(folder: Path) -> list[_Part]:
    found: dict[tuple[str, str], _Part] = {}
    for event in _events(folder / LOG):
        with suppress(KeyError, TypeError, ValueError):
            key = str(event["host"]), str(event.get("part", "1/1"))
            found.setdefault(key, _Part(host=key[0], part=key[1])).take(event)
    now = time.time()
    for part in found.values():
        with suppress(ValueError):
            if part.state == "running" and now - timegm(time.strptime(part.last, _TIME)) > SILENT_S:
                part.state = "stalled"
    return list(found.values())


def _events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the events of a log; lines truncated by a power cut are skipped."""
    if not path.is_file():
        return
    with opened(path, follow=False) as file:
        for raw in file:
            with suppress(InputError):
                event = parse_json(raw)
                if isinstance(event, dict):
                    yield event
