"""Commands on eyes and scenes: eyes, view, fit-eye."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from ..base.errors import InputError
from ..base.storage.files import written
from .app import app
from .options import OutputFile, OutputFolder, Overwrite, Result, Strict
from .output import Heed, emit

_FORMATS = (".svg", ".pdf", ".png")


@app.command(name="eyes")
def eyes(name: str | None = None, /, *, json: Result = None) -> int:
    """List the eye models of the catalogue, or print one as an eye file.

    Args:
        name: The name of a catalogue model, or an eye file.
    """
    from ..eye.catalogue import catalogue_names, load_eye

    if name is not None:
        spec = load_eye(name)
        emit({"schema": "eyerender/eye/1", "eye": spec.to_mapping()}, spec.to_yaml().rstrip(), json)
        return 0
    specs = {n: load_eye(n) for n in catalogue_names()}
    width = max(map(len, specs))
    text = "\n".join(f"{n:<{width}}  {s.description}" for n, s in specs.items())
    emit(
        {"schema": "eyerender/eyes/1", "eyes": [{"name": n, "description": s.description} for n, s in specs.items()]},
        text,
        json,
    )
    return 0


@app.command(name="view")
def view(
    what: Literal["eye", "scene"], name: str, /, *, output: OutputFile, eye: str | None = None, strict: Strict = False
) -> int:
    """Draw an eye's section, or a scene's rig and rays, as SVG, PDF or PNG.

    Args:
        what: What to draw.
        name: For an eye, a catalogue name or an eye file; for a scene, a scene file or the name of a shipped one.
        output: The picture to write; its suffix selects the format.
        eye: Replace the scene's eye model.
    """
    if output.suffix.lower() not in _FORMATS:
        raise InputError(f"must end with one of {', '.join(_FORMATS)}", source=str(output))
    if what == "eye":
        from ..eye.catalogue import load_eye
        from ..report.eye_section import eye_section

        fig = eye_section(load_eye(name).build())
    else:
        from ..report.scene_view import scene_view

        fig = scene_view(Heed(strict).scene(name, eye=eye))
    with written(output) as file:
        fig.savefig(file, format=output.suffix[1:].lower(), dpi=150)
    print(output)
    return 0


@app.command(name="fit-eye")
def fit_eye(
    recording: Path,
    /,
    *,
    output: OutputFolder,
    rig: str | None = None,
    unknowns: Path | None = None,
    eye: str = "adult",
    columns: Path | None = None,
    targets: bool = True,
    robust: Literal["geman-mcclure", "huber", "none"] = "geman-mcclure",
    outline_px: float = 0.1,
    glint_px: float = 0.05,
    overwrite: Overwrite = False,
    json: Result = None,
) -> int:
    """Fit the eye and its gaze in every frame to a recording's features, with covariances.

    The folder receives one eye file per eye (right.yaml, left.yaml), which every other command accepts, and fit.json:
    gaze, pupil and slippage of every frame, the person's parameters with standard deviations, chi^2, and the parameters
    that the recording does not determine. A fit that may be wrong gives a warning; one that leads to an eye that cannot
    exist, or far from the priors, is refused.

    Args:
        recording: Records as `features` or `extract` write them (JSON, JSONL), or a table (CSV).
        rig: A rig file, or a scene for its rig and for places of eyes that the recording lacks (default: the rig in the
            recording).
        unknowns: A YAML file with the keys of `er.Unknowns` (default: the priors of people, 3 mm of slippage).
        eye: Start of the fit and mean of its priors: a catalogue name or an eye file.
        columns: A YAML file with the meaning of a table's columns.
        targets: Use the known targets, which determine the line of sight.
        robust: Reduce the weight of wrong features.
        outline_px: Standard deviation of one pixel of outline, for records without covariance.
        glint_px: Standard deviation of a glint along each axis, for records without covariance.
    """
    from ..design.fit import fit_eye as fit
    from ..design.fitfolder import write_fits
    from ..design.noise import FeatureNoise
    from ..design.unknowns import Unknowns
    from ..eye.catalogue import load_eye
    from ..gaze.records import is_rig_file, load_observations

    # A scene also places eyes whose place is not recorded.
    whose = {"rig": rig} if rig is None or is_rig_file(rig) else {"scene": rig}
    observations, built = load_observations(recording, **whose, columns=columns)
    given = None if unknowns is None else Unknowns.load(unknowns)
    noise = FeatureNoise.of(outline_px, glint_px, rig=built)
    fits = fit(observations, built, given, prior=load_eye(eye), noise=noise, targets=targets, robust=robust)
    found = write_fits(output, fits, overwrite=overwrite)
    emit(found, _text(found, output), json)
    return 0


def _text(found: dict[str, Any], output: Path) -> str:
    lines = []
    for one in found["eyes"]:
        lines.append(f"{one['eye']} eye: {len(one['frames'])} frames, chi^2 {one['chi2']:.1f} "
                     f"for {one['degrees_of_freedom']} degrees of freedom")  # fmt: skip
        lines.append(f"  {'change from the prior':<27} {'unit':<5} {'result':>23} {'prior':>12}")
        for name, value in one["person"].items():
            if value["deviation"] != 0.0:
                before = "unknown" if value["prior_deviation"] is None else f"+- {value['prior_deviation']:.4g}"
                spread = "" if value["deviation"] is None else f" +- {value['deviation']:<10.4g}"
                cells = f"{value['unit']:<5} {value['change']:>+9.4f}{spread:<14} {before:>12}"
                lines.append(f"  {name:<27} {cells}{'' if value['learned'] else '  not learned'}")
        if one["not_seen"]:
            lines.append(f"  not seen: {', '.join(one['not_seen'])}")
    return "\n".join([*lines, f"written to {output}"])
