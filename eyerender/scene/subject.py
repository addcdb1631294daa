"""The subject in Python code, and the frames in which it fixates targets or looks in given directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..population.people import Person
from ..region.anatomy import Region
from ..region.look import Look
from ..rig.rig import Rig
from .scene import Frames, Scene
from .spec import Eye, EyeDirection, SubjectSpec, Targets


class Subject(SubjectSpec):
    """The subject with its eye model. In a scene file, the eye has its own key.

    >>> er.Subject(er.Eye.load("E2"), ipd_mm=63).ipd_mm
    63.0
    """

    POSITIONAL: ClassVar[tuple[str, ...]] = ("eye",)
    if TYPE_CHECKING:

        def __init__(self, eye: Any = None, **fields: Any) -> None: ...

    eye: Eye = Field(default=Eye(), description="the eye model and its settings")
    person: Person | None = Field(default=None, description="a drawn person, whose eyes replace the eye model")
    look: Look | None = Field(default=None, description="albedos and textures of the eye; default: the scene's")
    region: Region | None = Field(default=None, description="lids, lashes, brow and skin; default: the scene's")

    @classmethod
    def of(cls, person: Person, **fields: Any) -> Self:
        """Create the subject of a drawn person.

        Args:
            person: the person.
            fields: further fields, such as `eyes` or `luminance_cd_m2`.

        Raises:
            InputError: an eye is physically impossible, or a value does not fit.
        """
        own: dict[str, Any] = {"look": person.look(), "region": person.region()}
        if "ipd_mm" not in fields:
            own["ipd_mm"] = person.apex_distance_mm
        return cls(person=person, **{**own, **fields})

    @classmethod
    def one_eye(
        cls,
        eye: Any = None,
        *,
        side: Literal["right", "left"] = "right",
        at_mm: ArrayLike = (0.0, 0.0, 0.0),
        **fields: Any,
    ) -> Self:
        """Create a subject of whom one eye is observed.

        The head is placed so that the apex of this eye, unrotated, lies at `at_mm`.

        Args:
            eye: the eye model; default: E2.
            side: "right" or "left".
            at_mm: (3,) world point of the eye's apex, or (n, 3) for n positions of the head.
            fields: further fields, such as `look`, `region` or `ipd_mm`.

        Raises:
            InputError: a value does not fit.
        """
        subject = cls(**{**({} if eye is None else {"eye": eye}), **fields, "eyes": [side]})
        at = np.asarray(at_mm, dtype=float).reshape(-1, 3)
        half = subject.ipd_mm / 2
        heads = at + np.array([0.0, half if side == "right" else -half, 0.0])
        return cls(**{**subject.to_mapping(), "head_positions_mm": heads})

    def fixating(self, targets_mm: ArrayLike, rig: Rig, **scene: Any) -> Frames:
        """Compute the frames in which the subject fixates targets, one after the other.

        Args:
            targets_mm: (n, 3) or (3,) world points.
            rig: the cameras, lights and screen that observe the eyes.
            scene: further fields of `Scene`: `region`, `look`, `sensor`, `seed`, ...

        Raises:
            InputError: a value does not fit, or no pose of an eye fixates a target.
        """
        return Scene(self, rig, targets=Targets.at(targets_mm), **scene).frames()

    def looking(self, directions_deg: ArrayLike, rig: Rig, **scene: Any) -> Frames:
        """Compute the frames in which the eyes' optic axes take given directions, one after the other.

        Args:
            directions_deg: (n, 2) or (2,) azimuth (positive to the subject's left) and elevation (positive up).
            rig: the cameras, lights and screen that observe the eyes.
            scene: further fields of `Scene`.

        Raises:
            InputError: a value does not fit.
        """
        return Scene(self, rig, poses=EyeDirection.listed(directions_deg), **scene).frames()
