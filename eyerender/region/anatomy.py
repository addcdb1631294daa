"""Specification of the anatomy of the eye region: lids, lashes, brow, face, tears and skin.

Every length is in mm, every angle in degrees. Defaults are those of a European adult; ranges cover the spread of
adults. Sources, by the name used in the descriptions; "chosen" marks values set by visual judgement or without a
source:

- Read: Read, Collins, Carney, Iskander 2006, Optom Vis Sci 83, 738 (fissure of young adults by vertical gaze: 9.7 (1.2)
  mm high straight ahead, 6.4 (1.1) mm at 40 degrees down).
- Knezi: Knezi et al. 2020, Int J Morphol 38, 1381 (fissure of young adults 27.1 (1.7) mm wide, 9.4 (1.6) mm high).
- van den Bosch: van den Bosch, Leenders, Mulder 1999, Br J Ophthalmol 83, 347 (lids, fold and brow by sex and age:
  the fissure loses 2.5 mm of its width between 35 and 85 years, brows of women stand 2.5 mm higher).
- Cartwright: Cartwright et al. 1994, Am J Ophthalmol 117, 231 (lid below the fold 1.4 (1.1) mm, crease 6.4 (1.2) mm
  above the margin, at 41 to 60 years).
- Zhu: Zhu et al. 2022, Ophthalmol Ther 11, 177 (margin from the lash line to the mucocutaneous junction 1.4 (0.25) mm
  above, 1.0 (0.2) mm below).
- Becker: Becker and Fuchs 1988, J Neurophysiol 60, 1227 (during fixation the upper lid turns by the same angle as the
  eye; upward lid saccades are often smaller).
- Doughty: Doughty, Laiquzzaman, Oblak, Button 2002, Cont Lens Anterior Eye 25, 57 (published means of the meniscus'
  height: 0.215 mm, 0.16 to 0.35 mm).
- textbooks: numbers and lengths of lashes as anatomies and reviews repeat them (90 to 160 above, 75 to 80 below; 8 to
  12 mm and 6 to 8 mm long), for which no original source was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from ..base.spec import KeyProblem, Spec
from .headspec import Head

Share = Annotated[float, Field(ge=0, le=1)]
MOVEMENTS = ("blink", "squint", "wide")
"""Keys of a region by which the lids move."""


def _number(default: float, low: float, high: float, text: str) -> Any:
    return Field(default=default, ge=low, le=high, description=f"{text}; {low:g} to {high:g}")


class Fissure(Spec):
    """The palpebral fissure of a relaxed eye that looks straight ahead."""

    width_mm: float = _number(28.5, 25.0, 33.0, "canthus to canthus (Knezi, van den Bosch)")
    lateral_share: float = _number(0.46, 0.42, 0.50, "share of the width that lies temporal of the pupil (chosen)")
    upper_mm: float = _number(3.7, 2.2, 6.0, "upper margin above the pupil's centre (with the lower one: Read, Knezi)")
    lower_mm: float = _number(
        5.2, 4.0, 7.2, "lower margin below the pupil's centre (with the upper one: Read, Knezi); above 6 sclera shows"
    )
    tilt_deg: float = _number(4.0, -5.0, 11.0, "lateral canthus above the medial one (chosen)")
    canthi_mm: float = _number(-2.2, -3.5, -0.5, "middle of the canthi above the pupil's centre (chosen)")
    epicanthus_mm: float = _number(
        0.0, 0.0, 3.5, "fold of skin from the upper lid that covers the medial canthus by this much (chosen)"
    )
    peak: float = _number(0.02, -0.15, 0.15, "place of the upper margin's peak, -1 temporal to 1 nasal (chosen)")


class Lid(Spec):
    """Shape and movement of the lids."""

    margin_mm: float = _number(
        1.9, 1.4, 2.5, "thickness of the upper margin; the lower is thinner (Zhu, and rows of lashes)"
    )
    margin_tilt_deg: float = _number(-4.0, -8.0, 20.0, "how far the upper margin opens outwards (chosen)")
    thickness_mm: float = _number(2.6, 2.0, 3.4, "skin to globe above the margin (chosen)")
    film_mm: float = _number(0.02, 0.005, 0.05, "thickness of the tear film between inner lid edge and globe (chosen)")
    upper_follows: float = _number(0.9, 0.6, 1.0, "turn of the upper lid per turn of the eye (Becker)")
    lower_follows: float = _number(0.5, 0.1, 0.6, "turn of the lower lid per turn of the eye (chosen)")
    crease_mm: float = _number(8.0, 5.0, 11.0, "crease above the margin of the closed lid (Cartwright; others 8 to 10)")
    show_mm: float = _number(2.6, 1.2, 5.0, "lid visible below the fold when open (Cartwright)")
    fold_mm: float = _number(1.0, 0.0, 1.9, "how far the fold stands above the crease (chosen)")
    hood_mm: float = _number(
        0.0, 0.0, 2.5, "how much farther the fold hangs over the lid, most at the temple: hooded lids, age (chosen)"
    )
    fill_mm: float = _number(2.1, 0.0, 3.5, "how far the hollow above the lid fills as it shuts (chosen)")
    bags_mm: float = _number(0.5, 0.0, 1.5, "fullness below the lower lid (chosen)")


class Lashes(Spec):
    """Lashes of both lids."""

    upper_count: Annotated[int, Field(ge=0, le=180)] = Field(
        default=120, description="number on the upper lid (textbooks)"
    )
    lower_count: Annotated[int, Field(ge=0, le=110)] = Field(
        default=76, description="number on the lower lid (textbooks)"
    )
    upper_length_mm: float = _number(8.5, 5.0, 12.0, "longest lash of the upper lid (textbooks)")
    lower_length_mm: float = _number(4.6, 3.0, 8.0, "longest lash of the lower lid (chosen)")
    diameter_mm: float = _number(0.085, 0.05, 0.12, "diameter at the root (chosen)")
    upper_curl_deg: float = _number(80.0, 20.0, 120.0, "turn of an upper lash from root to tip (chosen)")
    lower_curl_deg: float = _number(80.0, 10.0, 140.0, "turn of a lower lash from root to tip (chosen)")
    upper_droop_deg: float = _number(
        38.0, 22.0, 60.0, "angle of upper lashes at the root below the lid's normal (chosen)"
    )
    clumping: Share = Field(default=0.55, description="how far the tips of neighbours lean together (chosen)")
    spread_deg: float = _number(11.0, 2.0, 20.0, "standard deviation of direction (chosen)")
    mascara: Share = Field(
        default=0.0, description="make-up: lashes darker to the tips, thicker and in firmer tufts, and a dark lash line"
    )
    albedo: float = _number(
        0.05, 0.02, 0.5, "albedo at 850 nm; melanin absorbs little there, but hair is still dark (chosen)"
    )
    tip_albedo: float = _number(
        0.24, 0.02, 0.7, "albedo at the tips of upper lashes, which are thin and let light through (chosen)"
    )
    lower_albedo: float = _number(
        0.16, 0.02, 0.6, "albedo of the lower lashes at the root, which are paler than the upper ones (chosen)"
    )


class Brow(Spec):
    """The brow's hairs."""

    count: Annotated[int, Field(ge=0, le=700)] = Field(default=470, description="number of hairs (chosen)")
    length_mm: float = _number(9.0, 5.0, 13.0, "longest hair (chosen)")
    height_mm: float = _number(15.5, 10.0, 24.0, "lower border above the pupil (chosen)")
    thickness_mm: float = _number(8.5, 3.0, 12.0, "height of the band at its head (chosen)")
    arch_mm: float = _number(3.5, 0.0, 8.0, "rise from head to arch (chosen)")
    diameter_mm: float = _number(0.075, 0.05, 0.14, "diameter at the root (chosen)")
    albedo: float = _number(0.18, 0.02, 0.6, "albedo at 850 nm (chosen)")
    asymmetry_mm: float = _number(0.0, -3.0, 3.0, "left brow above the right one (chosen)")


class Face(Spec):
    """The face around the lids, as differences from the average face."""

    brow_ridge_mm: float = _number(0.0, -4.0, 5.0, "ridge further forward (chosen)")
    sulcus_mm: float = _number(0.0, -4.0, 3.0, "hollow between lid and brow further forward (chosen)")
    nose_mm: float = _number(0.0, -6.0, 6.0, "bridge of the nose further forward (chosen)")
    cheek_mm: float = _number(0.0, -4.0, 4.0, "cheek further forward (chosen)")


class Skin(Spec):
    """Optical appearance of the surfaces at 850 nm."""

    albedo: float = _number(0.55, 0.30, 0.75, "albedo of the skin (chosen; forearms: Cooksey, Allen, Tsai 2017)")
    mottling: Share = Field(default=0.5, description="unevenness of the albedo (chosen)")
    relief_mm: float = _number(0.032, 0.0, 0.12, "depth of the skin's fine furrows (some tens of micrometres; chosen)")
    wrinkles: Share = Field(default=0.35, description="lines on and below the lids (chosen)")
    folds: Share = Field(
        default=0.0, description="number and depth of the folds of age: below and above the lids, crow's feet (chosen)"
    )
    shadow: Share = Field(default=0.0, description="make-up that darkens the upper lid up to its crease (chosen)")
    liner: Share = Field(default=0.0, description="make-up that draws a dark line along the lashes (chosen)")
    pores: Share = Field(default=0.5, description="depth of the pores beyond the lids (chosen)")
    veins: Share = Field(
        default=0.35, description="strength of the veins that show through the thin skin of the lids (chosen)"
    )
    sheen: Share = Field(
        default=0.5, description="strength of the rough specular reflection of lamps by oily skin (chosen)"
    )
    wet_albedo: float = _number(
        0.40, 0.25, 0.55, "albedo of the caruncle and of the moist inner edges of the lid margins (chosen)"
    )
    map: Literal["off"] | None = Field(
        default=None,
        description="`off` for photometry: skin, margins and caruncle are smooth and matte, with `albedo` everywhere",
    )

    @field_validator("map", mode="before")
    @classmethod
    def _off(cls, value: object) -> object:
        return {False: "off", True: None}[value] if isinstance(value, bool) else value  # YAML reads `off` as false


class TearFilm(Spec):
    """Tears on margins, caruncle and lash roots, and the meniscus along both margins."""

    height_mm: float = _number(0.21, 0.0, 0.6, "height of the meniscus on the globe (Doughty)")
    unevenness: Share = Field(
        default=0.5,
        description="how far the meniscus breaks up and the wet margins are rough (chosen so that highlights are "
        "about as many as in photographs)",
    )


class LidsBySide(Spec):
    """A movement of the lids that differs between the eyes, such as a wink."""

    right: Share = Field(default=0.0, description="of the right eye")
    left: Share = Field(default=0.0, description="of the left eye")


Movement = Annotated[
    Annotated[Share, Tag("NumberSpec")] | Annotated[LidsBySide, Tag("SidesSpec")],
    Discriminator(lambda value: "SidesSpec" if isinstance(value, Mapping | LidsBySide) else "NumberSpec"),
]


class Region(Spec):
    """The eye region of one subject. Without this key, a scene shows the bare eye in front of a matte background.

    >>> er.Region(blink=0.3).blink
    0.3
    """

    fissure: Fissure = Field(default=Fissure(), description="the opening between the lids")
    lids: Lid = Field(default=Lid(), description="shape and movement of the lids")
    lashes: Lashes = Field(default=Lashes(), description="lashes of both lids")
    brow: Brow = Field(default=Brow(), description="the brow's hairs")
    face: Face = Field(default=Face(), description="the face around the lids")
    skin: Skin = Field(default=Skin(), description="appearance of the skin at 850 nm")
    tears: TearFilm = Field(default=TearFilm(), description="the tear meniscus along both margins")
    blink: Movement = Field(
        default=0.0, description="closure of the lids, 0 open to 1 shut; a number, or `{right: .., left: ..}`"
    )
    squint: Movement = Field(
        default=0.0, description="lower lid raised, 0 at rest to 1 straight between the canthi; like `blink`"
    )
    wide: Movement = Field(
        default=0.0, description="upper lid raised above its rest, by up to 2.5 mm at 1 (chosen); like `blink`"
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="selects the hairs and the skin")
    head: Head | None = Field(default=None, description="your own head mesh instead of all of this")

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in (*MOVEMENTS, "fissure", "lids", "face") if self.head is not None else ():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"{name}: cannot be combined with a head mesh, which does not move and has its own shape"
                )
        if self.head is not None and self.skin.map is not None:
            raise KeyProblem("skin.map", "cannot be combined with a head mesh, which has its own texture")
        return self

    def moved(self, name: str) -> float:
        """Return how far the lids of one side do one of `MOVEMENTS`, 0 to 1; see `of_side`."""
        value = getattr(self, name)
        if isinstance(value, LidsBySide):
            raise ValueError(f"region.{name} differs between the eyes; take the region of one side first")
        return float(value)

    def with_lids(self, blink: float = 0.0) -> Self:
        """Return the same person with lids that neither squint nor are opened wide."""
        return self.model_copy(update={**dict.fromkeys(MOVEMENTS, 0.0), "blink": blink})

    def of_side(self, side: str) -> Self:
        """Return the region of the right or left eye; movements of the lids and heights of the brows may differ."""
        own = {name: getattr(self, name) for name in MOVEMENTS}
        own = {name: getattr(value, side) for name, value in own.items() if isinstance(value, LidsBySide)}
        return (self.model_copy(update=own) if own else self)._brow_of(side)

    def _brow_of(self, side: str) -> Self:
        if self.brow.asymmetry_mm == 0:
            return self
        half = 0.5 * self.brow.asymmetry_mm * (1 if side == "left" else -1)
        height = float(np.clip(self.brow.height_mm + half, 10.0, 24.0))
        brow = self.brow.model_copy(update={"height_mm": height, "asymmetry_mm": 0.0})
        return self.model_copy(update={"brow": brow})

    @classmethod
    def drawn(cls, seed: int, *, spread: float = 1.0, blink: float = 0.0) -> Self:
        """Draw a subject without make-up: every bounded number is uniform over `spread` of its range about the default.

        Each number is a pure function of (seed, key).
        """
        return cls.from_mapping({**_draw(cls, (seed,), spread), "seed": seed, "blink": blink})


_NOT_DRAWN = ("folds", "head", "liner", "map", "mascara", "shadow", "squint", "wide")


def _draw(kind: type[Spec], key: tuple[int, ...], spread: float) -> dict[str, object]:
    out: dict[str, object] = {}
    fields = [(name, field) for name, field in sorted(kind.model_fields.items()) if name not in _NOT_DRAWN]
    for i, (name, field) in enumerate(fields):
        if isinstance(field.annotation, type) and issubclass(field.annotation, Spec):
            out[name] = _draw(field.annotation, (*key, i), spread)
            continue
        bounds = [getattr(m, "ge", None) for m in field.metadata], [getattr(m, "le", None) for m in field.metadata]
        low, high = (next((b for b in side if b is not None), None) for side in bounds)
        if low is None or high is None:
            continue
        u = np.random.default_rng((0x5EED, *key, i)).uniform(-spread, spread)
        default = float(field.default)
        value = default + u * ((high - default) if u > 0 else (default - low))
        out[name] = round(value) if field.annotation is int else float(value)
    return out
