"""The best k of n places for LEDs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.design.choice import SiteInformation, choose_lights, noise_of_some, site_information
from eyerender.design.information import case_of, information_of_instants


def twelve_sites() -> er.Scene:
    """The headset's camera with twelve LEDs about the lens of the display."""
    angles = 2 * np.pi * np.arange(12) / 12
    lights = [
        {"position_mm": [24.0, -31.5 + 21.0 * np.cos(a), 17.0 * np.sin(a)], "radius_mm": 0.5, "aim_mm": [0, -31.5, 0],
         "intensity_mw_sr": 0.1}
        for a in angles
    ]  # fmt: skip
    return er.load_scene("headset").with_({"rig.lights": lights})


@pytest.fixture(scope="module")
def known() -> SiteInformation:
    scene = twelve_sites()
    return site_information(scene.frames(), noise=noise_of_some(scene, 4))


def test_greedy_exchange_is_as_good_as_exhaustive_search_of_4_of_12(known):
    """The bar is 2 % of the geometric-mean standard deviation; submodularity alone would promise much less."""
    every = list(combinations(range(12), 4))
    best = max(every, key=known.value)
    worst = min(every, key=known.value)
    assert known.worse_by(worst, best) > 1.1  # the choice matters
    assert known.worse_by(choose_lights(known, 4), best) <= 1.02


def test_the_sites_add_up_to_the_information_of_the_rig(known):
    """Against the sum that `er.information` computes by another path; rounding only."""
    scene = twelve_sites()
    case, _ = case_of(scene.frames())
    unknowns = er.Unknowns.population()
    free = np.flatnonzero(unknowns.free())
    whole = information_of_instants(case, noise_of_some(scene, 4), 16) + np.diag(np.maximum(unknowns.precision(), 1e-6))
    summed = known.base + known.sites.sum(axis=0)
    np.testing.assert_allclose(summed, whole[:, free[:, None], free], rtol=1e-9, atol=1e-9)


def test_one_led_is_the_best_one_and_all_are_all(known):
    values = [known.value((k,)) for k in range(12)]
    assert choose_lights(known, 1) == (int(np.argmax(values)),)
    assert choose_lights(known, 12) == tuple(range(12))
    for count in (0, 13):
        with pytest.raises(InputError, match="must be 1 to 12"):
            choose_lights(known, count)
