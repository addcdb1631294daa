"""The command study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..study.options import StudyOptions
from .app import app
from .options import Result
from .output import emit, progress, say


@app.command(name="study")
def study(
    name: Annotated[str, Parameter(name="NAME")],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    eyes: str | None = None,
    options: Annotated[StudyOptions, Parameter(name="*")] = StudyOptions(),
    json: Result = None,
) -> int:
    """Replicate a published gaze study, or compare observers or conditions.

    The folder receives summary.json, findings.json, both as CSV, and report.html. A folder of the same study is
    updated in place. Rendered images form a dataset in images/: an interrupted run resumes, and finished images are
    reused.

    Args:
        name: guestrin2006 (model-based gaze), blignaut2014 (interpolation-based gaze), observers (analytic against
            image-derived features on the head-mounted rig), or conditions (analytic errors over the screen, head
            positions, pupil sizes and eye parameters).
        output: The folder to write.
        eyes: Eye models separated by commas, as catalogue names or eye files (default: E1 to E5).
    """
    from ..study.literature import MODELS
    from ..study.run import REPORT, run_study

    names = MODELS if eyes is None else tuple(e.strip() for e in eyes.split(",") if e.strip())
    with progress(f"study {name}") as steps:
        summary = run_study(name, output, options, eyes=names, progress=steps, say=say)
    emit(summary, f"{_table(summary)}\n\nreport: {output / REPORT}", json)
    return 0


def _table(summary: dict[str, Any]) -> str:
    """Write the most important means, one line each."""
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
