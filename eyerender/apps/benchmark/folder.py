"""A labelled folder for benchmarks: images, true features in image coordinates, hints, and factors that vary.

Four kinds are read: folders that this package rendered, folders of ideal images (`rendered`), the user's own labelled
images (`own`), and public layouts (`layouts`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...base.errors import InputError
from ...folders.imagefolder import DATASET
from ...scene.parts import IRIS, PUPIL
from .bound import Edge, edge_of, is_bounded
from .conditions import of_pixels, of_shape, tags
from .glintlabels import measured
from .hints import FolderHints
from .labelled import BenchImage
from .layouts import reader_of, stated_gamma
from .own import is_own, own_images
from .rendered import ideal_images, is_ideal, rendered_images

EYE_ERROR_MM = 5.0


def load_labelled(
    folder: str | Path,
    gamma: float | None = None,
    *,
    eye_error_mm: float = EYE_ERROR_MM,
    pupil_class: int | None = None,
) -> list[BenchImage]:
    """Load every image of a folder; options as in `BenchOptions`.

    Raises:
        InputError: the folder is of another kind; an image is missing, has another size or does not show exactly one
            eye; or the folder states another gamma than `gamma`.
    """
    path = Path(folder)
    if is_ideal(path):
        images = ideal_images(path)
    elif is_own(path):
        images = hinted(path, own_images(path, pupil_class), None)
    elif not (path / DATASET).exists() and (read := reader_of(path)):
        images = hinted(path, read(path), stated_gamma(path))
    else:
        images = rendered_images(path, eye_error_mm)
    return [_described(with_gamma(image, gamma)) for image in images]


def with_edge(image: BenchImage) -> BenchImage:
    """Add the pupil's edge, the bound that follows from it, and noise and blur as possible causes of an error.

    The edge is as the folder states it, else measured.
    """
    if image.known:
        edge = edge_of(np.zeros((0, 0)), image.bit_depth, image.pupil, image.glints_px, image.known)
        factors = {"noise_dn": image.known["noise_dn"], "blur_px": image.known["blur_px"]}
    else:
        edge = _measured_edge(image)
        factors = {} if edge is None else edge.factors()
    sigma_px = None
    if edge is not None and image.pupil is not None:
        factors["contrast_to_noise"] = abs(edge.step_dn) / edge.noise_dn
        if is_bounded(image.visible, image.known):
            sigma_px = edge.centre_sigma_px(image.pupil)
    return replace(image, edge=edge, sigma_px=sigma_px, factors={**image.factors, **factors})


def _measured_edge(image: BenchImage) -> Edge | None:
    classes = image.classes()
    shows = None if classes is None else np.isin(classes, (PUPIL, IRIS))
    if shows is None and image.visible is not None and image.visible < 1.0:
        return None  # the occluder of the outline is unknown
    return edge_of(image.grey(), image.bit_depth, image.pupil, image.glints_px, {}, shows)


def hinted(folder: Path, images: Iterable[BenchImage], gamma: float | None) -> list[BenchImage]:
    """Add the hints stated by the folder to its images; `gamma` is that of its layout, if it states one."""
    told = FolderHints.load(folder)
    gamma = told.gamma or gamma
    hints, source = {**told.to_request(), "gamma": gamma or 1.0}, "assumed" if gamma is None else "folder"
    out = [replace(image, hints=hints, gamma_from=source) for image in images]
    if not out:
        raise InputError("holds no labelled images", source=str(folder))
    return out


def with_gamma(image: BenchImage, gamma: float | None) -> BenchImage:
    """Replace an assumed gamma by a given one, which must not contradict a stated one."""
    stated = float(image.hints["gamma"])
    if gamma is None or (gamma == stated and image.gamma_from != "assumed"):
        return image
    if image.gamma_from != "assumed":
        raise InputError(f"{image.name} states a gamma of {stated:g}, not {gamma:g}", source="--gamma")
    return replace(image, hints={**image.hints, "gamma": gamma}, gamma_from="given")


def _described(image: BenchImage) -> BenchImage:
    """Add measured properties of the glints, and the conditions that features and pixels show."""
    conditions = [set(image.conditions)]
    if image.centre_px is None:
        conditions.append(of_shape(image.pupil, image.visible, image.size, image.glints_px))
    glints, mask = image.glints, image.classes()
    if mask is not None or glints:
        grey = image.grey()
        conditions.append(of_pixels(grey, image.bit_depth, mask))
        glints = measured(glints, grey, image.bit_depth, image.pupil, mask)
    return replace(image, conditions=tags(*conditions), glints=glints)
