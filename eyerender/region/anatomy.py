"""The anatomy of the eye region as a person writes it: lids, lashes, brow, face, tears and skin.

Every length is in mm, every angle in degrees. Defaults are those of a European adult; ranges hold the spread of adults.
Sources, by the name used in the descriptions (means are theirs, ranges wider than theirs are chosen):

- Hall: Hall, Gripp, Slavotinek 2007, Handbook of Physical Measurements (fissure length 28 to 32 mm, canthal tilt).
- van den Bosch: van den Bosch, Leenders, Mulder 1999, Br J Ophthalmol 83, 347 (fissure 27 to 30 mm long, 8 to 11 mm
  high, both margins above and below the pupil's centre, by sex and age).
- Becker: Becker and Fuchs 1988, J Neurophysiol 60, 1227 (the upper lid turns nearly as far as the eye).
- Evinger: Evinger, Manning, Sibony 1991, Invest Ophthalmol Vis Sci 32, 387 (lids in blinks).
- Wolff: Bron, Tripathi, Tripathi 1997, Wolff's Anatomy of the Eye and Orbit (margin 2 mm thick; lashes in two to three
  rows, 100 to 150 above, 50 to 75 below, 8 to 12 and 6 to 8 mm long; caruncle 5 x 3 mm).
- Na: Na et al. 2006, Br J Dermatol 155, 1170 (lash length, diameter, curl and number).
- Mainstone: Mainstone, Bruce, Golding 1996, Curr Eye Res 15, 653 (meniscus radius and height 0.2 to 0.3 mm).
- Farkas: Farkas 1994, Anthropometry of the Head and Face (brow, nose, orbit).
"""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field

from ..spec import Spec

Share = Annotated[float, Field(ge=0, le=1)]


def _number(default: float, low: float, high: float, text: str) -> Any:
    return Field(default=default, ge=low, le=high, description=f"{text}; {low:g} to {high:g}")


class FissureSpec(Spec):
    """The palpebral fissure of a relaxed eye that looks straight ahead."""

    width_mm: float = _number(29.0, 25.0, 33.0, "canthus to canthus (Hall, van den Bosch)")
    lateral_share: float = _number(0.46, 0.42, 0.50, "share of the width that lies temporal of the pupil (chosen)")
    upper_mm: float = _number(3.7, 2.2, 6.0, "upper margin above the pupil's centre (van den Bosch)")
    lower_mm: float = _number(5.2, 4.0, 6.5, "lower margin below the pupil's centre (van den Bosch)")
    tilt_deg: float = _number(4.0, -3.0, 9.0, "lateral canthus above the medial one (Hall)")
    canthi_mm: float = _number(-2.2, -3.5, -0.5, "middle of the canthi above the pupil's centre (chosen)")
    peak: float = _number(0.02, -0.15, 0.15, "place of the upper margin's peak, -1 temporal to 1 nasal (chosen)")


class LidSpec(Spec):
    """The lids themselves and how they move."""

    margin_mm: float = _number(2.0, 1.5, 2.5, "thickness of the margin (Wolff)")
    margin_tilt_deg: float = _number(14.0, 5.0, 40.0, "how far the margin opens outwards (chosen)")
    thickness_mm: float = _number(2.6, 2.0, 3.4, "skin to globe above the margin (Wolff)")
    film_mm: float = _number(0.02, 0.005, 0.05, "between the margin's inner edge and the globe (chosen)")
    upper_follows: float = _number(0.9, 0.6, 1.0, "turn of the upper lid per turn of the eye (Becker)")
    lower_follows: float = _number(0.35, 0.1, 0.6, "turn of the lower lid per turn of the eye (chosen after Evinger)")
    crease_mm: float = _number(8.5, 5.0, 11.0, "crease above the margin of the closed lid (commonly 8 to 10; chosen)")
    show_mm: float = _number(3.2, 1.0, 5.5, "lid visible below the fold when open (chosen)")
    fold_mm: float = _number(1.3, 0.0, 2.2, "how far the fold stands above the crease (chosen)")
    bags_mm: float = _number(0.5, 0.0, 1.5, "fullness below the lower lid (chosen)")


class LashSpec(Spec):
    """Lashes of both lids."""

    upper_count: Annotated[int, Field(ge=0, le=180)] = Field(default=120, description="of the upper lid (Wolff, Na)")
    lower_count: Annotated[int, Field(ge=0, le=110)] = Field(default=68, description="of the lower lid (Wolff)")
    upper_length_mm: float = _number(8.5, 5.0, 12.0, "longest of the upper lid (Wolff, Na)")
    lower_length_mm: float = _number(5.0, 3.0, 8.0, "longest of the lower lid (Wolff)")
    diameter_mm: float = _number(0.085, 0.05, 0.12, "at the root (Na)")
    upper_curl_deg: float = _number(80.0, 20.0, 120.0, "turn of an upper lash from root to tip (Na)")
    lower_curl_deg: float = _number(45.0, 10.0, 80.0, "turn of a lower lash from root to tip (chosen)")
    upper_droop_deg: float = _number(38.0, 10.0, 60.0, "upper lashes start that far below the lid's normal (chosen)")
    clumping: Share = Field(default=0.45, description="how far tips of neighbours lean together (chosen)")
    spread_deg: float = _number(9.0, 2.0, 25.0, "standard deviation of direction (chosen)")
    albedo: float = _number(0.09, 0.02, 0.5, "at 850 nm; melanin absorbs little there, hair is still dark (chosen)")


class BrowSpec(Spec):
    """The brow's hairs."""

    count: Annotated[int, Field(ge=0, le=700)] = Field(default=520, description="number of hairs (Wolff: 250 to 700)")
    length_mm: float = _number(9.0, 5.0, 13.0, "longest hair (Farkas)")
    height_mm: float = _number(15.5, 10.0, 24.0, "lower border above the pupil (Farkas)")
    thickness_mm: float = _number(8.5, 3.0, 12.0, "height of the band at its head (chosen)")
    arch_mm: float = _number(3.5, 0.0, 8.0, "rise from head to arch (chosen)")
    diameter_mm: float = _number(0.1, 0.05, 0.14, "at the root (chosen)")
    albedo: float = _number(0.13, 0.02, 0.6, "at 850 nm (chosen)")


class FaceSpec(Spec):
    """The face around the lids; differences from the average face."""

    brow_ridge_mm: float = _number(0.0, -4.0, 5.0, "ridge further forward (chosen after Farkas)")
    sulcus_mm: float = _number(0.0, -4.0, 3.0, "hollow between lid and brow further forward (chosen)")
    nose_mm: float = _number(0.0, -6.0, 6.0, "bridge of the nose further forward (chosen after Farkas)")
    cheek_mm: float = _number(0.0, -4.0, 4.0, "cheek further forward (chosen after Farkas)")


class SkinSpec(Spec):
    """How the surfaces look at 850 nm."""

    albedo: float = _number(0.55, 0.30, 0.75, "of the skin (Cooksey, Allen, Tsai 2017: about 0.4 to 0.65 at 850 nm)")
    mottling: Share = Field(default=0.5, description="unevenness of the albedo (chosen)")
    relief_mm: float = _number(0.032, 0.0, 0.12, "depth of the skin's fine furrows (some tens of micrometres; chosen)")
    wrinkles: Share = Field(default=0.35, description="lines on and below the lids (chosen)")
    sheen: Share = Field(default=0.5, description="strength of the oily skin's rough mirror (chosen)")
    wet_albedo: float = _number(0.40, 0.2, 0.7, "of the margins and the caruncle (chosen)")


class TearSpec(Spec):
    """The tear meniscus along both margins."""

    height_mm: float = _number(0.25, 0.0, 0.6, "on the globe (Mainstone)")


class RegionSpec(Spec):
    """The eye region of one subject. Without this key a scene shows the bare eye before a matte surround."""

    fissure: FissureSpec = FissureSpec()
    lids: LidSpec = LidSpec()
    lashes: LashSpec = LashSpec()
    brow: BrowSpec = BrowSpec()
    face: FaceSpec = FaceSpec()
    skin: SkinSpec = SkinSpec()
    tears: TearSpec = TearSpec()
    blink: Share = Field(default=0.0, description="closure of the lids, 0 open to 1 shut")
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(default=1, description="which hairs, which skin")

    @classmethod
    def drawn(cls, seed: int, *, spread: float = 1.0, blink: float = 0.0) -> Self:
        """A seeded subject: every bounded number uniform over `spread` of its range about the default.

        Each number is a pure function of (seed, key).
        """
        return cls.from_mapping({**_draw(cls, (seed,), spread), "seed": seed, "blink": blink})


def _draw(kind: type[Spec], key: tuple[int, ...], spread: float) -> dict[str, object]:
    out: dict[str, object] = {}
    for i, (name, field) in enumerate(sorted(kind.model_fields.items())):
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
