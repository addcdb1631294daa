"""The command study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..apps.study.options import StudyOptions
from ..base.errors import InputError
from .app import app
from .options import OutputFolder, Result
from .output import emit, progress, say


@app.command(name="study")
def study(
    name: Annotated[str, Parameter(name="NAME")],
    /,
    *,
    output: OutputFolder,
    eyes: str | None = None,
    people: int | None = None,
    options: Annotated[StudyOptions, Parameter(name="*")] = StudyOptions(),
    json: Result = None,
) -> int:
    """Replicate a published gaze study, or compare observers or conditions.

    The folder receives summary.json, findings.json, both as CSV, and report.html. A folder of the same study is updated
    in place. Rendered images form a dataset in images/: an interrupted run resumes, and finished images are reused.

    Args:
        name: guestrin2006 (model-based gaze), blignaut2014 (interpolation-based gaze), observers (analytic against
            image-derived features on the head-mounted rig), conditions (analytic errors over the screen, head
            positions, pupil sizes and eye parameters), or rigs (six known layouts over a population: for whom each
            fails where, and the effect of each LED).
        eyes: Eye models separated by commas, as catalogue names or eye files (default: E1 to E5).
        people: rigs: Number of people (default: 100).
    """
    from ..apps.study.literature import MODELS
    from ..apps.study.run import REPORT, run_study

    if name == "rigs":
        return _rigs(output, people, eyes, options, json)
    if people is not None:
        raise InputError("belongs to the study 'rigs'", source="--people")
    names = MODELS if eyes is None else tuple(e.strip() for e in eyes.split(",") if e.strip())
    with progress(f"study {name}") as steps:
        summary = run_study(name, output, options, eyes=names, progress=steps, say=say)
    emit(summary, f"{_table(summary)}\n\nreport: {output / REPORT}", json)
    return 0


def _rigs(output: Path, people: int | None, eyes: str | None, options: StudyOptions, json: str | None) -> int:
    """Run the study of rigs."""
    from ..apps.study.rigs import run_rigs

    if people is not None and not 1 <= people <= 100_000:
        raise InputError(f"must be 1 to 100000, not {people}", source="--people")
    if eyes is not None:
        raise InputError("has no meaning for the study 'rigs', whose eyes are those of people", source="--eyes")
    with progress("study rigs") as steps:
        found = run_rigs(output, options, people=people, progress=steps)
    lines = [f"{'layout':<18} {'lost':>7} {'2 glints':>9} {'U95E95 deg':>11}"]
    for row in found["rows"]:
        noise = row["frame_to_frame_deg"]["U95E95"]
        shown = "not seen" if noise is None else f"{noise:.4f}"
        covered = row["coverage"]["outline_and_2_glints"]
        lines.append(f"{row['layout']:<18} {100 * row['lost']:>5.1f} % {100 * covered:>7.1f} % {shown:>11}")
    emit(found, "\n".join([*lines, "", f"report: {output / 'report.html'}"]), json)
    return 0


def _table(summary: dict[str, Any]) -> str:
    """Format the most important means, one line each."""
    rows = summary["rows"]
    if summary["study"] == "blignaut2014":
        lines = [f"{'protocol':<12} {'observer':<15} {'eye':<18} {'set':<5} {'best':<5} {'mean deg':>9}"]
        best: dict[tuple[str, ...], dict[str, Any]] = {}
        for row in rows:
            key = (row["protocol"], row["observer"], row["eye_model"], row["calibration"])
            if row["variant"] != "vector" or row["mean_deg"] is None:
                continue
            if key not in best or row["mean_deg"] < best[key]["mean_deg"]:
                best[key] = row
        lines += [
            f"{k[0]:<12} {k[1]:<15} {k[2]:<18} {k[3]:<5} {row['function']:<5} {row['mean_deg']:>9.4f}"
            for k, row in best.items()
        ]
        return "\n".join(lines)
    lines = [f"{'protocol':<12} {'observer':<15} {'eye':<18} {'side':<6} {'mean deg':>9} {'n':>4}  condition"]
    for row in rows:
        mean = "-" if row["mean_deg"] is None else f"{row['mean_deg']:.4f}"
        condition = " ".join(str(v) for v in (row["head"], row["variant"]) if v)
        lines.append(
            f"{row['protocol']:<12} {row['observer']:<15} {row['eye_model']:<18} {row['eye']:<6} {mean:>9} "
            f"{row['n']:>4}  {condition}"
        )
    return "\n".join(lines)
