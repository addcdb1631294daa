"""Functions that give the scenes of a dataset, as a user would write them; workers import this module."""

from __future__ import annotations

import copy
import random
from functools import cache

import eyerender as er
from tests.support.dataset_specs import TINY, plan

TINY_SCENE = {**copy.deepcopy(TINY["scene"]), "eye": {"model": "E2"}, "subject": {"eyes": ["right"], "ipd_mm": 63.0}}


@cache
def _plan():
    return plan()


def rewritten(seed, i, attempt):
    """The scenes of the tiny spec, with its draws."""
    made = _plan()
    assert seed == made.spec.seed
    drawn = made.draw(i, attempt)
    return er.dataset.GivenScene(tree=drawn.scene, eye=drawn.eye, draws=drawn.draws)


def _scene(power, target, albedo):
    scene = copy.deepcopy(TINY_SCENE)
    for light in scene["rig"]["lights"]:
        light["intensity_mw_sr"] = power
    scene["targets"] = {"screen_mm": [target]}
    scene["look"] = {"iris_albedo": albedo}
    return scene


def drawn(seed, i, subject):
    """A mapping, with draws of its own: the iris belongs to the subject."""
    own, whose = random.Random(f"{seed} {i}"), random.Random(f"{seed} subject {subject}")
    power, target = own.uniform(80, 120), [own.uniform(-100, 100), own.uniform(-80, 80)]
    return _scene(power, target, whose.uniform(0.2, 0.4)), {"power_mw_sr": power}


def objects(seed, i):
    """A scene made of objects."""
    scene, _ = drawn(seed, i, i)
    return er.Scene.of(er.SceneSpec.from_mapping({"format": 2, "name": "own", **scene}))


def partly(seed, i):
    """A function that fails for some samples: it raises, looks away, or gives no scene."""
    if i % 4 == 1:
        raise ZeroDivisionError("a defect of the user's\ncode")
    if i % 4 == 2:
        return _scene(100.0, [90_000.0, 0.0], 0.3)
    return None if i % 4 == 3 else drawn(seed, i, i)


def impure(seed, i):
    """A function whose result depends on chance."""
    return _scene(random.random(), [0.0, 0.0], 0.3)


not_a_function = 3
