"""The command budget."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from ..base.errors import InputError
from .app import app
from .options import AtLeastOne, Backend, EstimatorFlags, EstimatorName, EyeModel, Result, Strict, Threads
from .output import Heed, emit, progress


@app.command(name="budget")
def budget(
    scene: str,
    /,
    *,
    estimator: EstimatorName,
    eye: EyeModel = None,
    options: Annotated[EstimatorFlags, Parameter(name="*")] = EstimatorFlags(),
    binocular: bool = False,
    reference: str = "E1",
    seeds: AtLeastOne = None,
    images: Annotated[bool, Parameter(negative="--no-images")] = True,
    backend: Backend = "auto",
    threads: Threads = None,
    strict: Strict = False,
    json: Result = None,
) -> int:
    """Split the gaze error of a scene by cause: eye model, features, image, noise, estimator.

    The images are rendered once and exposed again for each seed of the noise. With --fixations the remaining ones are
    tested; otherwise each fixation is tested with a calibration on all others.

    Args:
        scene: A scene file or the name of a shipped one, with targets.
        binocular: Use the mean of both eyes' gaze points. It hides horizontal errors of eyes that are mirror images of
            each other.
        reference: Eye model that gives the estimator's own error.
        seeds: Number of exposures of each image with other noise (default: 10).
        images: Render images; without them only eye model and optics are separated.
    """
    from ..gaze.budget import budget as split
    from ..imaging.causes import SEEDS, budget_steps

    chosen, calibration = options.choose(estimator), options.fixation_list()
    heed = Heed(strict)
    loaded = heed.scene(scene, eye=eye)
    frames = loaded.frames()
    unknown = sorted(set(calibration or ()) - set(frames.index.fixation.tolist()))
    if unknown:
        raise InputError(f"there is no fixation {unknown[0]}", source="--fixations")
    try:
        with progress(f"budget {scene}") as steps:
            observed = budget_steps(
                frames, reference=reference, images=images, seeds=seeds or SEEDS, backend=backend, threads=threads,
                progress=steps,
            )  # fmt: skip
        found = split(observed, loaded.rig, chosen, calibration=calibration, binocular=binocular)
    except InputError as error:
        raise error.placed(source=scene) from None
    data = {"scene": loaded.name, "eye_model": loaded.eye_spec.name, "estimator": estimator, "reference": reference}
    emit({**found.to_mapping(), **data}, str(found), json, heed)
    return 0
