"""The command study."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from ..apps.study.options import StudyOptions
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
    options: Annotated[StudyOptions, Parameter(name="*")] = StudyOptions(),
    json: Result = None,
) -> int:
    """Replicate a published gaze study, measure over people what others left open, or run a study of your own.

    The folder receives summary.json, findings.json, both as CSV, and report.html. A folder of the same study is updated
    in place. Rendered images form a dataset in images/: an interrupted run resumes, and finished images are reused.

    Args:
        name: guestrin2006 (model-based gaze), blignaut2014 (interpolation-based gaze), observers (analytic against
            image-derived features on the head-mounted rig), conditions (analytic errors over the screen, head
            positions, pupil sizes and eye parameters), rigs (six known layouts over a population: for whom each fails
            where, and the effect of each LED), pupil-size (its measured size over gaze, gaze over its size),
            calibration (targets and slippage with every estimator), stereo (posterior cornea, and how the eye turns),
            head-movement (what images do to the error when the head moves), or a study of your own as module:Class.
        eyes: Eye models separated by commas, as catalogue names or eye files (default: those of the study).
    """
    from ..apps.study.run import REPORT, load_study, run_study

    names = None if eyes is None else tuple(e.strip() for e in eyes.split(",") if e.strip())
    with progress(f"study {name}") as steps:
        summary = run_study(name, output, options, eyes=names, progress=steps, say=say)
    lines = [*load_study(name).text(summary), "", f"report: {output / REPORT}"]
    emit(summary, "\n".join(lines), json)
    return 0
