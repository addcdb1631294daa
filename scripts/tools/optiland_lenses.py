#!/usr/bin/env python3
"""Trace random rays through random tilted lenses with Optiland; write tests/data/optiland_lenses.json.

    optiland_lenses.py FILE

It needs Optiland (MIT), which is no dependency: run it in an environment of its own. Lenses are placed as
docs/glasses.md says: p = o + A p_lens, A = Rz(s wrap) Ry(pantoscopic), s = -1 for a right and +1 for a left eye.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from optiland.materials import IdealMaterial  # type: ignore[import-not-found,unused-ignore]
from optiland.optic import Optic  # type: ignore[import-not-found,unused-ignore]
from optiland.rays import RealRays  # type: ignore[import-not-found,unused-ignore]

Floats = np.ndarray[Any, np.dtype[np.float64]]
COUNT, WAVELENGTH_UM = 100, 0.85


def main() -> None:
    """Draw the lenses and rays, and trace them."""
    rng = np.random.default_rng(850)
    rows = []
    for number in range(COUNT):
        front, back = rng.uniform(40, 200), rng.uniform(40, 200) * rng.choice([-1, 1])
        surfaces = {"front_radius_mm": front, "back_radius_mm": back, "thickness_mm": rng.uniform(7, 9),
                    "index": rng.uniform(1.45, 1.75)}  # fmt: skip
        if number % 3 == 0:
            surfaces |= {"front_asphericity": rng.uniform(-1, 0.5), "back_asphericity": rng.uniform(-1, 0.5)}
        elif number % 3 == 1:
            surfaces["back_radius_mm"] = None
        lens = {"surfaces": surfaces, "vertex_mm": rng.uniform(12, 16), "pantoscopic_deg": rng.uniform(-20, 20),
                "wrap_deg": rng.uniform(-20, 20), "decentration_mm": rng.uniform(-3, 3, 2).tolist(),
                "outline_mm": [12.0, 12.0]}  # fmt: skip
        side = ("right", "left")[number % 2]
        start = np.array([60.0, *rng.uniform(-8, 8, 2)])
        way = np.array([-1.0, *rng.uniform(-0.1, 0.1, 2)])
        way /= np.linalg.norm(way)
        end, after = traced(lens, surfaces, side, start, way)
        rows.append({"side": side, "lens": lens, "start_mm": start.tolist(), "direction": way.tolist(),
                     "end_mm": end.tolist(), "end_direction": after.tolist()})  # fmt: skip
    text = json.dumps({"optiland": version("optiland"), "rays": rows}, indent=1)
    Path(sys.argv[1]).write_text(text + "\n", encoding="utf-8")


def traced(
    lens: dict[str, Any], surfaces: dict[str, Any], side: str, start: Floats, way: Floats
) -> tuple[Floats, Floats]:
    """Trace a ray (3,) of the eye's frame to the back surface; return the point there and the direction behind it."""
    sign = -1.0 if side == "right" else 1.0
    wrap, tilt = np.radians([sign * lens["wrap_deg"], lens["pantoscopic_deg"]])
    about_z = np.array([[np.cos(wrap), -np.sin(wrap), 0], [np.sin(wrap), np.cos(wrap), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    A = about_z @ about_y
    nasal, up = lens["decentration_mm"]
    origin = np.array([lens["vertex_mm"], -sign * nasal, up])
    # Light runs along +z of Optiland, which is -x of the lens; its z is 0 at the front vertex.
    thickness = surfaces["thickness_mm"]
    p, d = A.T @ (start - origin), A.T @ way
    optic = Optic()
    optic.surfaces.add(index=0, thickness=np.inf)
    glass = IdealMaterial(n=surfaces["index"])
    for k, name in enumerate(("front", "back")):
        radius = surfaces[f"{name}_radius_mm"]
        optic.surfaces.add(
            index=k + 1, radius=np.inf if radius is None else radius, conic=surfaces.get(f"{name}_asphericity", 0.0),
            thickness=thickness if k == 0 else 10.0, material=glass if k == 0 else "air", is_stop=k == 0,
        )  # fmt: skip
    optic.surfaces.add(index=3)
    optic.wavelengths.add(value=WAVELENGTH_UM, is_primary=True)
    one = [np.array([v]) for v in (p[1], p[2], thickness - p[0], d[1], d[2], -d[0], 1.0, WAVELENGTH_UM)]
    rays = RealRays(*one)
    for surface in list(optic.surfaces)[1:3]:
        surface.trace(rays)
    end = np.array([thickness - float(rays.z[0]), float(rays.x[0]), float(rays.y[0])])
    after = np.array([-float(rays.N[0]), float(rays.L[0]), float(rays.M[0])])
    return origin + A @ end, A @ after


if __name__ == "__main__":
    main()
