"""Answers of extractors in the output folder of a benchmark, from which an interrupted one resumes.

The first line states the task: the commands and the code of the extractors, and everything that they receive. A file of
another task starts anew. Only answers are stored, never failures.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from ...base.errors import InputError
from ...base.processes import python_command, run
from ...base.references import is_reference
from ...base.storage.files import MAX_FILE_BYTES, appended, parse_json, read_bytes, read_text, write_text
from ...folders.imagefolder import versions
from ...folders.outfolder import mark
from .labelled import BenchImage
from .registry import PREFIX, WORKER, ExtractorCommand

ANSWERS = "answers.jsonl"
_SCHEMA = "eyerender/bench-answers/1"
_PACKAGE = Path(__file__).resolve().parents[2]


class Answers:
    """Stored answers of one task, (line, greeting, round-trip time) by extractor and row of the image.

    Without a file nothing is stored.
    """

    def __init__(self, path: Path | None = None, task: str = "", *, fresh: bool = False) -> None:
        self._path, self._lock, self._begun = path, threading.Lock(), False
        self._first = json.dumps({"schema": _SCHEMA, "task": task})
        self._known: dict[tuple[str, int], tuple[str, str, float]] = {}
        lines: list[str] = []
        with suppress(InputError):
            lines = [] if path is None or fresh else read_text(path, limit=MAX_FILE_BYTES, follow=False).splitlines()
        for line in lines[1:] if lines[:1] == [self._first] else ():
            with suppress(InputError, ValueError, TypeError):  # the last line of a killed run may be truncated
                extractor, row, text, greeting, trip_s = parse_json(line)
                self._known[extractor, row] = text, greeting, trip_s

    def get(self, extractor: str, row: int) -> tuple[str, str, float] | None:
        """Return the stored answer of an extractor about an image."""
        return self._known.get((extractor, row))

    def put(self, extractor: str, row: int, answer: tuple[str, str, float]) -> None:
        """Store an answer; the file is begun with the first one.

        Raises:
            OSError: the file cannot be written.
        """
        if self._path is None:
            return
        with self._lock:
            new = {(extractor, row): answer}
            self._known |= new
            if not self._begun:
                mark(self._path.parent, {self._path.name})
                write_text(self._path, self._first + "\n", sync=False)
                self._begun, new = True, self._known
            with appended(self._path) as file:
                file.writelines(json.dumps([*key, *value]).encode() + b"\n" for key, value in new.items())


def image_key(image: BenchImage) -> str:
    """Compute the SHA-256 of all that an extractor receives: the file's bytes, bit depth, hints and place in time."""
    place = [] if image.time_s is None else [image.recording, image.time_s]
    told = json.dumps([image.bit_depth, image.hints, *place], sort_keys=True)
    return hashlib.sha256(read_bytes(image.path) + told.encode()).hexdigest()


def task_of(extractors: Sequence[ExtractorCommand], code: Sequence[str], keys: Sequence[str]) -> str:
    """Compute the SHA-256 of a benchmark's extractors, their code, the libraries, and the images' keys."""
    named = [[extractor.name, extractor.argv] for extractor in extractors]
    return hashlib.sha256(json.dumps([named, code, keys, sys.version, versions()]).encode()).hexdigest()


def code_digest(extractor: ExtractorCommand, timeout_s: float) -> str:
    """Compute the SHA-256 of an extractor's code; a `module:callable` or network is loaded, in a separate process.

    Returns:
        The digest; "" if its process failed for another reason, which the benchmark then reports.

    Raises:
        InputError: there is no such module or callable, or the network cannot be used.
    """
    argv = extractor.argv
    if argv[2:4] != ("-m", WORKER) or not (is_reference(argv[4]) or argv[4].startswith(PREFIX)):
        return _digest([path for word in argv if (path := Path(shutil.which(word) or word)).is_file()])
    reference = argv[4]
    if reference.startswith("eyerender."):
        return _digest(sorted(_PACKAGE.rglob("*.py")))
    try:
        done = run(python_command(WORKER, "--check", reference), capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return ""
    if done.returncode == 2:
        last = (done.stderr.strip().splitlines() or ["cannot be loaded"])[-1]
        raise InputError(last, source=f"--extractor {extractor.given}")
    return _digest(map(Path, json.loads(done.stdout.splitlines()[-1]))) if done.returncode == 0 else ""


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        with suppress(OSError, InputError):
            digest.update(hashlib.sha256(read_bytes(path)).digest())
    return digest.hexdigest()
