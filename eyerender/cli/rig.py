"""The command rig: how well a rig determines a population's gaze."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..apps.rigs.options import RigSize
from .app import app
from .options import Backend, OutputFolder, Overwrite, Result
from .output import emit, progress
from .population import read_population


@app.command(name="rig")
def rig(
    scene: str,
    /,
    *,
    output: OutputFolder,
    population: str = "adults",
    size: Annotated[RigSize, Parameter(name="*")] = RigSize(),
    unknowns: Path | None = None,
    backend: Backend = "auto",
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Report how well a rig determines gaze, for whom it fails, and whether its LEDs are safe.

    The folder receives report.html, summary.json, people.csv (one row per person) and gaze.csv (one row per direction):
    the bound by noise alone, visible outline and glints, errors of estimators on exact features, and eye safety.

    Args:
        scene: A scene file or the name of a shipped one: its rig, sensor, first eye and first head position.
        population: adults, emmetropic_adults, myopes, children or elderly, or a YAML file with the keys of
            `population`.
        unknowns: A YAML file with the keys of `er.Unknowns` (default: priors of a population, 3 mm of slippage).
    """
    from ..apps.rigs.report import REPORT, run_rig
    from ..design.unknowns import Unknowns
    from ..scene import load_scene

    given = None if unknowns is None else Unknowns.load(unknowns)
    everyone = read_population(population, "--population")
    with progress("rig") as steps:
        found = run_rig(
            load_scene(scene), everyone, output, size, unknowns=given, backend=backend, overwrite=overwrite,
            progress=steps,
        )  # fmt: skip
    emit(found, f"{_text(found)}\n\nreport: {output / REPORT}", json)
    return 0


def _text(found: dict[str, Any]) -> str:
    def degrees(value: float | None) -> str:
        return "not seen" if value is None else f"{value:.4f} deg"

    covered = found["coverage"]["outline_and_2_glints"]
    bound, noise, safety = found["bound_deg"], found["frame_to_frame_deg"], found["safety"]
    lines = [
        f"{found['people']} people in {found['directions']} directions",
        f"frame to frame, noise only:      U50E95 {degrees(noise['U50E95'])}, U95E95 {degrees(noise['U95E95'])}",
        f"after a calibration, noise only: U50E95 {degrees(bound['U50E95'])}, U95E95 {degrees(bound['U95E95'])}",
        f"2 glints and 60 % of the outline: {100 * covered:.1f} % of people x directions",
    ]
    for name, one in found["estimators"].items():
        if one["U50E95"] is not None:
            lines.append(f"{name} on exact features: U50E95 {degrees(one['U50E95'])}")
    for name, one in found["estimators_on_images"].items():
        if one["U50E95"] is not None:
            lines.append(f"{name} on rendered images: U50E95 {degrees(one['U50E95'])}")
    if "cornea_share" in safety:
        lines.append(f"cornea: {100 * safety['cornea_share']:.2f} % of the limit ({safety['note']})")
    return "\n".join(lines)
