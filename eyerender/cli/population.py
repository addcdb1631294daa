"""The command population."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..base.errors import InputError
from .app import app
from .options import Backend, OutputFolder, Overwrite, Result, Threads
from .output import emit, progress

if TYPE_CHECKING:
    from ..scene.people import Population


def read_population(given: str, argument: str) -> Population:
    """Read a population: the name of a preset, or a YAML file with the keys of `population`.

    Args:
        given: what the user gave.
        argument: the argument that messages name.

    Raises:
        InputError: there is no such preset, or the file does not fit.
    """
    from ..base.spec import read_yaml
    from ..scene.people import Population

    if given.endswith((".yaml", ".yml")):
        data = read_yaml(given)
        return Population.from_mapping(data.get("population", data), source=given)
    try:
        return Population(given)
    except InputError as error:
        raise InputError(error.reason, source=argument) from None


@app.command(name="population")
def population(
    preset: str = "adults",
    /,
    *,
    output: OutputFolder,
    count: int = 10_000,
    check: int = 200,
    faces: int = 16,
    spp: int = 16,
    seed: int = 0,
    backend: Backend = "auto",
    threads: Threads = None,
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Draw people, and compare them with the sources of their joint distribution.

    The output folder receives report.html (histograms and correlations next to the table's values, with standard
    errors, faces, sources), people.csv, faces.png and summary.json.

    Args:
        preset: adults, emmetropic_adults, myopes, children or elderly, or a YAML file with the keys of `population`.
        count: Number of people in the statistics and in people.csv.
        check: Number of people whose eyes are built, to count the impossible ones.
        faces: Number of people whose eyes are rendered (0: none).
        spp: Samples per pixel of the faces.
        seed: The seed of the draw.
    """
    from ..apps.survey import REPORT, SurveySize, run_survey

    size = SurveySize(seed=seed, count=count, check=check, faces=faces, spp=spp)
    people = read_population(preset, "PRESET")
    with progress("drawing") as steps:
        found = run_survey(people, output, size, backend=backend, threads=threads, overwrite=overwrite, progress=steps)
    emit(found, f"{_text(found)}\n\nreport: {output / REPORT}", json)
    return 0


def _text(found: dict[str, Any]) -> str:
    lines = [f"{'':<26} {'drawn':>22} {'table':>18}"]
    for name in ("age_years", "refraction_d", "axial_length_mm", "corneal_radius_mm", "chamber_depth_mm",
                 "lens_thickness_mm", "iris_diameter_mm", "ipd_mm"):  # fmt: skip
        q = found["quantities"].get(name)
        if q is not None:
            told = "" if q["expected_mean"] is None else f"{q['expected_mean']:.3f} +- {q['expected_sd']:.3f}"
            lines.append(f"{name:<26} {q['mean']:>12.3f} +- {q['sd']:.3f} {told:>18}")
    lines.append(f"refused by physics: {found['refused']} of {found['checked']} people")
    return "\n".join(lines)
