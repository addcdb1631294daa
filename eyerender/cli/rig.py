"""The command rig: how well a rig determines a population's gaze."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..apps.rigs.options import RigSize
from ..base.errors import InputError
from .app import app
from .options import Overwrite, Result
from .output import emit, progress
from .population import read_population


@app.command(name="rig")
def rig(
    *scenes: str,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], help="The folder to write.")] = None,
    population: str = "adults",
    size: Annotated[RigSize, Parameter(name="*")] = RigSize(),
    unknowns: Path | None = None,
    tolerances: Path | None = None,
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Report how well a rig determines gaze, for whom it fails, and whether its LEDs are safe.

    The folder receives report.html, summary.json, people.csv (one row per person) and gaze.csv (one row per direction):
    the bound by noise alone, visible outline and glints, errors of estimators on exact features, and eye safety.

    Two or more scenes are compared over the same people: differences with 95 % intervals, which is better, for whom.

    Args:
        scenes: Scene files or names of shipped ones: their rigs, sensors, first eyes and first head positions.
        population: adults, emmetropic_adults, myopes, children or elderly, or a YAML file with the keys of
            `population`.
        tolerances: A YAML file of tolerances of cameras, LEDs and mirrors, before or after the user's calibration.
        unknowns: A YAML file with the keys of `er.Unknowns` (default: priors of a population, 3 mm of slippage).
    """
    from ..apps.rigs.compare import compare_rigs, text_of
    from ..apps.rigs.report import REPORT, run_rig
    from ..design.tolerances import Tolerances
    from ..design.unknowns import Unknowns
    from ..scene import load_scene

    given = None if unknowns is None else Unknowns.load(unknowns)
    allowed = None if tolerances is None else Tolerances.load(tolerances)
    everyone = read_population(population, "--population")
    if not scenes:
        raise InputError("needs a scene, or several to compare", source="SCENES")
    loaded = [load_scene(scene) for scene in scenes]
    if len(loaded) > 1:
        for option, value in (("--images", size.images), ("--unknowns", given), ("--tolerances", allowed)):
            if value:
                raise InputError("is for one rig", source=option)
        with progress("rig") as steps:
            compared = compare_rigs(loaded, everyone, size, output=output, overwrite=overwrite, progress=steps)
        emit(compared, text_of(compared) + (f"\n\nreport: {output / REPORT}" if output is not None else ""), json)
        return 0
    if output is None:
        raise InputError("is needed for one rig", source="--output")
    with progress("rig") as steps:
        try:
            found = run_rig(
                loaded[0], everyone, output, size, unknowns=given, tolerances=allowed, overwrite=overwrite,
                progress=steps,
            )  # fmt: skip
        except InputError as error:
            raise error.placed(source=str(tolerances) if error.path.startswith("tolerances.") else "") from None
    emit(found, f"{_text(found)}\n\nreport: {output / REPORT}", json)
    return 0


def _text(found: dict[str, Any]) -> str:
    def degrees(value: float | None) -> str:
        return "not seen" if value is None else f"{value:.4f} deg"

    covered = found["coverage"]["outline_and_2_glints"]
    bound, noise, safety = found["bound_deg"], found["frame_to_frame_deg"], found["safety"]
    fixating = found["bound_with_fixation_deg"]
    lines = [
        f"{found['people']} people in {found['directions']} directions",
        f"frame to frame, noise only:      U50E95 {degrees(noise['U50E95'])}, U95E95 {degrees(noise['U95E95'])}",
        f"after a calibration, noise only: U50E95 {degrees(bound['U50E95'])}, U95E95 {degrees(bound['U95E95'])}",
        f"  with {fixating['fixation_deg']:g} deg of fixation noise:   "
        f"U50E95 {degrees(fixating['U50E95'])}, U95E95 {degrees(fixating['U95E95'])}",
        f"2 glints and 60 % of the outline: {100 * covered:.1f} % of people x directions",
    ]
    for one in found["tolerances"] or ():
        lines.append(
            f"{one['part']} {one['number']}, {one['quantity']} {one['sd']:g}, {one['when']} calibration: "
            f"{degrees(one['gaze_deg'])}"
        )
    if found["units"] is not None:
        units = found["units"]
        lines.append(f"all tolerances: U50E95 {degrees(units['U50E95'])}, U95E95 {degrees(units['U95E95'])}")
    for name, one in found["estimators"].items():
        if one["U50E95"] is not None:
            lines.append(f"{name} on exact features: U50E95 {degrees(one['U50E95'])}")
    for name, one in found["estimators_on_images"].items():
        if one["U50E95"] is not None:
            lines.append(f"{name} on rendered images: U50E95 {degrees(one['U50E95'])}")
    if "cornea_share" in safety:
        lines.append(
            f"cornea: {100 * safety['cornea_share']:.2f} % of the limit, "
            f"{100 * safety['stuck_on']['cornea_share']:.2f} % with the LEDs stuck on ({safety['note']})"
        )
    return "\n".join(lines)
