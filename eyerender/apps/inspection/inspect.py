"""The command inspect: read one dataset or two, find what is wrong or unusual, and write a page."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import InputError
from ...base.progress import Progress
from ...base.storage.files import refuse_special
from .comparing import Shift, has_subjects, only_in, shares, shifts
from .duplicates import equal_pictures, near_duplicates
from .faults import KINDS, Fault
from .found import Inspection
from .missing import missing_labels
from .outliers import outliers, worst_pictures
from .planned import dependences_of, draw_plan
from .reading import Contents, matrix, read, split_of_subjects
from .statistics import distribution
from .strata import shares_of

SCHEMA = "eyerender/inspection/1"
IMAGES = 100_000
"""Images that are read of a dataset, by default at most."""


def inspect(
    folder: str | Path,  # the dataset's folder; with `planned`, its spec or the name of a shipped one
    other: str | Path | None = None,  # a second dataset, to which it is compared
    *,
    output: str | Path | None = None,  # the HTML page; None: no page
    images: int = IMAGES,  # the largest number of images that are read of a dataset, spread evenly over it
    # draw the samples of a spec instead of reading a folder: splits, distributions and dependences of draws
    planned: bool = False,
    workers: int = 1,  # processes that read them; the result does not depend on their number
    progress: Progress | None = None,  # called with (images read, images to read, what)
) -> dict[str, Any]:
    """Look into a dataset, and write a page about it.

    Returns:
        What was found (`eyerender/inspection/1`): `datasets`, one or two, and `difference`.

    Raises:
        InputError: a folder is not a dataset, the page cannot be written to, or a plan is given with something else.
        EyerenderError: the page cannot be written.
    """
    if images < 1:
        raise InputError("must be >= 1", source="--images")
    if output is not None:
        refuse_special(output)
    if planned:
        if other is not None:
            raise InputError("takes one spec", source="--planned")
        drawn = draw_plan(folder, images, progress)
        if output is not None:
            from .page import write_planned

            write_planned(Path(output), drawn)
        return {"schema": SCHEMA, "kinds": dict(KINDS), "datasets": [drawn.to_mapping()], "difference": None}
    paths = [folder] if other is None else [folder, other]
    found = [examine(read(path, limit=images, workers=workers, progress=progress)) for path in paths]
    moved = shifts(found[0].contents, found[1].contents) if other is not None else []
    data = {
        "schema": SCHEMA,
        "kinds": dict(KINDS),
        "datasets": [one.to_mapping() for one in found],
        "difference": _difference(found, moved) if other is not None else None,
    }
    if output is not None:
        from .page import write  # matplotlib loads slowly

        write(Path(output), found, moved)
    return data


def examine(contents: Contents) -> Inspection:
    """Find out all about what was read of one dataset; faults of several images are added to `contents`."""
    splits = split_of_subjects(contents)
    shared = _shared(contents, splits)
    _same_frames(contents)
    equal = equal_pictures(contents.digests)
    for group in equal:
        for at in group[1:]:
            contents.add(at, Fault("same picture", f"as {contents.names[group[0]]}"))
    near = near_duplicates(contents.thumbnails, contents.digests)
    for pair in near:
        contents.add(pair.second, Fault("near-duplicate", f"of {contents.names[pair.first]}: {pair.correlation:.5f}"))
    distributions = {name: distribution(name, contents.columns[name]) for name in sorted(contents.columns)}
    varying = [name for name, d in distributions.items() if len(d.counts)]
    values = matrix(contents, varying) if varying else np.zeros((len(contents), 0))
    return Inspection(
        contents=contents,
        splits=splits,
        shared=shared,
        equal=equal,
        near=near,
        outliers=outliers(values, varying),
        worst=worst_pictures(contents),
        distributions=distributions,
        missing=missing_labels(contents),
        shares=shares_of(contents),
        dependences=dependences_of(contents),
    )


def _shared(contents: Contents, splits: Mapping[str, tuple[int, set[int]]]) -> dict[int, list[str]]:
    """Subjects that are in more than one split; the first image of each is at fault."""
    places: dict[int, list[str]] = defaultdict(list)
    for name, (_, subjects) in splits.items():
        for subject in subjects:
            places[subject].append(name)
    shared = {subject: names for subject, names in sorted(places.items()) if len(names) > 1}
    for subject, names in shared.items():
        own = np.flatnonzero(contents.subjects == subject)
        if len(own):
            contents.add(int(own[0]), Fault("subject in two splits", f"subject {subject}: {', '.join(names)}"))
    return shared


def _same_frames(contents: Contents) -> None:
    """Note lines that name a frame, or a file, that another line has."""
    files: dict[str, int] = {}
    frames: dict[tuple[Any, ...], int] = {}
    cameras, eyes = (contents.groups.get(name, [None] * len(contents)) for name in ("camera", "eye"))
    for at, name in enumerate(contents.names):
        if not name:
            continue
        first = files.setdefault(name, at)
        frame = (int(contents.frames[at]), cameras[at], eyes[at])
        twin = frames.setdefault(frame, at) if frame[0] >= 0 else at
        if first != at:
            contents.add(at, Fault("same frame", f"its file is that of line {int(contents.rows[first]) + 1}"))
        elif twin != at:
            contents.add(at, Fault("same frame", f"frame {frame[0]}, as {contents.names[twin]}"))


def _difference(found: Sequence[Inspection], moved: Sequence[Shift]) -> dict[str, Any]:
    first, second = (one.contents for one in found)
    return {
        "by": "subjects" if has_subjects(first) and has_subjects(second) else "images",
        "columns": [asdict(shift) for shift in moved],
        "groups": [{"group": name, "distance": d, "shares": rows} for name, d, rows in shares(first, second)],
        "only_in_first": only_in(first, second),
        "only_in_second": only_in(second, first),
    }
