"""Pictures that are equal, or nearly so.

Pictures of the same pixels have the same digest. Near-duplicates are neighbours among the thumbnails, which are
compared without their brightness and contrast: with the mean removed and unit length, two thumbnails at the distance d
have the correlation 1 - d^2 / 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...base.arrays import Bytes, Floats

CORRELATION = 0.9995
"""Least correlation of the thumbnails of near-duplicates. Two pictures of one scene with other noise have more."""
_AXES = 12  # principal axes in which neighbours are searched
_NEIGHBOURS = 4
_FLAT = 1.0  # least spread of a thumbnail's levels, of 255


@dataclass(frozen=True, slots=True)
class SimilarPair:
    """Two images, by their places, and the correlation of their thumbnails; 1 where their pixels are equal."""

    first: int
    second: int
    correlation: float


def equal_pictures(digests: Sequence[bytes]) -> list[list[int]]:
    """Groups of at least two pictures with the same pixels; the largest groups come first."""
    groups: dict[bytes, list[int]] = {}
    for at, digest in enumerate(digests):
        if digest:
            groups.setdefault(digest, []).append(at)
    return sorted((group for group in groups.values() if len(group) > 1), key=lambda group: (-len(group), group[0]))


def near_duplicates(thumbnails: Bytes, digests: Sequence[bytes]) -> list[SimilarPair]:
    """Pairs of pictures that differ, with thumbnails that hardly do; the most alike come first.

    Args:
        thumbnails: (n, h, w) mean levels.
        digests: (n,) of the pixels; one picture of those with the same pixels is compared.
    """
    first = {digest: at for at, digest in reversed(list(enumerate(digests))) if digest}
    places = np.array(sorted(first.values()), dtype=np.int64)
    flat = thumbnails[places].reshape(len(places), thumbnails.shape[1] * thumbnails.shape[2])
    places = places[np.ptp(flat, axis=1).astype(float) > _FLAT] if len(places) else places
    if len(places) < 2:
        return []
    unit = _unit(thumbnails[places])
    reach = float(np.sqrt(2 * (1 - CORRELATION)))
    axes = unit @ np.linalg.eigh(unit.T @ unit)[1][:, -_AXES:]  # coordinates along some principal axes
    k = min(_NEIGHBOURS + 1, len(places))
    # Distances along some axes are at most those of the thumbnails, so no pair within reach is missed by them.
    _, neighbours = cKDTree(axes).query(axes, k=k, distance_upper_bound=reach, workers=-1)
    pairs = set()
    for a, row in enumerate(np.asarray(neighbours).reshape(len(places), k)):
        for b in row[row < len(places)]:
            if a != b and float(unit[a] @ unit[b]) >= CORRELATION:
                pairs.add((min(a, int(b)), max(a, int(b))))
    found = [SimilarPair(int(places[a]), int(places[b]), float(unit[a] @ unit[b])) for a, b in pairs]
    return sorted(found, key=lambda pair: (-pair.correlation, pair.first, pair.second))


def _unit(thumbnails: Bytes) -> Floats:
    rows = thumbnails.reshape(len(thumbnails), -1).astype(np.float32)
    rows -= rows.mean(axis=1, keepdims=True)
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))
