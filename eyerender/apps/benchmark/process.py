"""Run an extractor as a process that answers over pipes, with time limits, and kill it with all its children."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import IO, Self

from ...base.errors import InputError, one_line
from ...base.processes import start
from .protocol import Greeting, Reply, Request

_LONGEST_LINE = 4_000_000
_TAIL_BYTES = 4096
# Every extractor uses one core, because times are comparable only then.
_ONE_CORE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}


class Failed(Exception):
    """The extractor gave no proper answer; the message is the reason."""


class _Tail:
    """The end of a pipe's output.

    A separate thread reads the pipe, so that the writer never blocks. Only the end is kept, so that a process may print
    without limit.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._kept = b""
        self._thread = threading.Thread(target=self._drain, daemon=True)
        self._thread.start()

    def _drain(self) -> None:
        while chunk := os.read(self._pipe.fileno(), 65536):
            self._kept = (self._kept + chunk)[-_TAIL_BYTES:]

    def read(self) -> bytes:
        """Return the last bytes so far; if the writer has ended, wait for all of them."""
        self._thread.join(timeout=0.5)
        return self._kept

    def close(self) -> None:
        """Close the pipe once its writers have ended."""
        self._thread.join(timeout=0.5)
        # A process that has left the group may still hold the pipe. The reader then continues until that process ends.
        if not self._thread.is_alive():
            self._pipe.close()


class ExtractorProcess:
    """A running extractor; a context manager that leaves nothing running.

    After `Failed` the process is dead, and a new one must be started.
    """

    def __init__(
        self, argv: Sequence[str], *, start_timeout_s: float, timeout_s: float, env: Mapping[str, str] | None = None
    ) -> None:
        self._timeout_s, self._start_timeout_s = timeout_s, start_timeout_s
        self._buffer = b""
        self._closed = False
        try:
            self._process = start(
                list(argv),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # A separate process group, so that killing the group also kills its children.
                start_new_session=True,
                env={**os.environ, **_ONE_CORE, **(env or {})},
            )
        except OSError as error:
            raise Failed(f"cannot be started: {error.strerror or error}") from None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        # It may stop reading at any time, and writing must not block longer than waiting for an answer.
        os.set_blocking(self._process.stdin.fileno(), False)
        self._stderr = _Tail(self._process.stderr)
        try:
            self.greeting_line = self._line(start_timeout_s, "no greeting")
            self.greeting = Greeting.parse(self.greeting_line)
            self._cold = self.greeting.warms_up
        except InputError as error:
            self.close()
            raise Failed(f"greeting: {error}") from None
        except BaseException:
            self.close()
            raise

    @property
    def alive(self) -> bool:
        """Whether it can answer further requests."""
        return not self._closed

    def ask(self, request: Request) -> tuple[Reply, float]:
        """Return the answer to one request, and the seconds of the round trip."""
        begin = time.monotonic()
        self._send(request.to_line().encode())
        limit_s = self._timeout_s + (self._start_timeout_s if self._cold else 0.0)
        line = self._line(limit_s, "no answer")
        self._cold = False
        seconds = time.monotonic() - begin
        try:
            return Reply.parse(line, request.id, self.greeting.conventions), seconds
        except InputError as error:
            # Its next answer may belong to any image, so it is no longer trusted.
            self.close()
            raise Failed(f"unusable answer: {error}") from None

    def close(self) -> None:
        """End the process and its children; it may be called again."""
        if self._closed:
            return
        self._closed = True
        # Needed even if it has ended by itself, because its children may still run in its group.
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        self._stderr.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _send(self, data: bytes) -> None:
        """Write to its input; raise `Failed` if it has ended or does not read."""
        assert self._process.stdin is not None
        pipe = self._process.stdin.fileno()
        end = time.monotonic() + self._timeout_s
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_WRITE)
            while data:
                left = end - time.monotonic()
                if left <= 0 or not selector.select(left):
                    self.close()
                    raise Failed(f"read no request within {self._timeout_s:g} s")
                try:
                    data = data[os.write(pipe, data) :]
                except BlockingIOError:
                    continue
                except OSError:
                    raise self._died() from None

    def _line(self, timeout_s: float, what: str) -> str:
        """Read the next line of its output.

        Raises:
            Failed: the process takes too long or ends, or the line is too long.
        """
        assert self._process.stdout is not None
        end = time.monotonic() + timeout_s
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._buffer:
                left = end - time.monotonic()
                if left <= 0 or not selector.select(left):
                    self.close()
                    raise Failed(f"{what} within {timeout_s:g} s")
                chunk = os.read(self._process.stdout.fileno(), 65536)
                if not chunk:
                    raise self._died()
                self._buffer += chunk
                if len(self._buffer) > _LONGEST_LINE:
                    self.close()
                    raise Failed(f"printed {len(self._buffer)} bytes without an answer")
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode("utf-8", "replace")

    def _died(self) -> Failed:
        """Return the reason why it ended: its exit status and its last line on stderr."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=0.5)
        code = self._process.poll()
        last = self._last_words()
        self.close()
        if code is None:
            how = "closed its output"
        elif code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            how = f"was killed by {name}"
        else:
            how = f"ended with exit code {code}"
        return Failed(f"{how}: {last}" if last else how)

    def _last_words(self) -> str:
        lines = [line.strip() for line in self._stderr.read().decode("utf-8", "replace").splitlines()]
        lines = [line for line in lines if line]
        return one_line(lines[-1], 160) if lines else ""
