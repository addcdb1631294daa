"""The refraction of drawn eyes by an independent tracer, Optiland (MIT), where it is installed.

Optiland is no dependency: `pip install optiland` in an environment of its own, then run this file there.
"""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.eye.refraction import VERTEX_MM, refraction_d

WAVELENGTH_NM = 555.0
HEIGHT_MM, SLOPE = 2e-3, 1e-4


def of_optiland(optiland, eye, length_mm):
    """Spectacle refraction (M, J0) of a centred eye whose astigmatism lies in y and z, from rays near its axis."""
    optic_module, rays_module, materials = optiland
    optic = optic_module.Optic()
    surfaces = [*eye.front, *eye.back]
    indices = [*eye.front_indices, *eye.back_indices]
    places = [float(s.origin_mm[0]) for s in surfaces] + [-length_mm]
    optic.surfaces.add(index=0, thickness=5.0)
    for k, (surface, index) in enumerate(zip(surfaces, indices, strict=True)):
        gap, medium = places[k] - places[k + 1], materials.IdealMaterial(n=float(index))
        # Light travels to -x of the eye, which is +z there; y and z of the eye are x and y.
        if surface.kind == "biconic":
            (ry, rz), (qy, qz) = surface.radii_mm, surface.conic_constants
            turned = abs(np.degrees(np.arctan2(surface.rotation[2, 1], surface.rotation[1, 1])) % 180 - 90) < 1e-6
            (ry, rz), (qy, qz) = ((rz, ry), (qz, qy)) if turned else ((ry, rz), (qy, qz))
            optic.surfaces.add(index=k + 1, surface_type="biconic", radius_x=float(ry), radius_y=float(rz),
                               conic_x=float(qy), conic_y=float(qz), thickness=gap, material=medium)  # fmt: skip
        else:
            radius, conic = conic_of(surface)
            optic.surfaces.add(index=k + 1, radius=radius, conic=conic, thickness=gap, material=medium)
    optic.surfaces.add(index=len(surfaces) + 1)
    optic.add_wavelength(value=WAVELENGTH_NM / 1000, is_primary=True)
    powers = []
    for axis in (0, 1):
        # A ray at a height, and one with a slope through the apex.
        positions, ways = np.zeros((2, 2)), np.zeros((2, 2))
        positions[axis], ways[axis] = (HEIGHT_MM, -SLOPE), (0.0, SLOPE)
        depth = np.sqrt(1 - np.sum(ways**2, axis=0))
        rays = rays_module.RealRays(positions[0], positions[1], np.full(2, -1.0), ways[0], ways[1], depth,
                                    np.ones(2), np.full(2, WAVELENGTH_NM / 1000))  # fmt: skip
        optic.surfaces.trace(rays)
        a, b = np.array((rays.x, rays.y))[axis] / (HEIGHT_MM, SLOPE)
        vergence = a / b
        powers.append(1000 * vergence / (1 + VERTEX_MM * vergence))
    return (powers[0] + powers[1]) / 2, (powers[0] - powers[1]) / 2


def conic_of(surface):
    """Radius and conic constant of a quadric of revolution, from its depth at two heights: radius > 0 opens to -x."""
    h = np.array([0.5, 1.0])
    s = np.array([float(surface.sag(np.array(v), np.array(0.0))) for v in h])
    # y^2 + 2 R s + (1 + Q) s^2 = 0
    r, q = np.linalg.solve(np.column_stack([2 * s, s**2]), -(h**2))
    return float(r), float(q - 1)


@pytest.mark.slow
def test_refraction_agrees_with_optiland():
    optiland = tuple(pytest.importorskip(f"optiland.{name}") for name in ("optic", "rays", "materials"))
    none = {"kind": "fixed", "value": 0.0}
    names = ("refraction_j45_d", "posterior_j45_d", "lens_nasal_mm", "lens_up_mm", "lens_tilt_y_deg", "lens_tilt_z_deg")
    people = er.Population("adults", replace=dict.fromkeys(names, none)).draw(20, 6)
    misses = []
    for row in range(20):
        person = people.person(row)
        eye = person.eye("right").build(wavelength_nm=WAVELENGTH_NM)
        theirs = of_optiland(optiland, eye, person.number("axial_length_mm", "right"))
        ours = refraction_d(eye)
        drawn = [person.number(name, "right") for name in ("refraction_d", "refraction_j0_d")]
        misses.append([*np.subtract(ours[:2], theirs), *np.subtract(drawn, theirs)])
    assert np.abs(misses).max() < 0.01, np.abs(misses).max(axis=0)
