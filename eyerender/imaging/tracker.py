"""A tracker that samples a sequence at a steady rate: options that the command line and Python share."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..base.errors import InputError
from ..scene.observation import WHITE


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracker:
    """A tracker that samples a sequence at a steady rate, whatever the rates of the cameras are.

    >>> er.Tracker(rate=500, noise_deg=0.02).rate
    500

    Attributes:
        rate: Sample the sequence so many times a second, instead of at the cameras' frames.
        noise_px: With --rate: standard deviation of the features along each axis, px.
        noise_deg: With --rate and --format asc or bids: standard deviation of the gaze along each axis, degrees.
        noise_type: With --rate: the noise's RMS-S2S over its SD; 1.414 is white noise, filtered noise has less.
        loss: With --rate: share of the samples that are lost.
        seed: With --rate: selects noise and losses.
    """

    rate: float = 0.0
    noise_px: float = 0.0
    noise_deg: float = 0.0
    noise_type: float = WHITE
    loss: float = 0.0
    seed: int = 0

    def refuse_unused(self, form: str) -> None:
        """Raise an error for an option that a trace of this form (csv, asc, bids) does not use.

        Raises:
            InputError: naming the option.
        """
        plain = Tracker()
        given = [f.name for f in fields(self) if f.name != "rate" and getattr(self, f.name) != getattr(plain, f.name)]
        if not self.rate and given:
            raise InputError("needs --rate", source=f"--{given[0].replace('_', '-')}")
        if form == "csv" and "noise_deg" in given:
            raise InputError("is noise of the gaze, which --format asc and bids hold", source="--noise-deg")
        if form == "asc" and "noise_px" in given:
            raise InputError("is noise of features, which --format csv holds; give --noise-deg", source="--noise-px")

    def __post_init__(self) -> None:
        limits = {"rate": (0, 1e5), "noise_px": (0, 1e3), "noise_deg": (0, 45), "noise_type": (1e-3, 1.999)}
        for name, (low, high) in {**limits, "loss": (0, 1), "seed": (0, 2**63 - 1)}.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"must be {low:g} to {high:g}, not {value:g}", source=f"--{name.replace('_', '-')}")
