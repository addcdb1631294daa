"""Render samples again and compare their pixels with those of the folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...backends.choose import BackendChoice
from ...base.progress import Progress
from ...base.storage.files import shown
from ...folders.imagefolder import ARRAY_KEYS, KINDS, ImageEntry, ImageFolder
from ..done import cpu_family, read_done, run_versions
from ..environment import rounding
from ..maker import Maker
from .problems import FolderProblems
from .truth import DatasetTruth


def render_again(
    folder: ImageFolder,
    truth: DatasetTruth,
    rows: Sequence[int],
    step: Progress,
    problems: FolderProblems,
    *,
    backend: BackendChoice = "auto",
    threads: int | None = None,
) -> list[str]:
    """Render the samples of some rows of a dataset again.

    Differences are problems if the same versions, backend and kind of processor made the images. Returns notes: the
    number of images, and differences from images of another maker with how the makers differ. Raises BackendError if no
    backend can render; InputError if a file of the plan is missing, or a picture cannot be read.
    """
    entries: dict[int, list[ImageEntry]] = {}
    for row in rows:
        entry = folder.entries[row]
        entries.setdefault(int(entry.line["sample"]), []).append(entry)
    truth.remember({sample: own[0].line for sample, own in entries.items()})
    maker = Maker(truth.plan, truth.frames, backend=backend, threads=threads)
    notes = [f"{len(rows)} images are rendered again"]
    for k, made in enumerate(maker.make_all(entries)):
        pictures = {image.name: image.pictures for image in made.images}
        for entry in entries[made.index]:
            own = pictures.get(entry.name.split("/")[-1].removesuffix(".png"), {})
            differences = list(_differences(entry, own))
            other = other_maker(folder, truth, entry, maker.backend) if differences else ""
            if other:
                notes += [f"{text}; {other}" for text in differences]
            else:
                problems.extend(differences)
        step(k + 1, len(entries), "samples rendered again")
    return notes


def _differences(entry: ImageEntry, made: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    for kind, key in KINDS.items():
        found = _pixels(entry, key)
        if found is None:
            continue
        if kind not in made or made[kind].shape != found.shape:
            yield f"{entry.line[key]}: rendered again: there is no such picture"
            continue
        gap = np.abs(made[kind].astype(float) - found)
        gap[np.isnan(made[kind]) & np.isnan(found)] = 0.0
        gap[np.isnan(gap)] = np.inf
        gap = gap.max(axis=2) if gap.ndim == 3 else gap
        if gap.any():
            v, u = np.unravel_index(int(gap.argmax()), gap.shape)
            yield (
                f"{entry.line[key]}: rendered again: {np.count_nonzero(gap)} pixels differ, by up to {gap.max():g} "
                f"at x = {u}, y = {v}"
            )


def _pixels(entry: ImageEntry, key: str) -> NDArray[Any] | None:
    if key in ARRAY_KEYS:
        return entry.pixels(key)
    found = entry.picture(key)
    return None if found is None else found[0]


def other_maker(folder: ImageFolder, truth: DatasetTruth, entry: ImageEntry, backend: Mapping[str, Any]) -> str:
    """Describe how the maker of an image differs from this process; empty if nothing affects its bytes."""
    done = read_done(folder.path, truth.plan.spec.selection.shard_of(int(entry.line["sample"])))
    old = {**done["versions"], **{k: v for k, v in done["backend"].items() if k != "threads"}, "cpu": done["cpu"]}
    old["rounding"] = done.get("rounding")
    new = {
        **run_versions(),
        **{k: v for k, v in backend.items() if k != "threads"},
        "cpu": cpu_family(),
        "rounding": rounding(),
    }
    other = [key for key in old if key != "python" and old[key] != new.get(key)]
    return ", ".join(f"{key} is {shown(new.get(key))}, was {shown(old[key])}" for key in other)
