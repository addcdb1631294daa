"""The spec of a dataset: a scene template, numbers of samples and subjects, splits and labels."""

from __future__ import annotations

import keyword
import os
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from ..base.errors import InputError
from ..base.spec import FileSpec, Positive, Spec
from ..design.tolerances import Tolerance, Tolerances
from ..population.people import PopulationSpec
from ..rig.timing import DEFAULT_RATE_HZ
from ..scene import is_shipped_dataset, refuse_folder, shipped_files
from ..scene.spec import DATASET_KIND, NOT_A_DATASET
from .expressions import FUNCTIONS
from .gathering import extended, with_tables
from .selection import ClipSelection, Selection

# Largest number of samples of a run; a Sobol sequence has no more points.
MAX_COUNT = 10**9
LEAST_SHARDS = 16
PACKED_SHARD = 1000  # samples of a packed shard by default, so that millions of images make some thousand files
SPLITS_SLACK = 0.01  # most by which the sum of shares may differ from 1, so that thirds can be written
SPLIT_NAME = re.compile(r"[a-z][a-z0-9]*")
_selection = lru_cache(maxsize=16)(Selection)

GeometryKind = Literal["depth", "normals", "iris_coordinates", "instances"]


class LabelsSpec(Spec):
    """Optional labels, in addition to those of every image."""

    boundary_points: Annotated[int, Field(ge=6, le=360)] = Field(
        default=30, description="boundary points of the pupil in the record"
    )
    amodal_masks: bool = Field(default=False, description="also write masks of the eye without anything in front of it")
    as_annotated: bool = Field(
        default=False, description="also write masks as people draw them: lids cut the eye, lashes and glints do not"
    )
    noiseless: bool = Field(
        default=False, description="also write each image without sensor noise, from the same rendering"
    )

    highlights: bool = Field(
        default=False,
        description="also write masks of the highlights of wet and oily surfaces (lids, tears, skin, lashes), which "
        "are no glints",
    )

    lens_reflections: bool = Field(
        default=False,
        description="also write masks of where spectacle lenses mirror more light than comes from behind them",
    )

    geometry: tuple[GeometryKind, ...] | None = Field(
        default=None,
        description="also write what each pixel's centre shows: `depth` (mm along the camera's axis), `normals` (in "
        "the camera's frame), `iris_coordinates` (mm toward the nose and up in the plane of the iris, from the centre "
        "of the pupil, as seen through the cornea) and `instances` (masks in which lids, lashes, brow, skin and "
        "background differ); all but the last are .npz files; default: none",
    )

    half_precision: bool = Field(
        default=False, description="store arrays of geometry as float16, which takes half the space or less"
    )

    @property
    def pictures(self) -> tuple[str, ...]:
        """Kinds of images that every sample has; each kind has its own folder."""
        more = ("amodal_masks", "as_annotated", "noiseless", "highlights", "lens_reflections")
        return ("images", "masks", *(kind for kind in more if getattr(self, kind)), *sorted(set(self.geometry or ())))


class DatasetSpec(FileSpec):
    """Content of a dataset file. Draws may replace any value of `scene`; see the documentation.

    >>> er.DatasetSpec.load(er.dataset.find_dataset("people_openeds")).count
    240
    """

    FORMAT: ClassVar[int] = 3

    format: int = Field(default=FORMAT, description="version of this file format")
    kind: Literal["dataset"] = Field(description="declares that the file is a dataset, not a scene")
    name: Annotated[str, Field(min_length=1, max_length=100)] = Field(description="name of the dataset")
    description: str = Field(default="", description="what the dataset is for, in a sentence")
    licence: Annotated[str, Field(min_length=1, max_length=200)] | None = Field(
        default=None, description="licence of the pictures and labels, such as CC-BY-4.0; stated beside them"
    )
    count: Annotated[int, Field(ge=1, le=MAX_COUNT)] = Field(description="number of samples")
    planned: Annotated[int, Field(ge=1, le=MAX_COUNT)] | None = Field(
        default=None,
        description="number of samples of the whole plan, of which `count` are made; beyond it the plan is continued "
        "with new subjects; default: count",
    )
    choice: Literal["first", "spread"] | None = Field(
        default=None,
        description="which samples are made where not all planned ones are: the first ones, or (as with --count) the "
        "first ones of each subject in turn; default: first",
    )
    shard_size: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=64,
        description="samples in a shard; default: 64 (webdataset: 1000), fewer in a small plan, which has 16 shards",
    )
    layout: Literal["files", "webdataset"] | None = Field(
        default=None,
        description="files: each picture is a file; webdataset: each shard is one tar that mixes subjects, with its "
        "metadata packed, for datasets of more than some 100,000 images; default: files",
    )
    subjects: Annotated[int, Field(ge=1, le=MAX_COUNT)] | None = Field(
        default=None, description="number of identities; each has a run of consecutive samples; default: one per sample"
    )
    splits: dict[str, Positive] = Field(
        default={"train": 1.0}, description="name -> share of the subjects; shares add up to 1"
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(default=0, description="selects all draws")
    variables: dict[str, Any] | None = Field(
        default=None,
        description="name -> value or draw, which `{var: EXPRESSION}` in the scene or the eye's parameters refers to; "
        "each is drawn once per sample, or once per subject with `per: subject`",
    )
    scene: dict[str, Any] = Field(description="a scene in which any value may be a draw")
    eye_parameters: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="eye model -> dotted path in its eye file -> value or draw"
    )
    population: PopulationSpec | None = Field(
        default=None,
        description="whom the subjects are drawn from: eyes, lids, face and distance of the pupils; what `scene` says "
        "of `look`, `region` and `subject.ipd_mm` stays; default: the eye of the scene",
    )
    tolerances: Annotated[tuple[Tolerance, ...], Field(min_length=1, max_length=100)] | None = Field(
        default=None,
        description="deviations of each subject's unit from the rig of `scene`: a list, or the name of a file of "
        "tolerances (as for `rig`); labels and `scene_json` state the unit's rig; default: none",
    )
    labels: LabelsSpec = Field(default=LabelsSpec(), description="labels in addition to those that every image has")
    auto_exposure: Annotated[float, Field(ge=0.01, le=2)] | None = Field(
        default=None,
        description="expose each subject as a camera's automatic exposure settles: one exposure time for all of its "
        "samples, at which 98 % of the pixels of the first are at most at this share of full scale (more than 1 "
        "clips); default: the exposure of the scene",
    )
    require: Literal["pupil", "nothing"] = Field(
        default="pupil", description="pupil: draw a sample again if its window does not contain the apparent pupil"
    )
    attempts: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=20, description="number of draws before a sample that cannot be made is given up"
    )

    @model_validator(mode="after")
    def _divide(self) -> Self:
        """Divide a small plan into enough shards for several workers."""
        if "shard_size" not in self.model_fields_set:
            n = self.clip_frames
            size = min(PACKED_SHARD if self.is_packed else self.shard_size, -(-self.planned_count // LEAST_SHARDS))
            object.__setattr__(self, "shard_size", -(-size // n) * n)
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._check_clips()
        if self.population is not None and self.eye_parameters:
            raise ValueError("eye_parameters: cannot be combined with a population; use its 'replace'")
        for name in self.variables or {}:
            if not (name.isidentifier() and name.isascii()) or name in FUNCTIONS or keyword.iskeyword(name):
                raise ValueError(f"variables.{name}: a name must be a plain word that is no function")
        for key in ("population", "person"):
            if key in self.scene:
                raise ValueError(f"scene.{key}: write 'population' next to 'scene', not in it")
        self._check_splits()
        return self

    def _check_clips(self) -> None:
        stamps = (self.scene.get("sequence") or {}).get("timestamps") if "sequence" in self.scene else None
        if isinstance(stamps, Mapping) and stamps.get("dropped_share"):
            raise ValueError("scene.sequence.timestamps.dropped_share: clips of a dataset are whole")
        n = self.clip_frames
        for name in ("count", "planned", "shard_size"):
            if (getattr(self, name) or 0) % n:
                raise ValueError(f"{name}: must be a multiple of {n}, the frames of a clip")
        if self.subjects is not None and self.subjects > self.planned_count // n:
            most = self.planned_count // n
            raise ValueError(f"subjects: must be at most {most} (count or planned), not {self.subjects}")

    def _check_splits(self) -> None:
        if not self.splits:
            raise ValueError("splits: give at least one")
        for name in self.splits:
            if not SPLIT_NAME.fullmatch(name):
                raise ValueError(f"splits.{name}: a name must consist of lower-case letters and digits")
        if abs((total := sum(self.splits.values())) - 1) > SPLITS_SLACK:
            raise ValueError(f"splits: shares must add up to 1, not {total:g}")

    @classmethod
    def gathered(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Merge the spec that a file extends, the rows of its tables, and a file of tolerances into its mapping."""
        found: dict[str, Any] = with_tables(extended(data, find_dataset, folder), folder)
        if isinstance(file := found.get("tolerances"), str):
            found["tolerances"] = Tolerances.load(folder / file).to_mapping()["tolerances"]
        return found

    @classmethod
    def refuse_other_kinds(cls, data: Mapping[str, Any], *, source: str = "") -> None:
        """Check that a mapping is declared as a dataset; InputError if the mapping is of another kind."""
        if data.get("kind") != DATASET_KIND:
            if "rig" in data:
                raise InputError(NOT_A_DATASET, source=source)
            raise InputError(f"is not a dataset; write 'kind: {DATASET_KIND}'", source=source, path="kind")

    @property
    def planned_count(self) -> int:
        """Number of samples of the whole plan; subjects and splits are parts of it."""
        return self.planned or self.count

    @property
    def subject_count(self) -> int:
        """Number of subjects of the whole plan."""
        return self.subjects or self.planned_count // self.clip_frames

    @property
    def has_clips(self) -> bool:
        """Whether samples are frames of clips."""
        return isinstance(self.scene.get("sequence"), Mapping)

    @property
    def clip_frames(self) -> int:
        """Number of samples of a clip: frames of a sequence; 1 without a sequence."""
        if not isinstance(sequence := self.scene.get("sequence"), Mapping):
            return 1
        return _clip_frames(sequence.get("duration_s"), self.scene.get("rig"))

    def first(self, count: int) -> Self:
        """Return the spec of `count` samples of the same plan, spread over its subjects, or of its continuation."""
        planned = self.planned_count
        changes = {"count": count, "planned": None if count == planned else planned}
        return self.replaced("--count", {**changes, "choice": "spread" if count % planned else None})

    @property
    def selection(self) -> Selection | ClipSelection:
        """Plan of a dataset: its samples and the shards that hold them."""
        spread, n = self.choice == "spread" and self.count % self.planned_count > 0, self.clip_frames
        found = _selection(
            count=self.count // n,
            planned=self.planned_count // n,
            subjects=self.subject_count,
            shard_size=self.shard_size // n,
            spread=spread,
            interleave=self.seed if self.is_packed else None,
        )
        return found if n == 1 else ClipSelection(found, n)

    @property
    def is_packed(self) -> bool:
        """Whether shards are packed into tar files."""
        return self.layout == "webdataset"

    @property
    def shards(self) -> Sequence[int]:
        """Numbers of the shards."""
        return self.selection.shards

    def shard_samples(self, shard: int) -> Sequence[int]:
        """Return the samples of a shard."""
        return self.selection.shard_samples(shard)


def _clip_frames(duration_s: Any, rig: Any) -> int:
    """Return the number of frames of a sequence from its keys, which must be plain numbers.

    Raises:
        ValueError: they are not, or cameras have different rates.
    """
    cameras = rig.get("cameras") if isinstance(rig, Mapping) else None
    given = [c.get("frame_rate_hz") for c in cameras if isinstance(c, Mapping)] if isinstance(cameras, list) else []
    if any(isinstance(rate, Mapping) for rate in given) or not isinstance(duration_s, int | float):
        raise ValueError("scene.sequence.duration_s: must be a plain number, and so must frame_rate_hz of the cameras")
    rates = {DEFAULT_RATE_HZ if rate is None else rate for rate in given or [None]}
    if len(rates) > 1:
        raise ValueError("scene.rig.cameras: must have one frame_rate_hz in a dataset of sequences")
    (rate,) = rates
    return max(1, int(duration_s * float(rate) + 1e-6)) if isinstance(rate, int | float) else 1


def shipped_datasets() -> dict[str, Path]:
    """Return the dataset specs that come with the package, as a mapping from name to file.

    >>> "people_openeds" in er.dataset.shipped_datasets()
    True
    """
    return {name: path for name, path in shipped_files().items() if is_shipped_dataset(path)}


def find_dataset(spec: str | Path) -> Path:
    """Return the file of a dataset spec, given its path or the name of a shipped one.

    >>> er.dataset.find_dataset("people_openeds").name
    'people_openeds.yaml'

    Raises:
        InputError: there is no such spec.
    """
    path, shipped = Path(spec), shipped_datasets()
    if not os.path.isfile(path):
        if str(spec) in shipped:
            return shipped[str(spec)]
        if str(spec) in shipped_files():
            raise InputError(NOT_A_DATASET, source=str(spec))
        if path.suffix not in (".yaml", ".yml") and not os.path.exists(path):
            raise InputError(f"no such dataset file; shipped: {', '.join(shipped)}", source=str(spec))
    refuse_folder(path, "a dataset file, or the name of a shipped one")
    return path
