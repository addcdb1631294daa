"""What drawn people wear: prescriptions that correct by traced rays, and who wears what."""

from __future__ import annotations

import numpy as np
import pytest

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.base.spec import EYES
from eyerender.eye.contact import ContactLens
from eyerender.eye.landmarks import path_to_retina, refraction_d
from eyerender.eye.spectacles import SpectacleLens
from eyerender.optics.trace import trace
from eyerender.optics.transforms import normalize
from eyerender.population.table import default_table
from eyerender.scene.spec import SceneSpec

POPULATION = er.Population(preset="adults")
NM = default_table().constant("refraction_nm")
ASTIGMATIC = [k for k in range(60) if abs(POPULATION.person(k).number("refraction_j45_d", "left")) > 0.25][:4]


def residual_d(eye, lens):
    """Refraction matrix (2, 2), dioptres, that is left in front of a lens, by rays about the optic axis."""
    h, u = 2e-3, 1e-4
    steps = np.array([[h, 0, 0, 0], [0, h, 0, 0], [0, 0, u, 0], [0, 0, 0, u]])
    rays = np.concatenate([steps, -steps])
    start = lens.front.to_eye([0.0, 0.0, 0.0])[0]
    origin = np.column_stack([np.full(8, start + 1.0), rays[:, :2] - rays[:, 2:]])
    way = normalize(np.column_stack([np.full(8, -1.0), rays[:, 2:]]))
    met = trace((*lens.inward(), *path_to_retina(eye)), 1.0, origin, way).points_mm[-1, :, 1:]
    change = (met[:4] - met[4:]).T
    return 1e3 * np.linalg.inv(change[:, 2:] / (2 * u)) @ (change[:, :2] / (2 * h))


@pytest.mark.parametrize("subject", ASTIGMATIC)
def test_a_persons_own_spectacles_correct_both_eyes_with_their_astigmatism(subject):
    """Within 0.12 D: the table's refraction is paraxial for a thin lens at its distance, this lens is thick."""
    person = POPULATION.person(subject)
    given = person.spectacles(vertex_mm=14.0, pantoscopic_deg=0.0, wrap_deg=0.0, index=1.6)
    for side in EYES:
        eye = person.eye(side).build(eye=side, wavelength_nm=NM)
        left = residual_d(eye, SpectacleLens.from_mapping(given[side]).build(side, NM))
        assert np.abs(left).max() < 0.12


@pytest.mark.parametrize("subject", [2, 5])
def test_a_persons_own_contact_lenses_correct_the_mean(subject):
    person = POPULATION.person(subject)
    for side in EYES:
        lens = person.contact_lens()[side]
        eye = ContactLens.from_mapping(lens).worn_by(person.eye(side).build(eye=side, wavelength_nm=NM))
        assert refraction_d(eye)[0] == pytest.approx(0.0, abs=0.05 + 0.045 * abs(lens["power_d"]))


def test_who_wears_what():
    """Those without need wear nothing, a larger share adds wearers, and the old wear few contact lenses."""
    people = [POPULATION.person(k) for k in range(120)]
    none, half, all_of_them = ([p.worn(share) for p in people] for share in (0.0, 0.5, 1.0))
    assert not any(none)
    assert all(not few or few == many for few, many in zip(half, all_of_them, strict=True))
    in_need = [bool(worn) for worn in all_of_them]
    errors = [max(abs(p.number("refraction_d", s)) for s in ("right", "left")) for p in people]
    assert min(e for e, need in zip(errors, in_need, strict=True) if not need) < 0.75
    assert all(need for e, need in zip(errors, in_need, strict=True) if e > 0.9)
    share = sum(map(bool, half)) / sum(in_need)
    assert abs(share - 0.5) < 3 * 0.5 / np.sqrt(sum(in_need))
    old = [POPULATION.model_copy(update={"where": {"age_years": (55, 80)}}).person(k).worn(1.0) for k in range(40)]
    assert sum("contact_lens" in worn for worn in old) <= 8  # 5.7 % of at most 40, 3 standard errors


def scene(worn, **population):
    return SceneSpec.from_mapping({
        "format": 2, "name": "own", "population": {"preset": "adults", "seed": 0, **population}, "subject": worn,
        "targets": {"world_mm": [[600.0, 0.0, 0.0]]},
        "rig": {"cameras": [{"position_mm": [600, 0, -30], "look_at_mm": [0, -31, 0], "focal_length_mm": 25,
                             "sensor_mm": [4.8, 3.6], "resolution_px": [320, 240]}],
                "lights": [{"position_mm": [600, 20, -30]}]},
    })  # fmt: skip


def test_scenes_know_the_persons_own_prescription():
    person = POPULATION.person(3)
    worn = scene({"spectacles": {"prescription": "own", "material": "1.60"}}, subject=3).subject.spectacles
    assert worn.right.sphere_d == person.spectacles()["right"]["sphere_d"]
    assert worn.left.material == "1.60"
    lens = scene({"contact_lens": {"prescription": "own"}}, subject=3).subject.contact_lens
    assert lens.left.power_d == person.contact_lens()["left"]["power_d"]


def test_an_own_prescription_needs_a_drawn_person():
    for key in ("spectacles", "contact_lens"):
        with pytest.raises(InputError, match=f"{key}.prescription: needs a drawn person"):
            er.Subject.from_mapping({key: {"prescription": "own"}})


def test_a_share_of_a_population_wears_its_prescription_and_scenes_may_decide_otherwise():
    wearer = next(k for k in range(30) if "spectacles" in POPULATION.person(k).worn(1.0))
    assert scene({}, subject=wearer, corrected=1.0).subject.spectacles is not None
    assert scene({"spectacles": None}, subject=wearer, corrected=1.0).subject.spectacles is None
    assert scene({}, subject=wearer).subject.spectacles is None
