"""The survey of a population: statistics against the sources, faces, a table of people, and an HTML report."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..backends.choose import BackendChoice
from ..base.arrays import finite_or_none
from ..base.errors import InputError
from ..base.progress import Progress, notify
from ..base.storage.files import write_json
from ..dataset.sheet import contact_sheet
from ..folders.imagefile import preview as eight_bit
from ..folders.outfolder import staged
from ..imaging.capture import make_renderer, render_windows
from ..population.people import PopulationSpec
from ..population.statistics import Moments, PopulationStatistics, Refusals, pieces, refusals, survey
from ..population.table import PopulationTable, Source, default_table
from ..report.overlay import picture
from ..report.page import Card, Content, Figure, Page, Section, Table, write_page
from ..report.style import ANALYTIC, IMAGE, figure, svg
from ..scene import Scene
from ..scene.people import Population
from ..scene.spec import SceneSpec
from ..scene.subject import Subject

SCHEMA = "eyerender/population/1"
REPORT, CSV, FACES, SUMMARY = "report.html", "people.csv", "faces.png", "summary.json"
MOST_FACES = 64
_SHOWN = (
    "age_years", "refraction_d", "refraction_j0_d", "axial_length_mm", "corneal_radius_mm", "corneal_asphericity",
    "posterior_radius_mm", "corneal_thickness_mm", "chamber_depth_mm", "lens_thickness_mm", "lens_front_radius_mm",
    "lens_back_radius_mm", "kappa_horizontal_deg", "kappa_vertical_deg", "iris_diameter_mm", "ipd_mm",
    "entrance_pupil_mm", "rotation_azimuth_mm", "pupil_nasal_mm", "fissure.width_mm",
)  # fmt: skip
_FACE_RIG = {
    "cameras": [{
        "position_mm": [500, 0, -60], "look_at_mm": [0, 0, 0], "focal_length_px": 4400, "resolution_px": [1600, 640],
    }],
    "lights": [
        {"position_mm": [490, 110, -80], "radius_mm": 4, "aim_mm": [0, 0, 0], "intensity_mw_sr": 105},
        {"position_mm": [490, -110, -80], "radius_mm": 4, "aim_mm": [0, 0, 0], "intensity_mw_sr": 105},
    ],
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Result:
    """Results of a survey."""

    population: PopulationSpec
    seed: int
    statistics: PopulationStatistics
    refused: Refusals

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the mapping of summary.json."""
        s, r = self.statistics, self.refused
        return {
            "schema": SCHEMA,
            "population": self.population.to_mapping(),
            "seed": self.seed,
            "people": s.n,
            "quantities": {
                m.name: {
                    "mean": m.mean, "mean_error": m.mean_error, "sd": m.sd, "sd_error": m.sd_error,
                    "expected_mean": finite_or_none(m.expected_mean), "expected_sd": finite_or_none(m.expected_sd),
                }
                for m in s.moments
            },
            "checked": r.n,
            "refused": r.people,
            "reasons": dict(r.reasons),
            "shifts_in_sd": dict(r.shifts),
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveySize:
    """Size of a survey."""

    seed: int = 0  # seed of the draw
    count: int = 10_000  # number of people in the statistics and in the table
    check: int = 200  # number of people whose eyes are built, to count the impossible ones
    faces: int = 16  # number of people whose eyes are rendered; 0 for none
    spp: int = 16  # samples per pixel of the faces

    def __post_init__(self) -> None:
        """Raise an error for numbers out of range, naming the command's option."""
        for name, low, high in (
            ("count", 2, 10**7),
            ("check", 1, 10**5),
            ("faces", 0, MOST_FACES),
            ("spp", 1, 65536),
            ("seed", 0, 2**63 - 1),
        ):
            if not low <= (value := getattr(self, name)) <= high:
                raise InputError(f"must be {low} to {high}, not {value}", source=f"--{name}")


def run_survey(
    population: PopulationSpec,  # the people
    output: str | Path,  # the folder
    size: SurveySize = SurveySize(),  # how many people, and the seed
    *,
    backend: BackendChoice = "auto",  # the render backend
    threads: int | None = None,  # total number of processor threads; by default all
    overwrite: bool = False,  # replace the contents of the folder
    progress: Progress | None = None,  # called with (steps done, steps in all, what)
) -> dict[str, Any]:
    """Draw people and write report.html, people.csv, faces.png and summary.json into a folder.

    Raises:
        InputError: the folder is not empty.
    """
    seed, count = size.seed, size.count
    with staged(output, overwrite=overwrite) as folder:
        _write_csv(folder / CSV, population, count, seed)
        found = Result(
            population, seed, survey(population, count, seed), refusals(population, size.check, seed, progress=progress)
        )
        sheet = None
        if size.faces:
            tiles = list(_faces(population, size, backend=backend, threads=threads, progress=progress))
            sheet = contact_sheet(tiles)
            sheet.save(folder / FACES)
        data = found.to_mapping()
        write_json(folder / SUMMARY, data)
        write_page(folder / REPORT, page_of(found, sheet))
    return data


def _write_csv(path: Path, population: PopulationSpec, count: int, seed: int) -> None:
    """Write one row of numbers per person; columns of an eye end with .right and .left."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer, number = csv.writer(file), 0
        for piece in pieces(population, count, seed):
            columns: dict[str, Any] = {}
            for name, column in piece.items():
                if column.ndim == 1:
                    columns[name] = column
                else:
                    columns |= {f"{name}.{side}": column[:, k] for k, side in enumerate(("right", "left"))}
            if number == 0:
                writer.writerow(["subject", *columns])
            table = np.column_stack(list(columns.values()))
            for row in table:
                writer.writerow([number, *(f"{value:.6g}" for value in row)])
                number += 1


def face_scene(subject: Subject, spp: int = 16) -> Scene:
    """Build the scene of a person's two eyes, half a metre from a camera and looking straight ahead."""
    spec = SceneSpec.from_mapping(
        {
            "name": "face",
            "subject": subject,
            "rig": _FACE_RIG,
            "targets": {"world_mm": [[3000.0, 0.0, 0.0]]},
            "image": {"window_px": [300, 260], "spp": spp},
        }
    )
    return Scene.of(spec)


def _faces(
    population: PopulationSpec,
    size: SurveySize,
    *,
    backend: BackendChoice,
    threads: int | None,
    progress: Progress | None,
) -> Iterator[tuple[Any, str]]:
    renderer = make_renderer(backend, threads)
    subject, done = 0, 0
    while done < size.faces:
        person = population.person(subject, size.seed)
        subject += 1
        try:
            scene = face_scene(Subject.of(person), size.spp)
        except InputError:
            continue  # the eye of this person is physically impossible
        shots = list(render_windows(scene.frames(), renderer=renderer))
        # The right eye appears on the left of the image.
        white = np.full((shots[0].counts.shape[0], 12), 2**scene.spec.sensor.bit_depth - 1)
        both = np.concatenate([shots[0].counts, white, shots[1].counts], axis=1)
        text = (
            f"{person.subject}: {person.sex}, {person.number('age_years'):.0f} y, "
            f"{person.number('refraction_d', 'right'):+.1f} D"
        )
        yield eight_bit(both, 2.0**scene.spec.sensor.bit_depth - 1), text
        done += 1
        notify(progress, done, size.faces, "faces")


def page_of(found: Result, sheet: Image.Image | None) -> Page:
    """Compose the report's page."""
    table, s, r = default_table(), found.statistics, found.refused
    told = [m for m in s.moments if np.isfinite(m.expected_mean)]
    worst = max((max(map(abs, m.errors)) for m in told), default=0.0)
    largest = max(r.shifts, key=lambda name: abs(r.shifts[name]), default="")
    cards = [
        Card(f"{s.n}", "people drawn"),
        Card(f"{worst:.1f} standard errors", f"largest deviation of {2 * len(told)} means and spreads from the table"),
        Card(f"{r.people} of {r.n}", "people with an eye that physics refuses"),
    ]
    sections = [Section("What was drawn", _lead(found), Figure(_histograms(s), _HISTOGRAMS), _quantities(s, table))]
    if sheet is not None:
        sections.append(Section("Faces", Figure(_picture(sheet), "Right and left eye of the first people.")))
    refused: list[Content] = [
        f"Both eyes of {r.n} people were built: surfaces must not cross, the stop must lie inside the chamber, and "
        "rays must reach the fovea."
    ]
    if r.people:
        refused.append(
            f"Leaving out the {r.people} people moves the mean of {largest} by {r.shifts[largest]:+.3f} standard "
            "deviations, and all others by less."
        )
    rows = [(reason, str(number)) for reason, number in sorted(r.reasons.items(), key=lambda item: -item[1])]
    if rows:
        refused.append(Table(("reason", "eyes"), rows, wide=(0,)))
    sections.append(Section("What physics refuses", *refused))
    sections.append(Section("Sources", _MARKS, _sources(table, found.population)))
    lead = table.presets[found.population.preset].description.capitalize() + "."
    return Page(f"People: {found.population.preset}", [lead], cards, sections)


_HISTOGRAMS = (
    "Right eyes. Lines: mean (solid) and one standard deviation on either side (dashed) that the table gives. "
    "Quantities without lines follow from others."
)
_MARKS = (
    "read: the text or code of the source was read; abstract: its abstract only; memory: from memory, to be checked; "
    "chosen: without a source for the number."
)


def _lead(found: Result) -> str | None:
    where = found.population.where
    if not where:
        return None
    told = ", ".join(f"{name} {value}" for name, value in where.items())
    return f"Only people with {told}; the table's values are of all people, so they are left out."


def _histograms(s: PopulationStatistics) -> str:
    shown = [m for name in _SHOWN for m in s.moments if m.name == name]
    with figure(13.0, 2.1 * -(-len(shown) // 5), 5, -(-len(shown) // 5)) as (fig, axes):
        flat = np.atleast_1d(axes).ravel()
        for ax, m in zip(flat, shown, strict=False):
            ax.stairs(m.counts / m.n, m.edges, fill=True, color=ANALYTIC, alpha=0.75)
            if np.isfinite(m.expected_mean):
                ax.axvline(m.expected_mean, color=IMAGE, lw=1.4)
                for side in (-1, 1):
                    ax.axvline(m.expected_mean + side * m.expected_sd, color=IMAGE, lw=1.0, ls="--")
            filled = np.flatnonzero(m.counts)
            ax.set_xlim(m.edges[filled[0]], m.edges[filled[-1] + 1])
            ax.set(title=m.name, yticks=[])
            ax.title.set_fontsize(9)
            ax.tick_params(labelsize=8)
        return svg(fig)


def _quantities(s: PopulationStatistics, table: PopulationTable) -> Table:
    rows = [
        (m.name, _number(m.expected_mean), f"{_number(m.mean)} ± {m.mean_error:.1g}", _number(m.expected_sd),
         f"{_number(m.sd)} ± {m.sd_error:.1g}", _off(m), _marks(table, m.name))
        for m in s.moments
    ]  # fmt: skip
    header = ("quantity", "mean, table", "mean, drawn", "SD, table", "SD, drawn", "off by (standard errors)", "marks")
    caption = "Means and standard deviations, with standard errors; of the eyes, the right ones."
    return Table(header, rows, caption, wide=(6,))


def _off(m: Moments) -> str:
    return "-" if not np.isfinite(m.expected_mean) else " ".join(f"{e:+.1f}" for e in m.errors)


def _sources(table: PopulationTable, population: PopulationSpec) -> Table:
    rows = []
    for name, quantity in table.quantities.items():
        told: tuple[Source, ...] = quantity.sources
        if name in population.replace:
            rows.append((name, "all", "replaced", "by the user"))
            continue
        if name in table.presets[population.preset].replace:
            told = table.presets[population.preset].sources
        rows += [(name, source.what, source.mark, source.text) for source in told]
    rows += [(name, "value", constant.mark, constant.text) for name, constant in table.constants.items()]
    rows += [(" - ".join(pair.pair), "correlation", pair.mark, pair.text) for pair in table.correlations]
    header = ("quantity", "what", "mark", "source")
    return Table(header, rows, "Every number and its source", wide=(3,), folded=True)


def _marks(table: PopulationTable, name: str) -> str:
    if name not in table.quantities:
        return "follows"
    return ", ".join(dict.fromkeys(source.mark for source in table.quantities[name].sources))


def _picture(sheet: Image.Image) -> str:
    data = io.BytesIO()
    sheet.save(data, format="JPEG", quality=88)
    return picture(data.getvalue(), "jpeg", sheet.size, title="faces")


def _number(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.4g}"


__all__ = ["Population", "run_survey"]
