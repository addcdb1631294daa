"""Patches of skin between which light is exchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eyerender.region.anatomy import Region
from eyerender.region.mesh import region_mesh
from eyerender.rendering.transport.patches import skin_patches
from tests.region.test_geometry import posed

pytestmark = pytest.mark.render


@pytest.mark.parametrize("seed", [0, 3, 8])
def test_rounding_errors_choose_no_other_patches(seed):
    # Processors round differently, and many pairs of vertices are equally far from their middle.
    _, globe = posed("E4", (0.0, 0.0))
    mesh = region_mesh(Region(seed=seed), globe)
    chosen = skin_patches(mesh, globe).vertices
    rng = np.random.default_rng(seed)
    for _ in range(3):
        moved = mesh.vertices * (1.0 + 1e-15 * rng.standard_normal(mesh.vertices.shape))
        np.testing.assert_array_equal(skin_patches(replace(mesh, vertices=moved), globe).vertices, chosen)
