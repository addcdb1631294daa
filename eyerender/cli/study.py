"""The command study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..apps.study.options import StudyOptions
from .app import app
from .dataset import part_of
from .options import OutputFolder, Overwrite, Result
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
    """Replicate a published gaze study, answer open questions of such studies over people, or run a study of your own.

    The folder receives summary.json, findings.json, both as CSV, and report.html. A folder of the same study is updated
    in place. Rendered images form a dataset in images/: an interrupted run resumes, and finished images are reused.

    Args:
        name: guestrin2006 (model-based gaze), blignaut2014 (interpolation-based gaze), observers (analytic against
            image-derived features on the head-mounted rig), conditions (analytic errors over the screen, head
            positions, pupil sizes and eye parameters), rigs (six known layouts over a population: for whom each fails
            where, and the effect of each LED), pupil-size (its measured size over gaze, gaze over its size),
            calibration (targets and slippage with every estimator), stereo (posterior cornea, and how the eye turns),
            head-movement (what images do to the error when the head moves), glasses (what lenses do to features, loss
            and every estimator), appearance (networks that learn gaze from pictures of each eye model; the extra
            torch), or a study of your own as module:Class.
        eyes: Eye models separated by commas, as catalogue names or eye files (default: those of the study).
    """
    from ..apps.study.run import REPORT, load_study, run_study

    names = None if eyes is None else tuple(e.strip() for e in eyes.split(",") if e.strip())
    with progress(f"study {name}") as steps:
        summary = run_study(name, output, options, eyes=names, progress=steps, say=say)
    lines = [*load_study(name).text(summary), "", f"report: {output / REPORT}"]
    emit(summary, "\n".join(lines), json)
    return 0


@app.command(name="sweep")
def sweep(
    spec: Path,
    /,
    *,
    output: OutputFolder,
    people: int | None = None,
    tolerances: Path | None = None,
    workers: int | None = None,
    shard: str | None = None,
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Compare layouts of a rig: positions of cameras and LEDs, focal length, resolution, number and intensity of LEDs.

    The folder receives report.html, summary.json and layouts.csv. The report shows the Pareto front of bound, dropout,
    number of LEDs and light on the cornea. An interrupted run resumes.

    Args:
        spec: A YAML file that names a scene and has the key `sweep`.
        people: Number of people (default: that of the file).
        tolerances: A YAML file of tolerances of cameras, LEDs and mirrors, as for `rig`; their cost becomes a goal.
        workers: Number of processes (default: one per processor). Results do not depend on it.
        shard: K/N: evaluate only every N-th layout, starting with the K-th (1 <= K <= N), for array jobs that write to
            one folder.
    """
    from ..apps.sweeps.run import REPORT, SweepRun, run_sweep
    from ..apps.sweeps.spec import SweepSpec
    from ..base.errors import InputError
    from ..design.tolerances import Tolerances

    part = part_of(shard)
    if overwrite and shard is not None:
        raise InputError("cannot be combined with --shard, because other jobs may be writing", source="--overwrite")
    if workers is not None and workers < 1:
        raise InputError(f"must be >= 1, not {workers}", source="--workers")
    wanted = SweepSpec.load(spec)
    if people is not None:
        wanted = wanted.replaced("--people", {"people": people})
    if tolerances is not None:
        wanted = wanted.replaced("--tolerances", {"tolerances": Tolerances.load(tolerances).to_mapping()})
    how = SweepRun(workers=workers, part=part, overwrite=overwrite)
    try:
        scene = wanted.base(spec.parent)
        with progress("sweep") as steps:
            found = run_sweep(wanted, scene, output, how, progress=steps, say=say)
    except InputError as error:
        raise error.placed(source=str(spec)) from None
    emit(found, _text(found, output / REPORT), json)
    return 0


def _text(found: dict[str, Any], report: Path) -> str:
    if not found["complete"]:
        return f"{found['missing']} of {found['layouts']} layouts are still missing"
    from ..apps.sweeps.page import leds_of

    best = [row for row in found["rows"] if row["pareto"]]
    lines = [f"{found['layouts']} layouts, {len(best)} of them on the Pareto front"]
    for row in sorted(best, key=lambda row: row["noise_deg"] or float("inf"))[:8]:
        noise = "not seen" if row["noise_deg"] is None else f"{row['noise_deg']:.4f} deg"
        lines.append(f"layout {row['number']}: noise {noise}, dropout {100 * row['dropout']:.1f} %, {leds_of(row)}")
    return "\n".join([*lines, "", f"report: {report}"])
