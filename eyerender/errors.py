"""The hierarchy of expected errors, and the policy on them.

A user's mistake raises `InputError`; the command line prints it as one line and ends with its exit code. Whatever a
computation can expect to meet (a ray that misses, a pupil that is not found) is no error: it is a status with a reason
in the result. Any other exception is a defect of this package.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from typing import NoReturn

# A message may quote a file that somebody else made. Longer parts lose their middle.
MAX_MESSAGE, MAX_SOURCE, MAX_PATH, MAX_REASON = 2000, 600, 200, 400


class EyerenderError(Exception):
    """Base of every error this package raises on purpose: the run failed (disk, worker, backend).

    The message is one line of printable characters of a limited length, whatever it quotes.
    """

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message, MAX_MESSAGE))


class InputError(EyerenderError):
    """What the user gave cannot be used.

    `source` is the file or argument it stands in, `path` the dotted path of the key inside (either may be empty).
    """

    exit_code = 2

    def __init__(self, reason: str, *, source: str = "", path: str = "") -> None:
        self.reason = one_line(reason, MAX_REASON)
        self.source = source
        self.path = one_line(path, MAX_PATH)
        shown = one_line(source, MAX_SOURCE)
        super().__init__(": ".join(part for part in (shown, self.path, self.reason) if part))


Refuse = Callable[[str, str], NoReturn]
"""Raises `InputError` for a path in some input, with a reason."""


@dataclass(frozen=True, slots=True)
class InputWarning:
    """What the user gave can be used, but was probably not meant.

    `code` is a word for programs, `source` and `path` are as of `InputError`.
    """

    code: str
    reason: str
    source: str = ""
    path: str = ""

    def __str__(self) -> str:
        return str(self.error())

    def error(self) -> InputError:
        """The same as an error, for who wants none of it."""
        return InputError(self.reason, source=self.source, path=self.path)

    def at(self, source: str) -> InputWarning:
        """The same in a source."""
        return replace(self, source=source)

    def to_mapping(self) -> dict[str, str]:
        """As JSON has it."""
        return asdict(self)


# What hears of warnings while there is still time to stop: it may raise.
Warn = Callable[[Iterable[InputWarning]], None]


class BackendError(EyerenderError):
    """No backend renders; the message says how to fix it."""

    exit_code = 3


def one_line(text: str, limit: int) -> str:
    """A text as one line of printable characters, its middle left out where it is longer than `limit`.

    Control characters (terminals obey some of them) become question marks.
    """
    if len(text) > limit:
        tail = limit // 4
        text = f"{text[: limit - tail - 5]} ... {text[len(text) - tail :]}"
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()))
