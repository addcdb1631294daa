"""Run extractors on images: several processes at a time, stored answers first, failures as results."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ...base.errors import InputError
from ...base.jit import ensure_compiled
from ...optics.ellipse import Ellipse
from .answers import Answers
from .labelled import BenchImage
from .options import BenchOptions
from .process import ExtractorProcess, Failed
from .protocol import Greeting, Reply, Request
from .recordings import pieces, previous
from .registry import ExtractorCommand
from .score import Score, failed, score

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

    The images of an extractor are divided among `options.jobs` processes. The results do not depend on their number.

    Args:
        extractors: the extractors.
        images: the images.
        options: jobs and time limits.
        answers: stored answers, which receive the new ones.
        step: called with an extractor's name after each of its answers.
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
    """Return what an extractor is told of the pupil that it found last, in this package's conventions."""
    x, y, a, b, angle = pupil.numbers()
    return {"centre_px": [x, y], "semi_axes_px": [a, b], "angle_rad": angle}
