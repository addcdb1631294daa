"""A power cut, simulated: a run's file operations are recorded and replayed up to an instant, and what was not synced
may be lost.

Of a file only what was in it when it was last synced is kept; one that was never synced is empty or full of zeros. Of a
folder the names are kept that it had when it was last synced; each later change of a name has reached the disk or not,
whatever happened to the others. So a rename may be there before the data, and may lose one of its two names.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RECORDER = Path(__file__).parent / "recorder"


@dataclass
class File:
    """A file: the content that is on the disk, None for one that was never synced."""

    data: bytes | None = None


@dataclass
class Folder:
    """A folder: its names as processes see them, as they are on the disk, and the changes in between."""

    live: dict[str, Any] = field(default_factory=dict)
    kept: dict[str, Any] = field(default_factory=dict)
    pending: list[tuple[str, Any]] = field(default_factory=list)

    def put(self, name: str, entry: Any) -> None:
        if entry is None:
            self.live.pop(name, None)
        else:
            self.live[name] = entry
        self.pending.append((name, entry))

    def sync(self) -> None:
        self.kept, self.pending = dict(self.live), []


class Disk:
    """A folder whose operations are recorded; `start` is what it holds, durably, before them.

    Without `syncs` those are left out, as if the run had none.
    """

    def __init__(self, journal: Path, start: Path | None = None, *, syncs: bool = True) -> None:
        self.blobs = Path(f"{journal}.blobs")
        operations = [json.loads(line) for line in journal.read_text().splitlines()]
        self.operations = [o for o in operations if syncs or not o[0].startswith("sync")]
        self.start = start

    def after(self, count: int, draws: random.Random, place: Path, share: float | None = None) -> None:
        """Write what a power cut after `count` operations leaves into a new folder.

        `share` of the changes of names that were not synced have reached the disk; by default it is drawn, too.
        """
        root = Folder() if self.start is None else _loaded(self.start)
        for operation in self.operations[:count]:
            self._apply(root, *operation)
        _write(root, place, draws, draws.choice((0.0, 0.5, 0.5, 1.0)) if share is None else share)

    def _apply(self, root: Folder, what: str, path: str, other: str | None = None) -> None:
        *above, name = path.split("/") if path != "." else [""]
        folder: Any = root
        for part in above:
            folder = folder.live.get(part) if isinstance(folder, Folder) else None
        if not isinstance(folder, Folder):
            return
        entry = folder.live.get(name) if name else root
        if what == "sync folder" and isinstance(entry, Folder):
            entry.sync()
        elif what == "sync" and isinstance(entry, File) and other is not None:
            entry.data = (self.blobs / other).read_bytes()
        elif what in ("create", "mkdir") and entry is None:
            folder.put(name, File() if what == "create" else Folder())
        elif what == "remove" and entry is not None:
            folder.put(name, None)
        elif what == "rename" and entry is not None:
            folder.put(name, None)
            if other is not None:
                *above, name = other.split("/")
                target: Any = root
                for part in above:
                    target = target.live[part]
                target.put(name, entry)


def record(journal: Path, root: Path, *argv: str) -> subprocess.CompletedProcess[str]:
    """Run a command of eyerender to its end, recording what it and its workers do to the files below `root`."""
    paths = [str(RECORDER), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.run(
        [sys.executable, "-m", "eyerender", *argv],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "POWERCUT_ROOT": str(root),
            "POWERCUT_JOURNAL": str(journal),
        },
        capture_output=True,
        text=True,
        timeout=300,
    )


def _loaded(place: Path) -> Folder:
    folder = Folder()
    for path in place.iterdir():
        folder.live[path.name] = _loaded(path) if path.is_dir() else File(path.read_bytes())
    folder.sync()
    return folder


def _write(folder: Folder, place: Path, draws: random.Random, share: float) -> None:
    place.mkdir()
    names = dict(folder.kept)
    for name, entry in folder.pending:
        if draws.random() < share:
            names[name] = entry
    for name, entry in names.items():
        if isinstance(entry, Folder):
            _write(entry, place / name, draws, share)
        elif entry is not None:
            lost = bytes(draws.choice((0, 0, 500)))
            (place / name).write_bytes(lost if entry.data is None else entry.data)
