"""The study of six known rigs over a population: for whom each fails where, and the effect of each LED.

People differ, sit differently in front of the rig, and look in 81 directions. A person is lost in a direction if less
than 60 % of the outline or fewer than two glints are visible (one, if the rig has one LED). The effect of a number of
LEDs is computed for the best choice of that number (greedy exchange, `design/choice.py`), in the nine directions of a
calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...base.arrays import Bools, Floats, finite_or_none
from ...base.progress import Progress
from ...design.choice import SiteInformation, choose_lights, noise_of_some
from ...design.crowd import coverage_of, covered, figures_of_people, gaze_of
from ...design.noise import sensor_noise
from ...design.people import GRID, LOST, Figures, RigPopulation, sites_seen
from ...design.safety import eye_exposure
from ...design.unknowns import Unknowns
from ...report.page import Page
from ...scene import Scene
from ...scene.people import Population
from ...scene.spec import SceneSpec
from . import rigs_page
from .layouts import KnownLayout, known_layouts
from .study import Study, StudyPlan, StudyReport

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
    preset: str
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


class RigsStudy(Study):
    """Six known rigs before a population."""

    title = "Six rigs and a population"
    about = rigs_page.LEAD
    eyes = ()
    people = 100
    observers = ("analytic",)

    def parts(self, plan: StudyPlan, progress: Progress | None = None) -> list[RigResult]:
        """Compute the results of each layout; the processes share the people."""
        preset, workers = plan.people[0]["preset"], plan.options.workers
        return [_result(layout, preset, len(plan.people), workers, progress) for layout in known_layouts()]

    def report(self, parts: Sequence[RigResult], protocols: Sequence[str]) -> StudyReport:
        """Compose summary, tables and page."""
        preset = parts[0].preset
        rows = [part.to_mapping(traits_of(part.figures, preset)) for part in parts]
        leds = [{"layout": row["layout"], **one} for row in rows for one in row["leds"]]
        who = [
            (row["layout"], name, third, lost)
            for row in rows
            for name, losses in row["lost_by_third"].items()
            for third, lost in zip(("low", "middle", "high"), losses, strict=True)
        ]
        maps = {part.layout.name: part.lost.mean(axis=0) for part in parts}
        return StudyReport(
            rows=rows,
            more={"population": preset, "note": "noise only"},
            tables={
                "leds.csv": (list(leds[0]), [list(one.values()) for one in leds]),
                "who.csv": (("layout", "trait", "third", "lost"), who),
            },
            page=Page(self.title, self.about, rigs_page.cards(rows), rigs_page.sections(rows, maps)),
        )

    def text(self, summary: Mapping[str, Any]) -> list[str]:
        """Format one line per layout."""
        lines = [f"{'layout':<18} {'lost':>7} {'2 glints':>9} {'U95E95 deg':>11}"]
        for row in summary["rows"]:
            noise = row["frame_to_frame_deg"]["U95E95"]
            shown = "not seen" if noise is None else f"{noise:.4f}"
            covered = row["coverage"]["outline_and_2_glints"]
            lines.append(f"{row['layout']:<18} {100 * row['lost']:>5.1f} % {100 * covered:>7.1f} % {shown:>11}")
        return lines


def _result(layout: KnownLayout, preset: str, people: int, workers: int | None, progress: Progress | None) -> RigResult:
    scene = Scene.of(SceneSpec.from_mapping(layout.scene))
    survey = RigPopulation(
        scene=layout.scene,
        population=Population(preset).to_mapping(),
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
        preset=preset,
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


def traits_of(found: Figures, preset: str = "adults", seed: int = 0) -> dict[str, Floats]:
    """Return traits (p,) of the people of figures."""
    last = int(found.subject.max()) + 1
    numbers = Population(preset).numbers(last, seed)
    out = {}
    for name, keys in TRAITS.items():
        columns = [numbers[key] if numbers[key].ndim == 1 else numbers[key][:, 0] for key in keys]
        out[name] = np.sum(columns, axis=0)[found.subject]
    return out


def thirds(lost: Bools, values: Floats) -> list[float | None]:
    """Compute the share of lost directions in the thirds of people with low, middle and high values; None of nobody."""
    order = np.argsort(values, kind="stable")
    return [float(lost[part].mean()) if len(part) else None for part in np.array_split(order, 3)]
