"""The content of a scene file: eye, subject, rig, targets, and how images are taken."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)

from ..base.errors import InputError
from ..base.spec import EYES, FileSpec, KeyProblem, Positive, Side, Spec, Vec2, Vec3
from ..eye.biometry import BiometrySpec
from ..eye.catalogue import load_eye, refuse_unknown
from ..eye.contact import ContactLenses
from ..eye.margin import PupilMargin
from ..eye.model import EyeModel
from ..eye.spec import EyeSpec
from ..eye.spectacles import Spectacles, lenses_of
from ..population.people import Person, PersonChoice, chosen_person
from ..region.anatomy import Region
from ..region.look import Look
from ..rig.camera import EyeNames, serves
from ..rig.imaging import Ambient, Lens, Motion, Picture, samples_for
from ..rig.rig import Rig
from ..rig.sensor import Sensor
from .observation import MAX_GLINTS
from .sequence.spec import GazeModel, Sequence

DATASET_KIND = "dataset"
Count = Annotated[int, Field(ge=1, le=1000)]
# An observation is one eye in one frame. The analysis of this many takes about 1 GB of memory, and their records some 2
# GB.
MAX_OBSERVATIONS = 200_000


Model = Annotated[
    Annotated[str, Tag("name")] | Annotated[EyeSpec, Tag("EyeSpec")],
    Discriminator(lambda value: "EyeSpec" if isinstance(value, Mapping | EyeSpec) else "name"),
]


class Eye(Spec):
    """The eye model and its settings.

    >>> er.Eye.load("E4", pupil_diameter_mm=4.0).build("left").side
    'left'
    """

    POSITIONAL: ClassVar[tuple[str, ...]] = ("model",)
    if TYPE_CHECKING:

        def __init__(self, model: Any = "E2", **fields: Any) -> None: ...

    model: Model = Field(
        default="E2", description="a catalogue name, an eye file (relative to the scene), or the keys of an eye file"
    )
    biometry: BiometrySpec | None = Field(
        default=None, description="numbers of a biometer, from which the eye is made, in place of `model`"
    )
    pupil_diameter_mm: Positive | None = Field(
        default=None, description="diameter of the anatomical pupil; default: the eye file's"
    )
    line_of_sight: Literal["chief_ray", "entrance_window"] = Field(
        default="chief_ray",
        description="line of sight that meets the target: through the middle of the stop, or through the centre of the "
        "entrance window (Aguirre 2019)",
    )
    margin: PupilMargin | None = Field(default=None, description="boundary of the pupil; default: the eye file's")

    @field_validator("model")
    @classmethod
    def _known(cls, model: str | EyeSpec) -> str | EyeSpec:
        """Refuse a name that is neither in the catalogue nor that of a file."""
        if isinstance(model, str) and not model.endswith((".yaml", ".yml")):
            refuse_unknown(model)
        return model

    @model_validator(mode="after")
    def _one_eye(self) -> Self:
        if self.biometry is not None and "model" in self.model_fields_set:
            raise KeyProblem("biometry", "cannot be combined with 'model'; both say which eye it is")
        return self

    @model_serializer(mode="wrap")
    def _without_default(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the default model where `biometry` is given."""
        found: dict[str, Any] = serialise(self)
        return found if self.biometry is None else {key: value for key, value in found.items() if key != "model"}

    @classmethod
    def load(cls, model: str | EyeSpec, **fields: Any) -> Self:
        """Create an eye and check that it is physically possible.

        Args:
            model: a name of the catalogue ("E1" to "E5"), an eye file, or the eye's own record.
            fields: further fields of `Eye`, such as `pupil_diameter_mm`.

        Raises:
            InputError: there is no such eye, or a value does not fit.
        """
        eye = cls(model, **fields)
        eye.build()
        return eye

    def spec(self, base: Path | None = None) -> EyeSpec:
        """Read the eye's surfaces and media; `base` is the folder that an eye file's name is relative to."""
        if self.biometry is not None:
            try:
                return EyeSpec.from_mapping(self.biometry.keys())
            except InputError as error:
                raise error.placed(under="eye.biometry") from None
        if isinstance(self.model, EyeSpec):
            return self.model
        inside = base is not None and self.model.endswith((".yaml", ".yml"))
        return load_eye(str(base / self.model) if base is not None and inside else self.model)

    def named(self, model: str) -> Self:
        """Copy the settings with another eye: a name of the catalogue or an eye file."""
        return self.model_copy(update={"model": model, "biometry": None})

    def build(self, side: Side = "right", *, wavelength_nm: float = 850.0) -> EyeModel:
        """Build the numeric eye of one side."""
        spec = self.spec() if self.margin is None else self.margin.applied(self.spec())
        return spec.build(eye=side, wavelength_nm=wavelength_nm, pupil_diameter_mm=self.pupil_diameter_mm)


MOST_ACCOMMODATION_D = 20.0


Accommodation = Annotated[
    Annotated[Literal["targets"], Tag("TextSpec")]
    | Annotated[float, Field(ge=0, le=MOST_ACCOMMODATION_D), Tag("NumberSpec")],
    Discriminator(lambda value: "TextSpec" if isinstance(value, str) else "NumberSpec"),
]


class SubjectSpec(Spec):
    """The eyes of the subject, their distance, and the head positions."""

    eyes: EyeNames = Field(default=("right", "left"), description="the eyes that are observed")
    ipd_mm: Positive = Field(
        default=63.0,
        description="distance of the corneal apexes of the unrotated eyes, which the paper calls interpupillary "
        "distance; default of a drawn person: the one at which its far pupil distance is the drawn one",
    )
    head_positions_mm: Annotated[tuple[Vec3, ...], Field(min_length=1)] = Field(
        default=((0.0, 0.0, 0.0),), description="displacements of the head in the world; each has frames of its own"
    )
    luminance_cd_m2: Positive | None = Field(
        default=None,
        description="luminance of what the eyes see, which sets the pupil; default: 20 for a drawn person, else the "
        "pupil of the eye model",
    )
    field_deg: Annotated[float, Field(gt=0, le=180)] | None = Field(
        default=None, description="diameter of the lit field; default: 60"
    )
    accommodation_d: Accommodation | None = Field(
        default=None,
        description="dioptres to which the eyes are asked to accommodate, or `targets`: what the mean vergence of the "
        "targets asks of them through the glasses worn, 0 with poses; default: `targets` for a drawn person, else 0",
    )
    age_years: Annotated[float, Field(ge=5, le=100)] | None = Field(
        default=None,
        description="age of eyes that are not drawn, for light and accommodation; default: 28.58, about which the "
        "formula of the pupil turns",
    )
    spectacles: Spectacles | None = Field(
        default=None,
        description="a lens in front of both eyes, a list of lenses in order from the eye, or `{right: .., left: ..}` "
        "of these; default: none",
    )
    contact_lens: ContactLenses | None = Field(
        default=None, description="a soft contact lens on both eyes, or `{right: .., left: ..}`; default: none"
    )


Torsion = Annotated[float, Field(ge=-45, le=45)]


class Targets(Spec):
    """Fixation targets: a grid up to the screen's edges, points on the screen, or points in the world.

    >>> er.Targets(grid=(3, 3)).grid
    (3, 3)
    """

    grid: tuple[Count, Count] | None = Field(default=None, description="columns and rows")
    screen_mm: Annotated[tuple[Vec2, ...], Field(min_length=1)] | None = Field(
        default=None, description="points on the screen, measured to the subject's right and up from its centre"
    )
    world_mm: Annotated[tuple[Vec3, ...], Field(min_length=1)] | None = Field(
        default=None, description="points in the world"
    )
    torsion_deg: Torsion = Field(
        default=0.0, description="torsion, added to that of Listing's law; the eyes see their targets even so"
    )

    @classmethod
    def at(cls, points_mm: ArrayLike) -> Self:
        """Create targets from world points, (3,) or (n, 3) mm."""
        return cls.from_mapping({"world_mm": np.asarray(points_mm, dtype=float).reshape(-1, 3)})

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(v is not None for v in (self.grid, self.screen_mm, self.world_mm)) != 1:
            raise ValueError("give exactly one of grid, screen_mm, world_mm")
        return self


class EyeDirection(Spec):
    """Direction of an eye's optic axis, without a target; torsion follows Listing's law.

    >>> er.EyeDirection.listed([[10, -5], [0, 0]])[0].azimuth_deg
    10.0
    """

    azimuth_deg: Annotated[float, Field(gt=-90, lt=90)] = Field(
        description="azimuth of the optic axis, from +x to the subject's left"
    )
    elevation_deg: Annotated[float, Field(gt=-90, lt=90)] = Field(
        description="elevation of the optic axis, positive upwards"
    )
    torsion_deg: Torsion = Field(default=0.0, description="torsion, added to that of Listing's law")

    @classmethod
    def listed(cls, angles_deg: ArrayLike) -> list[Self]:
        """Create directions from azimuths and elevations, (2,) or (n, 2) degrees."""
        angles = np.asarray(angles_deg, dtype=float).reshape(-1, 2)
        return [cls(azimuth_deg=azimuth, elevation_deg=elevation) for azimuth, elevation in angles]


NOT_A_SCENE = (
    "is the spec of a dataset, not a scene; 'eyerender generate SPEC DIR' makes its images, "
    "'eyerender sample SPEC 0 -o DIR' writes one of its scenes"
)
NOT_A_DATASET = (
    "is a scene, not a dataset; 'eyerender render SCENE -o DIR' makes its images; the spec of a dataset says "
    "'kind: dataset' and holds a scene under 'scene'"
)


LIFTED = ("eye", "person", "look", "region")
"""Keys of a scene that a subject in Python code may provide."""


class SceneSpec(FileSpec):
    """Content of a scene file.

    >>> er.load_scene("headset").spec.format
    2
    """

    FORMAT: ClassVar[int] = 2

    format: int = Field(default=FORMAT, description="version of this file format")
    name: Annotated[str, Field(min_length=1)] = Field(description="name of the scene, for reports")
    description: str = Field(default="", description="what the scene is for, in a sentence")
    eye: Eye = Field(default=Eye(), description="the eye model and its settings")
    subject: SubjectSpec = Field(default=SubjectSpec(), description="eyes, their distance and the head's positions")
    population: PersonChoice | None = Field(
        default=None,
        description="a subject drawn from a population, in place of `eye.model`; it becomes `person`, and gives "
        "`look`, `region` and `subject.ipd_mm` where the scene does not",
    )
    person: Person | None = Field(
        default=None, description="a person as drawn, whose eyes replace `eye.model`; written by `population`"
    )
    rig: Rig = Field(description="cameras, lights and screen")
    targets: Targets | None = Field(default=None, description="what the eyes fixate; give this or `poses`")
    poses: Annotated[tuple[EyeDirection, ...], Field(min_length=1)] | None = Field(
        default=None, description="directions of the optic axes, one frame each; give this or `targets`"
    )
    sequence: Sequence | None = Field(
        default=None,
        description="eyes, lids, pupils, head and rig in time, in place of `targets` and `poses`; each camera takes "
        "frames at its own rate",
    )
    wavelength_nm: Annotated[float, Field(ge=350, le=1100)] = Field(
        default=850.0,
        description="wavelength of the lights, at which the eye's refractive indices hold; "
        "quantum efficiency and albedos are for 850 nm",
    )
    image: Picture = Field(default=Picture(), description="the part of the sensor that is rendered, and its samples")
    sensor: Sensor = Field(default=Sensor(), description="aperture, exposure and sensor of all cameras")
    look: Look = Field(default=Look(), description="albedos and textures of the eye")
    region: Region | None = Field(default=None, description="lids, lashes, brow and skin; default: the bare eye")
    lens: Lens = Field(default=Lens(), description="defocus and vignetting")
    motion: Motion | None = Field(default=None, description="motion during the exposure; default: none")
    ambient: Ambient = Field(default=Ambient(), description="light other than that of the lamps")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(
        default=0,
        description="selects the draws of places on lamps and of the sensor noise; the places in a pixel never change",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(given is not None for given in (self.targets, self.poses, self.sequence)) != 1:
            raise ValueError("give either targets or poses, or a sequence")
        if self.sequence is not None:
            self._check_sequence()
        if self.targets is not None and self.targets.world_mm is None and self.rig.screen is None:
            raise ValueError("targets on a screen need rig.screen")
        if self.rig.calibration is None:  # else once its file is read
            self._check_size()
        self._check_response()
        if self.image.window_px is not None:
            for i, camera in enumerate(self.rig.cameras):
                if any(w > r for w, r in zip(self.image.window_px, camera.resolution_px, strict=True)):
                    raise ValueError(f"image.window_px: is larger than the sensor of rig.cameras.{i}")
        return self

    def _check_sequence(self) -> None:
        if self.motion is not None:
            raise KeyProblem("motion", "cannot be combined with a sequence, which moves eyes and head")
        if len(self.subject.head_positions_mm) > 1:
            raise KeyProblem("subject.head_positions_mm", "must be one with a sequence, which moves the head")
        gaze = self.sequence.gaze if self.sequence is not None else None
        if isinstance(gaze, GazeModel) and (gaze.grid or gaze.screen_mm) and self.rig.screen is None:
            raise KeyProblem("sequence.gaze", "targets on a screen need rig.screen")
        lenses = [lens for side in EYES for lens in lenses_of(self.subject.spectacles, side)]
        if any(lens.mount == "rig" for lens in lenses):
            raise KeyProblem("subject.spectacles", "cannot have mount: rig with a sequence so far")

    def _check_response(self) -> None:
        subject = self.subject
        for name in ("spectacles", "contact_lens"):
            if getattr(subject, name) is not None and self.eye.line_of_sight != "chief_ray":
                raise KeyProblem("eye.line_of_sight", f"must be chief_ray with subject.{name}")
        framed = any(lens.frame for side in EYES for lens in lenses_of(subject.spectacles, side))
        if framed and (self.region is None or self.region.head is not None):
            raise KeyProblem("subject.spectacles", "frames are drawn around eyes with a region and without a head mesh")
        if self.person is not None:
            if subject.age_years is not None:
                raise KeyProblem("subject.age_years", "cannot be combined with a drawn person, who has an age")
            return
        if subject.luminance_cd_m2 is None:
            if subject.field_deg is not None:
                raise KeyProblem("subject.field_deg", "needs subject.luminance_cd_m2")
        elif self.eye.pupil_diameter_mm is not None:
            raise KeyProblem("subject.luminance_cd_m2", "cannot be combined with eye.pupil_diameter_mm: both set it")

    @classmethod
    def arranged(cls, data: Mapping[str, Any]) -> Mapping[str, Any]:
        """Move what the subject or its population says to the scene's own keys, and replace `image.spp: auto`."""
        subject = data.get("subject")
        if isinstance(subject, Spec):
            rest = subject.to_mapping()
            lifted = {key: rest.pop(key) for key in LIFTED if key in rest}
            if "eye" in lifted and "eye" in data:
                raise InputError("is given twice, for the scene and for its subject", path="eye")
            data = {**lifted, **data, "subject": rest}
        image, sensor = data.get("image"), data.get("sensor", {})
        if isinstance(image, Mapping) and image.get("spp") == "auto":
            blur = sensor.get("psf_sigma_px") if isinstance(sensor, Mapping) else getattr(sensor, "psf_sigma_px", None)
            blur = blur if isinstance(blur, int | float) else Sensor().psf_sigma_px
            data = {**data, "image": {**image, "spp": samples_for(blur)}}
        return data if data.get("population") is None else _peopled(data)

    @classmethod
    def refuse_other_kinds(cls, data: Mapping[str, Any], *, source: str = "") -> None:
        """Raise an error for a mapping of a dataset or an eye, with a hint how to use it.

        Raises:
            InputError: the mapping is of another kind.
        """
        if data.get("kind") == DATASET_KIND:
            raise InputError(NOT_A_SCENE, source=source)
        if "cornea" in data:
            raise InputError(
                "is an eye file, not a scene; give it with --eye, or as 'eye.model' of a scene", source=source
            )

    def _check_size(self) -> None:
        targets = self.targets
        if self.sequence is not None:
            fixations = 1  # its frames are counted when they are made
        elif targets is None:
            fixations = len(self.poses or ())
        elif targets.grid is not None:
            fixations = targets.grid[0] * targets.grid[1]
        else:
            fixations = len(targets.screen_mm or targets.world_mm or ())
        heads, cameras, eyes = len(self.subject.head_positions_mm), len(self.rig.cameras), len(self.subject.eyes)
        views = sum(serves(camera.eyes, side) for camera in self.rig.cameras for side in self.subject.eyes)
        if views == 0:
            raise KeyProblem("rig.cameras", f"none sees the {' or the '.join(self.subject.eyes)} eye of `subject.eyes`")
        count = fixations * heads * views
        if count > MAX_OBSERVATIONS:
            raise ValueError(
                f"{fixations} fixations, {heads} head positions, {cameras} cameras and {eyes} eyes make {count} "
                f"observations; a scene may have {MAX_OBSERVATIONS}"
            )
        lights = self.rig.light_count
        if count * lights > MAX_GLINTS:
            raise ValueError(
                f"{count} observations of {lights} lights make {count * lights} glints; a scene may have {MAX_GLINTS}"
            )

    def with_image(self, **changes: Any) -> Self:
        """Copy with other values of `image`; a None leaves a value unchanged.

        Raises:
            InputError: naming the option, such as --spp.
        """
        spec = self
        for name, value in changes.items():
            if value is not None:
                spec = spec.replaced(f"--{name}", {"image": {**spec.to_mapping()["image"], name: value}})
        return spec


def _peopled(data: Mapping[str, Any]) -> dict[str, Any]:
    """Add the person drawn from the population to a scene's mapping; keys of the scene take precedence."""
    eye = data.get("eye")
    for key in ("model", "biometry"):
        if isinstance(eye, Spec) or (isinstance(eye, Mapping) and key in eye):
            raise InputError("cannot be combined with a population, which gives the eyes", path=f"eye.{key}")
    if data.get("person") is not None:
        raise InputError("cannot be combined with a population, which gives the person", path="person")
    given = data["population"]
    try:
        person = chosen_person(given.to_mapping() if isinstance(given, Spec) else given)
    except InputError as error:
        raise error.placed(under="population") from None
    out = with_person({key: value for key, value in data.items() if key != "population"}, person)
    share = given.corrected if isinstance(given, PersonChoice) else float(given.get("corrected", 0.0))
    if share and not {"spectacles", "contact_lens"} & out["subject"].keys():
        out["subject"] = {**out["subject"], **person.worn(share)}
    return out


def with_person(data: Mapping[str, Any], person: Person) -> dict[str, Any]:
    """Add a person to a scene's mapping; its pupil distance, look and region apply where the scene has none."""
    subject = data.get("subject") or {}
    subject = subject.to_mapping() if isinstance(subject, Spec) else subject
    if "ipd_mm" not in subject:
        subject = {"ipd_mm": _apex_distance_mm(person), **subject}
    out = {**data, "person": person.to_mapping(), "subject": _with_own_lenses(subject, person)}
    for key, own in (("look", person.look()), ("region", person.region())):
        given = data.get(key, {})
        given = given.to_mapping() if isinstance(given, Spec) else given
        if isinstance(given, Mapping) and not (key == "region" and given.get("head") is not None):
            out[key] = _merged(own.to_mapping(), given)
    return out


def _with_own_lenses(subject: Mapping[str, Any], person: Person) -> dict[str, Any]:
    """Write lenses of the person's own prescription out for each eye."""
    out = dict(subject)
    for key, write in (("spectacles", person.spectacles), ("contact_lens", person.contact_lens)):
        given = out.get(key)
        if isinstance(given, Mapping) and given.get("prescription") == "own":
            out[key] = write(**{name: value for name, value in given.items() if name != "prescription"})
    return out


def _apex_distance_mm(person: Person) -> float:
    try:
        return person.apex_distance_mm
    except InputError as error:
        raise error.placed(under="person") from None


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        value = value.to_mapping() if isinstance(value, Spec) else value
        inner = out.get(key)
        out[key] = _merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return out
