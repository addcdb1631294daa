"""A unit furnace: in even light of radiance 1 from everywhere, no part of an eye can be brighter than 1."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.base.errors import InputError
from eyerender.base.spec import EYES
from eyerender.eye.catalogue import load_eye
from eyerender.eye.model import EyeModel
from eyerender.region.anatomy import Region
from eyerender.region.look import Look
from eyerender.rig.camera import Camera
from eyerender.rig.imaging import Ambient
from eyerender.scene.people import Population
from tests.support.render_oracles import cos4
from tests.support.render_rigs import PLAIN, LampRig, job_of

pytestmark = pytest.mark.render

UNIT = Ambient(irradiance_w_m2=1e3 * np.pi)
NO_LAMPS = LampRig(
    Camera(
        resolution_px=(96, 72), position_mm=(34.0, -9.0, -12.0), look_at_mm=(0.0, 0.0, 0.0), focal_length_px=90.0
    ).build(),
    (),
)
ROUNDING = 1.002  # radiosity and interpolation are good to a thousandth or two


def class_means(renderer, eye: EyeModel, look: Look, region: Region | None, spp: int = 4) -> dict[int, float]:
    """Mean radiance of each class of the mask."""
    job = job_of(eye, NO_LAMPS, (0, 0, 96, 72), (3.0, -5.0), look=look, region=region, ambient=UNIT)
    radiance, part = renderer.radiance(job, spp=spp) / cos4(job), renderer.labels(job).part
    return {int(k): float(radiance[part == k].mean()) for k in np.unique(part)}


def brightest(renderer, count: int, seed: int) -> float:
    """The brightest class of some drawn people."""
    people, most = Population().draw(count, seed), 0.0
    for k in range(count):
        person, side = people.person(k), EYES[k % 2]
        eye = person.eye(side).build(eye=side)
        means = class_means(renderer, eye, person.look(), person.region().of_side(side))
        assert set(means) >= {0, 1, 2}
        most = max(most, *means.values())
    return most


def test_drawn_people_make_no_light(renderer):
    assert 0.3 < brightest(renderer, 1, seed=5) < ROUNDING


@pytest.mark.slow
def test_two_hundred_drawn_people_make_no_light(renderer):
    assert brightest(renderer, 200, seed=6) < ROUNDING


def test_a_limbus_that_would_make_light_is_refused():
    """.95 and .9 gave an iris of 1.07 beside a white sclera."""
    with pytest.raises(InputError, match="limbus_transmittance: must be at most 1 - limbus_albedo"):
        Look(limbus_albedo=0.95, limbus_transmittance=0.9)
    assert Look(limbus_albedo=0.3, limbus_transmittance=0.7).limbus_albedo == 0.3


@pytest.mark.parametrize("limbus_albedo", [0.1, 0.6, 0.95])
def test_the_whitest_limbus_makes_no_light(renderer, limbus_albedo):
    """All that the limbus does not scatter, it lets through: the eye is as bright as its light, but for its pupil."""
    look = PLAIN.model_validate(
        PLAIN.to_mapping()
        | {"limbus_albedo": limbus_albedo, "limbus_transmittance": min(1 - limbus_albedo, 0.9), "limbus_width_mm": 1.0}
        | dict.fromkeys(("iris_albedo", "sclera_albedo", "backdrop_albedo"), 0.95)
    )
    means = class_means(renderer, load_eye("E2").build(eye="right", pupil_diameter_mm=3.0), look, None)
    assert max(means.values()) < ROUNDING
    assert means[1] > 0.85  # the sclera, a part of which is limbus
