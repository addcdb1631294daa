"""Run extractors on images: several processes at a time, stored answers first, failures as results.

The first line of stored answers states the task: the commands and the code of the extractors, and everything that they
receive. A file of another task starts anew. Only answers are stored, never failures.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...base.errors import InputError
from ...base.jit import ensure_compiled
from ...base.processes import python_command, run
from ...base.references import is_reference
from ...base.storage.files import MAX_FILE_BYTES, appended, parse_json, read_bytes, read_text, write_text
from ...folders.imagefolder import versions
from ...folders.outfolder import mark
from ...optics.ellipse import Ellipse
from .labelled import BenchImage
from .options import BenchOptions
from .process import ExtractorProcess, Failed
from .protocol import Greeting, Reply, Request
from .recordings import pieces, previous
from .registry import PREFIX, WORKER, ExtractorCommand
from .score import Score, failed, score

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
        """Store an answer; the file is begun with the first one. Raises OSError if the file cannot be written."""
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

    Returns the digest; "" if its process failed for another reason, which the benchmark then reports. Raises InputError
    if there is no such module or callable, or the network cannot be used.
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


# Number of consecutive failures after which an extractor is no longer run.
PATIENCE = 3
_OWN = "eyerender.apps.benchmark.shipped:own_"


@dataclass(frozen=True, slots=True)
class ExtractorResults:
    """Results of one extractor: its greeting (None if it never came), and a score per image."""

    extractor: ExtractorCommand
    greeting: Greeting | None
    scores: tuple[Score, ...]


@dataclass(frozen=True, slots=True)
class _Answer:
    """A reply with its round-trip time, or the reason of a failure."""

    reply: Reply | None
    trip_s: float = 0.0
    failure: str = ""


def ask_extractors(
    extractors: Sequence[ExtractorCommand],
    images: Sequence[BenchImage],
    options: BenchOptions,
    *,
    answers: Answers | None = None,
    step: Callable[[str], None] = lambda _name: None,
) -> list[ExtractorResults]:
    """Run every extractor on every image; the scores include every failure.

    The images of an extractor are divided among `options.jobs` processes; the results do not depend on their number.
    `answers` are stored ones, which receive the new ones; `step` is called with an extractor's name after each answer.
    """
    if any(argument.startswith(_OWN) for extractor in extractors for argument in extractor.argv):
        ensure_compiled()  # once, before the clocks of several processes run
    known = Answers() if answers is None else answers
    askers = [_Asker(extractor, images, options, known, step) for extractor in extractors]
    parts = pieces(previous(images), options.jobs)
    with ThreadPoolExecutor(options.jobs) as pool:
        try:
            for done in [pool.submit(asker.ask, part) for asker in askers for part in parts]:
                done.result()
        except BaseException:
            for asker in askers:
                asker.stop()
            pool.shutdown(cancel_futures=True)
            raise
    return [asker.run() for asker in askers]


class _Asker:
    """Runs one extractor on images, from several threads."""

    def __init__(
        self,
        extractor: ExtractorCommand,
        images: Sequence[BenchImage],
        options: BenchOptions,
        stored: Answers,
        step: Callable[[str], None],
    ) -> None:
        self._extractor, self._images, self._options = extractor, images, options
        self._before, self._last = previous(images), dict[int, Ellipse]()
        self._stored, self._step = stored, step
        self._answers: list[_Answer | None] = [None] * len(images)
        self._greeting: Greeting | None = None
        self._processes: set[ExtractorProcess] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def ask(self, rows: range) -> None:
        """Process some images in turn; after `PATIENCE` consecutive failures the remaining ones get no answer."""
        process: ExtractorProcess | None = None
        failures = 0
        try:
            for row in rows:
                if self._stopped or failures >= PATIENCE:
                    return
                try:
                    answer, process = self._answer(row, process)
                    self._answers[row] = answer
                    self._remember(row, answer.reply)
                    failures = 0
                except Failed as failure:
                    failures += 1
                    self._answers[row] = _Answer(None, failure=str(failure))
                    if self._greeting is None:
                        return
                self._step(self._extractor.name)
        finally:
            self._close(process)

    def stop(self) -> None:
        """End all processes of this extractor."""
        self._stopped = True
        with self._lock:
            processes = list(self._processes)
        for process in processes:
            process.close()

    def run(self) -> ExtractorResults:
        """Score all answers; images after `PATIENCE` consecutive failures count as not processed."""
        greeting = self._greeting
        reports = greeting.reports if greeting else ()
        scores, failures, given_up = [], 0, ""
        for image, answer in zip(self._images, self._answers, strict=True):
            if given_up or answer is None or answer.reply is None:
                reason = given_up or (answer.failure if answer else "not asked")
                scores.append(failed(image, reason, "glints" in reports))
                failures += 1
                if not given_up and greeting is None:
                    given_up = reason
                elif not given_up and failures >= PATIENCE:
                    given_up = f"not asked after {PATIENCE} failures in a row, the last: {reason}"
                continue
            failures = 0
            scores.append(score(image, answer.reply, answer.trip_s, reports))
        return ExtractorResults(self._extractor, greeting, tuple(scores))

    def _answer(self, row: int, process: ExtractorProcess | None) -> tuple[_Answer, ExtractorProcess | None]:
        """Return the answer for one image, stored or new, and the process to use next."""
        stored = self._stored.get(self._extractor.name, row)
        if stored is not None:
            line, told, trip_s = stored
            with suppress(InputError):  # the file may have been damaged
                greeting = Greeting.parse(told)
                reply = Reply.parse(line, row, greeting.conventions)
                self._greeting = self._greeting or greeting
                return _Answer(reply, trip_s), process
        if process is None or not process.alive:
            process = self._open(process)
        image, before = self._images[row], self._before[row]
        prior = None if before is None else self._last.get(before)
        hints = {**image.hints, "prior": None if prior is None else _prior(prior)}
        reply, trip_s = process.ask(Request(row, str(image.path.resolve()), image.bit_depth, hints))
        if reply.error is None:
            self._stored.put(self._extractor.name, row, (reply.line, process.greeting_line, trip_s))
        return _Answer(reply, trip_s), process

    def _remember(self, row: int, reply: Reply | None) -> None:
        """Keep the pupil that was found last up to a frame."""
        before = self._before[row]
        found = None if reply is None else reply.ellipse
        if found is None and before is not None:
            found = self._last.get(before)
        if found is not None:
            self._last[row] = found

    def _open(self, before: ExtractorProcess | None) -> ExtractorProcess:
        self._close(before)
        options = self._options
        process = ExtractorProcess(
            self._extractor.argv, start_timeout_s=options.start_timeout_s, timeout_s=options.timeout_s
        )
        with self._lock:
            self._processes.add(process)
            self._greeting = self._greeting or process.greeting
        return process

    def _close(self, process: ExtractorProcess | None) -> None:
        if process is not None:
            process.close()
            with self._lock:
                self._processes.discard(process)


def _prior(pupil: Ellipse) -> dict[str, Any]:
    """Return the hint on the pupil that an extractor found last, in this package's conventions."""
    x, y, a, b, angle = pupil.numbers()
    return {"centre_px": [x, y], "semi_axes_px": [a, b], "angle_rad": angle}
