"""Status: what became of a ray, a fixation, a feature or an estimate, with the reason in words.

A computation that can expect to fail says so with a status, never with an exception. A batch holds its statuses as an
array of int8 (`arrays.Statuses`): `status == Status.OK` selects what was found, `Status(status[i]).reason` reads one.
"""

from __future__ import annotations

from enum import IntEnum

from .arrays import Bools, Statuses


class Status(IntEnum):
    """What became of a ray, of the search for one, of a fixation, of a feature or of an estimate.

    OK alone stands beside usable numbers. `reason` puts the others into words.
    """

    OK = 0
    # Rays.
    MISSED = 1
    TOTAL_REFLECTION = 2
    OUTSIDE_LIMBUS = 3
    BEHIND_IRIS = 4
    NOT_CONVERGED = 5
    NO_MIRROR_POINT = 6
    BEHIND_SCLERA = 7
    BEHIND_CAMERA = 8
    # Fixations.
    TARGET_TOO_NEAR = 9
    OUT_OF_REACH = 10
    NO_LINE_OF_SIGHT = 11
    # Features in an image.
    NOT_FOUND = 12
    REJECTED = 13

    @property
    def reason(self) -> str | None:
        """The status in words; None where nothing is wrong."""
        return _REASONS.get(self)


_REASONS = {
    Status.MISSED: "the ray misses a surface",
    Status.TOTAL_REFLECTION: "total reflection",
    Status.OUTSIDE_LIMBUS: "outside the limbus",
    Status.BEHIND_IRIS: "behind the iris",
    Status.NOT_CONVERGED: "the solver did not converge",
    Status.NO_MIRROR_POINT: "no point of the surface mirrors the light to the viewpoint",
    Status.BEHIND_SCLERA: "behind the sclera",
    Status.BEHIND_CAMERA: "behind the camera",
    Status.TARGET_TOO_NEAR: "the target lies inside the eye",
    Status.OUT_OF_REACH: "the target is out of reach of the eye's rotation",
    Status.NO_LINE_OF_SIGHT: "no line of sight joins the target and the fovea",
    Status.NOT_FOUND: "not found",
    Status.REJECTED: "a reflection, but no glint of the cornea",
}


def mark(status: Statuses, where: Bools, value: Status) -> None:
    """Set `value` where nothing has gone wrong before (in place: `status` belongs to the caller)."""
    status[(status == Status.OK) & where] = value
