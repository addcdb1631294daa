"""Status: the outcome of a ray, a fixation, a feature or an estimate, with the reason in words.

A computation that can expect to fail reports that with a status, never with an exception. A batch holds its statuses as
an array of int8 (`arrays.Statuses`): `status == Status.OK` selects the valid ones, `Status(status[i])` names one, and
`Status(status[i]).reason` gives its reason in words. Records hold a word instead, `Status(status[i]).label`.
"""

from __future__ import annotations

from enum import IntEnum

from .arrays import Bools, Statuses


class Status(IntEnum):
    """Outcome of a ray, a ray search, a fixation, a feature or an estimate.

    The numbers of an entry are complete only where its status is OK. NONE marks padding: an entry that does not exist.

    >>> er.Status.OUTSIDE_LIMBUS.reason
    'outside the limbus'
    """

    NONE = -1
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
    AT_LENS_EDGE = 17
    BEHIND_OBSTACLE = 18
    BEHIND_OPENING = 19
    BESIDE_MIRROR = 20
    UNLIT = 21
    # Fixations.
    TARGET_TOO_NEAR = 9
    OUT_OF_REACH = 10
    NO_LINE_OF_SIGHT = 11
    # Features.
    PARTIAL = 12
    NO_ELLIPSE = 13
    NOT_FOUND = 14
    REJECTED = 15
    # Gaze.
    NO_ESTIMATE = 16

    @property
    def reason(self) -> str | None:
        """Reason in words; None if the status is OK."""
        return _REASONS.get(self)

    @property
    def label(self) -> str:
        """Word for records: "ok", "partial" or "missing"; "" for padding."""
        return _LABELS.get(self, "missing")

    @classmethod
    def of_record(cls, label: str, reason: str | None = None) -> Status:
        """Convert the word and reason of a record to a status; NOT_FOUND if the reason is unknown.

        A reason may be followed by details in parentheses.
        """
        if label in _OF_LABEL:
            return _OF_LABEL[label]
        return _OF_REASON.get((reason or "").split(" (")[0], cls.NOT_FOUND)


_REASONS = {
    Status.NONE: "no entry",
    Status.MISSED: "the ray misses a surface",
    Status.TOTAL_REFLECTION: "total reflection",
    Status.OUTSIDE_LIMBUS: "outside the limbus",
    Status.BEHIND_IRIS: "behind the iris",
    Status.NOT_CONVERGED: "the solver did not converge",
    Status.NO_MIRROR_POINT: "no point of the surface mirrors the light to the viewpoint",
    Status.BEHIND_SCLERA: "behind the sclera",
    Status.BEHIND_CAMERA: "behind the camera",
    Status.AT_LENS_EDGE: "at the edge of a lens",
    Status.BEHIND_OBSTACLE: "occluded by obstacle",
    Status.BEHIND_OPENING: "occluded by frame",
    Status.BESIDE_MIRROR: "beside the mirror",
    Status.UNLIT: "no light while its rows are exposed",
    Status.TARGET_TOO_NEAR: "the target lies inside the eye",
    Status.OUT_OF_REACH: "the target is out of reach of the eye's rotation",
    Status.NO_LINE_OF_SIGHT: "no line of sight joins the target and the fovea",
    Status.PARTIAL: "only arcs of the boundary are seen",
    Status.NO_ELLIPSE: "no ellipse fits the boundary",
    Status.NOT_FOUND: "not found",
    Status.REJECTED: "a reflection, but no glint of the cornea",
    Status.NO_ESTIMATE: "no estimate of gaze",
}
_LABELS = {Status.NONE: "", Status.OK: "ok", Status.PARTIAL: "partial"}
_OF_LABEL = {label: status for status, label in _LABELS.items()}
_OF_REASON = {reason: status for status, reason in _REASONS.items() if status.label == "missing"}


def mark(status: Statuses, where: Bools, value: Status) -> None:
    """Set the status to `value` at `where`, in place, unless a failure is already recorded there."""
    status[(status == Status.OK) & where] = value
