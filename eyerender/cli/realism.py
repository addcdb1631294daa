"""The command realism."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..base.errors import InputError
from .app import app
from .options import Result
from .output import emit, progress


@app.command(name="realism")
def realism(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *other: Annotated[Path, Parameter(name="OTHER")],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    gamma: tuple[float, ...] = (),
    limit: int = 200,
    json: Result = None,
) -> int:
    """Measure image statistics of eye pictures: contrasts, edges, texture, highlights, noise.

    With a second folder, such as frames of your own camera, the command compares both. A classifier then measures how
    well patches of the two can be told apart; this needs scikit-learn, which is not installed by default. With folders
    of three or more cameras, it is trained on all cameras but one and tested on that one.

    Args:
        folder: A folder of images of one eye each: written by this package, exported by it, or your own.
        other: A second folder, to compare with, or a folder for each of several cameras.
        output: An HTML page to write, with the table and montages at equal scale.
        gamma: Encoding gamma of the pixel values; give it twice for two folders. Default: the value that a folder of
            this package or an export states, else 1 (linear).
        limit: The largest number of images of a folder, chosen evenly.
    """
    from ..apps.realism import realism as measured

    if output is not None and output.suffix.lower() not in (".html", ".htm"):
        raise InputError("must end with .html", source="--output")
    folders = [folder, *other]
    with progress("measuring") as steps:
        data = measured(folders, output=output, gammas=gamma, limit=limit, progress=steps)
    page = f"\n\npage: {output}" if output is not None else ""
    emit(data, _table(data) + page, json)
    return 0


def _table(data: dict[str, Any]) -> str:
    """Format one line per statistic: median and middle half of each folder's images, and the ratio of the medians."""
    from ..apps.realism.page import text

    folders, ratios = data["folders"], data["ratios"]
    lines = []
    for k, f in enumerate(folders):
        lines.append(
            f"{chr(65 + k)}: {f['path']}: {f['measured']} of {f['images']} images, gamma {f['gamma']:g} "
            f"({f['gamma_from']}), pupil and iris from: {f['landmarks']}"
        )
    heads = "".join(f"{chr(65 + k):>10} {'middle half':>19}" for k in range(len(folders)))
    lines += ["", f"{'':<24}{heads}{'A / B':>9}" if ratios else f"{'':<24}{heads}"]
    for name in data["definitions"]:
        cells = ""
        for f in folders:
            s = f["figures"][name]
            spread = f"[{text(s['q25'])}, {text(s['q75'])}]" if s["n"] else ""
            cells += f"{text(s['median']):>10} {spread:>19}"
        lines.append(f"{name:<24}{cells}" + (f"{text(ratios[name]):>9}" if ratios else ""))
    return "\n".join([*lines, *_test(data)])


def _test(data: dict[str, Any]) -> list[str]:
    """Format one line per kind of patch: how well the two folders can be told apart."""
    if len(data["folders"]) < 2:
        return []
    if len(data["folders"]) > 2:
        lines = [
            "",
            f"{'told from an unseen camera':<28}{'AUC':>6} {'90 % interval':>15}{'a camera':>10} {'90 % interval':>15}",
        ]
        for kind, found in (data["left_out"] or {}).items():
            if found is None:
                lines.append(f"{kind:<28}{'-':>6} {'too few images':>15}")
                continue
            own, placebo = ("[{:.2f}, {:.2f}]".format(*found[f"{name}interval_90"]) for name in ("", "placebo_"))
            lines.append(f"{kind:<28}{found['auc']:>6.2f} {own:>15}{found['placebo']:>10.2f} {placebo:>15}")
        return lines
    if data["separability"] is None:
        return ["", f"two-sample test: {data['separability_reason']}"]
    lines = ["", f"{'told apart (.5 chance)':<24}{'AUC':>10} {'90 % interval':>19}{'images':>12}"]
    for kind, found in data["separability"].items():
        if found is None:
            lines.append(f"{kind:<24}{'-':>10} {'too few images':>19}")
            continue
        low, high = found["interval_90"]
        images = "{} and {}".format(*found["images"])
        lines.append(f"{kind:<24}{found['auc']:>10.2f} {f'[{low:.2f}, {high:.2f}]':>19}{images:>12}")
    return lines
