"""Populations and the people drawn from them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property, lru_cache
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import ndtri

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.spec import EYES, KeyProblem, Number, Side, Spec
from ..eye.fixation import far_sight_mm
from ..eye.landmarks import at_cornea_d
from ..eye.spec import EyeSpec
from ..region.anatomy import Region, Skin
from ..region.look import Look
from . import correction
from .draw import Conditions, latent_numbers, uniform_numbers
from .eyes import amplitude_d, eye_file
from .marginals import Fixed
from .model import Model, reference_of
from .pupil import watson_yellott_mm
from .refraction import Biometry, Optics, solve
from .table import ROOTS, Distribution, PopulationTable, QuantityRegression, default_table

_SKIN_STREAM = 0x5C1A  # of random numbers; those of the latent numbers begin at 0x9E0 << 32
SOLVED = tuple(field.name for field in fields(Optics))
"""Numbers of an eye that follow from its refraction."""


class PopulationSpec(Spec):
    """A population: one of the table's presets, with changed distributions and conditions."""

    preset: str = Field(default="adults", description="adults, emmetropic_adults, myopes, children or elderly")
    replace: dict[str, Distribution] = Field(
        default_factory=dict, description="quantity of the table -> another distribution of it"
    )
    where: dict[str, Number | tuple[Number, Number]] = Field(
        default_factory=dict,
        description="quantity -> its value, or the range in which it must lie (of an eye's quantity: of both eyes)",
    )

    corrected: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="share of those who need a correction that wear their own glasses or contact lenses in scenes; the "
        "people stay the same",
    )

    skin_history: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None,
        description="strength (default 1) of what years and make-up do to skin: folds, unevenness, liner, shadow; with "
        "0, people are the same without these",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        table = default_table()
        if self.preset not in table.presets:
            raise KeyProblem("preset", f"must be one of {', '.join(table.presets)}, not {self.preset!r}")
        for key, names in (("replace", self.replace), ("where", self.where)):
            for name in names:
                if name not in table.quantities:
                    raise KeyProblem(f"{key}.{name}", "no such quantity of the table")
        for root in ROOTS:
            if isinstance(self.replace.get(root), QuantityRegression):
                raise KeyProblem(f"replace.{root}", "must be a marginal, because the regressions start from it")
        for name, found in self.replace.items():
            if isinstance(found, Fixed) and name in self.where:
                raise KeyProblem(f"where.{name}", "has one value already")
        try:
            Conditions.of(self.model, self.where)
        except InputError as error:
            raise KeyProblem(f"where.{error.path}", error.reason) from None
        return self

    @cached_property
    def model(self) -> Model:
        """Joint distribution of this population."""
        reference = reference_of(self.preset)
        preset = reference.table.presets[self.preset]
        return Model(reference, {**reference.distributions, **preset.replace, **self.replace})

    def numbers(self, n: int, seed: int = 0, *, first: int = 0) -> dict[str, Floats]:
        """Draw the numbers of subjects `first` to `first + n - 1`: name -> (n,) or (n, 2) for right and left.

        A subject's numbers depend on (this population, seed, subject) alone. Besides the quantities of the table these
        are `entrance_pupil_mm`, at the table's luminance, and numbers that follow from the refraction: the cornea's
        principal radii (`steep_mm`, `flat_mm`, ...) and the lens (`lens_c0`). Raises InputError if n < 1, or hardly
        anybody meets the conditions.
        """
        if n < 1:
            raise InputError(f"must be >= 1, not {n}", path="n")
        found = _values(self.model, latent_numbers(self.model, Conditions.of(self.model, self.where), seed, first, n))
        strength = 1.0 if self.skin_history is None else self.skin_history
        return found | skin_history(found["age_years"], found["male"], strength, seed, first)

    def person(self, subject: int, seed: int = 0) -> Person:
        """Return one subject."""
        return Person.of(self.preset, seed, subject, {k: v[0] for k, v in self.numbers(1, seed, first=subject).items()})


class Person(Spec):
    """A drawn person: its numbers, from which eyes, lids and face are made."""

    preset: str = Field(description="population of the person")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(description="seed of the draw")
    subject: Annotated[int, Field(ge=0, lt=2**63)] = Field(description="number of the subject")
    numbers: dict[str, Number | tuple[Number, Number]] = Field(
        description="quantity -> value, or its values of the right and the left eye"
    )

    @classmethod
    def of(cls, preset: str, seed: int, subject: int, numbers: Mapping[str, Any]) -> Self:
        """Create the person from its numbers, which may be NumPy's."""
        plain = {name: np.asarray(value).tolist() for name, value in numbers.items()}
        return cls(preset=preset, seed=seed, subject=subject, numbers=plain)

    def number(self, name: str, side: Side | None = None) -> float:
        """Return a number of the person, or of one eye; InputError if there is no such number."""
        value = self.numbers.get(name)
        if value is None or isinstance(value, tuple) != (side is not None):
            raise InputError("missing, or not of the right kind", path=f"person.numbers.{name}")
        return value[EYES.index(side)] if isinstance(value, tuple) and side is not None else float(value)  # type: ignore[arg-type]

    def to_json(self) -> str:
        """Return the person as text, the same for equal persons."""
        return json.dumps(self.to_mapping(), sort_keys=True)

    @property
    def sex(self) -> str:
        """Male or female."""
        return "male" if self.number("male") > 0.5 else "female"

    @property
    def ipd_mm(self) -> float:
        """Far interpupillary distance (mm); scenes use the corneal apexes' distance, see `apex_distance_mm`."""
        return self.number("ipd_mm")

    @property
    def apex_distance_mm(self) -> float:
        """Distance (mm) of the unrotated corneal apexes at which the far interpupillary distance is `ipd_mm`.

        A pupillometer lets each eye look into the distance and sees its entrance pupil from the front. So it measures
        the horizontal distance of the parallel lines of sight, which pass through the centres of the entrance pupils.
        The value holds for a person who looks far away without glasses, in the table's light, at 850 nm. Raises
        InputError if an eye is physically impossible.
        """
        return _apex_distance_mm(self.to_json())

    @property
    def mean_refraction_d(self) -> float:
        """Mean refraction (D) of both eyes at the cornea; hyperopes must accommodate by it to see far away."""
        return float(np.mean([at_cornea_d(self.number("refraction_d", side)) for side in EYES]))

    def draw_seed(self, purpose: str) -> int:
        """Return a seed of 31 bits for something without a quantity in the table, such as hairs."""
        text = f"{self.preset}/{self.seed}/{self.subject}/{purpose}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1

    @property
    def amplitude_d(self) -> float:
        """Accommodation amplitude (D) at the person's age, at least 0."""
        return amplitude_d(default_table(), self.number("age_years"))

    def accommodation_d(self, demand_d: float) -> float:
        """Compute the accommodation (D) to a demand: the demand itself, as far as the age allows."""
        return min(max(demand_d, 0.0), self.amplitude_d)

    def entrance_pupil_mm(
        self,
        luminance_cd_m2: float | None = None,
        field_deg: float | None = None,
        demand_d: float = 0.0,
        *,
        side: Side | None = None,
    ) -> float:
        """Compute the entrance pupil (mm) for a field of given luminance and diameter (deg), and a viewing demand (D).

        The near response reduces it by the person's miosis per dioptre of accommodation. The pupils of both eyes differ
        by the person's anisocoria; without a `side` it is their mean.
        """
        table = default_table()
        luminance = table.constant("luminance_cd_m2") if luminance_cd_m2 is None else luminance_cd_m2
        field = table.constant("field_deg") if field_deg is None else field_deg
        far = far_pupil_mm(table, luminance, field, np.array(self.number("age_years")), self.number("pupil_score"))
        near = float(far) - self.number("miosis_mm_per_d") * self.accommodation_d(demand_d)
        if side is not None:
            near += self.number("anisocoria_mm") * (0.5 if side == "right" else -0.5)
        return float(np.clip(near, table.constant("smallest_pupil_mm"), table.constant("largest_pupil_mm")))

    def eye(
        self, side: Side, *, luminance_cd_m2: float | None = None, field_deg: float | None = None, demand_d: float = 0.0
    ) -> EyeSpec:
        """Return the eye file of one eye, written as a right eye as all eye files are.

        Args:
            side: right or left.
            luminance_cd_m2: luminance of the visual field; default: the table's.
            field_deg: diameter of the lit field; default: the table's.
            demand_d: accommodation that the target demands, in dioptres.

        Raises:
            InputError: the eye is physically impossible.
        """
        k = EYES.index(side)
        numbers = {name: value[k] for name, value in self.numbers.items() if isinstance(value, tuple)}
        return eye_file(
            f"{self.preset} {self.seed}/{self.subject}",
            numbers,
            default_table(),
            age_years=self.number("age_years"),
            accommodation_d=self.accommodation_d(demand_d),
            entrance_mm=self.entrance_pupil_mm(luminance_cd_m2, field_deg, demand_d, side=side),
            seed=self.draw_seed(f"pupil/{side}"),
        )

    def region(self) -> Region:
        """Return lids, lashes, brow, face and skin; numbers outside the range of a key are clipped."""
        data: dict[str, Any] = {"seed": self.draw_seed("region")}
        for group, kind in Region.model_fields.items():
            fields = getattr(kind.annotation, "model_fields", {})
            mine = {key: _within(fields[key], value) for key, value in self._under(f"{group}.").items()}
            if mine:
                data[group] = mine
        return Region.from_mapping(data)

    def look(self) -> Look:
        """Return albedos and textures of the eyes; numbers outside the range of a key are clipped."""
        mine = {key: _within(Look.model_fields[key], value) for key, value in self._under("look.").items()}
        if "limbus_albedo" in mine:
            passed = mine.get("limbus_transmittance", Look.model_fields["limbus_transmittance"].default)
            mine["limbus_albedo"] = min(mine["limbus_albedo"], 1 - passed)
        return Look.from_mapping({"iris_seed": self.draw_seed("iris"), **mine})

    def spectacles(self, **keys: Any) -> dict[str, Any]:
        """Return `spectacles` of a subject with the prescriptions of both eyes; `keys` are those of the lenses."""
        return correction.spectacles_of(self, **keys)

    def contact_lens(self, **keys: Any) -> dict[str, Any]:
        """Return `contact_lens` of a subject with the powers of both eyes; `keys` are those of the lenses."""
        return correction.contact_lens_of_person(self, **keys)

    def worn(self, share: float) -> dict[str, Any]:
        """Return `spectacles` or `contact_lens` of a subject, or neither, if a share of those in need wears one."""
        return correction.worn_by(self, share)

    def _under(self, prefix: str) -> dict[str, float]:
        return {name[len(prefix) :]: self.number(name) for name in self.numbers if name.startswith(prefix)}


@lru_cache(maxsize=64)
def _apex_distance_mm(text: str) -> float:
    """Solve for `apex_distance_mm` of a person from its JSON; cached for all frames."""
    person = Person.from_mapping(json.loads(text))
    eyes = (person.eye(side, demand_d=max(person.mean_refraction_d, 0.0)).build() for side in EYES)
    # Eye files are written as right eyes, so +y is nasal in both.
    return person.ipd_mm + float(sum(far_sight_mm(eye)[0] for eye in eyes))


class PersonChoice(PopulationSpec):
    """`population` of a scene: one subject of a population."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(default=0, description="seed of the draw")
    subject: Annotated[int, Field(ge=0, lt=2**53)] = Field(default=0, description="number of the subject")

    def chosen(self) -> Person:
        """Return the person."""
        return self.person(self.subject, self.seed)


@lru_cache(maxsize=64)
def choice_of(text: str) -> PersonChoice:
    """Parse the choice of a subject from its JSON."""
    return PersonChoice.from_mapping(json.loads(text))


@lru_cache(maxsize=64)
def _chosen(text: str) -> Person:
    return choice_of(text).chosen()


def chosen_person(data: object) -> Person:
    """Return the person of a mapping of `PersonChoice`; drawn once for all frames.

    Raises:
        InputError: the mapping is not such a choice, or hardly anybody meets its conditions.
    """
    try:
        text = json.dumps(data, sort_keys=True)
    except (TypeError, ValueError):
        return PersonChoice.from_mapping(data).chosen()
    return _chosen(text)


def far_pupil_mm(
    table: PopulationTable, luminance: float, field: float, age_years: Floats, score: Floats | float
) -> Floats:
    """Compute entrance pupils (mm) of people who look far away: the mean for their age plus score times spread."""
    mean = watson_yellott_mm(luminance, field, age_years)
    small, large = table.constant("pupil_sd_small_mm"), table.constant("pupil_sd_large_mm")
    spread = small + (large - small) * np.clip((mean - 2.5) / 4.0, 0.0, 1.0)
    far = mean + score * spread
    return np.clip(far, table.constant("smallest_pupil_mm"), table.constant("largest_pupil_mm"))


def skin_history(age_years: Floats, male: Floats, strength: float, seed: int, first: int) -> dict[str, Floats]:
    """Draw folds, unevenness and make-up (n,) of people from `first` on, with random numbers of their own.

    All of it is set by eye. Folds deepen by half of their range from 25 to 65 years, and a third of the women wear
    liner, a quarter shadow. Mottling and relief are lognormal about the defaults of the skin.
    """
    u = uniform_numbers(seed, _SKIN_STREAM, first, len(age_years), 5)
    z, woman = ndtri(u), male < 0.5
    skin = Skin()
    return {
        "skin.folds": strength * np.clip(0.3 + 0.0125 * (age_years - 25.0) + 0.15 * z[:, 0], 0.0, 1.0),
        "skin.mottling": np.minimum(skin.mottling * np.exp(strength * (0.5 + 0.6 * z[:, 1])), 1.0),
        "skin.relief_mm": np.minimum(skin.relief_mm * np.exp(strength * (0.5 + 0.4 * z[:, 2])), 0.12),
        "skin.liner": strength * np.where(woman, np.clip(3.0 * u[:, 3] - 2.0, 0.0, 1.0), 0.0),
        "skin.shadow": strength * np.where(woman, np.clip(4.0 * u[:, 4] - 3.0, 0.0, 1.0), 0.0),
    }


def _values(model: Model, latent: Floats) -> dict[str, Floats]:
    """Compute every number of people from latent numbers."""
    values = model.values(latent)
    table = model.reference.table
    values["entrance_pupil_mm"] = far_pupil_mm(
        table,
        table.constant("luminance_cd_m2"),
        table.constant("field_deg"),
        values["age_years"],
        values["pupil_score"],
    )
    optics = solve(biometry(table, values))
    for name in SOLVED:
        values[name] = np.asarray(getattr(optics, name))
    return values


def biometry(table: PopulationTable, values: Mapping[str, Floats]) -> Biometry:
    """Return lengths and radii of people's eyes, (n, 2) each."""
    return Biometry(
        refraction=(values["refraction_d"], values["refraction_j0_d"], values["refraction_j45_d"]),
        corneal_radius_mm=values["corneal_radius_mm"],
        posterior_radius_mm=values["posterior_radius_mm"],
        posterior_astigmatism_d=(values["posterior_j0_d"], values["posterior_j45_d"]),
        corneal_thickness_mm=values["corneal_thickness_mm"],
        chamber_depth_mm=values["chamber_depth_mm"],
        lens_thickness_mm=values["lens_thickness_mm"],
        lens_radii_mm=(values["lens_front_radius_mm"], values["lens_back_radius_mm"]),
        axial_length_mm=values["axial_length_mm"],
        vertex_mm=table.constant("vertex_mm"),
        wavelength_nm=table.constant("refraction_nm"),
    )


def _within(field: Any, value: float) -> float | int:
    """Clip a number to the range of a key; round it if the key is a whole number."""
    low = next((m.ge for m in field.metadata if getattr(m, "ge", None) is not None), -np.inf)
    high = next((m.le for m in field.metadata if getattr(m, "le", None) is not None), np.inf)
    moved = min(max(value, low), high)
    return round(moved) if field.annotation is int else float(moved)
