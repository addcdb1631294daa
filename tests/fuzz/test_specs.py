"""Scenes, dataset specs and eye files that somebody else may have written: used, or refused in one line."""

from __future__ import annotations

import copy
from functools import cache
from random import Random
from typing import Any

import pytest
import yaml
from hypothesis import given

from eyerender.analytic.observer import trace
from eyerender.dataset.plan import Plan
from eyerender.dataset.spec import DatasetSpec, shipped_datasets
from eyerender.eye.catalogue import FOLDER, catalogue_names, load_eye
from eyerender.eye.spec import EyeSpec
from eyerender.imaging.capture import check_windows
from eyerender.scene import Scene, load_scene, shipped_scenes
from eyerender.scene.spec import SceneSpec
from tests.support.corneas import eye_with, grid_of, keratoconus, measured_shapes
from tests.support.fuzzing import CASES, budget, edited, garbled, proper, strict_json

FEW = 8  # observations: more cost time and show nothing new


@cache
def scenes() -> list[dict[str, Any]]:
    """The shipped scenes, each whole and with two targets and one eye."""
    out = []
    for path in shipped_scenes().values():
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        small = copy.deepcopy(data)
        small["targets"] = {"world_mm": [[600.0, 0.0, -60.0]]}
        small.setdefault("subject", {}).update(eyes=["left"], head_positions_mm=[[0.0, 0.0, 0.0]])
        out += [data, small, small]
    return out


@cache
def datasets() -> list[dict[str, Any]]:
    return [yaml.safe_load(path.read_text(encoding="utf-8")) for path in shipped_datasets().values()]


@cache
def eyes() -> list[dict[str, Any]]:
    measured = [measured_shapes()["zernike"], grid_of(keratoconus, 4.5, 1.5)]
    return [
        *(load_eye(name).to_mapping() for name in catalogue_names()),
        *(eye_with(shape).to_mapping() for shape in measured),
    ]


def use_scene(scene: Scene) -> None:
    """All that a scene is asked for before anything is rendered."""
    if len(scene.frames()) > FEW:
        return
    found = trace(scene, boundary_points=12)
    strict_json([list(found.records()), scene.rig.to_mapping()])
    for x0, y0, width, height in scene.windows().values():
        assert min(x0, y0) >= 0
        assert min(width, height) >= 1
    check_windows(scene)


def use_plan(plan: Plan) -> None:
    """A dataset's first and last sample, drawn and observed."""
    for k in (0, plan.spec.count - 1):
        sample = plan.draw(k)
        strict_json(sample.draws)
        use_scene(sample.build())


def check_scene(data: Any) -> None:
    proper(lambda: use_scene(Scene.of(SceneSpec.from_mapping(data))))


def check_dataset(data: Any) -> None:
    proper(lambda: use_plan(Plan.of(DatasetSpec.from_mapping(data))))


def check_eye(data: Any) -> None:
    def use() -> None:
        spec = EyeSpec.from_mapping(data)
        scene = yaml.safe_load(shipped_scenes()["guestrin2006"].read_text(encoding="utf-8"))
        scene["targets"] = {"world_mm": [[600.0, 0.0, -60.0]]}
        scene["subject"]["head_positions_mm"] = [[0.0, 0.0, 0.0]]
        scene.setdefault("eye", {}).pop("pupil_diameter_mm", None)
        compiled = SceneSpec.from_mapping(scene)
        use_scene(Scene.compiled(compiled, spec))

    proper(use)


def check_bytes(path: Any, data: bytes, kind: str) -> None:
    path.write_bytes(data)
    if kind == "scene":
        proper(lambda: use_scene(load_scene(path)))
    elif kind == "dataset":
        proper(lambda: use_plan(Plan.of(DatasetSpec.load(path), source=str(path))))
    else:
        proper(lambda: load_eye(path).build())


@cache
def files(kind: str) -> list[bytes]:
    paths = {"scene": shipped_scenes().values(), "dataset": shipped_datasets().values(), "eye": FOLDER.glob("*.yaml")}
    return [path.read_bytes() for path in sorted(paths[kind])]


KINDS = {"scene": (scenes, check_scene), "dataset": (datasets, check_dataset), "eye": (eyes, check_eye)}


def fuzz_mappings(kind: str, examples: int) -> None:
    bases, check = KINDS[kind]

    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        check(edited(rng.choice(bases()), rng))

    cases()


def fuzz_files(kind: str, examples: int, path: Any) -> None:
    @budget(examples)
    @given(CASES)
    def cases(rng: Random) -> None:
        check_bytes(path, garbled(rng.choice(files(kind)), rng), kind)

    cases()


@pytest.mark.parametrize(("kind", "examples"), [("scene", 75), ("dataset", 25), ("eye", 30)])
def test_mutated_mappings(kind, examples):
    fuzz_mappings(kind, examples)


@pytest.mark.parametrize(("kind", "examples"), [("scene", 15), ("dataset", 8), ("eye", 15)])
def test_garbled_files(kind, examples, tmp_path):
    fuzz_files(kind, examples, tmp_path / "file.yaml")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kind", "examples"), [("scene", 1000), ("dataset", 400), ("eye", 600)])
def test_many_mutated_mappings(kind, examples):
    fuzz_mappings(kind, examples)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kind", "examples"), [("scene", 250), ("dataset", 120), ("eye", 120)])
def test_many_garbled_files(kind, examples, tmp_path):
    fuzz_files(kind, examples, tmp_path / "file.yaml")
