"""The eye of the authors' software, surface by surface."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.eye.catalogue import load_eye
from eyerender.eye.landmarks import field_direction, incident_node
from eyerender.optics.surfaces_quadric import Quadric
from eyerender.scene import load_scene
from tests.support.surfaces import centre_of


def test_the_published_lens_is_the_authors_software():
    """44 surfaces (its two outer ones and 42 shells); the core's index does not square the age: 1.425654, not 1.421859.

    Node and shells by a port of that software's surfaces as 4 x 4 matrices, which shares nothing with this package.
    """
    eye = load_eye("E5-published").build()
    assert len(eye.back) == 44
    edge, core = 1.363983982095, 1.425654450575
    inside = edge + (core - edge) * np.arange(22) / 21.0
    aqueous, vitreous = 1.3302435786, 1.3304719540
    ladder = [*inside, *inside[-2::-1], vitreous]
    assert eye.back_indices == pytest.approx(ladder, abs=1e-10)
    assert eye.front_indices[-1] == pytest.approx(aqueous, abs=1e-10)
    # Hyperboloids about K(p) = C + p (K(1) - C); the software turns each about its own centre.
    for half, centre in ((eye.back[:22], [-3.6 + 14.304 / 2.546, -0.371, 0.036]),
                         (eye.back[22:][::-1], [-7.1 - 6.884 / 2.3286, -0.27, 0.092])):  # fmt: skip
        assert half[0] == half[1]
        middle = np.array([-5.0, -0.3205, 0.064])
        for k, surface in enumerate(half[1:]):
            p = np.sqrt(1.0 - k / 42.0)
            assert isinstance(surface, Quadric)
            assert np.allclose(centre_of(surface), middle + p * (np.array(centre) - middle), atol=1e-9)
    assert np.abs(incident_node(eye) - [-7.08250041, 0.12055175, -0.15770869]).max() < 1e-8


def test_the_published_node_is_that_of_the_authors_software():
    """It has (-6.747, .134, -.162): a point of one nodal ray. Seen along the direction of the fovea it lies .03 mm from
    the waist, which turns the eye by .001 deg; a node on the optic axis lies .2 mm off.
    """
    node = incident_node(load_eye("E5-published").build())
    way = field_direction(np.radians([5.45, 2.5]))
    apart = np.linalg.norm(np.cross(node - [-6.747, 0.134, -0.162], way))
    assert apart < 0.03
    assert np.linalg.norm(np.cross([node[0], 0.0, 0.0] - np.array([-6.747, 0.134, -0.162]), way)) > 0.19


def test_its_name_is_known_wherever_an_eye_is_named():
    assert load_scene("blignaut2014", eye="E5-published").eye_spec == load_eye("E5-published")
