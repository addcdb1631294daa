"""Read measured points of a cornea (tables of topographers and OCT, and meshes) and fit the grid of an eye file.

Files are not trusted: file size, number of points and magnitudes are limited, and each problem is one line.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.spec import read_yaml
from ..base.storage.files import read_bytes, read_text, shown
from ..optics.ply import plain_ply
from ..optics.topography import smooth_heights
from .parts import MAX_NODES, GridSpec, TopographySpec

MAX_FILE_BYTES, MAX_POINTS, MIN_POINTS = 64 * 2**20, 200_000, 50
"""Limits of a file; the fit needs sixteen numbers per point."""
_MM = {"mm": 1.0, "um": 1e-3, "m": 1e3}
_FARTHEST_MM = 30.0
_SECTORS = 36
_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "-"))


def read_topography(spec: TopographySpec, folder: str | Path = ".") -> GridSpec:
    """Fit a grid to measured points of a cornea.

    The grid ends where the points end: its half width is the largest radius up to which there are points in every
    direction.

    Args:
        spec: the file, its axes and units.
        folder: folder to which the file's path is relative.

    Raises:
        InputError: the file cannot be read, or its points are no surface about the axis.
    """
    path = Path(folder) / spec.path
    source = str(path)
    if spec.layout == "mesh":
        points = _mesh(path)
    elif spec.layout == "matrix":
        points = _matrix(_rows(path), source)
    else:
        points = _columns(_rows(path), spec, source)
    if spec.layout == "polar":
        radius, angle = points[:, 0], np.radians(points[:, 1])
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), points[:, 2]])
    scale = _MM[spec.unit]
    depth = -1.0 if spec.z == "in" else 1.0
    y = scale * (points[:, 0] - spec.centre[0]) * (1.0 if spec.x == "nasal" else -1.0)
    z = scale * (points[:, 1] - spec.centre[1]) * (1.0 if spec.y == "up" else -1.0)
    x = depth * _MM[spec.z_unit or spec.unit] * points[:, 2]
    near = np.hypot(y, z) <= _FARTHEST_MM
    if not near.any() or np.ptp(x[near]) > _FARTHEST_MM:
        raise InputError(f"its points do not lie within {_FARTHEST_MM:g} mm; are unit and centre right?", source=source)
    half = _reach(y[near], z[near])
    count = int(half / spec.spacing_mm)
    if count < 2:
        raise InputError(
            f"its points surround the axis to {half:.3g} mm only; are unit and centre right?", source=source
        )
    if 2 * count + 1 > MAX_NODES:
        reason = f"needs a grid of more than {MAX_NODES} nodes in a row; give a larger 'spacing_mm'"
        raise InputError(reason, source=source)
    half = count * spec.spacing_mm
    # Points outside the square have no influence.
    inside = near & (np.maximum(np.abs(y), np.abs(z)) <= half)
    if np.count_nonzero(inside) < MIN_POINTS:
        raise InputError(f"has fewer than {MIN_POINTS} points within {half:.3g} mm of the axis", source=source)
    heights = smooth_heights(
        y[inside], z[inside], x[inside], half_mm=half, spacing_mm=spec.spacing_mm, smoothing=spec.smoothing
    )
    heights = heights - heights[count, count]
    # A hundredth of a nanometre is far below any measurement, and keeps the file short.
    rows = tuple(tuple(float(v) for v in row) for row in np.round(heights.T, 8))
    return GridSpec(kind="grid", spacing_mm=spec.spacing_mm, heights_mm=rows)


def topography_files(path: str | Path) -> tuple[str, ...]:
    """Return the files of measured points that an eye file names, relative to its folder; InputError if unreadable."""
    found: list[str] = []

    def walk(node: Any) -> None:
        if isinstance(node, Mapping):
            file = node.get("file")
            if node.get("kind") == "grid" and isinstance(file, Mapping) and isinstance(file.get("path"), str):
                found.append(file["path"])
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(read_yaml(path))
    return tuple(found)


def with_topographies(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Replace the files that the shapes of an eye file name by fitted grids; InputError names the wrong key or file."""

    def walk(node: Any, path: str) -> Any:
        if isinstance(node, Mapping):
            if node.get("kind") == "grid" and isinstance(node.get("file"), Mapping):
                return _fitted(node, path, folder)
            return {key: walk(value, f"{path}.{key}".lstrip(".")) for key, value in node.items()}
        if isinstance(node, list):
            return [walk(value, f"{path}.{k}".lstrip(".")) for k, value in enumerate(node)]
        return node

    return {key: walk(value, str(key)) for key, value in data.items()}


def _fitted(node: Mapping[str, Any], path: str, folder: Path) -> dict[str, Any]:
    for key in ("heights_mm", "spacing_mm"):
        if node.get(key) is not None:
            raise InputError("cannot be combined with 'file'", path=f"{path}.{key}")
    try:
        spec = TopographySpec.from_mapping(node["file"])
    except InputError as error:
        raise error.placed(under=f"{path}.file") from None
    try:
        grid = read_topography(spec, folder)
    except InputError as error:
        where = ": ".join(part for part in (Path(error.source).name, error.path, error.reason) if part)
        raise InputError(where, path=f"{path}.file.path") from None
    return {**{key: value for key, value in node.items() if key != "file"}, **grid.to_mapping()}


def _rows(path: Path) -> list[list[str]]:
    """Yield the cells of a table, row by row."""
    text = read_text(path, limit=MAX_FILE_BYTES).lstrip("\ufeff")
    delimiter = max(",;\t", key=text.split("\n", 1)[0].count)
    rows: list[list[str]] = []
    try:
        for row in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter):
            if any(cell.strip() for cell in row):
                rows.append([cell.strip() for cell in row])
            if len(rows) > MAX_POINTS + 1:
                raise InputError(f"holds more than {MAX_POINTS} rows", source=str(path))
    except csv.Error as error:
        raise InputError(f"is not valid CSV: {error}", source=str(path)) from None
    if not rows:
        raise InputError("is empty", source=str(path))
    return rows


def _columns(rows: list[list[str]], spec: TopographySpec, source: str) -> Floats:
    """Read three columns of a table as points (n, 3); rows with an empty cell are left out."""
    wanted = (0, 1, 2) if spec.columns is None else spec.columns
    header = rows[0] if any(isinstance(name, str) for name in wanted) else None
    places = []
    for name in wanted:
        if isinstance(name, int):
            places.append(name)
        elif header is None or name not in header:
            raise InputError(f"has no column {shown(name)}", source=source, path="line 1")
        else:
            places.append(header.index(name))
    out = []
    for number, row in enumerate(rows[1:] if header is not None else rows, start=1 if header is None else 2):
        if not all(0 <= place < len(row) for place in places):
            raise InputError(f"has {len(row)} cells", source=source, path=f"row {number}")
        cells = [row[place] for place in places]
        if all(cell.lower() not in _MISSING for cell in cells):
            out.append([_number(cell, source, number) for cell in cells])
    return np.reshape(out, (-1, 3))


def _matrix(rows: list[list[str]], source: str) -> Floats:
    """Read a matrix of z, with x in its first row and y in its first column, as points (n, 3)."""
    across = [_number(cell, source, 1) for cell in rows[0][1:]]
    out = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(across) + 1:
            reason = f"has {len(row)} cells; the first row has {len(across) + 1}"
            raise InputError(reason, source=source, path=f"row {number}")
        up = _number(row[0], source, number)
        cells = zip(across, row[1:], strict=True)
        out += [(x, up, _number(cell, source, number)) for x, cell in cells if cell.lower() not in _MISSING]
        if len(out) > MAX_POINTS:
            raise InputError(f"holds more than {MAX_POINTS} points", source=source)
    return np.reshape(out, (-1, 3))


def _number(cell: str, source: str, row: int) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise InputError(f"{shown(cell)} is not a number", source=source, path=f"row {row}") from None
    if not abs(value) <= 1e9:
        raise InputError(f"{shown(cell)} is not a number within 1e9", source=source, path=f"row {row}")
    return value


def _mesh(path: Path) -> Floats:
    """Read the vertices of a PLY file, (n, 3)."""
    import trimesh  # its import takes a quarter of a second

    data = plain_ply(read_bytes(path, limit=MAX_FILE_BYTES), source=str(path))
    try:
        loaded: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
        points = np.asarray(loaded.vertices, dtype=np.float64)
    except Exception as error:
        raise InputError(f"is not a PLY file that can be read ({type(error).__name__})", source=str(path)) from None
    if points.ndim != 2 or points.shape[1] != 3 or len(points) > MAX_POINTS or not (np.abs(points) <= 1e9).all():
        raise InputError(f"must hold at most {MAX_POINTS} vertices within 1e9", source=str(path))
    return points


def _reach(y: Floats, z: Floats) -> float:
    """Compute the largest radius up to which there are points in every direction (sectors of ten degrees)."""
    radius, angle = np.hypot(y, z), np.arctan2(z, y)
    sector = np.floor((angle + np.pi) / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    farthest = np.zeros(_SECTORS)
    np.maximum.at(farthest, sector, radius)
    return float(farthest.min())
