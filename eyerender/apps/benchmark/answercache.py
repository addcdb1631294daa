"""Stored answers of extractors, so that a repeated benchmark only computes what is new.

There is one file per extractor in `$XDG_CACHE_HOME/eyerender/answers`, with a JSON line per answer. An extractor is
identified by its command and the content of its code, and an image by its content and the hints that go with it. Only
answers are stored, never failures.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ...base.errors import InputError
from ...base.references import is_reference
from ...base.storage.cachefolder import cache_folder
from ...base.storage.files import read_bytes
from ...folders.imagefolder import versions
from .folder import LabelledImage
from .registry import WORKER, ExtractorCommand

_PACKAGE = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, slots=True)
class StoredAnswer:
    """A line that an extractor sent, the id of its request, the extractor's greeting, and the round-trip time."""

    request_id: int
    line: str
    greeting: str
    trip_s: float


class AnswerCache:
    """Stored answers of one extractor; without a file it stores nothing."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._known: dict[str, StoredAnswer] = {}
        if path is not None:
            with suppress(OSError):
                for line in path.read_text(encoding="utf-8").splitlines():
                    # The last line of a killed run may be truncated.
                    with suppress(ValueError, KeyError, TypeError):
                        data = json.loads(line)
                        image = data.pop("image")
                        self._known[image] = StoredAnswer(**data)

    @classmethod
    def of(cls, extractor: ExtractorCommand, sources: Iterable[Path] | None) -> AnswerCache:
        """Open the cache of an extractor.

        Args:
            extractor: the extractor.
            sources: files of its code; None where they are unknown, and then nothing is stored.
        """
        home = cache_folder()
        if home is None or sources is None:
            return cls(None)
        folder = home / "answers"
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError:
            return cls(None)
        return cls(folder / f"{_identity(extractor, sources)}.jsonl")

    def get(self, image: str) -> StoredAnswer | None:
        """Return the stored answer for an image, given by its `image_key`."""
        return self._known.get(image)

    def put(self, image: str, answer: StoredAnswer) -> None:
        """Store an answer; an unwritable cache is not an error."""
        with self._lock:
            self._known[image] = answer
            if self._path is not None:
                values = {name: getattr(answer, name) for name in StoredAnswer.__slots__}
                with suppress(OSError), open(self._path, "a", encoding="utf-8") as file:
                    file.write(json.dumps({"image": image, **values}) + "\n")


def image_key(image: LabelledImage) -> str:
    """Compute the SHA-256 of everything that an extractor receives: the file's bytes, the bit depth and the hints."""
    told = json.dumps([image.bit_depth, image.hints], sort_keys=True)
    return hashlib.sha256(read_bytes(image.path) + told.encode()).hexdigest()


def check_reference(extractor: ExtractorCommand, timeout_s: float) -> list[Path] | None:
    """Load a `module:callable` in a separate process, before any image is read.

    Returns:
        The files of the extractor's code; None if its process failed for another reason, which the benchmark then
        reports.

    Raises:
        InputError: there is no such module or callable.
    """
    if extractor.argv[1:3] != ("-m", WORKER) or not is_reference(extractor.argv[3]):
        return [path for word in extractor.argv if (path := _file_of(word)) is not None]
    reference = extractor.argv[3]
    if reference.startswith("eyerender."):
        return sorted(_PACKAGE.rglob("*.py"))
    try:
        done = subprocess.run(
            [sys.executable, "-m", WORKER, "--check", reference], capture_output=True, text=True, timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode == 2:
        last = (done.stderr.strip().splitlines() or ["cannot be loaded"])[-1]
        raise InputError(last, source=f"--extractor {extractor.given}")
    if done.returncode:
        return None
    return [Path(name) for name in json.loads(done.stdout.splitlines()[-1])]


def _file_of(word: str) -> Path | None:
    path = Path(shutil.which(word) or word)
    return path.resolve() if path.is_file() else None


def _identity(extractor: ExtractorCommand, sources: Iterable[Path]) -> str:
    """Compute the SHA-256 of an extractor's command, of the files of its code, and of the installed libraries."""
    digest = hashlib.sha256(json.dumps([extractor.argv, sys.version, versions()], sort_keys=True).encode())
    for path in sources:
        digest.update(str(path).encode())
        with suppress(OSError, InputError):
            digest.update(hashlib.sha256(read_bytes(path)).digest())
    return digest.hexdigest()
