"""The command budget."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from ..base.errors import InputError
from .app import app
from .options import AtLeastOne, Backend, EyeModel, Result, Strict, Threads
from .output import Heed, emit, progress


@app.command(name="budget")
def budget(
    scene: str,
    /,
    *,
    estimator: Annotated[str, Parameter(name="--estimator")],
    eye: EyeModel = None,
    function: str = "R3",
    monocular: bool = False,
    feature: Literal["pupil-glint", "pupil"] = "pupil-glint",
    method: Literal["A", "B"] = "A",
    index: float | None = None,
    recalibration: Literal["angle", "screen", "none"] = "angle",
    fixations: str | None = None,
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

    The images are rendered once and exposed again for each seed of the noise.

    Args:
        scene: A scene file or the name of a shipped one, with targets.
        estimator: regression, direction-regression, homography, cross-ratio, hennessey, shih-wu-liu or
            guestrin-eizenman (see `gaze fit`), or module:Class, a class of your own.
        function: regressions: the function, R1 to R12.
        monocular: regression: use the vector of one eye in pixels, without dividing it by the distance between the
            pupils.
        feature: direction-regression: the vector from the mean of all glints to the pupil, or the pupil's centre alone.
        method: guestrin-eizenman: locate the corneal centre from all glints (A), or on the common line of the planes
            (B).
        index: guestrin-eizenman, hennessey: the assumed refractive index.
        recalibration: hennessey, shih-wu-liu: the quantity that the correction polynomial acts on.
        fixations: Calibrate on these fixations and test on the others, counted from 0, such as '0,4,8' (default: each
            fixation is tested with a calibration on all others).
        binocular: Use the mean of both eyes' gaze points. It hides horizontal errors of eyes that are mirror images of
            each other.
        reference: Eye model that gives the estimator's own error.
        seeds: Number of exposures of each image with other noise (default: 10).
        images: Render images; without them only eye model and optics are separated.
    """
    from ..gaze.budget import budget as split
    from ..gaze.store import choose_estimator
    from ..imaging.causes import SEEDS, budget_steps
    from ..scene import load_scene
    from .gaze import fixation_list

    chosen = choose_estimator(
        estimator, function=function, normalised=not monocular, feature=feature, method=method, index=index,
        recalibration=recalibration,
    )  # fmt: skip
    calibration = fixation_list(fixations)
    heed = Heed(strict)
    loaded = load_scene(scene, eye=eye)
    heed(loaded.warnings())
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
