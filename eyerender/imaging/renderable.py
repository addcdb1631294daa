"""Protocols of a scene and its frames for rendering; `Scene` and `Frames` fulfil them."""

from __future__ import annotations

from typing import Any, Protocol, Self, runtime_checkable

from ..analytic.observer import Traceable, TraceableScene
from ..base.arrays import Floats
from ..eye.contact import ContactLens
from ..eye.model import EyeModel
from ..population.people import Person
from ..region.anatomy import Region
from ..region.look import Look
from ..rig.camera import Window
from ..rig.imaging import Ambient, Lens, Motion, Picture
from ..rig.sensor import Sensor
from ..scene.observation import Index


class EyeSettings(Protocol):
    """Settings of the eye model."""

    @property
    def line_of_sight(self) -> str:
        """The line of sight that meets a target: `chief_ray` or `entrance_window`."""
        ...


class PictureSettings(Protocol):
    """The keys of a scene that its pictures and labels depend on."""

    @property
    def eye(self) -> EyeSettings:
        """Settings of the eye model."""
        ...

    @property
    def person(self) -> Person | None:
        """The drawn person, if there is one."""
        ...

    @property
    def region(self) -> Region | None:
        """Lids, lashes, brow and skin, as written: the files of a head mesh are relative to the scene's folder."""
        ...

    @property
    def image(self) -> Picture:
        """The rendered part of the sensor, and its samples."""
        ...

    @property
    def sensor(self) -> Sensor:
        """Aperture, exposure and sensor."""
        ...

    @property
    def look(self) -> Look:
        """Albedos and textures of the eye."""
        ...

    @property
    def lens(self) -> Lens:
        """Defocus and vignetting."""
        ...

    @property
    def sequence(self) -> object | None:
        """Eyes, lids, head and rig in time."""
        ...

    @property
    def motion(self) -> Motion | None:
        """Motion during the exposure."""
        ...

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the lights."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the samples and of the sensor's noise."""
        ...


class RenderableScene(TraceableScene, Protocol):
    """A scene whose frames can be rendered."""

    @property
    def spec(self) -> PictureSettings:
        """Spec of the scene, as in its file."""
        ...

    @property
    def region(self) -> Region | None:
        """The eye region, with paths of its files; None for bare eyes."""
        ...

    @property
    def ambient(self) -> Ambient:
        """Light other than that of the lamps, with paths of its files."""
        ...

    @property
    def accommodation_d(self) -> float | None:
        """Accommodation, D; None if the eye is focused on its target."""
        ...

    def refuse_spectacles(self, what: str) -> None:
        """Raise an error where spectacles are worn."""
        ...

    def eye(self, side: str, head_mm: tuple[float, ...] | None = None) -> EyeModel:
        """Return the numeric eye of a side, with the lenses worn at a position of the head."""
        ...

    def eye_position_mm(self, side: str) -> Floats:
        """Return the apex of an unrotated eye, (3,) mm."""
        ...

    def eye_at(self, index: Index, row: int) -> EyeModel:
        """Return the numeric eye of one row, with the pupil as it is then."""
        ...

    def region_at(self, index: Index, row: int) -> Region | None:
        """Return the region of the eye of one row, with its lids as they are then; None for a bare eye."""
        ...

    def contact_lens(self, side: str) -> ContactLens | None:
        """Return the contact lens on an eye."""
        ...

    def refraction_d(self, side: str) -> float:
        """Return the refraction of an eye, D."""
        ...

    def stop_diameter_mm(self, side: str) -> float:
        """Return the diameter of an eye's stop."""
        ...

    def window(self, camera: int, head: int, eye: int) -> Window:
        """Return the rendered window."""
        ...

    def window_size_px(self, camera: int) -> tuple[int, int]:
        """Return the size of a camera's windows."""
        ...

    def with_(self, *, spp: int | None, **fields: Any) -> Any:
        """Return the scene with other values of its keys."""
        ...


@runtime_checkable
class RenderableFrames(Traceable, Protocol):
    """Frames that can be rendered: a row is one eye in one frame."""

    @property
    def scene(self) -> RenderableScene:
        """The scene."""
        ...

    def __len__(self) -> int: ...

    def take(self, rows: Any) -> RenderableFrames:
        """Select rows."""
        ...

    def at(self, rows: Any, time_s: Floats) -> RenderableFrames:
        """Select rows of a sequence and return their eyes at other times, s."""
        ...

    def of_scene(self, scene: Any) -> Self:
        """Keep the eyes and poses in another scene."""
        ...


@runtime_checkable
class RenderableFrame(RenderableFrames, Protocol):
    """One row of frames."""

    @property
    def side(self) -> str:
        """The eye, right or left."""
        ...


@runtime_checkable
class RenderableSource(Protocol):
    """A scene, which poses its eyes in all of its frames."""

    def frames(self) -> RenderableFrames:
        """Compute the pose of every (frame, eye)."""
        ...


def posed_frames(frames: RenderableFrames | RenderableSource) -> RenderableFrames:
    """Return the frames of a scene, or the given frames. Raises TypeError if the argument is neither."""
    found = frames.frames() if isinstance(frames, RenderableSource) else frames
    if not isinstance(found, RenderableFrames):
        raise TypeError(f"give frames or a scene, not {type(frames).__name__}")
    return found
