"""The plan of a dataset, which defines sample i as a pure function of (spec, i).

Sample i belongs to subject floor(i S / N) for N planned samples and S subjects. A subject's samples are therefore
consecutive, and all subjects have equally many, give or take one. Beyond N the plan continues in blocks of N samples
and S new subjects (`Selection`). A hash of the subject determines its split (`Plan.split_of`). The memory of a plan
does not grow with the number of samples.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import InputError, InputWarning
from ..base.references import is_reference
from ..base.spec import read_yaml
from ..design.tolerances import Tolerances, drawn_unit
from ..eye.catalogue import catalogue_names, load_eye
from ..eye.spec import EyeSpec
from ..eye.topography import topography_files
from ..population.people import PersonChoice, choice_of, chosen_person
from ..rig.rig import Rig
from ..scene import Scene
from ..scene.observation import EYES
from ..scene.spec import SceneSpec
from .draws import Unit, is_draw, unit_number
from .files import sum_of_file, sums_of_files
from .gathering import aliased_draws
from .options import PlanOptions
from .ownscenes import OwnScenes
from .spec import DatasetSpec, find_dataset
from .template import Template, Turn, possible

# Beyond this many subjects, splits are drawn without sorting them.
RANKED_SUBJECTS = 1_000_000
# Of a function without a spec, whose number of samples may grow: samples of a block of its plan, and of a shard.
_PLANNED, _SHARD = 16_000, 16
_UNIT, _SETTING = 0x75, 0x69  # of the random numbers of units and of settings
_LOOKED_AT = 16  # samples that `Plan.warnings` checks for probable mistakes


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One sample as drawn.

    Attributes:
        turn: identity of the sample: index, subject and attempt.
        split: name of its split.
        scene: plain mapping that `SceneSpec` validates.
        eye: mapping of its eye file; empty for a drawn person, whose eyes differ.
        draws: value of every draw of the spec by its path, None if it was not used.
        base: folder to which the files of the scene are relative.
    """

    turn: Turn
    split: str
    scene: dict[str, Any]
    eye: dict[str, Any]
    draws: dict[str, Any]
    base: Path

    def build(self) -> Scene:
        """Build the scene; InputError if the drawn values do not fit together."""
        spec = SceneSpec.from_mapping(self.scene, source=f"sample {self.turn.sample}")
        eye = _eye(json.dumps(self.eye, sort_keys=True)) if self.eye else None
        scene = Scene.compiled(spec, eye, base=self.base)
        for side in spec.subject.eyes if eye is None else EYES[:1]:
            scene.eye(side)
        return scene

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON and YAML."""
        turn = self.turn
        return {
            "sample": turn.sample,
            "subject": turn.subject,
            "split": self.split,
            "sequence_index": turn.sequence,
            "attempt": turn.attempt,
            "subject_attempt": turn.subject_attempt,
            "draws": self.draws,
            "scene": self.scene,
            "eye": self.eye,
        }


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A dataset spec with its eyes, and the checksums of all files that it names, including eye files.

    `files` maps names, relative to the folder `base`, to SHA-256. Workers of a run find the files there, wherever they
    run. `scenes` is what gives the scenes in place of the spec, if anything does.
    """

    spec: DatasetSpec
    eyes: Mapping[str, Mapping[str, Any]]
    files: Mapping[str, str]
    base: Path
    source: str = ""
    scenes: OwnScenes | None = None

    @classmethod
    def load(
        cls,
        given: str | Path | DatasetSpec | Plan | None,
        *,
        scenes: str | Callable[..., Any] | None = None,
        eye: str | None = None,
        seed: int | None = None,
        count: int | None = None,
        changes: PlanOptions = PlanOptions(),
    ) -> Plan:
        """Load a plan from a file, the bare name of a shipped dataset, or a spec; a plan is returned as it is.

        `scenes`, or `module:function` instead of a file, is a function that gives the scenes (`OwnScenes`). It replaces
        what the spec says of them; without a spec, `count` is needed. `eye` and `seed` replace those of the spec;
        parameters of other eye models are then dropped. `count` requests so many samples of the plan, or of its
        continuation (see `DatasetSpec.first`). `changes` replaces subjects, splits, the size of the pictures and more.

        Raises:
            InputError: the spec cannot be read, or a value does not fit.
        """
        if isinstance(given, Plan):
            if (scenes, eye, seed, count, changes) != (None, None, None, None, PlanOptions()):
                raise InputError("a plan has its eye, seed and count already; give its spec", path="spec")
            return given
        if is_function(given):
            given, scenes = None, str(given)
        own = None if scenes is None else OwnScenes.of(scenes)
        file, spec = _spec_of(given, own, count, changes)
        if seed is not None:
            spec = spec.replaced("--seed", {"seed": seed})
        spec = changes.apply(spec, count)
        count = changes.frames(spec, count)
        if count is not None:
            spec = spec.first(count)
        if own is not None:
            return _of_function(spec, own, eye)
        if eye is not None:
            spec = spec.replaced("--eye", _with_eye(spec, eye))
        return cls.of(spec) if file is None else cls.of(spec, base=file.parent, source=str(file))

    @classmethod
    def of(cls, spec: DatasetSpec, *, base: Path | None = None, source: str = "") -> Plan:
        """Check the template, read the eyes and compute the checksums of all files of a spec.

        File names are relative to `base`, by default the current folder.

        Raises:
            InputError: a file cannot be read.
        """
        eyes: dict[str, Mapping[str, Any]] = {}
        sums: dict[str, str] = {}
        for name in _eye_names(spec, source):
            file = str(base / name) if base is not None and name not in catalogue_names() else name
            try:
                if name not in catalogue_names() and os.path.isfile(file):
                    # The checksum is computed before the file is read, so that a change in between is detected when the
                    # run checks its files.
                    sums[name] = sum_of_file(Path(file))
                    for points in topography_files(file):
                        sums[str(Path(name).parent / points)] = sum_of_file(Path(file).parent / points)
                eyes[name] = load_eye(file).to_mapping()
            except InputError as error:
                if error.source == file and error.reason.startswith("no such"):
                    raise InputError(f"{name!r}: {error.reason}", source=source, path="scene.eye.model") from None
                raise
        folder = (Path.cwd() if base is None else base).resolve()
        sums |= sums_of_files(spec.scene, folder)
        plan = cls(spec=spec, eyes=eyes, files=dict(sorted(sums.items())), base=folder, source=source)
        for name in spec.eye_parameters:
            if name not in eyes:
                raise InputError("no sample uses this eye", source=source, path=f"eye_parameters.{name}")
            for path in spec.eye_parameters[name]:
                _set(deepcopy(eyes[name]), path, 0.0, f"eye_parameters.{name}", source)
        _ = plan.scene_template, plan.eye_template
        return plan

    @cached_property
    def variable_template(self) -> Template:
        """Template of the variables."""
        tree = {"variables": self.spec.variables or {}}
        return Template.of(tree, self.spec.seed, source=self.source, clips=self.spec.has_clips)

    @cached_property
    def _variables(self) -> dict[str, Unit]:
        """Return for what each variable is drawn; a plain value is the same for every sample."""
        draws = self.variable_template.draws
        names = self.spec.variables or {}
        return {
            name: "sample"
            if any(_is_at(path, name) and placed.unit != "subject" for path, placed in draws.items())
            else "subject"
            for name in names
        }

    @cached_property
    def scene_template(self) -> Template:
        """Template of the scene."""
        return Template.of(
            self.spec.scene,
            self.spec.seed,
            source=self.source,
            prefix="scene",
            variables=self._variables,
            clips=self.spec.has_clips,
        )

    @cached_property
    def eye_template(self) -> Template:
        """Template of the eyes' parameters."""
        tree = {"eye_parameters": self.spec.eye_parameters}
        return Template.of(tree, self.spec.seed, source=self.source, variables=self._variables)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the spec and of the content of every file it names; independent of the number of samples."""
        return plan_digest(self.to_mapping())

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the mapping that `from_mapping` reads, without the eye files; `files` only if there are any."""
        data: dict[str, Any] = {"spec": self.spec.to_mapping(), "eyes": self.eyes}
        own = {} if self.scenes is None else {"scenes": self.scenes.to_mapping()}
        return dict(_sorted(data | own | ({"files": self.files} if self.files else {})))

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], base: Path) -> Plan:
        """Make the plan of another process, its files relative to `base`; a function of scenes is not loaded."""
        own = data.get("scenes")
        return cls(
            spec=DatasetSpec.from_mapping(data["spec"]),
            eyes=data["eyes"],
            files=data.get("files", {}),
            base=base,
            scenes=None if own is None else OwnScenes.from_mapping(own),
        )

    def loaded(self) -> Plan:
        """Load the function of the scenes in a worker process, if there is one.

        Raises:
            InputError: it cannot be loaded, or has changed.
        """
        return self if self.scenes is None else replace(self, scenes=self.scenes.loaded())

    def warnings(self) -> list[InputWarning]:
        """Return probable mistakes in the scenes of some samples, spread over the dataset; each is reported once."""
        found: dict[tuple[str, str], InputWarning] = {}
        data = read_yaml(Path(self.source)) if os.path.isfile(self.source) else {}
        for first, again in aliased_draws(data):
            reason = f"is an alias of {first}, but drawn on its own; use 'variables' for one value in both places"
            found["alias", again] = InputWarning(code="alias", reason=reason, source=self.source, path=again)
        count = min(self.spec.count, _LOOKED_AT)
        for sample in self.spread(count):
            try:
                warnings = self.draw(sample).build().warnings()
            except InputError:
                continue  # it is drawn again or reported when the sample is made
            for w in warnings:
                path, reason = f"scene.{w.path}", f"{w.reason} (sample {sample})"
                found.setdefault(
                    (w.code, path), InputWarning(code=w.code, reason=reason, source=self.source, path=path)
                )
        return list(found.values())

    def spread(self, count: int) -> list[int]:
        """Return at most `count` of the samples, spread evenly."""
        samples = self.spec.selection.samples
        count = min(count, len(samples))
        return [samples[k * len(samples) // count] for k in range(count)]

    def check_files(self) -> None:
        """Check that the files that the spec names are unchanged since the plan was made; fast if their times are.

        Raises:
            InputError: a file has changed.
        """
        for name, wanted in self.files.items():
            if sum_of_file(self.base / name) != wanted:
                raise InputError("has changed since the run began", source=str(self.base / name))

    @cached_property
    def _shares(self) -> tuple[float, ...]:
        """Return the cumulative shares of the splits, sorted by name.

        Because of the sorting, the order of keys in a file has no effect.
        """
        total = sum(self.spec.splits.values())
        return tuple(accumulate(self.spec.splits[name] / total for name in sorted(self.spec.splits)))

    def split_of(self, subject: int) -> str:
        """Return the split of a subject.

        The split follows from a number u in (0, 1) of each subject. Up to `RANKED_SUBJECTS` subjects of a block are
        sorted by u and cut at the cumulative shares, so counts are exact. More subjects are not sorted: u itself is
        compared with the shares, so counts are those of a random draw.
        """
        names = sorted(self.spec.splits)
        if len(names) == 1:
            return names[0]
        if self.spec.subject_count <= RANKED_SUBJECTS:
            block, k = divmod(subject, self.spec.subject_count)
            return names[int(_split_ranks(self.spec.seed, self.spec.subject_count, block, self._shares)[k])]
        u = _split_number(self.spec.seed, subject)
        return next((name for name, share in zip(names, self._shares, strict=True) if u < share), names[-1])

    def subject_of(self, sample: int) -> tuple[int, int]:
        """Return the subject of a sample, and the position of the sample in the subject's sequence."""
        subject = self.spec.selection.subject_of(sample)
        return subject, sample - self.first_of(subject)

    def first_of(self, subject: int) -> int:
        """Return the first sample of a subject."""
        return self.spec.selection.first_of(subject)

    def draw(self, sample: int, attempt: int = 0) -> Sample:
        """Draw the values of a sample at an attempt.

        Raises:
            InputError: there is no such sample, its subject's eye cannot be made in any attempt, or the drawn values
                are not a valid scene.
        """
        spec = self.spec
        if not 0 <= sample < spec.selection.end:
            raise InputError(f"must be 0 to {spec.selection.end - 1}", source=str(sample))
        subject, sequence = self.subject_of(sample)
        subject_attempt = self.identity(subject)[0]
        turn = Turn(
            sample=sample,
            subject=subject,
            sequence=sequence,
            attempt=attempt,
            subject_attempt=subject_attempt,
            place=spec.selection.place_of(sample),
            frames=spec.clip_frames,
        )
        own = None if self.scenes is None else self.scenes.at(spec.seed, turn, self.base)
        if own is not None and own.subject is not None:
            turn = replace(turn, subject=own.subject, sequence=0)
        tree, drawn = self._scene_of(turn) if own is None else (dict(own.tree), own.draws)
        tree.setdefault("format", SceneSpec.FORMAT)
        if spec.population is not None:
            tree["population"] = self.person_of(subject, subject_attempt).to_mapping()
        tree.setdefault("name", f"{spec.name} {sample}")
        if "seed" not in tree:
            tree["seed"] = int(unit_number(spec.seed, "seed", "sample", sample, attempt) * 2**53)
        if isinstance(tree.get("sequence"), dict):
            seed = int(unit_number(spec.seed, "sequence.seed", "clip", turn.clip, 0) * 2**53)
            tree["sequence"] = {"seed": seed, **tree["sequence"], "instants": [turn.frame]}
        if isinstance(tree.get("rig"), dict) and (tree["rig"].get("ipd_adjust") or {}).get("residual_mm"):
            tree["rig"] = _adjusted(tree, (spec.seed, turn.subject, _SETTING))
        if spec.tolerances is not None:
            tree["rig"] = self._unit_of(tree.get("rig"), turn.subject)
        eye, eye_drawn, _ = self._eye_of(tree, turn) if own is None else (own.eye, {}, False)
        if own is None and spec.population is not None and eye:
            tree = _with_optics(tree, self.base)
        return Sample(
            turn=turn,
            split=self.split_of(subject) if own is None or own.split is None else own.split,
            scene=tree,
            eye=eye,
            draws={**drawn, **eye_drawn},
            base=self.base if own is None or own.base is None else own.base,
        )

    def _unit_of(self, rig: Any, subject: int) -> dict[str, Any]:
        """Draw the rig of a subject's unit from the nominal one.

        Raises:
            InputError: the rig is none, or a tolerance is that of no part.
        """
        try:
            nominal = Rig.from_mapping(rig).resolved(self.base)
        except InputError as error:
            raise error.placed(under="rig") from None
        tolerances = Tolerances.from_mapping({"tolerances": self.spec.to_mapping()["tolerances"]})
        try:
            return drawn_unit(nominal, tolerances, (self.spec.seed, subject, _UNIT)).to_mapping()
        except InputError as error:
            raise error.placed(source=self.source) from None

    def _scene_of(self, turn: Turn) -> tuple[dict[str, Any], dict[str, Any]]:
        variables, variables_drawn = self.variable_template.values(turn)
        tree, drawn = self.scene_template.values(turn, variables["variables"])
        drawn |= variables_drawn
        if not isinstance(tree, dict):
            raise InputError(f"must be a mapping in every sample, not {tree!r}", path="scene")
        return tree, drawn

    @cached_property
    def _identities(self) -> dict[int, tuple[int, tuple[str, ...]]]:
        return {}

    def identity(self, subject: int) -> tuple[int, tuple[str, ...]]:
        """Return the first attempt in which a subject's eye can be made, and the reasons why earlier ones failed."""
        if self.scenes is not None:
            return 0, ()
        if subject not in self._identities:
            if len(self._identities) >= 1024:
                self._identities.clear()
            self._identities[subject] = self._identify(subject)
        return self._identities[subject]

    def _identify(self, subject: int) -> tuple[int, tuple[str, ...]]:
        reasons: list[str] = []
        for attempt in range(self.spec.attempts):
            turn = Turn(sample=0, subject=subject, sequence=0, attempt=0, subject_attempt=attempt)
            tree = {} if self.spec.population is not None else self._scene_of(turn)[0]
            try:
                if self.spec.population is not None:
                    # The distance between the eyes needs both of them.
                    _ = chosen_person(self.person_of(subject, attempt).to_mapping()).apex_distance_mm
                else:
                    eye, _, modified = self._eye_of(tree, turn)
                    if modified:
                        _eye(json.dumps(eye, sort_keys=True)).build()
            except InputError as error:
                reasons.append(error.reason if not error.path else f"{error.path}: {error.reason}")
                if self.spec.population is None and not (self.eye_template.draws or self.variable_template.draws):
                    break
            else:
                return attempt, tuple(reasons)
        raise InputError(f"its eye cannot be made: {reasons[-1]}", source=self.source, path=f"subject {subject}")

    def person_of(self, subject: int, attempt: int) -> PersonChoice:
        """Draw the person of a subject at an attempt: the first uses the dataset's seed, others a derived one."""
        assert self.spec.population is not None
        seed = self.spec.seed
        if attempt:
            seed = int(unit_number(seed, "population", "subject", subject, attempt) * 2**53)
        choice = {**self.spec.population.to_mapping(), "seed": seed, "subject": subject}
        return choice_of(json.dumps(choice, sort_keys=True))

    def _eye_of(self, tree: Mapping[str, Any], turn: Turn) -> tuple[dict[str, Any], dict[str, Any], bool]:
        if self.spec.population is not None and not self.eyes:
            return {}, {}, False
        variables = self.variable_template.values(turn)[0]["variables"]
        values, drawn = self.eye_template.values(turn, variables)
        eye_part = tree.get("eye")
        model = eye_part.get("model", "E2") if isinstance(eye_part, Mapping) else "E2"
        eye = deepcopy(dict(self.eyes[model]))
        mine = values["eye_parameters"].get(model, {})
        for path, value in mine.items():
            _set(eye, path, value, f"eye_parameters.{model}", self.source)
        if mine:
            eye["name"] = f"{model} of subject {turn.subject}"
        # The parameters of the other eyes were not used.
        asked = {k: v if k.startswith(f"eye_parameters.{model}.") else None for k, v in drawn.items()}
        return eye, asked, bool(mine)


def _split_number(seed: int, subject: int) -> float:
    return unit_number(seed, "split", "subject", subject, 0)


@lru_cache(maxsize=16)
def _split_ranks(seed: int, subjects: int, block: int, shares: tuple[float, ...]) -> NDArray[np.int32]:
    """Return the split index of each subject of a block, from the rank of its u; splits are sorted by name."""
    numbers = (_split_number(seed, subject) for subject in range(block * subjects, (block + 1) * subjects))
    order = np.argsort(np.fromiter(numbers, float, subjects), kind="stable")
    ends = [*(round(subjects * share) for share in shares[:-1]), subjects]
    out = np.zeros(subjects, dtype=np.int32)
    out[order] = np.searchsorted(ends, np.arange(subjects), side="right")
    return out


def is_function(given: object) -> bool:
    """Whether a user gave `module:function` in the place of a spec's file."""
    return isinstance(given, str) and is_reference(given) and not os.path.exists(given)


def _spec_of(
    given: str | Path | DatasetSpec | None, own: OwnScenes | None, count: int | None, changes: PlanOptions
) -> tuple[Path | None, DatasetSpec]:
    """Return the file and the spec that a user gave; for a function alone a spec with default settings.

    Raises:
        InputError: the file cannot be read, or there is neither spec nor number of samples.
    """
    if isinstance(given, DatasetSpec):
        return None, given
    if given is not None:
        file = find_dataset(given)
        return file, DatasetSpec.load(file)
    if own is None:
        raise InputError("give a dataset file, the name of a shipped one, or a function of scenes", source="spec")
    if count is None:
        raise InputError("needs the number of samples", source="--count")
    # The number of samples may grow later, which must not change the plan.
    planned = count if changes.subjects is not None else _PLANNED
    name = own.reference.rpartition(":")[2]
    return None, DatasetSpec(kind="dataset", name=name, count=planned, shard_size=_SHARD, scene={})


def _of_function(spec: DatasetSpec, own: OwnScenes, eye: str | None) -> Plan:
    """Return the plan whose scenes a function gives; their files are relative to the current folder.

    Raises:
        InputError: an eye is given, too, or the function gives two different scenes for one sample.
    """
    if eye is not None:
        raise InputError("the scenes of a function have their eyes", source="--eye")
    bare: dict[str, Any] = {"scene": {}, "variables": None, "eye_parameters": {}, "population": None}
    spec = spec.model_copy(update=bare)
    plan = replace(Plan.of(spec), eyes={}, scenes=own)
    subject, sequence = plan.subject_of(0)
    own.check(spec.seed, Turn(sample=0, subject=subject, sequence=sequence, attempt=0, subject_attempt=0), plan.base)
    return plan


def plan_digest(mapping: Mapping[str, Any]) -> str:
    """Compute the SHA-256 of a plan's mapping, independent of the number of samples."""
    spec = dict(mapping["spec"])
    spec["planned"] = spec.get("planned") or spec["count"]
    del spec["count"]
    spec.pop("choice", None)
    text = json.dumps({**mapping, "spec": spec}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _eye_names(spec: DatasetSpec, source: str) -> list[str]:
    """Return the names of the eye models that a spec may use; none if it draws people."""
    part = spec.scene.get("eye", {})
    if is_draw(part):
        raise InputError("draw single values of the eye, not the whole eye", source=source, path="scene.eye")
    if isinstance(part, Mapping) and "biometry" in part:
        reason = "write it to an eye file, and name this file as the model"
        raise InputError(reason, source=source, path="scene.eye.biometry")
    given = isinstance(part, Mapping) and "model" in part
    if spec.population is not None and not given:
        return []
    names = possible(part["model"]) if given else ["E2"]
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"must be the name of an eye, not {name!r}", source=source, path="scene.eye.model")
    return names


def _is_at(path: str, name: str) -> bool:
    """Return whether the path of a draw is at or below a variable."""
    return re.match(rf"variables\.{name}(?![A-Za-z0-9_])", path) is not None


def _with_eye(spec: DatasetSpec, eye: str) -> dict[str, Any]:
    """Return the parts of a spec with another eye model."""
    part = spec.scene.get("eye", {})
    if not isinstance(part, Mapping) or is_draw(part):
        raise InputError("the spec draws the whole eye; choose the model in the spec", source="--eye")
    load_eye(eye)
    # A path in a command is relative to the current folder, a name in a spec to the folder of the spec.
    model = eye if eye in catalogue_names() else str(Path(eye).resolve())
    parameters = {name: values for name, values in spec.eye_parameters.items() if name == model}
    return {"scene": {**spec.scene, "eye": {**part, "model": model}}, "eye_parameters": parameters}


def _with_optics(tree: Mapping[str, Any], base: Path) -> dict[str, Any]:
    """Turn the scene of a drawn person into one of the eye model that it names.

    Look, lids, the distance of the eyes and the diameter of the stop remain those of the person. Raises InputError if
    the person cannot be drawn in this scene.
    """
    model = tree["eye"]["model"]
    rest = {key: value for key, value in tree["eye"].items() if key != "model"}
    scene = Scene.compiled(SceneSpec.from_mapping({**tree, "eye": rest}), base=base)
    data = {key: value for key, value in scene.spec.to_mapping().items() if key not in ("person", "population")}
    set_pupil = ("luminance_cd_m2", "field_deg", "accommodation_d")
    subject = {key: value for key, value in data["subject"].items() if key not in set_pupil}
    stop = scene.stop_diameter_mm(scene.spec.subject.eyes[0])
    return {**data, "subject": subject, "eye": {**data.get("eye", {}), "model": model, "pupil_diameter_mm": stop}}


@lru_cache(maxsize=64)
def _eye(text: str) -> EyeSpec:
    """Parse an eye file from its JSON; cached, so the frames of a subject share it and its computed values."""
    return EyeSpec.from_mapping(json.loads(text))


def _sorted(node: Any) -> Any:
    """Copy a tree with the keys of its mappings sorted."""
    if isinstance(node, Mapping):
        return {key: _sorted(node[key]) for key in sorted(node)}
    return [_sorted(value) for value in node] if isinstance(node, list | tuple) else node


def _set(tree: Any, path: str, value: Any, prefix: str, source: str) -> None:
    """Set the value at an existing dotted path."""
    keys = path.split(".")
    node = tree
    for key in keys[:-1]:
        node = _child(node, key)
    last = keys[-1]
    if _child(node, last) is None:
        raise InputError("no such number in the eye file", source=source, path=f"{prefix}.{path}")
    node[int(last) if isinstance(node, list) else last] = value


def _child(node: Any, key: str) -> Any:
    if isinstance(node, list):
        return node[int(key)] if key.isdigit() and int(key) < len(node) else None
    return node.get(key) if isinstance(node, dict) else None


def _adjusted(tree: Mapping[str, Any], seed: tuple[int, ...]) -> dict[str, Any]:
    """Return the rig of a scene, set to the wearer's distance of the eyes plus a drawn residual."""
    spec = SceneSpec.from_mapping(tree)
    adjust = spec.rig.set_to(spec.subject.ipd_mm).ipd_adjust
    assert adjust is not None
    assert adjust.set_mm is not None
    # An error of the setting moves each eye's parts by half of it.
    error = 2.0 * adjust.residual_mm * float(np.random.default_rng(seed).standard_normal())
    given = tree["rig"]["ipd_adjust"].get("set_mm")
    return {**tree["rig"], "ipd_adjust": {**adjust.to_mapping(), "set_mm": given or adjust.set_mm + error}}
