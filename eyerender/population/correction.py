"""Glasses and contact lenses of drawn people: prescriptions from drawn refractions, and who wears which kind.

A drawn refraction is that of spectacles at the table's vertex distance d: the power matrix F leaves light of the
vergence K = F (1 - d F)^-1 at the cornea. Spectacles at the distance v need F' = K (1 + v K)^-1, and a soft contact
lens, which has one power, the mean part of K.

Of those who wear a correction, 39 % (10 to 18 years), 37 % (18 to 40) and 5.7 % (over 50) wear contact lenses (NHANES
2005 to 2008, abstract). All other numbers here are chosen.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..base.spec import EYES, Side
from ..eye.spectacles import SpectacleLens
from .refraction import Power, mapped
from .table import default_table


class Wearer(Protocol):
    """Properties of a person that this module reads: see `people.Person`."""

    def number(self, name: str, side: Side | None = None) -> float:
        """Return a number of the person, or of one eye."""
        ...

    def draw_seed(self, purpose: str) -> int:
        """Return a seed for something without a quantity in the table."""
        ...


NEEDED_D, NEEDED_CYLINDER_D = 0.75, 1.0
"""Refractive errors from which on people need a correction (chosen; the usual limits of prescribing)."""
MOST_CONTACT_D = 15.0
_CONTACT_AGES, _CONTACT_SHARES = (18.0, 40.0, 50.0), (0.39, 0.37, 0.057)


def at_cornea(person: Wearer, side: Side) -> Power:
    """Compute the refraction K of one eye at the cornea: (M, J0, J45) in dioptres, about nasal towards up."""
    mean, j0, j45 = (np.array(person.number(f"refraction_{part}", side)) for part in ("d", "j0_d", "j45_d"))
    d = 1e-3 * default_table().constant("vertex_mm")
    return mapped((mean, j0, j45), lambda power: power / (1.0 - d * power))


def prescription(power: Power, side: Side) -> dict[str, float]:
    """Write a power (M, J0, J45) in dioptres as an optician does, with a minus cylinder.

    The axis counts counter-clockwise as seen by somebody who faces the wearer. Nasal is at that person's right for a
    right eye and at the left for a left eye, so the axis of a left eye runs the other way about.
    """
    mean, j0, j45 = power
    across = np.hypot(j0, j45)
    axis = np.degrees(0.5 * np.arctan2(j45, j0))
    axis = (axis if side == "right" else 180.0 - axis) % 180.0
    return {"sphere_d": float(mean + across), "cylinder_d": float(-2.0 * across), "axis_deg": float(axis)}


def spectacles_of(person: Wearer, **keys: Any) -> dict[str, dict[str, Any]]:
    """Return `spectacles` with the prescription of each eye and the same other keys, such as `vertex_mm`."""
    v = 1e-3 * float(keys.get("vertex_mm", SpectacleLens.model_fields["vertex_mm"].default))
    out: dict[str, dict[str, Any]] = {}
    for side in EYES:
        out[side] = {**prescription(mapped(at_cornea(person, side), lambda k: k / (1.0 + v * k)), side), **keys}
    return out


def contact_lens_of_person(person: Wearer, **keys: Any) -> dict[str, dict[str, Any]]:
    """Return `contact_lens` with the power of each eye and the same other keys (`ContactLens`)."""
    return {side: {"power_d": float(at_cornea(person, side)[0]), **keys} for side in EYES}


def fitting(rng: np.random.Generator) -> dict[str, float]:
    """Draw how a frame sits on a face: vertex distance, tilt and wrap of its lenses (chosen)."""
    values = rng.normal([13.5, 8.0, 5.0], [0.8, 3.0, 2.5]).clip([12.0, 0.0, 0.0], [15.0, 15.0, 12.0])
    return dict(zip(("vertex_mm", "pantoscopic_deg", "wrap_deg"), values.tolist(), strict=True))


def worn_by(person: Wearer, share: float) -> dict[str, Any]:
    """Return the keys `spectacles` or `contact_lens` of a person, or none; a `share` of those who need one wear one."""
    rng = np.random.default_rng(person.draw_seed("correction"))
    wears, contact = rng.random(2)
    fit = fitting(rng)
    coated, mirrored = rng.random(), rng.uniform(0.2, 0.4)
    errors = [prescription(at_cornea(person, side), side) for side in EYES]
    largest = max(abs(e["sphere_d"] + e["cylinder_d"] / 2.0) for e in errors)
    if wears >= share or (largest < NEEDED_D and max(-e["cylinder_d"] for e in errors) < NEEDED_CYLINDER_D):
        return {}
    likes_contact = contact < np.interp(person.number("age_years"), _CONTACT_AGES, _CONTACT_SHARES)
    if likes_contact and NEEDED_D <= largest < MOST_CONTACT_D:
        return {"contact_lens": contact_lens_of_person(person)}
    lens: dict[str, Any] = {**fit}
    lens["material"] = "CR-39" if largest < 3.0 else "1.60" if largest < 6.0 else "1.67"
    # Small lenses are thin at their thick edge or middle, which strong prescriptions are chosen for.
    lens["outline_mm"] = [25.0, 17.0] if largest < 4.0 else [22.0, 15.0]
    if coated < 0.1:
        lens["reflectance"] = mirrored
    return {"spectacles": spectacles_of(person, **lens)}
