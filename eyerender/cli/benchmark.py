"""The command bench-extractors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..errors import InputError
from .app import app
from .options import Overwrite, Result
from .output import emit, progress


@app.command(name="bench-extractors")
def bench_extractors(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    extractor: tuple[str, ...] = (),
    timeout: float = 30.0,
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Measure pupil and glint extractors against the labels of a folder of images.

    The output folder receives report.html, results.json and results.csv. Each extractor runs in its own process. If it
    crashes, hangs or returns invalid answers, only its own result fails, with a reason.

    Args:
        folder: A folder of labelled images written by quickstart, render or generate, or a folder of ideal images.
        output: The folder to write.
        extractor: The name of an installed extractor (own-fast, own-refined, opencv-contour, pupil-detectors, or a
            plug-in), a Python module:callable, or a command that speaks the protocol. NAME=... names it in the report.
            Repeat the option for several extractors (default: all installed ones).
        timeout: Seconds that an extractor may take for one image.
    """
    from ..benchmark.run import REPORT, bench_extractors

    if not 0 < timeout <= 86400:
        raise InputError("must be above 0 and at most 86400 seconds", source="--timeout")
    with progress("benching") as steps:
        data = bench_extractors(
            folder, output, extractor or None, timeout_s=timeout, overwrite=overwrite, progress=steps
        )
    emit(data, f"{_table(data)}\n\nreport: {output / REPORT}", json)
    return 0


def _table(data: dict[str, Any]) -> str:
    """One line per extractor, then the reasons of failures."""
    lines = [
        f"{'':<18} {'right':>5} {'wrong':>5} {'none':>5} {'error':>5} {'centre px':>10} {'p95':>8} {'bias x':>8} "
        f"{'bias y':>8} {'eff.':>5} {'axis a':>8} {'axis b':>8} {'bound.':>7} {'IoU':>6} "
        f"{'glints':>9} {'gl. px':>7} {'ms':>6}"
    ]
    for e in data["extractors"]:
        s, g = e["summary"], e["summary"]["glints"]
        bias, axes = s["centre_bias_px"] or (None, None), s["semi_axes_bias_px"] or (None, None)
        time = s["time"]["cpu_ms"]["median"] or s["time"]["round_trip_ms"]["median"]
        lines.append(
            f"{e['name']:<18} {s['right']:>5} {s['wrong']:>5} {s['none']:>5} {s['error']:>5} "
            f"{_f(s['centre_px']['median'], 4):>10} {_f(s['centre_px']['p95'], 4):>8} {_f(bias[0], 4):>8} "
            f"{_f(bias[1], 4):>8} {_f(s['efficiency']['value'], 2):>5} {_f(axes[0], 4):>8} {_f(axes[1], 4):>8} "
            f"{_f(s['boundary_px']['median'], 3):>7} {_f(s['iou']['median'], 3):>6} "
            f"{'-' if g is None else '{}/{}'.format(g['matched'], g['true']):>9} "
            f"{_f(g['error_px']['median'] if g else None, 4):>7} {_f(time, 1):>6}"
        )
    for e in data["extractors"]:
        lines += [f"{e['name']}: {f['count']} x {f['outcome']}: {f['reason']}" for f in e["failures"][:3]]
    lines += [f"{e['name']}: not run: {e['reason']}" for e in data["not_run"]]
    return "\n".join(lines)


def _f(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
