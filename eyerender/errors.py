"""The hierarchy of expected errors, and the policy on them.

A user's mistake raises `InputError`; the command line prints it as one line and ends with its exit code. Whatever a
computation can expect to meet (a ray that misses, a pupil that is not found) is no error: it is a status with a reason
in the result. Any other exception is a defect of this package.
"""

from __future__ import annotations


class EyerenderError(Exception):
    """Base of every error this package raises on purpose: the run failed (disk, worker, backend)."""

    exit_code = 1


class InputError(EyerenderError):
    """What the user gave cannot be used.

    `source` is the file or argument it stands in, `path` the dotted path of the key inside (either may be empty).
    """

    exit_code = 2

    def __init__(self, reason: str, *, source: str = "", path: str = "") -> None:
        self.reason = reason
        self.source = source
        self.path = path
        super().__init__(": ".join(part for part in (source, path, reason) if part))


class BackendError(EyerenderError):
    """No usable render backend; the message names the mend."""

    exit_code = 3
