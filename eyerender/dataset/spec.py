"""The spec of a dataset: a scene template, how many samples, whose, and how they are split and labelled."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ..errors import InputError
from ..scene import is_dataset, shipped_files
from ..spec import FileSpec, Spec

_SPLIT = re.compile(r"[a-z][a-z0-9]*")


class LabelsSpec(Spec):
    """Which labels are written besides those that every image has."""

    boundary_points: Annotated[int, Field(ge=6, le=360)] = Field(default=30, description="of the pupil, in the record")
    amodal_masks: bool = Field(default=False, description="also masks of the eye as if nothing stood before it")
    noiseless: bool = Field(default=False, description="also each image without the sensor's noise, of one rendering")

    @property
    def pictures(self) -> tuple[str, ...]:
        """The kinds of pictures that every image has; each kind has a folder of its own."""
        more = {"amodal_masks": self.amodal_masks, "noiseless": self.noiseless}
        return ("images", "masks", *(kind for kind, wanted in more.items() if wanted))


class DatasetSpec(FileSpec):
    """A dataset file; see the documentation for draws, which may stand in place of any value of `scene`."""

    kind: Literal["dataset"]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    description: str = ""
    count: Annotated[int, Field(ge=1, le=10**9)] = Field(description="samples")
    shard_size: Annotated[int, Field(ge=1, le=100_000)] = Field(default=64, description="samples in a shard")
    subjects: Annotated[int, Field(ge=1, le=10**9)] | None = Field(
        default=None, description="identities; each has a run of consecutive samples; default: one a sample"
    )
    splits: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default={"train": 1.0}, description="name -> share of the subjects; shares are scaled to 1"
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    scene: dict[str, Any] = Field(description="a scene in which any value may be a draw")
    eye_parameters: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="eye model -> dotted path in its eye file -> value or draw"
    )
    labels: LabelsSpec = LabelsSpec()
    require: Literal["pupil", "nothing"] = Field(
        default="pupil", description="pupil: an image whose window does not hold the apparent pupil is drawn again"
    )
    attempts: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=20, description="how often a sample that cannot be made is drawn before it is given up"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.subjects is not None and self.subjects > self.count:
            raise ValueError("subjects: must be <= count")
        if not self.splits:
            raise ValueError("splits: needs at least one")
        for name in self.splits:
            if not _SPLIT.fullmatch(name):
                raise ValueError(f"splits.{name}: a name is lower-case letters and digits")
        return self

    @property
    def subject_count(self) -> int:
        """How many identities there are."""
        return self.subjects or self.count

    @property
    def shard_count(self) -> int:
        """How many shards there are."""
        return -(-self.count // self.shard_size)

    def shard_samples(self, shard: int) -> range:
        """The samples of a shard."""
        return range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.count))


def shipped_datasets() -> dict[str, Path]:
    """Name -> file of the dataset specs that come with the package."""
    return {name: path for name, path in shipped_files().items() if is_dataset(path)}


def find_dataset(spec: str | Path) -> Path:
    """The file of a dataset spec, by its path or by the bare name of a shipped one; raises `InputError`."""
    path, shipped = Path(spec), shipped_datasets()
    if str(spec) in shipped and not path.is_file():
        return shipped[str(spec)]
    if path.suffix not in (".yaml", ".yml") and not path.exists():
        raise InputError(f"no such dataset file; shipped: {', '.join(shipped)}", source=str(spec))
    if path.is_file() and not is_dataset(path):
        raise InputError("is no dataset; write 'kind: dataset'", source=str(spec), path="kind")
    return path
