"""A subject in Python code: eyes that look at something, and the frames that come of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Self

from numpy.typing import ArrayLike
from pydantic import Field

from ..population.people import Person
from ..region.anatomy import Region
from ..region.look import Look
from ..rig.rig import Rig
from .scene import Frames, Scene
from .spec import Eye, EyeDirection, SubjectSpec, Targets


class Subject(SubjectSpec):
    """The subject with its eye model. A scene file gives the eye under a key of its own."""

    POSITIONAL: ClassVar[tuple[str, ...]] = ("eye",)
    if TYPE_CHECKING:

        def __init__(self, eye: Any = None, **fields: Any) -> None: ...

    eye: Eye = Field(default=Eye(), description="the eye model and its settings")
    person: Person | None = Field(default=None, description="a drawn person, whose eyes replace the eye model")
    look: Look | None = Field(default=None, description="albedos and textures of the eye; default: the scene's")
    region: Region | None = Field(default=None, description="lids, lashes, brow and skin; default: the scene's")

    @classmethod
    def of(cls, person: Person, **fields: Any) -> Self:
        """The subject that a drawn person is.

        Args:
            person: the person.
            fields: further fields, such as `eyes` or `luminance_cd_m2`.

        Raises:
            InputError: an eye cannot exist, or a value does not fit.
        """
        own: dict[str, Any] = {"look": person.look(), "region": person.region()}
        if "ipd_mm" not in fields:
            own["ipd_mm"] = person.apex_distance_mm
        return cls(person=person, **{**own, **fields})

    def fixating(self, targets_mm: ArrayLike, rig: Rig, **scene: Any) -> Frames:
        """The frames in which the subject fixates targets, one after the other.

        Args:
            targets_mm: (n, 3) or (3,) world points.
            rig: what observes the eyes.
            scene: further fields of `Scene`: `region`, `look`, `sensor`, `seed`, ...

        Raises:
            InputError: a value does not fit, or a target that no pose of an eye fixates.
        """
        return Scene(self, rig, targets=Targets.at(targets_mm), **scene).frames()

    def looking(self, directions_deg: ArrayLike, rig: Rig, **scene: Any) -> Frames:
        """The frames in which the optic axes of the eyes have directions, one after the other.

        Args:
            directions_deg: (n, 2) or (2,) azimuth (positive to the subject's left) and elevation (positive up).
            rig: what observes the eyes.
            scene: further fields of `Scene`.

        Raises:
            InputError: a value does not fit.
        """
        return Scene(self, rig, poses=EyeDirection.listed(directions_deg), **scene).frames()
