"""The edge of a shadow on a slab of tissue, against Mitsuba's own volumetric path tracer."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.optics import diffusion
from tests.optics.test_interface import edge

pytestmark = pytest.mark.render

AT_MM = np.array([-2.0, -0.8, -0.3, 0.3, 0.8, 2.0])
SPP = 1024


def irradiance(at_mm: float, scattering: float, absorption: float, *, shadow: bool) -> float:
    """Light from below at a place of a slab under an even sky, which a black sheet covers where x < 0."""
    import mitsuba as mi

    T = mi.ScalarTransform4f
    total = scattering + absorption
    scene = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": -1, "rr_depth": 60},
        "sky": {"type": "constant", "radiance": 1 / np.pi},
        "slab": {
            "type": "cube",
            "to_world": T().scale([60, 60, 20]).translate([0, 0, -1]),
            "bsdf": {"type": "dielectric", "int_ior": 1.4, "ext_ior": 1.0},
            "interior": {"type": "homogeneous", "sigma_t": total, "albedo": scattering / total},
        },
        # The meter looks down, just above the slab; the sheet is above the meter.
        "meter": {
            "type": "rectangle",
            "to_world": T().translate([at_mm, 0, 0.004]).rotate([1, 0, 0], 180).scale([0.03, 1, 1]),
            "bsdf": {"type": "null"},
            "sensor": {
                "type": "irradiancemeter",
                "sampler": {"type": "independent", "sample_count": SPP},
                "film": {
                    "type": "hdrfilm",
                    "width": 8,
                    "height": 8,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
            },
        },
    }
    if shadow:
        black = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}}
        place = T().translate([-50, 0, 0.008]).scale([50, 50, 1])
        scene["sheet"] = {"type": "rectangle", "to_world": place, "bsdf": black}
    loaded = mi.load_dict(scene)
    picture = np.array(mi.render(loaded, sensor=loaded.sensors()[0], spp=SPP, seed=3))
    return float(picture.mean())


@pytest.mark.slow
@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize(("scattering", "absorption"), [(2.04, 0.034), (2.04, 0.08)])
def test_shadow_edges_agree_with_volumetric_paths(scattering, absorption):
    mirrored = irradiance(0.0, 1e-6, 50.0, shadow=False)
    whole = irradiance(0.0, scattering, absorption, shadow=False) - mirrored
    albedo = whole / (1 - mirrored)
    found = []
    for x in AT_MM:
        mirror = irradiance(x, 1e-6, 50.0, shadow=True)
        found.append((irradiance(x, scattering, absorption, shadow=True) - mirror) / whole)
    length = diffusion.half_space_length_mm(albedo, scattering)
    # The fit is good to 0.016; light from all directions and the noise of the paths take the rest.
    assert np.abs(np.array(found) - edge(AT_MM, length)).max() < 0.03
