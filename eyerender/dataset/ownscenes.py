"""Scenes of a user's own code: a function of (seed, i) in place of a spec's `scene`, or scenes that are handed over.

The function's name and the SHA-256 of its module's file are part of a run's identity. A file never makes this package
load a function: only the user's command or Python call does (`OwnScenes.of`), and workers of that run (`loaded`).
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..base.errors import EyerenderError, InputError
from ..base.references import load_reference
from ..base.spec import file_digest
from ..base.storage.files import shown
from ..eye.catalogue import catalogue_names, load_eye
from ..eye.spec import EyeSpec
from ..scene import Scene
from ..scene.spec import SceneSpec
from .template import Turn

MORE = ("subject", "sequence", "attempt")
"""Further parameters that a function may have; they are given by name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenScene:
    """The parts of a sample that a user's function gives.

    Attributes:
        tree: plain mapping that `SceneSpec` validates.
        eye: mapping of its eye file; empty for a drawn person.
        draws: numbers to store with the image, by name.
        base: folder to which the files of the scene are relative; None: that of the plan.
        subject: the subject; None: that of the plan.
        split: its split; None: that of the plan.
    """

    tree: dict[str, Any]
    eye: dict[str, Any]
    draws: dict[str, Any] = field(default_factory=dict)
    base: Path | None = None
    subject: int | None = None
    split: str | None = None


@dataclass(frozen=True, kw_only=True)
class OwnScenes:
    """Origin of the scenes of a plan that do not come from its spec."""

    reference: str  # `module:function`; empty where the scenes are handed over one by one (`DatasetWriter`)
    sha256: str = ""  # SHA-256 of the module's file; empty where it has none
    frames: int = 0  # frames of each scene that is handed over; 0 for a function
    # takes (seed, sample) and what it names of `MORE`, and returns a scene or (scene, draws); None where it is not
    # loaded
    function: Callable[..., Any] | None = field(default=None, compare=False)

    @classmethod
    def of(cls, given: str | Callable[..., Any]) -> OwnScenes:
        """Load a function that the user gave, as `module:function` or itself.

        Raises:
            InputError: it cannot be loaded, or worker processes could not import it.
        """
        function = load_reference(given, source=given) if isinstance(given, str) else given
        reference = given if isinstance(given, str) else _reference_of(function)
        if not callable(function):
            raise InputError("is no function", source=reference)
        return cls(reference=reference, sha256=_sha256_of(function), function=function)

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any]) -> OwnScenes:
        """Read what `to_mapping` wrote; the function is not loaded."""
        return cls(
            reference=str(data.get("function", "")),
            sha256=str(data.get("sha256", "")),
            frames=int(data.get("frames", 0)),
        )

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the mapping that identifies the scenes in run.json and dataset.json."""
        if not self.reference:
            return {"function": "", "frames": self.frames}
        return {"function": self.reference, "sha256": self.sha256}

    def loaded(self) -> OwnScenes:
        """Load the function in a worker process.

        Raises:
            InputError: it cannot be loaded, or its file has changed since the run began.
        """
        found = OwnScenes.of(self.reference)
        if found.sha256 != self.sha256:
            raise InputError("its file has changed since the run began", source=self.reference)
        return found

    @property
    def takes_attempt(self) -> bool:
        """Whether the function can give another scene where the first one cannot be used."""
        return self.function is not None and "attempt" in _more(self.function)

    def at(self, seed: int, turn: Turn, base: Path) -> GivenScene:
        """Return the scene of a sample; InputError if the function failed, or gave no scene."""
        if self.function is None:
            raise InputError("a file does not make this package run a function; name it yourself", source=self.name)
        call = f"{self.name}({seed}, {turn.sample})"
        try:
            found = self.function(seed, turn.sample, **{key: getattr(turn, key) for key in _more(self.function)})
        except EyerenderError as error:
            raise InputError(str(error), source=call) from None
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"raised {shown(text)}", source=call) from error
        draws: Any = {}
        if isinstance(found, tuple) and len(found) == 2:
            found, draws = found
        if not isinstance(draws, Mapping):
            raise InputError("must give its draws as a mapping", source=call)
        return found if isinstance(found, GivenScene) else given_scene(found, draws, base, source=call)

    @property
    def name(self) -> str:
        """Name of the function in messages."""
        return self.reference or "the scene"

    def check(self, seed: int, turn: Turn, base: Path) -> None:
        """Check that the function gives the same scene twice; InputError if it does not."""
        try:
            first, second = self.at(seed, turn, base), self.at(seed, turn, base)
        except InputError:
            return  # whether a sample can be made is found out elsewhere
        if first != second:
            raise InputError(
                f"gives two different scenes for ({seed}, {turn.sample}); it must depend on its arguments alone",
                source=self.name,
            )


def given_scene(scene: Any, draws: Mapping[str, Any], base: Path, *, source: str = "") -> GivenScene:
    """Take a scene apart: a `Scene`, a `SceneSpec`, or a mapping as in a scene's file.

    The seed 0 of a `Scene` or `SceneSpec` counts as none given, so that no two images share their noise. Raises
    InputError if it is something else, its eye cannot be read, or a draw is not finite.
    """
    for name, value in draws.items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise InputError(f"must be finite, not {shown(value)}", source=source, path=f"draws.{name}") from None
    if isinstance(scene, Scene):
        spec, own = scene.located(), scene.base
        eye = {} if spec.person is not None else scene.eye_spec.to_mapping()
        return GivenScene(tree=_tree(spec), eye=eye, draws=dict(draws), base=own)
    if isinstance(scene, SceneSpec):
        tree = _tree(scene)
    elif isinstance(scene, Mapping):
        tree = dict(scene)
    else:
        raise InputError(f"must give a Scene, a SceneSpec or a mapping, not {type(scene).__name__}", source=source)
    if tree.get("person") is not None or tree.get("population") is not None:
        return GivenScene(tree=tree, eye={}, draws=dict(draws))
    part = tree.get("eye")
    if part is None and isinstance(tree.get("subject"), Mapping):
        part = tree["subject"].get("eye")
    if isinstance(part, Mapping) and part.get("biometry") is not None:
        made = EyeSpec.from_mapping({"biometry": part["biometry"]}, source=source)
        return GivenScene(tree=tree, eye=made.to_mapping(), draws=dict(draws))
    model = str(part.get("model", "E2")) if isinstance(part, Mapping) else "E2"
    return GivenScene(tree=tree, eye=dict(_eye_file(model, base)), draws=dict(draws))


def _tree(spec: SceneSpec) -> dict[str, Any]:
    tree: dict[str, Any] = spec.to_mapping()
    if not tree.get("seed"):
        tree.pop("seed", None)
    return tree


@lru_cache(maxsize=64)
def _eye_file(model: str, base: Path) -> dict[str, Any]:
    found: dict[str, Any] = load_eye(model if model in catalogue_names() else str(base / model)).to_mapping()
    return found


def _more(function: Callable[..., Any]) -> tuple[str, ...]:
    """Parameters of a function that are given by name."""
    try:
        names = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return ()
    return tuple(name for name in MORE if name in names)


def _reference_of(function: Any) -> str:
    """Name a function so that a worker process can import it; InputError if it cannot."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    if not module or not name or "<" in name:
        raise InputError("must be a function at the top of a module, so that workers can import it", source="scenes")
    if module == "__main__":
        main = sys.modules["__main__"]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        if spec is None and file is None:
            raise InputError("must be in a file, so that workers can import it", source=f"scenes: {name}")
        module = spec.name if spec is not None else Path(str(file)).stem
    return f"{module}:{name}"


def _sha256_of(function: Any) -> str:
    """Compute the SHA-256 of the file that defines a function; empty where there is none."""
    try:
        file = inspect.getsourcefile(inspect.unwrap(function))
    except TypeError:
        return ""
    return "" if file is None or not Path(file).is_file() else file_digest(Path(file))
