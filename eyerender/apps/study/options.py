"""Options of a study, shared by Python and the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ...backends.choose import BackendChoice
from ...base.errors import InputError

MOST_PEOPLE = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions:
    """Options of a study.

    Attributes:
        population: Preset from which people are drawn (default: adults).
        people: Number of people, in place of eye models unless --eyes names some (default: none; rigs, appearance:
            100; conditions: 4, beside the models).
        image_people: Number of these people whose images are rendered (default: all).
        protocol: guestrin2006 and blignaut2014: as the authors' software computes (published), as the paper describes
            (corrected), or both.
        observer: Features from ray optics (analytic), from rendered images (image), or both for comparison (default:
            analytic; both for observers, which supports nothing else).
        seeds: appearance: number of networks that are trained on the pictures of each eye.
        workers: Number of worker processes (default: one per processor).
        spp: Samples per pixel of the images (default: the scene's value).
        noise: Images with sensor noise (on), without it (off), or both.
        noise_seeds: With both: number of exposures of each image with other noise, for shift and scatter in the error
            budget; 0 omits them.
        auto_exposure: Choose one exposure time for the images of each eye model, so that 98 % of the pixels do not
            exceed this share of full scale.
        backend: The render backend.
        threads: Total number of CPU threads (default: all).
        overwrite: Replace the contents of the folder.
    """

    population: str | None = None
    people: int | None = None
    image_people: int | None = None
    protocol: Literal["corrected", "published", "both"] = "both"
    observer: Literal["analytic", "image", "both"] | None = None
    seeds: int = 5
    workers: int | None = None
    spp: int | None = None
    noise: Literal["on", "off", "both"] = "both"
    noise_seeds: int = 10
    auto_exposure: float | None = None
    backend: BackendChoice = "auto"
    threads: int | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.people is not None and not 1 <= self.people <= MOST_PEOPLE:
            raise InputError(f"must be 1 to {MOST_PEOPLE}, not {self.people}", path="people")
        for name in ("image_people", "seeds", "workers", "spp", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"must be >= 1, not {value}", path=name)
        if self.noise_seeds < 0 or self.noise_seeds == 1:
            raise InputError(f"must be 0, or at least 2, not {self.noise_seeds}", path="noise_seeds")
