"""Encoding of the sensor's counts in an export: as stored, or with a tone curve and one gain for the whole export.

`stored` gives each pixel the code that its camera stored, with whatever gamma that camera has:

    stored:  code = count                            (more than 8 bits in 8: round(255 count / full scale))

Else, with F = 2^bits - 1 and s = count / (2^source_bit_depth - 1), to the power of the camera's gamma where that is not
1, which is the linear share of the source's full scale:

    linear:  code = round(F min(1, gain s))              s = code / F / gain
    gamma:   code = round(F min(1, gain s)^(1 / 2.2))    s = (code / F)^2.2 / gain

The inverse is exact to half a code, except for the code F, at which the image is clipped.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ...base.errors import InputError

GAMMA = 2.2
# A measured gain brings this share of all pixels to at most this part of full scale. The rest is headroom for brighter
# subjects, and keeps skin darker than glints. The gain is limited because the black level is 1/256 of full scale by
# default, and images without light must stay dark.
SHARE, LEVEL = 0.995, 0.8
LARGEST_GAIN = 32.0
SAMPLED = 256  # images used to measure a gain

Curve = Literal["stored", "linear", "gamma"]


@dataclass(frozen=True, slots=True)
class Encoding:
    """Bits (8 or 16), tone curve and gain of the exported images; `gain_from` names the source of the gain.

    Stored codes keep the bits of their source, unless these are too many.
    """

    bits: int
    curve: Curve
    gain: float
    gain_from: str

    def apply(self, image: NDArray[Any], bit_depth: int, gamma: float = 1.0) -> NDArray[Any]:
        """Encode an image's counts (h, w), unsigned integers of `bit_depth`, as codes (h, w) uint8 or uint16.

        The counts themselves encode the linear share s of full scale as s^(1 / gamma).
        """
        if self.keeps(bit_depth, gamma):
            return image
        table = _table(self.bits, self.curve, self.gain, 2**bit_depth - 1, gamma)
        return np.asarray(table[np.minimum(image.astype(np.intp), len(table) - 1)])

    def keeps(self, bit_depth: int, gamma: float = 1.0) -> bool:
        """Return whether the encoding leaves the counts unchanged."""
        if self.curve == "stored":
            return bit_depth <= self.bits
        return self.curve == "linear" and self.gain == 1 and self.bits == bit_depth and gamma == 1

    def of_image(self, bit_depth: int, gamma: float) -> dict[str, Any]:
        """Describe the codes of an exported image for its line of metadata; bits and gamma are those of its source."""
        return {
            "bit_depth": min(bit_depth, self.bits) if self.curve == "stored" else self.bits,
            "encoding": self.curve,
            "gamma": {"stored": gamma, "linear": 1.0, "gamma": GAMMA}[self.curve],
            "gain": self.gain,
        }

    def to_mapping(self, gammas: Iterable[float] = (1.0,)) -> dict[str, Any]:
        """Convert to the mapping in export.json; `gammas` are those of the dataset's images.

        The key `gamma` is null where stored images have several.
        """
        full = 2**self.bits - 1
        found = {self.of_image(self.bits, own)["gamma"] for own in gammas}
        formula, inverse = {
            "stored": (
                "code = round(count * (2 ** bit_depth - 1) / (2 ** source_bit_depth - 1))",
                "s = (code / (2 ** bit_depth - 1)) ** gamma",
            ),
            "linear": (f"code = round({full} * min(1, gain * s))", f"s = code / {full} / gain"),
            "gamma": (
                f"code = round({full} * min(1, gain * s) ** (1 / {GAMMA}))",
                f"s = (code / {full}) ** {GAMMA} / gain",
            ),
        }[self.curve]
        return {
            "bits": self.bits,
            "encoding": self.curve,
            "gamma": found.pop() if len(found) == 1 else None,
            "gain": self.gain,
            "gain_from": self.gain_from,
            "formula": formula,
            "inverse": inverse,
            "s": "count / (2 ** source_bit_depth - 1), to the power of the source's gamma where that is not 1: the "
            "linear share of the source's full scale",
        }

    def __str__(self) -> str:
        return f"{self.bits} bits, {self.curve}, gain {self.gain:g}"


STORED = Encoding(16, "stored", 1.0, "none")


def measured_gain(images: Iterable[tuple[NDArray[Any], int, float]]) -> float:
    """Compute the gain that brings the quantile `SHARE` of all pixels to `LEVEL`: 1 to `LARGEST_GAIN`, to four digits.

    Images come as counts (h, w), their bit depths and their gammas.
    """
    counts = np.zeros(65536, dtype=np.int64)
    for image, bit_depth, gamma in images:
        full = 2**bit_depth - 1
        linear = (np.minimum(image.astype(np.intp), full) / full) ** gamma
        share = np.round(linear * 65535).astype(np.intp)
        counts += np.bincount(share.ravel(), minlength=65536)
    below = np.cumsum(counts)
    level = int(np.searchsorted(below, SHARE * below[-1]))
    return float(np.clip(float(f"{LEVEL * 65535 / max(level, 1):.4g}"), 1.0, LARGEST_GAIN))


def check(bits: int, curve: str | None, gain: float | None) -> None:
    """Check the options of an encoding; InputError if they are not valid."""
    if bits not in (8, 16):
        raise InputError(f"must be 8 or 16, not {bits!r}", source="--bits")
    if curve not in (None, *get_args(Curve)):
        raise InputError(f"must be one of {', '.join(get_args(Curve))}, not {curve!r}", source="--encoding")
    if curve == "stored" and gain is not None:
        raise InputError("codes as stored have none; add '--encoding gamma' or 'linear'", source="--gain")
    if gain is not None and not 1e-3 <= gain <= 1e5:
        raise InputError(f"must be 0.001 to 100000, not {gain!r}", source="--gain")


@lru_cache(maxsize=4)
def _table(bits: int, curve: Curve, gain: float, full: int, source_gamma: float) -> NDArray[Any]:
    """Return the code of each possible count."""
    if curve == "stored":
        source_gamma = 1.0
    value = np.minimum(1.0, gain * (np.arange(full + 1) / full) ** source_gamma)
    if curve == "gamma":
        value = value ** (1 / GAMMA)
    return np.asarray(np.round((2**bits - 1) * value), dtype=np.uint8 if bits == 8 else np.uint16)
