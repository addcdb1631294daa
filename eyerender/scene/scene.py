"""A scene (one subject, one rig, and what is looked at), and its frames with poses.

Frames are ordered by head position, then fixation, then camera; within a frame the right eye comes first.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, Literal, Self, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import ArrayValue, Bools, Floats, Indices, take_rows
from ..base.errors import InputError, InputWarning
from ..base.spec import Side, Spec, file_digest
from ..base.status import Status
from ..eye.contact import ContactLens, contact_lens_of
from ..eye.fixation import fixations, with_torsion
from ..eye.margin import PupilMargin
from ..eye.model import EyeModel, Stop
from ..eye.pose import listing_torsion
from ..eye.spec import EyeSpec
from ..eye.spectacles import SpectacleLens, demand_through_d, lenses_of
from ..population.eyes import amplitude_d
from ..population.people import Person, PopulationSpec
from ..population.response import REFERENCE_AGE, responding
from ..population.table import default_table
from ..region.anatomy import MOVEMENTS, Region
from ..region.face import face_depth
from ..rig.camera import PinholeCamera, Window
from ..rig.exposure import automatic_exposure, iris_radiance
from ..rig.imaging import Ambient, Opening
from ..rig.light import Lamp
from ..rig.plausibility import (
    fold_warnings,
    length_warnings,
    mirror_warnings,
    place_warnings,
    pupil_warnings,
    timing_warnings,
    vertex_warnings,
    view_warnings,
    wavelength_warnings,
)
from ..rig.rig import Rig, RigGeometry, RigLike
from ..rig.sensor import Sensor
from ..rig.timing import FrameTimes
from .observation import EYES, Index, PoseTruth
from .spec import EyeDirection, SceneSpec, SubjectSpec, Targets
from .timeline import at_other_times, instants_of, rig_motions, rows_at, rows_in_time, stops_of

# Parts worn on a face may press the skin a little. Farther than 45 mm from an eye, the face is only a guess.
_BELOW_SKIN_MM, _FACE_MM = 2.0, 45.0

EYE_WINDOW_MM = (32.0, 24.0)
"""Default size (mm) of a window around each of two eyes: both lids and the corners are inside."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames(ArrayValue):
    """The frames of a scene with the pose of each eye: the input of every observer.

    A row is one eye in one frame (an exposure of one camera). `index` (n rows) gives its eye, camera and target, and
    `pose` (n rows) the pose of the eye.

    >>> frames = er.load_scene("guestrin2006").frames()
    >>> len(frames), len(frames[:4])
    (90, 4)
    """

    scene: Scene
    index: Index
    pose: PoseTruth

    def __len__(self) -> int:
        return len(self.index)

    @overload
    def __getitem__(self, row: int) -> Frame: ...
    @overload
    def __getitem__(self, row: slice | Indices | Bools) -> Frames: ...
    def __getitem__(self, row: int | slice | Indices | Bools) -> Frames:
        """Select one row as a `Frame`, or several (a slice, indices or a mask)."""
        if not isinstance(row, int | np.integer):
            return self.take(row)
        number = range(len(self))[row]  # an index beyond the end is an IndexError, as in a list
        return Frame(self.scene, self.index.take([number]), self.pose.take([number]))

    def __iter__(self) -> Iterator[Frame]:
        return (self[row] for row in range(len(self)))

    def take(self, rows: Any) -> Frames:
        """Select rows (indices, a slice or a mask)."""
        return Frames(self.scene, self.index.take(rows), self.pose.take(rows))

    def at(self, rows: Any, time_s: Floats) -> Frames:
        """Select rows of a sequence and return their eyes at other times, s."""
        return Frames(self.scene, *at_other_times(self.scene, self.index.take(rows), time_s))

    def seen_by(self, rig: RigLike | None) -> Self:
        """Observe the same eyes with another rig that has as many cameras; None changes nothing.

        Raises:
            InputError: the rig has another number of cameras, or one does not see an eye of its frames.
        """
        if rig is None or (built := rig.build(self.scene.spec.subject.ipd_mm)) == self.scene.rig:
            return self
        if len(built.cameras) != len(self.scene.rig.cameras):
            raise InputError(
                f"are {len(built.cameras)}, but the frames were made for {len(self.scene.rig.cameras)}",
                path="rig.cameras",
            )
        for eye, camera in set(zip(self.index.eye.tolist(), self.index.camera.tolist(), strict=True)):
            if not built.cameras[camera].sees(EYES[eye]):
                raise InputError(f"does not see the {EYES[eye]} eye of these frames", path=f"rig.cameras.{camera}.eyes")
        return self.of_scene(self.scene.replaced(rig=built))

    def of_scene(self, scene: Scene) -> Self:
        """Keep the eyes and poses, but replace the scene by one with another rig or other image settings."""
        return replace(self, scene=scene)


class Frame(Frames):
    """One row of `Frames`: one eye in one frame.

    >>> er.load_scene("headset").frames()[0].pose.azimuth_rad.round(3).tolist()
    [0.349]
    """

    __slots__ = ()

    @property
    def side(self) -> str:
        """The eye, right or left."""
        return EYES[int(self.index.eye[0])]


@dataclass(frozen=True, slots=True, init=False)
class Scene:
    """A scene ready to be observed: what the scene's file says, the eye's spec and the numeric rig.

    >>> scene = er.load_scene("headset").with_(pupil_diameter_mm=3)
    >>> len(scene.frames())
    9

    Attributes:
        spec: what a scene file says.
        rig: the numeric rig.
        base: folder to which the files of its pictures (an HDR map, a head mesh) are relative, by default the current
            one.
        source: name of the scene's file in messages.
    """

    spec: SceneSpec
    rig: RigGeometry
    base: Path | None = field(compare=False)
    source: str = field(compare=False)
    _eyes: EyeSpec | _DrawnEyes

    def __init__(
        self, subject: SubjectSpec | None = None, rig: Rig | None = None, *, name: str = "scene", **fields: Any
    ):
        """Build a scene from objects.

        Args:
            subject: the subject, with the eye model.
            rig: cameras, lights and screen.
            name: name of the scene in reports.
            fields: the other fields of `SceneSpec`: `targets`, `poses` or `sequence`, `region`, `look`, `sensor`,
                `lens`, `ambient`, `motion`, `image`, `wavelength_nm`, `seed`, `description`.

        Raises:
            InputError: a value does not fit, or an eye is impossible.
        """
        given = {key: value for key, value in {"subject": subject, "rig": rig, **fields}.items() if value is not None}
        made = Scene.of(SceneSpec(name=name, **given))
        for warning in length_warnings(made.spec.to_mapping()):
            warnings.warn(f"{warning.path}: {warning.reason}", stacklevel=2)
        for name in made.__slots__:
            object.__setattr__(self, name, getattr(made, name))

    @classmethod
    def compiled(
        cls,
        spec: SceneSpec,
        eye_spec: EyeSpec | None = None,
        *,
        rig: RigGeometry | None = None,
        base: Path | None = None,
        source: str = "",
    ) -> Scene:
        """Create a scene from validated parts; without a `rig`, that of the spec is built.

        The numbers of calibration files, and the exposure that the scene leaves open, become part of the spec. Without
        an `eye_spec`, the eye is that of the spec; a drawn person always has individual eyes.

        Raises:
            InputError: an eye of the person is physically impossible.
        """
        if (authored := spec.rig.resolved(base)) is not spec.rig:
            device, spec = spec.rig.calibration, spec.model_copy(update={"rig": authored})
            if device is not None:
                spec = SceneSpec.from_mapping(spec.to_mapping(), source=source)  # whose checks need all cameras
        if spec.sequence is not None and (read := spec.sequence.resolved(base)) is not spec.sequence:
            spec = spec.model_copy(update={"sequence": read})
        built = spec.rig.located(base).build(spec.subject.ipd_mm) if rig is None else rig
        if spec.sensor.exposure_ms is None:
            spec = spec.model_copy(update={"sensor": _exposed(spec, built)})
        eyes: EyeSpec | _DrawnEyes
        if spec.person is not None:
            eyes = _drawn_eyes(spec, spec.person, built)
        else:
            eyes = spec.eye.spec(base) if eye_spec is None else eye_spec
        scene = object.__new__(cls)
        for name, value in zip(cls.__slots__, (spec, built, base, source, eyes), strict=True):
            object.__setattr__(scene, name, value)
        return scene

    def replaced(
        self, spec: SceneSpec | None = None, *, eye_spec: EyeSpec | None = None, rig: RigGeometry | None = None
    ) -> Scene:
        """Copy with another spec (and its rig), another eye or another rig."""
        return Scene.compiled(
            spec or self.spec,
            eye_spec or (None if isinstance(self._eyes, _DrawnEyes) else self._eyes),
            rig=rig or (self.rig if spec is None else None),
            base=self.base,
            source=self.source,
        )

    @classmethod
    def of(cls, spec: SceneSpec, *, base: Path | None = None, eye: str | None = None, source: str = "") -> Scene:
        """Compile a spec.

        Args:
            spec: the spec.
            base: folder to which its files are relative.
            eye: replaces the scene's eye model.
            source: name of the scene's file in messages.

        Raises:
            InputError: an eye is not possible or, where a `base` is given, a file does not exist.
        """
        if eye is not None:
            spec = spec.model_copy(update={"eye": spec.eye.named(eye), "person": None})
        eye_spec = spec.eye.spec(base if eye is None else None)
        return cls.compiled(spec, eye_spec, base=base, source=source)._checked()

    def _checked(self) -> Scene:
        """Check that the eye can be built and that all files exist; return the scene itself."""
        try:
            for side in EYES if self.spec.person is not None else EYES[:1]:
                self.eye(side)
            self._fold_warnings()
            for file in self.files if self.base is not None else ():
                if not os.path.isfile(file):
                    raise InputError("no such file", source=str(file))
        except InputError as error:
            raise error.placed(source=self.source) from None
        return self

    def with_(
        self,
        changes: Mapping[str, Any] | None = None,
        *,
        pupil_diameter_mm: float | None = None,
        gaze_deg: ArrayLike | None = None,
        target_mm: ArrayLike | None = None,
        spp: int | None = None,
        **fields: Any,
    ) -> Scene:
        """Copy the scene with other values.

        Args:
            changes: new values by dotted path, as in error messages, such as `{"rig.lights.1.radius_mm": 2.5}`; a None
                removes a key. A new exposure time also replaces a gain that the scene has set by its lights.
            pupil_diameter_mm: diameter of the anatomical pupil.
            gaze_deg: azimuth and elevation of the optic axis, (2,) or (n, 2), instead of the targets.
            target_mm: world points that are fixated, (3,) or (n, 3), instead of the targets.
            spp: samples per pixel.
            fields: whole fields of `SceneSpec`, such as `rig`, `region`, `look`, `sensor` or `seed`.

        Raises:
            InputError: a value does not fit, or an eye is impossible.
        """
        data = self.spec.to_mapping()
        if any(path.partition(".")[0] == "population" for path in (*fields, *(changes or {}))):
            data = _without_person(data)
        data |= fields
        if gaze_deg is not None or target_mm is not None:
            data["targets"] = data["poses"] = data["sequence"] = None
        if gaze_deg is not None:
            data["poses"] = EyeDirection.listed(gaze_deg)
        if target_mm is not None:
            data["targets"] = Targets.at(target_mm)
        paths = dict(changes or {})
        if pupil_diameter_mm is not None:
            paths["eye.pupil_diameter_mm"] = pupil_diameter_mm
        if spp is not None:
            paths["image.spp"] = spp
        if "sensor.exposure_ms" in paths and self.spec.sensor == self._exposed_automatically:
            data["sensor"].pop("gain_dn_per_e", None)  # it was chosen with that time
        for path, value in paths.items():
            _put(data, path, value)
        spec = SceneSpec.from_mapping(data)
        # The eye may differ from the one that the scene's file names: one passed in Python, or one with drawn
        # parameters.
        same = (spec.eye.model, spec.eye.biometry) == (self.spec.eye.model, self.spec.eye.biometry)
        return self.replaced(spec, eye_spec=None if same else spec.eye.spec(self.base))._checked()

    def of_first_eye(self) -> Scene:
        """Return the scene with the part of its rig that its first eye meets (`Rig.of_eye`).

        Raises:
            InputError: no camera sees the eye, or no LED lights it.
        """
        side = self.spec.subject.eyes[0]
        if (rig := self.spec.rig.of_eye(side)) is self.spec.rig:
            return self
        subject = self.spec.subject.model_copy(update={"eyes": (side,)})
        return self.replaced(self.spec.model_copy(update={"rig": rig, "subject": subject}))

    @property
    def exposure_excess(self) -> float:
        """Factor by which exposure time and gain exceed those that the scene would set by its lights."""
        own, chosen = self.spec.sensor, self._exposed_automatically
        return own.time_ms * own.gain / (chosen.time_ms * chosen.gain)

    @property
    def _exposed_automatically(self) -> Sensor:
        open_ = self.spec.sensor.model_copy(update={"exposure_ms": None, "gain_dn_per_e": None})
        return _exposed(self.spec.model_copy(update={"sensor": open_}), self.rig)

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.spec.name

    @property
    def pupil_diameter_mm(self) -> float:
        """Diameter of the anatomical pupil: the scene's, or the (right) eye's own."""
        return self.stop_diameter_mm("right")

    def stop_diameter_mm(self, side: str) -> float:
        """Return the diameter of the anatomical pupil of one eye; the eyes of a drawn person differ."""
        if self.spec.person is None:
            return float(2 * self.eye("right").stop.semi_axes_mm[0])
        given = self.spec.eye.pupil_diameter_mm
        return self.eye_file(side).stop.diameter_mm if given is None else given

    def person_numbers(self, side: str) -> dict[str, dict[str, float | int | str]]:
        """Return the person's identity and the numbers of the person and this eye, as metadata of images.

        Empty if no person is drawn. Dots in names become underscores, because the names serve as column names. The name
        of the entrance pupil says that it is that at the table's luminance, not that of an image.
        """
        person = self.spec.person
        if person is None:
            return {}
        k = EYES.index(side)
        numbers = {
            name.replace(".", "_"): value[k] if isinstance(value, tuple) else value
            for name, value in person.numbers.items()
        }
        if "entrance_pupil_mm" in numbers:
            luminance = default_table().constant("luminance_cd_m2")
            numbers[f"entrance_pupil_at_{luminance:g}_cd_m2_mm"] = numbers.pop("entrance_pupil_mm")
        who: dict[str, float | int | str] = {"preset": person.preset, "seed": person.seed, "subject": person.subject}
        return {"person": {**who, "sex": person.sex, **numbers}}

    @property
    def eye_spec(self) -> EyeSpec:
        """Eye file; of a drawn person the right eye's."""
        return self.eye_file("right")

    @property
    def left_eye_spec(self) -> EyeSpec:
        """Eye file of the left eye, written as a right eye; the same object where it is the mirror image."""
        return self.eye_file("left")

    @property
    def eye_name(self) -> str:
        """Name of the eye file, the same for both eyes of a drawn person."""
        return self.eye_file(self.spec.subject.eyes[0]).name

    def eye_file(self, side: str) -> EyeSpec:
        """Return the eye file of one side, written as a right eye.

        Raises:
            InputError: a drawn eye, which is not observed, is physically impossible.
        """
        return self._eyes if isinstance(self._eyes, EyeSpec) else self._eyes.of("left" if side == "left" else "right")

    def warnings(self) -> list[InputWarning]:
        """Return warnings of probable mistakes: a pupil of 0.4 mm, lengths in metres, a lamp in the head, ...

        Nothing is traced or rendered. An empty list does not mean that the scene is good.
        """
        spec, rig = self.spec, self.rig
        positions = [np.array(head) for head in spec.subject.head_positions_mm]
        at = [f" at head position {k}" if len(positions) > 1 else "" for k in range(len(positions))]
        heads = {f"head{where}": head for where, head in zip(at, positions, strict=True)}
        eyes = {
            f"{side} eye{where}": self.eye_position_mm(side) + head
            for where, head in zip(at, positions, strict=True)
            for side in spec.subject.eyes
        }
        cameras = [
            f"rig.cameras.{i}.{'position_mm' if camera.calibration is None else 'calibration'}"
            for i, camera in enumerate(spec.rig.cameras)
        ]
        lights = [
            f"rig.lights.{i}.{'position_mm' if light.ring is None else 'ring'}"
            for i, light in enumerate(spec.rig.lights)
            for _ in range(1 if light.ring is None else light.ring.count)
        ]
        pupil = "eye.pupil_diameter_mm" if spec.eye.pupil_diameter_mm is not None else "eye.model"
        found = [
            *pupil_warnings(self.pupil_diameter_mm, pupil),
            *wavelength_warnings(spec.wavelength_nm),
            *length_warnings(spec.to_mapping()),
            *vertex_warnings(spec.to_mapping()),
            *(timing_warnings(self.timings) if spec.sequence is not None else ()),
            *(spec.sequence.warnings(bare=self.region is None) if spec.sequence is not None else ()),
            *place_warnings(rig, eyes, heads, cameras, lights),
            *mirror_warnings(spec.rig.cameras, eyes),
            *self._face_warnings([*zip(cameras, rig.cameras, strict=True)], [*zip(lights, rig.lights, strict=True)]),
            *view_warnings(rig, self._views(), [f"rig.cameras.{i}" for i in range(len(rig.cameras))]),
            *self._fold_warnings(),
        ]
        return [warning.at(self.source) for warning in found]

    def _views(self) -> dict[int, list[tuple[Window, Floats]]]:
        """Return the windows of each camera, each with the corneal apex that it shows."""
        views: dict[int, list[tuple[Window, Floats]]] = {c: [] for c in range(len(self.rig.cameras))}
        for (c, k, side), window in self.windows().items():
            head = np.array(self.spec.subject.head_positions_mm[k])
            views[c].append((window, self.eye_position_mm(EYES[side]) + head))
        return views

    def _fold_warnings(self) -> list[InputWarning]:
        if all(camera.fold[0] == np.inf for camera in self.rig.cameras):
            return []
        paths = [f"rig.cameras.{i}.distortion" for i in range(len(self.rig.cameras))]
        return fold_warnings(self.rig, self._views(), paths)

    def _face_warnings(
        self, cameras: list[tuple[str, PinholeCamera]], lights: list[tuple[str, Lamp]]
    ) -> list[InputWarning]:
        """Warn of cameras and lamps, given with their paths, below the skin at the first head position."""
        region, found = self.spec.region, dict[str, InputWarning]()
        if region is None or region.head is not None:
            return []
        places = [(path, "camera", camera.nodal_point_mm) for path, camera in cameras]
        places += [(path, "lamp", lamp.position_mm) for path, lamp in lights]
        head = np.array(self.spec.subject.head_positions_mm[0])
        for side in self.spec.subject.eyes:
            for path, what, place in places:
                x, y, z = place - self.eye_position_mm(side) - head
                nasal = y if side == "right" else -y
                below = float(face_depth(region.face, np.array(nasal), np.array(z))) - x
                if np.hypot(y, z) < _FACE_MM and _BELOW_SKIN_MM < below < _FACE_MM:
                    reason = f"the {what} is in the face, {below:.3g} mm below the skin by the {side} eye"
                    found.setdefault(path, InputWarning(code="in-face", reason=reason, path=path))
        return list(found.values())

    def digest(self) -> str:
        """Compute the SHA-256 of everything on which the scene's images depend, including the eye file's content."""
        eyes = {id(eye): eye.digest() for eye in (self.eye_spec, self.left_eye_spec)}
        parts = [self.spec.digest(), *eyes.values(), *(file_digest(file) for file in self.files)]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    @property
    def ambient(self) -> Ambient:
        """Ambient light, with the file of its map as an absolute path."""
        ambient = self.spec.ambient
        if ambient.map is None or ambient.map.file is None:
            return ambient
        file = str((Path.cwd() if self.base is None else self.base.resolve()) / ambient.map.file)
        return ambient.model_copy(update={"map": ambient.map.model_copy(update={"file": file})})

    @property
    def region(self) -> Region | None:
        """Eye region, with the files of a head mesh as absolute paths."""
        region = self.spec.region
        if region is None or region.head is None:
            return region
        return region.model_copy(update={"head": region.head.resolved(self.base)})

    @property
    def files(self) -> tuple[Path, ...]:
        """Files on which the images depend, besides the eye's."""
        ambient, region = self.ambient, self.region
        named = [] if ambient.map is None or ambient.map.file is None else [ambient.map.file]
        if self.spec.region is not None and self.spec.region.head is not None and self.spec.region.head.manifest:
            named.append(str((Path.cwd() if self.base is None else self.base) / self.spec.region.head.files[0]))
        if region is not None and region.head is not None:
            named += [*region.head.files, *([] if region.head.texture is None else [region.head.texture])]
        named += [part.file for part in self.spec.rig.located(self.base).obstacles if part.file is not None]
        return tuple(Path(name) for name in named)

    def located(self) -> SceneSpec:
        """Return a spec that does not depend on its folder: absolute paths, and the manifest of a head included."""
        placed = {"ambient": self.ambient, "region": self.region, "rig": self.spec.rig.located(self.base)}
        return self.spec.model_copy(update=placed)

    @property
    def further_purkinje(self) -> tuple[int, ...]:
        """Orders of the mirror images of the lamps that pictures show besides the glints."""
        return self.spec.image.purkinje

    @property
    def openings(self) -> tuple[Opening, ...]:
        """Openings through which the cameras look."""
        return self.spec.lens.openings

    def eye(self, side: Literal["right", "left"] | str, head_mm: tuple[float, ...] | None = None) -> EyeModel:
        """Build the numeric eye of one side at the scene's wavelength, with the scene's pupil size, margin and glasses.

        `head_mm` is the head's displacement, which lenses on the rig do not follow; default: the first one.
        """
        eye, same = self.spec.eye, self._responding(side)
        built = _built_eye(same, side == "left", self.spec.wavelength_nm, eye.pupil_diameter_mm, eye.margin)
        contact, lenses = self.contact_lens(side), lenses_of(self.spec.subject.spectacles, side)
        on_rig = any(lens.mount == "rig" for lens in lenses)
        head = self.spec.subject.head_positions_mm[0] if head_mm is None else head_mm
        if contact is None and not lenses:
            return built
        return _wearing(_Same(built), contact, lenses, tuple(head) if on_rig else None)

    def _responding(self, side: str) -> _Same[EyeSpec]:
        """Return the eye file of one side, adapted to the light and the viewing distance of the scene."""
        eye, same = self.spec.eye, _Same(self.eye_file(side))
        if self.spec.person is None and (state := _state_of(self.spec, self.rig)) is not None:
            return _responded(same, state, self.spec.wavelength_nm, eye.pupil_diameter_mm, eye.margin)
        return same

    def responding_file(self, side: str) -> EyeSpec:
        """Return the eye file that the numeric eye of one side is built from, written as a right eye."""
        spec, margin = self._responding(side).spec, self.spec.eye.margin
        return spec if margin is None else margin.applied(spec)

    def contact_lens(self, side: str) -> ContactLens | None:
        """Return the contact lens on one eye."""
        return contact_lens_of(self.spec.subject.contact_lens, side)

    def eyes_of(self, index: Index) -> tuple[list[EyeModel], Indices]:
        """Build the numeric eyes of an index, and return which of them each row uses; only observed eyes are built."""
        worn = (lenses_of(self.spec.subject.spectacles, side) for side in EYES)
        if not any(lens.mount == "rig" for lenses in worn for lens in lenses):
            sides, which = np.unique(index.eye, return_inverse=True)
            return [self.eye(EYES[side]) for side in sides], which
        keys, which = np.unique(np.column_stack([index.eye, index.head_mm]), axis=0, return_inverse=True)
        return [self.eye(EYES[int(key[0])], tuple(key[1:].tolist())) for key in keys], which.reshape(-1)

    def refuse_spectacles(self, what: str) -> None:
        """Raise an `InputError` for a scene with spectacles, which `what` does not follow."""
        if self.spec.subject.spectacles is not None:
            raise InputError(f"{what} without spectacles so far", source=self.source, path="subject.spectacles")

    def refuse_lenses(self, what: str, population: PopulationSpec) -> None:
        """Raise an `InputError` where people would wear spectacles or contact lenses, which `what` does not follow."""
        self.refuse_spectacles(what)
        if self.spec.subject.contact_lens is not None:
            raise InputError(f"{what} without contact lenses so far", source=self.source, path="subject.contact_lens")
        if population.corrected:
            raise InputError(f"{what} without glasses so far", path="population.corrected")

    @property
    def accommodation_d(self) -> float | None:
        """Accommodation of the eyes (D); None if each eye focuses on its target as far as it can."""
        person, state = self.spec.person, _state_of(self.spec, self.rig)
        if person is not None:
            return person.accommodation_d(demand_d(self.spec, self.targets_mm))
        return None if state is None or self.spec.subject.accommodation_d is None else state.accommodation_d

    def refraction_d(self, side: str) -> float:
        """Return the spectacle refraction (D) that one eye focuses with: the look's, or a drawn person's, else 0."""
        given, person = self.spec.look.fundus.refraction_d, self.spec.person
        if given is None and person is not None:
            return person.number("refraction_d", "left" if side == "left" else "right")
        return given or 0.0

    def eye_position_mm(self, side: str) -> Floats:
        """Compute the apex of the unrotated eye in the world, (3,) mm, with the head at its reference position."""
        return np.array([0.0, self.spec.subject.ipd_mm / 2 * (1 if side == "left" else -1), 0.0])

    @property
    def targets_mm(self) -> Floats | None:
        """Targets (f, 3) mm in the world, in fixation order; None if the scene gives poses."""
        return targets_of(self.spec, self.rig)

    def index(self) -> Index:
        """Return the index of all (frame, eye) of the scene, in order; n rows.

        A camera has no row of an eye that it does not see.
        """
        if self.spec.sequence is not None:
            return rows_in_time(self)[0]
        spec = self.spec
        targets = self.targets_mm
        fixations = len(targets) if targets is not None else len(spec.poses or ())
        heads = np.array(spec.subject.head_positions_mm, dtype=float)
        sides = np.array(sorted(EYES.index(e) for e in spec.subject.eyes))
        cameras = len(self.rig.cameras)
        seen = np.array([[camera.sees(EYES[side]) for side in sides] for camera in self.rig.cameras])
        head, fixation, camera, side = np.nonzero(np.broadcast_to(seen, (len(heads), fixations, *seen.shape)))
        n, eye = len(head), sides[side]
        instant = head * fixations + fixation
        model = np.empty(n, dtype=object)
        model[:] = self.eye_name
        return Index(
            frame=instant * cameras + camera,
            instant=instant,
            fixation=fixation,
            camera=camera,
            head=head,
            eye=eye,
            eye_model=model,
            target_mm=np.full((n, 3), np.nan) if targets is None else targets[fixation],
            head_mm=heads[head],
            eye_position_mm=np.stack([self.eye_position_mm(EYES[e]) for e in (0, 1)])[eye],
        )

    @property
    def frame_count(self) -> int:
        """Number of frames, one for each head position, fixation and camera, whether it sees an eye or not."""
        if (sequence := self.spec.sequence) is not None:
            return len(self.rig.cameras) * (instants_of(self) if sequence.instants is None else len(sequence.instants))
        fixations = len(self.spec.poses or ()) if self.targets_mm is None else len(self.targets_mm)
        return len(self.spec.subject.head_positions_mm) * fixations * len(self.rig.cameras)

    def frames(self) -> Frames:
        """Compute the pose of every (frame, eye) of the scene: the given one, or the one that fixates the target.

        Raises:
            InputError: no pose of an eye fixates a target; the message names the target and the reason.
        """
        if self.spec.sequence is not None:
            return self._placed(lambda: Frames(self, *rows_in_time(self)))
        index = self.index()
        if self.spec.poses is None:
            return Frames(self, index, self._fixating(index))
        wanted = np.radians([[p.azimuth_deg, p.elevation_deg, p.torsion_deg] for p in self.spec.poses])
        azimuth, elevation, torsion = wanted[index.fixation].T
        pose = PoseTruth(
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            torsion_rad=listing_torsion(azimuth, elevation) + torsion,
            residual_mm=np.zeros(len(index)),
        )
        return Frames(self, index, pose)

    def frames_at(self, time_s: ArrayLike) -> Frames:
        """Return the rows of a sequence at any times (k,), s, whatever the rates of the cameras are.

        Raises:
            InputError: the scene has no sequence.
        """
        if self.spec.sequence is None:
            raise InputError("is missing; only a sequence has times", source=self.source, path="sequence")
        return self._placed(lambda: Frames(self, *rows_at(self, time_s)))

    def _placed(self, made: Callable[[], Frames]) -> Frames:
        """Make frames; errors name the scene's file."""
        try:
            return made()
        except InputError as error:
            raise error.placed(source=self.source) from None

    @property
    def timings(self) -> tuple[FrameTimes, ...]:
        """When each camera takes its frames."""
        pulses = np.array([light.pulse_s for light in self.rig.lights], dtype=float).reshape(-1, 2)
        exposure_s = self.spec.sensor.time_ms * 1e-3
        return tuple(camera.timing(exposure_s, pulses) for camera in self.spec.rig.cameras)

    def rig_motions(self, index: Index) -> tuple[Floats, Floats] | None:
        """Return how a sequence moves the rig in each row: R (n, 3, 3) and t (n, 3) of x' = R x + t; None if not."""
        return rig_motions(self, index)

    def rig_at(self, index: Index, row: int) -> RigGeometry:
        """Return the rig in the world as it stands in one row."""
        motions = self.rig_motions(index.take([row]))
        return self.rig if motions is None else self.rig.moved(motions[0][0], motions[1][0])

    def region_at(self, index: Index, row: int) -> Region | None:
        """Return the eye region of the eye of one row, with its lids as they are then."""
        region, lids = self.region, index.lids[row].tolist()
        if region is None or region.head is not None:
            return region
        moved = {name: value for name, value in zip(MOVEMENTS, lids, strict=True) if np.isfinite(value)}
        region = region.model_copy(update=moved) if moved else region
        return region.of_side(EYES[index.eye[row]])

    def stops_of(self, index: Index) -> Stop | None:
        """Return the stop of each row where a sequence changes it; None if it does not."""
        return stops_of(self, index)

    def eye_at(self, index: Index, row: int) -> EyeModel:
        """Build the numeric eye of one row, with its pupil at that time."""
        eye = self.eye(EYES[index.eye[row]], tuple(index.head_mm[row]))
        stops = self.stops_of(index.take([row]))
        return eye if stops is None else _with_stop(_Same(eye), take_rows(stops, 0))

    def _fixating(self, index: Index) -> PoseTruth:
        # All cameras see the same pose, so each head position, fixation and eye is solved once.
        keys = np.stack([index.head, index.fixation, index.eye], axis=-1)
        _, rows, back = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        eyes, which = self.eyes_of(index)
        found = fixations(
            eyes,
            which[rows],
            index.target_mm[rows],
            index.eye_position_mm[rows] + index.head_mm[rows],
            self.spec.eye.line_of_sight,
        )
        bad = np.flatnonzero(found.status != Status.OK)
        if len(bad):
            row = rows[bad[0]]
            target = ", ".join(f"{v:g}" for v in index.target_mm[row])
            raise InputError(
                f"the {EYES[index.eye[row]]} eye cannot fixate ({target}) mm: {found.reason(int(bad[0]))}",
                path=f"targets.{index.fixation[row]}",
            )
        back, poses = back.reshape(-1), found.poses
        if self.spec.targets is not None and self.spec.targets.torsion_deg:
            seen = index.target_mm[rows] - index.eye_position_mm[rows] - index.head_mm[rows]
            extra = np.full(len(rows), np.radians(self.spec.targets.torsion_deg))
            poses = with_torsion(eyes, which[rows], found, seen, extra)
        return PoseTruth(
            azimuth_rad=poses.azimuth_rad[back],
            elevation_rad=poses.elevation_rad[back],
            torsion_rad=poses.torsion_rad[back],
            residual_mm=found.residual_mm[back],
        )

    def windows(self) -> dict[tuple[int, int, int], Window]:
        """Compute the image window (x0, y0, width, height) of each (camera, head position, eye), in full-sensor pixels.

        A camera has no window of an eye that it does not see.

        A window is centred on the image of the unrotated eye's apex, so it does not move with the gaze; it is kept on
        the sensor. Without `image.window_px` it is the whole sensor for one eye, and `EYE_WINDOW_MM` for two.
        """
        return {
            (c, k, EYES.index(side)): self.window(c, k, EYES.index(side))
            for c, camera in enumerate(self.rig.cameras)
            for k in range(len(self.spec.subject.head_positions_mm))
            for side in self.spec.subject.eyes
            if camera.sees(side)
        }

    def window(self, camera: int, head: int, eye: int) -> Window:
        """Return one of the `windows`: that of a camera, a head position and an eye (0 right, 1 left)."""
        view = self.rig.cameras[camera]
        (w, h), (ww, wh) = view.resolution_px, self.window_size_px(camera)
        position = self.eye_position_mm(EYES[eye]) + np.array(self.spec.subject.head_positions_mm[head])
        (u, v), front = view.project(position)
        front = front and np.isfinite(u) and np.isfinite(v)  # far outside the field of view the distortion may overflow
        x0 = int(np.floor((u if front else (w - 1) / 2) - (ww - 1) / 2 + 0.5))
        y0 = int(np.floor((v if front else (h - 1) / 2) - (wh - 1) / 2 + 0.5))
        return min(max(x0, 0), w - ww), min(max(y0, 0), h - wh), ww, wh

    def window_size_px(self, camera: int) -> tuple[int, int]:
        """Compute width and height of a camera's windows."""
        if self.spec.image.window_px is not None:
            return self.spec.image.window_px
        view = self.rig.cameras[camera]
        w, h = view.resolution_px
        positions = [self.eye_position_mm(side) for side in self.spec.subject.eyes if view.sees(side)]
        # A camera inside an eye has no defined image scale.
        if len(positions) <= 1 or any(np.array_equal(position, view.nodal_point_mm) for position in positions):
            return w, h
        scale = max(map(view.scale_at, positions))
        width, height = (16 * math.ceil(side_mm * scale / 16) for side_mm in EYE_WINDOW_MM)
        return min(width, w), min(height, h)


def _exposed(spec: SceneSpec, rig: RigGeometry) -> Sensor:
    """Set the exposure time of a sensor that states none; without a gain, by the light on the eyes (`rig/exposure.py`).

    The sensor is one for all cameras, so the camera that receives the most light decides.
    """
    if spec.sensor.gain_dn_per_e is not None:
        return spec.sensor.model_copy(update={"exposure_ms": spec.sensor.time_ms})
    head, half = np.array(spec.subject.head_positions_mm[0]), spec.subject.ipd_mm / 2
    albedo, ambient = spec.look.iris_albedo, spec.ambient.irradiance_w_m2
    brightest, lit = 0.0, False
    for side, y in (("right", -half), ("left", half)):
        cameras = [camera for camera in rig.cameras if camera.sees(side)]
        if side in spec.subject.eyes and cameras:
            lamps, place = [rig.lights[k] for k in rig.lights_of(EYES.index(side))], head + np.array([0.0, y, 0.0])
            share = max(camera.light_shares(place)[0] for camera in cameras)
            brightest = max(brightest, share * iris_radiance(lamps, place, albedo, ambient))
            lit |= bool(lamps)
    return automatic_exposure(spec.sensor, brightest, lit=lit, wavelength_nm=spec.wavelength_nm)


def _refuse_change(_scene: Scene, name: str, _value: object) -> None:
    raise AttributeError(f"a Scene cannot be changed; scene.with_({name}=...) gives a changed one")


# A frozen dataclass cannot define this method itself, and its default with slots fails for names that are no fields.
Scene.__setattr__ = _refuse_change  # type: ignore[method-assign,assignment]


def _put(data: dict[str, Any], path: str, value: Any) -> None:
    """Set the value at a dotted path of a mapping, creating the mappings on the way; a None removes what is there."""
    keys = path.split(".")
    here: Any = data
    try:
        for key in keys[:-1]:
            at: Any = int(key) if isinstance(here, list) else key
            inner = here[at] if isinstance(here, list) else here.get(at, {})
            # A copy, because the value may be the caller's own.
            inner = inner.to_mapping() if isinstance(inner, Spec) else copy(inner)
            here[at] = inner
            here = inner
        last: Any = int(keys[-1]) if isinstance(here, list) else keys[-1]
        if value is None and (isinstance(here, list) or last in here):
            del here[last]
        else:
            here[last] = value
    except (AttributeError, IndexError, TypeError, ValueError):
        raise InputError("there is no such key", path=path) from None


def demand_d(spec: SceneSpec, targets_mm: Floats | None) -> float:
    """Compute the accommodation (D) of a scene's eyes: as given, or what its targets demand.

    The vergence of a target is 1 / its distance from the point midway between the eyes, at the first head position, or
    what glasses and contact lenses make of it at the cornea, on average over the eyes. The mean refractive error of a
    drawn person's eyes is added: hyperopes accommodate more, myopes less, and nobody less than 0.
    """
    given = spec.subject.accommodation_d
    if given is not None and given != "targets":
        return given
    if targets_mm is None:
        return 0.0
    distance = np.linalg.norm(targets_mm - np.array(spec.subject.head_positions_mm[0]), axis=-1)
    vergence = float(np.mean(1000.0 / np.maximum(distance, 1.0)))
    if spec.subject.spectacles is not None:
        worn = [lenses_of(spec.subject.spectacles, side) for side in spec.subject.eyes]
        vergence = float(np.mean([demand_through_d(lenses, distance) for lenses in worn]))
    on = [contact_lens_of(spec.subject.contact_lens, side) for side in spec.subject.eyes]
    vergence -= float(np.mean([0.0 if lens is None else lens.power_d for lens in on]))
    if spec.person is not None:
        vergence += spec.person.mean_refraction_d
    return max(vergence, 0.0)


@dataclass(frozen=True, slots=True)
class _State:
    """Conditions to which eyes of the catalogue respond: light and accommodation."""

    age_years: float
    luminance_cd_m2: float | None
    field_deg: float | None
    accommodation_d: float


def _state_of(spec: SceneSpec, rig: RigGeometry) -> _State | None:
    """Return the conditions to which the eyes of a scene respond; None if the eye file is used as it is."""
    subject = spec.subject
    if subject.luminance_cd_m2 is None and subject.accommodation_d is None:
        return None
    demand = 0.0 if subject.accommodation_d is None else demand_d(spec, targets_of(spec, rig))
    age = REFERENCE_AGE if subject.age_years is None else subject.age_years
    response = min(demand, amplitude_d(default_table(), age))
    return _State(age, subject.luminance_cd_m2, subject.field_deg, response)


def targets_of(spec: SceneSpec, rig: RigGeometry) -> Floats | None:
    """Return the targets (f, 3) mm in the world, in fixation order; None if the scene gives poses."""
    targets, screen = spec.targets, rig.screen
    if targets is None:
        return None
    if targets.world_mm is not None:
        return np.array(targets.world_mm, dtype=float)
    if screen is None:
        raise InputError("targets on a screen need rig.screen")
    if targets.grid is not None:
        return screen.grid(*targets.grid)
    return screen.world(np.array(targets.screen_mm, dtype=float))


@dataclass(frozen=True, slots=True)
class _DrawnEyes:
    """Eyes of a drawn person (JSON) in the light and at the distance of a scene; each is built on first use."""

    person: str
    luminance_cd_m2: float | None
    field_deg: float | None
    demand_d: float

    def of(self, side: Side) -> EyeSpec:
        """Return the eye file of one side."""
        return _drawn_eye(self, side)


def _drawn_eyes(spec: SceneSpec, person: Person, rig: RigGeometry) -> _DrawnEyes:
    """Create the eyes of a person in a scene's light and at its distance; check that the observed ones can exist."""
    subject = spec.subject
    eyes = _DrawnEyes(
        person.to_json(), subject.luminance_cd_m2, subject.field_deg, demand_d(spec, targets_of(spec, rig))
    )
    try:
        for side in subject.eyes:
            eyes.of(side)
    except InputError as error:
        raise error.placed(under="person") from None
    return eyes


@lru_cache(maxsize=128)
def _drawn_eye(eyes: _DrawnEyes, side: Side) -> EyeSpec:
    """Build an eye of a person; cached, because this takes longer than everything else in a scene."""
    return Person.from_mapping(json.loads(eyes.person)).eye(
        side, luminance_cd_m2=eyes.luminance_cd_m2, field_deg=eyes.field_deg, demand_d=eyes.demand_d
    )


def _without_person(data: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the person from a scene's mapping, and every value that came from the person."""
    rest = {key: value for key, value in data.items() if key not in ("person", "look", "region")}
    rest["eye"] = {key: value for key, value in data["eye"].items() if key != "model"}
    rest["subject"] = {key: value for key, value in data["subject"].items() if key != "ipd_mm"}
    return rest


_Content = TypeVar("_Content", EyeSpec, EyeModel)


@dataclass(frozen=True, slots=True, eq=False)
class _Same(Generic[_Content]):
    """Wrapper of a spec or an eye, compared by identity: comparing the content would take a millisecond."""

    spec: _Content

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.spec is self.spec

    def __hash__(self) -> int:
        return id(self.spec)


@lru_cache(maxsize=32)
def _responded(
    eye: _Same[EyeSpec],
    state: _State,
    wavelength_nm: float,
    pupil_diameter_mm: float | None,
    margin: PupilMargin | None,
) -> _Same[EyeSpec]:
    """Adapt an eye file to the light and the viewing distance of a scene."""
    spec = eye.spec if margin is None else margin.applied(eye.spec)
    try:
        found = responding(
            spec,
            age_years=state.age_years,
            accommodation_d=state.accommodation_d,
            luminance_cd_m2=state.luminance_cd_m2,
            field_deg=state.field_deg,
            own_pupil=pupil_diameter_mm is not None,
            wavelength_nm=wavelength_nm,
        )
    except InputError as error:
        raise error if error.path.startswith("subject.") else error.placed(under="eye.model") from None
    return _Same(found)


@lru_cache(maxsize=32)
def _built_eye(
    eye: _Same[EyeSpec], left: bool, wavelength_nm: float, pupil_diameter_mm: float | None, margin: PupilMargin | None
) -> EyeModel:
    """Build a numeric eye; cached, because observers, renderer and labels request the same one repeatedly."""
    spec = eye.spec if margin is None else margin.applied(eye.spec)
    return spec.build(eye="left" if left else "right", wavelength_nm=wavelength_nm, pupil_diameter_mm=pupil_diameter_mm)


@lru_cache(maxsize=16)
def _with_stop(eye: _Same[EyeModel], stop: Stop) -> EyeModel:
    """Replace the stop of a numeric eye; cached, because renderer and labels compare eyes by identity."""
    return replace(eye.spec, stop=stop)


@lru_cache(maxsize=64)
def _wearing(
    eye: _Same[EyeModel],
    contact: ContactLens | None,
    lenses: tuple[SpectacleLens, ...],
    head_mm: tuple[float, ...] | None,
) -> EyeModel:
    """Put lenses on and before a numeric eye; cached, because observers compare eyes by identity."""
    bare, head = eye.spec, None if head_mm is None else np.array(head_mm)
    if contact is not None:
        try:
            bare = contact.worn_by(bare)
        except InputError as error:
            raise error.placed(under="subject.contact_lens") from None
    return replace(bare, worn=tuple(lens.build(bare.side, bare.wavelength_nm, head) for lens in lenses))
