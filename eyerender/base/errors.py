"""The hierarchy of expected errors, and the policy for them.

A user's mistake raises `InputError`; the command line prints it as one line and exits with its code. What a computation
can expect (a ray that misses, a pupil that is not found) is not an error but a status with a reason in the result. Any
other exception is a defect of this package.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from typing import Any, NoReturn

# A message may quote a file that somebody else made. Longer parts are shortened in the middle.
MAX_MESSAGE, MAX_SOURCE, MAX_PATH, MAX_REASON = 2000, 600, 200, 400
# What Python raises for values of another type or range than a reader expects.
WRONG = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RecursionError)
# Errors of one input that are reported together. More do not help, and a file may have millions.
MAX_ERRORS = 20


class UnfinishedRunWarning(UserWarning):
    """Only the finished shards of an unfinished run were read."""


class FitWarning(UserWarning):
    """The fit of an eye may be wrong: features and model disagree, or the features do not determine the gaze."""


class EyerenderError(Exception):
    """Base of every error that this package raises on purpose: the run failed (disk, worker, backend).

    The message is one line of printable characters with a limited length, even if it quotes other text.

    >>> issubclass(er.InputError, er.EyerenderError)
    True
    """

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message, MAX_MESSAGE))


class InputError(EyerenderError):
    """The user's input cannot be used.

    >>> try:
    ...     er.Led((600, 120, 0), radius_mm=-1)
    ... except er.InputError as error:
    ...     print(error)
    radius_mm: must be >= 0, not -1

    Attributes:
        reason: what is wrong, in words.
        source: the file or argument; may be empty.
        path: the dotted path of the key in it; may be empty.
        others: further errors of the same input, at most `MAX_ERRORS` - 1; `str()` shows the first error only.
        unlisted: number of errors beyond those.
    """

    exit_code = 2

    def __init__(
        self, reason: str, *, source: str = "", path: str = "", others: Iterable[InputError] = (), unlisted: int = 0
    ) -> None:
        self.reason = one_line(reason, MAX_REASON)
        self.source = source
        self.path = one_line(path, MAX_PATH)
        self.others = tuple(others)
        self.unlisted = unlisted
        shown = one_line(source, MAX_SOURCE)
        super().__init__(": ".join(part for part in (shown, self.path, self.reason) if part))

    def placed(self, *, source: str = "", under: str = "") -> InputError:
        """Copy the error and its `others`, add `source` where they have none, and put their paths below `under`."""
        return InputError(
            self.reason,
            source=self.source or source,
            path=".".join(part for part in (under, self.path) if part),
            others=[other.placed(source=source, under=under) for other in self.others],
            unlisted=self.unlisted,
        )


class Problems:
    """Collects the errors of one input, to raise them together."""

    def __init__(self, source: str = "") -> None:
        self.source = source
        self._listed: list[InputError] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, reason: str, path: str = "") -> None:
        """Record an error; only the first `MAX_ERRORS` are kept, later ones are counted."""
        self._count += 1
        if len(self._listed) < MAX_ERRORS:
            self._listed.append(InputError(reason, source=self.source, path=path))

    def include(self, error: InputError) -> None:
        """Record an error that was raised, and its `others`."""
        for one in (error, *error.others):
            self.add(one.reason, one.path)
        self._count += error.unlisted

    def attempt(self, call: Callable[[], Any]) -> Any:
        """Call a function; if it raises `InputError`, record the error and return None."""
        try:
            return call()
        except InputError as error:
            self.include(error)
            return None

    def check(self) -> None:
        """Raise the recorded errors, if there are any.

        Raises:
            InputError: the first error, which carries the others.
        """
        if self._listed:
            raise self.error()

    def error(self) -> InputError:
        """Return the first recorded error, which carries the others."""
        first, *others = self._listed
        return InputError(
            first.reason, source=first.source, path=first.path, others=others, unlisted=self._count - len(self._listed)
        )


Refuse = Callable[[str, str], NoReturn]
"""Function that raises `InputError` for a path in some input, with a reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InputWarning:
    """The user's input can be used, but is probably a mistake.

    `code` is a word for programs; `source` and `path` are as in `InputError`.
    """

    code: str
    reason: str
    source: str = ""
    path: str = ""

    def __str__(self) -> str:
        return str(self.error())

    def error(self) -> InputError:
        """Convert to an error, for callers that treat warnings as errors."""
        return InputError(self.reason, source=self.source, path=self.path)

    def at(self, source: str) -> InputWarning:
        """Copy the warning with a source."""
        return replace(self, source=source)

    def to_mapping(self) -> dict[str, str]:
        """Convert to a mapping for JSON."""
        return asdict(self)


# Receives warnings while there is still time to stop; it may raise.
Warn = Callable[[Iterable[InputWarning]], None]


class BackendError(EyerenderError):
    """No backend can render; the message says how to fix it.

    >>> issubclass(er.BackendError, er.EyerenderError)
    True
    """

    exit_code = 3


def nearest(name: str, names: Iterable[str]) -> str:
    """Return "did you mean NAME? " for a name that is nearly one of `names`, else an empty text."""
    near = get_close_matches(name, list(names), n=1)
    return f"did you mean {near[0]}? " if near else ""


def one_line(text: str, limit: int) -> str:
    """Convert a text to one line of printable characters; if it is longer than `limit`, cut out its middle.

    Control characters (terminals obey some of them) become question marks.
    """
    if len(text) > limit:
        tail = limit // 4
        text = f"{text[: limit - tail - 5]} ... {text[len(text) - tail :]}"
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()))
