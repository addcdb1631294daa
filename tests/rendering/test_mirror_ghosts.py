"""Pictures in mirrors of glass: ghosts of glints, the mirror's reflectance, and the dark beside its outline."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from tests.rig.test_mirror import GLASS, scene, small


def irradiance(mirror: dict[str, object]) -> np.ndarray:
    shown = scene(mirror=mirror).with_(
        {
            "sensor.exposure_ms": 5.0, "sensor.gain_dn_per_e": 1.0, "image.interreflection": False,
            "look.iris_albedo": 1e-4, "look.pupil_albedo": 1e-4, "look.iris_contrast": 0.0,
        },
        gaze_deg=[[0, 0]],
    )  # fmt: skip
    return er.render(shown.frames())[0].irradiance.astype(float)


def test_ghosts_have_their_place_and_energy_and_the_reflectance_counts():
    """The ghost lies where features say (0.05 px) and has (1 - R1)^2 R2 / R1 of the glint, but for its distance.

    The camera seems farther by h cos a across the plane of incidence and by .8 mm less in it (`rig.mirror`), of 54 mm
    to the image in the cornea: 2.6 % less light; 1 % for the distances that differ from lamp to lamp.
    """
    plain = {**GLASS, "back_reflectance": 0.0}
    without, whole = irradiance(plain), irradiance({**GLASS, "back_reflectance": 0.5})
    bare = irradiance({**plain, "reflectance": 1.0})
    np.testing.assert_allclose(without, 0.4 * bare, rtol=1e-5)
    ghost = whole - without
    found = er.trace(scene(mirror=GLASS).with_(gaze_deg=[[0, 0]]))
    v, u = np.mgrid[: ghost.shape[0], : ghost.shape[1]]
    for at, main in zip(found.ghost_glints.xy_px[0], found.glints.xy_px[0], strict=True):
        near = np.hypot(u - at[0], v - at[1]) < 6
        mine = ghost[near].sum()
        assert (ghost[near] * u[near]).sum() / mine == pytest.approx(at[0], abs=0.05)
        assert (ghost[near] * v[near]).sum() / mine == pytest.approx(at[1], abs=0.05)
        glint = without[np.hypot(u - main[0], v - main[1]) < 6].sum()
        assert mine / glint == pytest.approx(0.974 * 0.6**2 * 0.5 / 0.4, rel=0.01)


def test_pictures_are_black_beside_the_outline():
    found = er.trace(scene(mirror=GLASS).with_(gaze_deg=[[0, 0]])).glints.xy_px[0, 0]
    picture = irradiance({**GLASS, **small(found, 20.0)})
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    inside = (np.abs(u - found[0]) < 19) & (np.abs(v - found[1]) < 19)
    assert (picture[inside] > 0).all()
    assert not picture[(np.abs(u - found[0]) > 21) | (np.abs(v - found[1]) > 21)].any()
