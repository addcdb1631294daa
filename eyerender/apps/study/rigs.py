"""The study of six known rigs over a population: for whom each fails where, and the effect of each LED.

People differ, sit differently in front of the rig, and look in 81 directions. A person is lost in a direction if less
than 60 % of the outline or fewer than two glints are visible (one, if the rig has one LED). The effect of a number of
LEDs is computed for the best choice of that number (greedy exchange, `design/choice.py`), in the nine directions of a
calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats, finite_or_none
from ...base.progress import Progress
from ...base.storage.files import csv_text, write_json, write_text
from ...design.choice import SiteInformation, choose_lights, noise_of_some
from ...design.crowd import coverage_of, covered, figures_of_people, gaze_of
from ...design.noise import sensor_noise
from ...design.people import GRID, LOST, Figures, RigPopulation, sites_seen
from ...design.safety import eye_exposure
from ...design.unknowns import Unknowns
from ...folders.outfolder import staged
from ...scene import Scene
from ...scene.people import Population
from ...scene.spec import SceneSpec
from .layouts import KnownLayout, known_layouts
from .options import StudyOptions
from .rigs_page import write_rigs_page

SCHEMA = "eyerender/study/1"
PEOPLE = 100
_BUYERS = 24
_LOST_DEG = 60.0
TRAITS = {
    "opening of the lids": ("fissure.upper_mm", "fissure.lower_mm"),
    "width of the fissure": ("fissure.width_mm",),
    "entrance pupil": ("entrance_pupil_mm",),
    "corneal radius": ("corneal_radius_mm",),
    "distance of the pupils": ("ipd_mm",),
    "age": ("age_years",),
}
"""Traits that divide people into thirds, and the numbers of a person that are summed for each."""
REGIONS = ("up", "down", "to the left", "to the right", "ahead")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RigResult:
    """Results for one layout: figures of people, their losses (p, 81), and rows with the effect of LEDs."""

    layout: KnownLayout
    figures: Figures
    lost: Bools
    bought: Sequence[Mapping[str, Any]]
    cornea_share: float

    def to_mapping(self, traits: Mapping[str, Floats]) -> dict[str, Any]:
        """Convert to JSON values; `traits` are those of the figures' people."""
        found = self.figures
        return {
            "layout": self.layout.name,
            "text": self.layout.text,
            "people": len(found.subject),
            "refused": len(found.refused),
            "lost": float(self.lost.mean()),
            "lost_by_region": {name: float(self.lost[:, cells].mean()) for name, cells in regions().items()},
            "lost_by_third": {name: thirds(self.lost, values) for name, values in traits.items()},
            "coverage": coverage_of(found),
            "glints_missing": dict(zip(LOST, found.lost.mean(axis=(0, 1)).tolist(), strict=True)),
            "frame_to_frame_deg": gaze_of(found.noise_deg, ~self.lost),
            "cornea_share": self.cornea_share,
            "leds": list(self.bought),
        }  # fmt: skip


def run_rigs(
    output: str | Path, options: StudyOptions, *, people: int | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the study and write summary.json, leds.csv, who.csv and report.html.

    Args:
        output: the folder.
        options: workers and overwriting; no other option applies.
        people: number of people.
        progress: called with (people done, people in all, what).

    Raises:
        InputError: the folder is not empty.
    """
    count = PEOPLE if people is None else people
    with staged(output, overwrite=options.overwrite) as folder:
        results = [_result(layout, count, options.workers, progress) for layout in known_layouts()]
        traits = [traits_of(result.figures) for result in results]
        rows = [result.to_mapping(own) for result, own in zip(results, traits, strict=True)]
        data = {"schema": SCHEMA, "study": "rigs", "population": "adults", "note": "noise only", "rows": rows}
        write_json(folder / "summary.json", data)
        leds = [{"layout": row["layout"], **one} for row in rows for one in row["leds"]]
        write_text(folder / "leds.csv", csv_text(list(leds[0]), (list(one.values()) for one in leds)))
        who = (
            (row["layout"], name, third, lost)
            for row in rows
            for name, losses in row["lost_by_third"].items()
            for third, lost in zip(("low", "middle", "high"), losses, strict=True)
        )
        write_text(folder / "who.csv", csv_text(("layout", "trait", "third", "lost"), who))
        write_rigs_page(folder / "report.html", data, {r.layout.name: r.lost.mean(axis=0) for r in results})
    return data


def _result(layout: KnownLayout, people: int, workers: int | None, progress: Progress | None) -> RigResult:
    scene = Scene.of(SceneSpec.from_mapping(layout.scene))
    survey = RigPopulation(
        scene=layout.scene,
        population=Population("adults").to_mapping(),
        slippage_mm=layout.slippage_mm,
        relief_mm=layout.relief_mm,
        unknowns=Unknowns.population(slippage_mm=max(3.0, layout.slippage_mm)).to_mapping(),
    )
    told = None if progress is None else lambda done, total, _what: progress(done, total, f"people, {layout.name}")
    found = figures_of_people(survey, sensor_noise(scene), people, workers=workers, progress=told)
    needed = min(2, len(scene.rig.lights))
    place = scene.eye_position_mm("right")
    return RigResult(
        layout=layout,
        figures=found,
        lost=~covered(found, needed),
        bought=bought(survey, scene, min(_BUYERS, people)),
        cornea_share=eye_exposure(scene.rig, place, wavelength_nm=scene.spec.wavelength_nm).cornea_share,
    )


def bought(survey: RigPopulation, scene: Scene, people: int) -> list[dict[str, Any]]:
    """Compute the noise of the optic axis for a known person, and the glints, with the best 1, 2, ... LEDs."""
    known_person = replace(survey, unknowns=Unknowns(slippage_mm=max(3.0, survey.slippage_mm)).to_mapping())
    counts = range(1, len(scene.rig.lights) + 1)
    sites = sites_seen(known_person, [noise_of_some(scene, count) for count in counts], people)
    rows = []
    for count, known in zip(counts, sites, strict=True):
        chosen = choose_lights(known, count)
        noise = axis_deg(known, chosen)
        glints = np.any(known.sites[list(chosen)] != 0.0, axis=(2, 3)).sum(axis=0)
        rows.append(
            {
                "leds": count,
                "chosen": " ".join(map(str, chosen)),
                "axis_deg_median": finite_or_none(np.median(noise)),
                "axis_deg_p95": finite_or_none(np.quantile(noise, 0.95, method="higher")),
                "frames_with_1_glint": float((glints >= 1).mean()),
                "frames_with_2_glints": float((glints >= 2).mean()),
            }
        )
    return rows


def axis_deg(known: SiteInformation, chosen: Sequence[int]) -> Floats:
    """Compute the standard deviation (i,) deg of the optic axis: azimuth and elevation are the first two unknowns.

    It is inf if the axis is undetermined.
    """
    whole = known.base + known.sites[list(chosen)].sum(axis=0)
    scale = 1.0 / np.sqrt(np.einsum("iaa->ia", whole))
    inverse = np.linalg.inv(whole * scale[:, :, None] * scale[:, None, :]) * scale[:, :, None] * scale[:, None, :]
    found = np.degrees(np.sqrt(inverse[:, 0, 0] + inverse[:, 1, 1]))
    return np.asarray(np.where(found < _LOST_DEG, found, np.inf))


def regions() -> dict[str, Bools]:
    """Divide the 81 directions (rows from top to bottom, the subject's right first) into five parts."""
    row, column = np.divmod(np.arange(GRID * GRID), GRID)
    up, side = GRID // 2 - row, column - GRID // 2
    steep = np.abs(up) >= np.abs(side)
    ahead = np.maximum(np.abs(up), np.abs(side)) <= 1
    parts = (steep & (up > 0), steep & (up < 0), ~steep & (side > 0), ~steep & (side < 0))
    return dict(zip(REGIONS, [*(part & ~ahead for part in parts), ahead], strict=True))


def traits_of(found: Figures, seed: int = 0) -> dict[str, Floats]:
    """Return traits (p,) of the people of figures."""
    last = int(found.subject.max()) + 1
    numbers = Population("adults").numbers(last, seed)
    out = {}
    for name, keys in TRAITS.items():
        columns = [numbers[key] if numbers[key].ndim == 1 else numbers[key][:, 0] for key in keys]
        out[name] = np.sum(columns, axis=0)[found.subject]
    return out


def thirds(lost: Bools, values: Floats) -> list[float]:
    """Compute the share of lost directions in the thirds of people with low, middle and high values."""
    order = np.argsort(values, kind="stable")
    return [float(lost[part].mean()) if len(part) else float("nan") for part in np.array_split(order, 3)]
