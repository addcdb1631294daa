"""Read tables (CSV) of pupils, glints and targets as observations.

A row is one eye in one frame, or both eyes of a frame (with columns of the right and of the left eye), or one glint
(with a column `light`). `CsvColumns` states the meaning of the columns.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Ints, Objects, frozen
from ..base.errors import InputError, Problems
from ..base.status import Status
from ..base.storage.files import csv_text, read_text, shown
from ..rig.light import MAX_LIGHTS
from ..rig.rig import RigGeometry, RigLike
from ..rig.screen import ScreenPlane
from ..scene.observation import (
    EYES,
    MAX_GLINTS,
    GlintFeatures,
    Index,
    Observations,
    PoseTruth,
    PupilFeatures,
    count_heads,
)
from .columns import CsvColumns, EyeColumns, completed

# A table in memory, as text and numbers, takes some 20 times its size in the file. A million rows are half an hour at
# 600 Hz.
MAX_TABLE_BYTES, MAX_COLUMNS, MAX_ROWS = 64 * 2**20, 1000, 1_000_000
# Larger numbers could not be squared.
_LARGEST = 1e30
_OF_TARGETS = ("time", "frame", "target", "target_unit", "target_origin", "screen_px", "delimiter")
_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "-"))
_EYE_WORDS = {
    **dict.fromkeys(("right", "r", "od", "0", "0.0", "eye0"), "right"),
    **dict.fromkeys(("left", "l", "os", "1", "1.0", "eye1"), "left"),
}


def observations_from_csv(
    path: str | Path, columns: str | Path | Mapping[str, Any] | CsvColumns | None = None, rig: RigLike | None = None
) -> Observations:
    """Read a table of pupils, glints and targets.

    >>> seen = er.gaze.observations_from_csv("recording.csv", rig=rig)  # doctest: +SKIP

    Args:
        path: the table (CSV with a header; commas, semicolons or tabs). An empty cell is a missing value.
        columns: meaning of columns that are not recognised by name: `CsvColumns`, a mapping of its keys or its YAML
            file.
        rig: the rig; needed for targets on its screen.

    Returns:
        The observations in frame order, the right eye first.

    Raises:
        InputError: naming the wrong lines and columns.
    """
    table, named = _opened(path, columns)
    return _observations(table, named, None if rig is None else rig.build())


def _opened(
    path: str | Path, columns: str | Path | Mapping[str, Any] | CsvColumns | None, *, of_targets: bool = False
) -> tuple[_Table, CsvColumns]:
    """Read a table, and complete the meaning of its columns by their names.

    A table of targets shares the file of columns with a recording, so it need not have the columns of that.
    """
    if columns is None:
        given = CsvColumns()
    elif isinstance(columns, CsvColumns):
        given = columns
    else:
        given = CsvColumns.load(columns) if isinstance(columns, str | Path) else CsvColumns.from_mapping(columns)
    source = str(columns) if isinstance(columns, str | Path) else "columns"
    table = _Table.read(path, given.delimiter)
    if of_targets:
        there = {*table.header, None}
        own = {key: value for key, value in given.to_mapping().items() if key in _OF_TARGETS}
        missing = [key for key in ("time", "frame") if own.get(key) not in there]
        missing += [] if there.issuperset(own.get("target", ())) else ["target"]
        given = CsvColumns.from_mapping({key: value for key, value in own.items() if key not in missing})
    table.choose_method(given.method)
    return table, completed(given, table.header, source, table.problems)


@dataclass
class _Table:
    """Cells of a table by column name, with the problems found so far."""

    source: str
    header: list[str]
    cells: dict[str, list[str]]
    lines: list[int]
    decimal_comma: bool
    problems: Problems

    @classmethod
    def read(cls, path: str | Path, delimiter: str | None) -> _Table:
        source = str(path)
        text = read_text(path, limit=MAX_TABLE_BYTES).removeprefix("\ufeff")
        delimiter = delimiter or max(",;\t", key=text.split("\n", 1)[0].count)
        problems = Problems(source)
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        rows: list[list[str]] = []
        lines: list[int] = []
        try:
            header = [name.strip() for name in next(reader, [])]
            if not any(header) or len(header) > MAX_COLUMNS:
                raise InputError(f"must be a header of 1 to {MAX_COLUMNS} columns", source=source, path="line 1")
            for row in filter(any, reader):
                if len(row) != len(header):
                    problems.add(f"has {len(row)} cells; the header has {len(header)}", f"line {reader.line_num}")
                if len(rows) == MAX_ROWS:
                    raise InputError(f"holds more than {MAX_ROWS} rows", source=source)
                rows.append(row)
                lines.append(reader.line_num)
        except csv.Error as error:
            raise InputError(f"is not valid CSV: {error}", source=source, path=f"line {reader.line_num}") from None
        again = sorted(name for name in set(header) if header.count(name) > 1)
        if again:
            problems.add(f"the column {shown(again[0])} appears twice", "line 1")
        if not rows:
            problems.add("holds no rows")
        problems.check()
        cells = {name: [row[k] for row in rows] for k, name in enumerate(header)}
        return cls(source, header, cells, lines, delimiter == ";", problems)

    def __len__(self) -> int:
        return len(self.lines)

    def choose_method(self, wanted: str | None) -> None:
        """Keep the rows of one detector, if a column `method` names several, as Pupil Labs' exports do."""
        column = next((name for name in self.header if name.lower() == "method"), None)
        words = [cell.strip() for cell in self.cells[column]] if column else []
        named = shown(", ".join(sorted(set(words))), 150)
        kept = [k for k, word in enumerate(words) if wanted is None or word.lower().startswith(wanted.lower())]
        if words and not kept:
            raise InputError(f"has no rows of the method {shown(wanted)}, but of {named}", source=self.source)
        if len({words[k] for k in kept}) > 1:
            reason = f"has rows of several detectors ({named}); choose one with 'method' in --columns"
            raise InputError(reason, source=self.source)
        if kept:
            self.lines = [self.lines[k] for k in kept]
            self.cells = {name: [cells[k] for k in kept] for name, cells in self.cells.items()}

    def refuse(self, row: int, column: str, reason: str) -> None:
        self.problems.add(reason, f"line {self.lines[row]}.{column}")

    def numbers(self, column: str | None) -> Floats:
        """Return a column as numbers (n,), NaN where a cell is empty or the column is missing."""
        out = np.full(len(self), np.nan)
        for k, cell in enumerate(self.cells[column] if column else ()):
            word = cell.strip()
            if word.lower() in _MISSING:
                continue
            try:
                value = float(word.replace(",", ".") if self.decimal_comma else word)
            except ValueError:
                value = np.inf
            if abs(value) <= _LARGEST:
                out[k] = value
            else:
                self.refuse(k, str(column), f"must be a number or empty, not {shown(cell)}")
        return out

    def several(self, columns: tuple[str, ...] | None, count: int) -> Floats:
        """Return columns that belong together as (n, count); each row must give all of them or none."""
        if columns is None:
            return np.full((len(self), count), np.nan)
        known = len(self.problems)
        out = np.stack([self.numbers(column) for column in columns], axis=-1)
        some = np.isnan(out).any(axis=1) & ~np.isnan(out).all(axis=1)
        if len(self.problems) == known:
            for k in np.flatnonzero(some).tolist():
                empty = columns[int(np.isnan(out[k]).argmax())]
                self.refuse(k, empty, f"is empty, but {', '.join(c for c in columns if c != empty)} is not")
        return out

    def counts(self, column: str | None, unknown: int, limit: int = 2**31 - 1) -> Ints:
        """Return a column of whole numbers (n,), `unknown` where a cell is empty or the column is missing."""
        found = self.numbers(column)
        empty = np.isnan(found)
        bad = ~empty & ~((found >= 0) & (found <= limit) & (found == np.floor(found)))
        for k in np.flatnonzero(bad).tolist():
            self.refuse(k, str(column), f"must be a whole number from 0 to {limit}, not {found[k]:g}")
        return np.where(empty | bad, unknown, np.where(bad, 0, found)).astype(np.int64)

    def eyes(self, column: str | None, words: Mapping[str, str]) -> Ints:
        """Return a column of eyes (n,): 0 right, 1 left, -1 where a cell is empty or the column is missing."""
        out = np.full(len(self), -1, np.int64)
        meanings = {**_EYE_WORDS, **{word.strip().lower(): side for word, side in words.items()}}
        for k, cell in enumerate(self.cells[column] if column else ()):
            word = cell.strip().lower()
            if word in meanings:
                out[k] = EYES.index(meanings[word])
            elif word not in _MISSING:
                self.refuse(k, str(column), f"must be right or left, not {shown(cell)}; say in 'eyes' what it means")
        return out


def _observations(table: _Table, columns: CsvColumns, rig: RigGeometry | None) -> Observations:
    parts = _parts(table, columns)
    eye = np.concatenate([eye for _, eye in parts])
    # One entry for each part of each row.
    line = np.tile(np.arange(len(table)), len(parts))
    frame, camera = _frames(table, columns, eye)[line], _cameras(table, columns, eye, rig)
    fixation, light = table.counts(columns.fixation, -1)[line], table.counts(columns.light, -1, MAX_LIGHTS - 1)[line]
    width = max(len(part.glints or ()) for part, _ in parts)
    if len(line) * width > MAX_GLINTS:
        raise InputError(f"holds more than {MAX_GLINTS} glints", source=table.source)
    features = [
        _features(table, part, columns, width, _to_pixels(table, part, columns, rig, one))
        for (part, _), one in zip(parts, np.split(camera, len(parts)), strict=True)
    ]
    values = {key: np.concatenate([part[key] for part in features]) for key in features[0]}
    values["target"] = _targets(table, columns, None if rig is None else rig.screen)[line]
    table.problems.check()

    # One observation for each eye of each frame, in order; the right eye comes first.
    keys = np.stack([frame, camera, eye], axis=1)
    rows, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    lights = np.broadcast_to(np.arange(width), (len(rows), width))
    if columns.light is None:
        _refuse_repeats(table, keys, line, first[which])
        found = {key: value[first] for key, value in values.items()}
    else:
        glints, lights = _listed_glints(table, columns.light, values.pop("glints"), light, which, len(rows))
        found = {key: _merged(table, key, value, which, len(rows)) for key, value in values.items()}
        found["glints"] = glints
    table.problems.check()

    numbers = fixation[first]
    if columns.fixation is None:
        there = np.isfinite(found["target"]).all(axis=1)
        numbers = np.full(len(rows), -1, np.int64)
        numbers[there] = count_heads(found["target"][there])
    position, head = _places(found["position"], rows[:, 0], rows[:, 2], columns)
    seen: Bools = np.asarray(np.isfinite(found["glints"]).all(axis=2))
    return Observations(
        index=Index(
            frame=rows[:, 0],
            fixation=numbers,
            camera=rows[:, 1],
            head=np.zeros(len(rows), np.int64),
            eye=rows[:, 2],
            time_s=_times(table, columns)[line][first],
            target_mm=found["target"],
            head_mm=head,
            eye_position_mm=position,
        ),
        pose=PoseTruth(azimuth_rad=np.full(len(rows), np.nan)),
        pupil=_pupil(found, columns),
        glints=GlintFeatures(
            status=np.where(seen, Status.OK, Status.NOT_FOUND).astype(np.int8),
            light=lights,
            reason=_reasons(seen),
            in_image=seen,
            xy_px=np.where(seen[..., None], found["glints"], np.nan),
        ),
    )


def _cameras(table: _Table, columns: CsvColumns, eye: Ints, rig: RigGeometry | None) -> Ints:
    """Return the camera of each entry (n,): as its column says, or the one that sees its eye, as in headsets."""
    camera = np.resize(table.counts(columns.camera, 0), len(eye))
    if rig is not None and columns.camera is None:
        for k, side in enumerate(EYES):
            seeing = [c for c, one in enumerate(rig.cameras) if one.sees(side)]
            camera[eye == k] = seeing[0] if len(seeing) == 1 else 0
    return camera


def _refuse_repeats(table: _Table, keys: Ints, line: Ints, first: Ints) -> None:
    """Report entries (n,) with the frame, camera and eye of an earlier one, the `first` of their kind."""
    for k in np.flatnonzero(first != np.arange(len(line))).tolist():
        frame, _, eye = keys[k]
        named = f"frame {frame}" + (f", {EYES[eye]} eye," if eye >= 0 else "")
        table.problems.add(f"{named} is in line {table.lines[line[first[k]]]} already", f"line {table.lines[line[k]]}")


def _parts(table: _Table, columns: CsvColumns) -> list[tuple[EyeColumns, Ints]]:
    """Return the columns of each eye, and the eye of each row."""
    sides = [(getattr(columns, side), k) for k, side in enumerate(EYES) if getattr(columns, side) is not None]
    parts = [(part, np.full(len(table), k, np.int64)) for part, k in sides]
    if parts and columns.light is not None:
        raise InputError("a row holds one glint (light) or both eyes (right, left), not both", source=table.source)
    if not parts:
        parts = [(columns, table.eyes(columns.eye, columns.eyes))]
    if all(part.pupil is None and not part.glints for part, _ in parts):
        raise InputError(
            "has no column of a pupil or a glint (pupil_x and pupil_y, glint0_x and glint0_y, ...); say with --columns "
            f"what {shown(', '.join(table.header), 150)} are",
            source=table.source,
        )
    return parts


def _frames(table: _Table, columns: CsvColumns, eye: Ints) -> Ints:
    """Return the frame number of each row."""
    named = columns.frame or columns.time
    for k, cell in enumerate(table.cells[named] if named else ()):
        if cell.strip().lower() in _MISSING:
            table.refuse(k, str(named), "is empty")
    if columns.frame is not None:
        return table.counts(columns.frame, -1)
    if columns.time is not None:
        times: dict[str, int] = {}
        found = [times.setdefault(cell.strip(), len(times)) for cell in table.cells[columns.time]]
        return np.array(found, np.int64)
    if columns.light is not None or (columns.right is None and columns.left is None and len(np.unique(eye)) > 1):
        raise InputError("needs a column frame or time, which says what rows are one frame", source=table.source)
    return np.arange(len(table))


def _features(
    table: _Table, part: EyeColumns, columns: CsvColumns, width: int, to_pixels: tuple[Floats, Floats]
) -> dict[str, Floats]:
    """Return one eye's numbers in each row: pupil centre (n, 2), axes and angle (n, 3), glints (n, width, 2), ..."""
    shape = np.full((len(table), 3), np.nan)
    if part.pupil_axes is not None:
        semi = columns.axes == "semi" or (columns.axes is None and "semi" in part.pupil_axes[0].lower())
        shape[:, :2] = table.several(part.pupil_axes, 2) * (1.0 if semi else 0.5)
        named = part.pupil_angle is not None and re.search(r"(?i)[^a-z]rad", part.pupil_angle) is not None
        angle = table.numbers(part.pupil_angle)
        shape[:, 2] = (
            angle if columns.angle_unit == "rad" or (columns.angle_unit is None and named) else np.radians(angle)
        )
    elif part.pupil_diameter is not None:
        shape[:, :2] = table.numbers(part.pupil_diameter)[:, None] / 2
    if part.pupil_axes is not None or part.pupil_diameter is not None:
        for k in np.flatnonzero((shape[:, :2] < 0).any(axis=1)).tolist():
            table.refuse(k, part.pupil_diameter or ", ".join(part.pupil_axes or ()), "must be > 0")
        shape[(shape[:, :2] == 0).any(axis=1)] = np.nan
    scale, shift = to_pixels
    glints = np.full((len(table), width, 2), np.nan)
    for k, pair in enumerate(part.glints or ()):
        glints[:, k] = table.several(pair, 2) * scale + shift
    return {
        "pupil": table.several(part.pupil, 2) * scale + shift,
        "shape": shape,
        "glints": glints,
        # Rows of single glints may each repeat a confidence of their own.
        "confidence": table.numbers(
            part.confidence if columns.light is None or columns.min_confidence is not None else None
        ),
        "position": table.several(part.eye_position, 3),
    }


def _to_pixels(
    table: _Table, part: EyeColumns, columns: CsvColumns, rig: RigGeometry | None, camera: Ints
) -> tuple[Floats, Floats]:
    """Return scale and shift (n, 2) that convert the places of features in a table to pixels."""
    is_share = (columns.pupil_unit or _unit_of((part.pupil or ("",))[0])) == "fraction"
    is_up = columns.pupil_origin == "bottom-left"
    if rig is None and (is_share or is_up):
        table.problems.add("pupils as fractions, or from the bottom left, need a rig", ", ".join(part.pupil or ()))
    sizes = np.array([(1, 1)] if rig is None else [one.resolution_px for one in rig.cameras])
    size = sizes[camera % len(sizes)].astype(float)
    scale = size.copy() if is_share else np.ones_like(size)
    shift = np.zeros_like(size) - (0.5 if is_share else 0.0)  # the centre of the first pixel is at 0
    if is_up:
        scale[:, 1], shift[:, 1] = -scale[:, 1], size[:, 1] - 1.0 - shift[:, 1]
    return scale, shift + columns.offset_px


def _unit_of(name: str) -> str | None:
    """Return the unit that the name of a column ends with."""
    said = re.search(r"(?i)[^a-z](px|pixels?|mm|norm|fraction|normali[sz]ed|deg|degrees)[^a-z]*$", name)
    return {"p": "px", "m": "mm", "d": "deg"}.get(said[1][0].lower(), "fraction") if said else None


def _targets(table: _Table, columns: CsvColumns, screen: ScreenPlane | None) -> Floats:
    """Return the target of each row (n, 3) mm in the world, NaN where there is none."""
    names = columns.target
    if names is None:
        return np.full((len(table), 3), np.nan)
    found = table.several(names, len(names))
    if len(names) == 3:
        return found
    unit = columns.target_unit or _unit_of(names[0])
    problem = None
    if unit is None:
        problem = "the unit is not known; say 'target_unit' (mm, px, deg, ...) in --columns, or add _mm or _px"
    elif screen is None:
        problem = "targets on the screen need a rig with a screen"
    elif unit == "px" and columns.screen_px is None:
        problem = "targets in px need the screen's size in px: --screen-px, or 'screen_px' in --columns"
    elif unit == "fraction" and columns.target_unit is None and (found < -0.2).any():
        problem = "holds negative numbers; say 'target_unit': norm (-1 to 1 from the centre), or fraction"
    if problem is not None or unit is None or screen is None:
        table.problems.add(str(problem), ", ".join(names))
        return np.full((len(table), 3), np.nan)
    size = np.array(screen.size_mm)
    shares = {"fraction": size, "norm": size / 2, "height": size[1], "px": size / np.array(columns.screen_px or (1, 1))}
    origin = columns.target_origin or ("top-left" if unit in ("px", "fraction") else "centre")
    # Degrees are those at the world's origin, between the eyes, or at the eyes that keep still.
    eye = np.mean(list(columns.eye_position_mm.values()) or [(0.0, 0.0, 0.0)], axis=0)
    at = np.tan(np.radians(found)) * abs((eye - screen.centre_mm) @ screen.normal) if unit == "deg" else found
    at = at * shares.get(unit, 1.0)
    if origin != "centre":
        at = at - size / 2
    if origin == "top-left":
        at[:, 1] *= -1
    return screen.world(at)


def _listed_glints(
    table: _Table, column: str, glints: Floats, light: Ints, which: Ints, count: int
) -> tuple[Floats, Ints]:
    """Return glints (count, lights, 2) and their lights, from rows that hold one glint each."""
    here = np.isfinite(glints[:, 0]).all(axis=1) if glints.shape[1] else np.zeros(len(light), bool)
    for k in np.flatnonzero(here & (light < 0)).tolist():
        table.refuse(k, column, "is empty, but the row holds a glint")
    lights = np.unique(light[light >= 0])
    if count * len(lights) > MAX_GLINTS:
        raise InputError(f"holds more than {MAX_GLINTS} glints", source=table.source)
    out = np.full((count, len(lights), 2), np.nan)
    for k in np.flatnonzero(here & (light >= 0)).tolist():
        at = which[k], np.searchsorted(lights, light[k])
        if np.isfinite(out[at]).all():
            table.refuse(k, column, f"light {light[k]} has a glint in this frame already")
        out[at] = glints[k, 0]
    return out, np.broadcast_to(lights, (count, len(lights)))


def _merged(table: _Table, key: str, values: Floats, which: Ints, count: int) -> Floats:
    """Merge the rows of each observation: use the first row that has values; later rows must agree."""
    out = np.full((count, *values.shape[1:]), np.nan)
    there = np.nonzero(np.isfinite(values))
    backwards = tuple(axis[::-1] for axis in there)  # assigned in reverse order, so that the first row wins
    out[(which[backwards[0]], *backwards[1:])] = values[backwards]
    other = np.isfinite(values) & (values != out[which])
    for k in np.flatnonzero(other.reshape(len(values), -1).any(axis=1)).tolist():
        table.problems.add(f"the {key} differs from another row of the same frame and eye", f"line {table.lines[k]}")
    return out


def _places(position: Floats, frame: Ints, eye: Ints, columns: CsvColumns) -> tuple[Floats, Floats]:
    """Return the eye's position relative to its head, and the head's: midway between the eyes if known, else 0."""
    position = position.copy()
    for side, place in columns.eye_position_mm.items():
        position[(eye == EYES.index(side)) & np.isnan(position).any(axis=1)] = place
    if len(columns.eye_position_mm) == 1:
        position[(eye < 0) & np.isnan(position).any(axis=1)] = next(iter(columns.eye_position_mm.values()))
    head = np.where(np.isnan(position), np.nan, 0.0)
    _, which = np.unique(frame, return_inverse=True)
    middle = np.zeros((int(which.max()) + 1, 2, 3))
    middle[:] = np.nan
    known = eye >= 0
    middle[which[known], eye[known]] = position[known]
    middle = middle.mean(axis=1)[which]
    head = np.where(np.isfinite(middle).all(axis=1)[:, None] & known[:, None], middle, head)
    return position - head, head


def _reasons(found: Bools) -> Objects:
    """Return why features are missing; None where they were found."""
    reason = np.full(found.shape, None, dtype=object)
    reason[~found] = Status.NOT_FOUND.reason
    return reason


def _pupil(found: dict[str, Floats], columns: CsvColumns) -> PupilFeatures:
    centre, shape = found["pupil"], found["shape"].copy()
    # The larger axis comes first; its angle is in [0, pi).
    turned = shape[:, 1] > shape[:, 0]
    shape[turned] = np.stack([shape[turned, 1], shape[turned, 0], shape[turned, 2] + np.pi / 2], axis=-1)
    ok: Bools = np.asarray(np.isfinite(centre).all(axis=1))
    reason = _reasons(ok)
    if columns.min_confidence is not None:
        unsure: Bools = ok & ~(found["confidence"] >= columns.min_confidence)
        for k in np.flatnonzero(unsure):
            reason[k] = f"{Status.NOT_FOUND.reason} (confidence below {columns.min_confidence:g})"
        ok = np.asarray(ok & ~unsure)
    return PupilFeatures(
        status=np.where(ok, Status.OK, Status.NOT_FOUND).astype(np.int8),
        reason=reason,
        in_image=ok,
        centre_px=np.where(ok[:, None], centre, np.nan),
        semi_axes_px=np.where(ok[:, None], shape[:, :2], np.nan),
        angle_rad=np.where(ok, shape[:, 2] % np.pi, np.nan),
        confidence=found["confidence"],
    )


def _times(table: _Table, columns: CsvColumns) -> Floats:
    """Return the time of each row (n,); NaN where the column holds something else than numbers."""
    out = np.full(len(table), np.nan)
    for k, cell in enumerate(table.cells[columns.time] if columns.time else ()):
        with suppress(ValueError):
            value = float(cell.strip().replace(",", ".") if table.decimal_comma else cell)
            out[k] = value if abs(value) <= _LARGEST else np.nan
    return out


def read_targets(
    path: str | Path, columns: str | Path | Mapping[str, Any] | CsvColumns | None, rig: RigLike
) -> tuple[str, Floats, Floats]:
    """Read a table of targets.

    Returns "frame" or "time", the frames or times (n,), and the targets (n, 3) mm, NaN where a row names none. Raises
    InputError, naming the wrong lines and columns.
    """
    table, named = _opened(path, columns, of_targets=True)
    if named.target is None:
        raise InputError("has no target (target_x, target_y, target_z in mm; or target_x_mm, ...)", source=table.source)
    kind = "frame" if named.frame is not None else "time"
    key = named.frame or named.time
    if key is None:
        raise InputError("needs a column frame or time", source=table.source)
    keys, target = table.numbers(key), _targets(table, named, rig.build().screen)
    for k in np.flatnonzero(np.isnan(keys)).tolist():
        table.refuse(k, key, "is empty")
    table.problems.check()
    return kind, keys, target


def with_targets(
    observations: Observations,
    path: str | Path,
    columns: str | Path | Mapping[str, Any] | CsvColumns | None,
    rig: RigLike,
) -> Observations:
    """Give observations the targets of a table.

    A row of the table with a `frame` belongs to this frame. A row with a `time` holds until that of the next row; a row
    without a target ends the one before. Equal targets are one fixation. Raises InputError if the table is wrong, the
    observations have no times, or no row fits.
    """
    kind, keys, target = read_targets(path, columns, rig)
    order = np.argsort(keys, kind="stable")
    keys, target = keys[order], target[order]
    mine = observations.index.frame.astype(float) if kind == "frame" else observations.index.time_s
    if np.isnan(mine).all():
        raise InputError("holds times, but the observations have none; give frames", source=str(path))
    # A time that is rounded up still belongs to its frame.
    steps = np.diff(np.unique(mine[np.isfinite(mine)]))
    slack = 0.0 if kind == "frame" or not len(steps) else float(np.median(steps)) / 2
    at = np.searchsorted(keys, mine + slack, side="right") - 1
    fits = (at >= 0) & np.isfinite(mine) & ((kind == "time") | (keys[np.maximum(at, 0)] == mine))
    found = np.where(fits[:, None], target[np.maximum(at, 0)], np.nan)
    there = np.isfinite(found).all(axis=1)
    if not there.any():
        raise InputError(f"no {kind} of it is one of the observations'", source=str(path))
    fixation = np.full(len(mine), -1, np.int64)
    fixation[there] = count_heads(found[there])
    index = replace(observations.index, fixation=fixation, target_mm=frozen(found))
    return replace(observations, index=index)


def features_csv(observations: Observations, lights: int | None) -> str:
    """Format observations as a table that `observations_from_csv` reads (docs/own_data.md).

    `lights` is the number of lights of the rig. None: glints of unknown lights are written as `spot0_x`, ..., which are
    not read as glints of lights.
    """
    index, pupil, glints = observations.index, observations.pupil, observations.glints
    several = bool((index.camera > 0).any())
    count = glints.status.shape[1] if lights is None else lights
    name = "spot" if lights is None else "glint"
    header = ["frame", "time", *(["camera"] if several else []), "eye", "pupil_x", "pupil_y", "pupil_semi_axis_a"]
    header += ["pupil_semi_axis_b", "pupil_angle_rad", "confidence"]
    header += [f"{name}{k}_{axis}" for k in range(count) for axis in "xy"]
    if lights is None:
        places = np.where(glints.ok[..., None], glints.xy_px, np.nan)
    else:
        places = np.stack([glints.of_light(k)[0] for k in range(lights)], axis=1).reshape(len(index), -1, 2)
    numbers = np.column_stack(
        [pupil.centre_px, pupil.semi_axes_px, pupil.angle_rad, pupil.confidence, places.reshape(len(index), -1)]
    )
    rows = []
    for k, row in enumerate(numbers.tolist()):
        time = index.time_s[k].item()
        who = ["" if math.isnan(time) else time, *([int(index.camera[k])] if several else [])]
        side = EYES[index.eye[k]] if index.eye[k] >= 0 else ""
        rows.append([int(index.frame[k]), *who, side, *("" if math.isnan(v) else f"{v:.9g}" for v in row)])
    return csv_text(header, rows)
