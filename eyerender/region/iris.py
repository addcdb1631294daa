"""The pattern of an iris at 850 nm: relative albedo and height of its front layer, seeded and deterministic.

The iris follows its anatomy, as textbooks describe it, from the pupil's margin outwards: the pigment ruff; the
pupillary zone, a thinner part with fine radial fibres; the collarette, a wavy ridge at about a third of the width; the
ciliary zone with coarser, wavy fibres; Fuchs' crypts (gaps of the front layer with a paler rim), mostly along the
collarette; and concentric contraction furrows. People differ in how much of each they have: the front layer may be
closed and nearly featureless, or open with deep crypts. At 850 nm melanin hardly absorbs, so relief is visible in every
eye colour. Albedo varies little; the map is darker where light is trapped (crypts).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base.arrays import Ints, Singles
from ..base.spec import Spec
from . import noise_kernels as kernels
from .contour import step
from .look import IrisPattern
from .noise import band_noise, nearest_two

RADIAL, ANGULAR = 256, 1024
WIDTH_MM, MARGIN_MM = 3.8, 2.0  # width and margin radius of the iris that strengths and means refer to
_SOFT = (1.5, 1.5)  # standard deviation of the smoothing of heights, rows and columns


class DrawnPattern(Spec):
    """A drawn iris: the seed and all strengths, which determine its maps."""

    seed: int
    crypts: float
    furrows: float
    collarette: float
    fibres: float

    @classmethod
    def of(cls, seed: int, pattern: IrisPattern) -> DrawnPattern:
        """Draw the strengths that a pattern leaves open.

        Four kinds of irises are equally frequent: closed ones with few features except furrows, fibrous ones, ones with
        crypts, and mixtures.
        """
        rng = np.random.default_rng((0x1125, seed))
        ranges = (
            {"crypts": (0, 0.12), "furrows": (0.1, 1.1), "collarette": (0.05, 0.5), "fibres": (0.1, 0.35)},
            {"crypts": (0, 0.35), "furrows": (0, 0.6), "collarette": (0.3, 1.0), "fibres": (0.6, 1.1)},
            {"crypts": (0.6, 1.3), "furrows": (0, 0.6), "collarette": (0.6, 1.3), "fibres": (0.25, 0.7)},
            {"crypts": (0.1, 0.8), "furrows": (0, 1.2), "collarette": (0.2, 1.2), "fibres": (0.15, 0.8)},
        )[rng.integers(4)]
        drawn = {name: round(float(rng.uniform(*ends)), 3) for name, ends in ranges.items()}
        given = {name: getattr(pattern, name) for name in drawn if getattr(pattern, name) is not None}
        return cls(seed=seed, **{**drawn, **given})


def _noise(
    rng: np.random.Generator, shape: tuple[int, int], rows: tuple[float, float], columns: tuple[float, float],
    periodic_rows: bool = False,
) -> Singles:  # fmt: skip
    """Compute band-passed Gaussian noise of unit variance; `rows`, `columns` are (low, high) cycles over the extent."""
    h, w = shape
    if periodic_rows:
        return band_noise(rng, shape, columns, rows)
    field = band_noise(rng, (2 * h, w), columns, (2 * rows[0], 2 * rows[1]), h)
    wide = field.ravel().astype(float)
    field /= np.float32(np.sqrt(wide @ wide / wide.size - wide.mean() ** 2))
    return field


def iris_maps(iris: DrawnPattern) -> Singles:
    """Compute the relative albedo and height (mm) of an iris, (2, RADIAL, ANGULAR).

    Rows run from the pupil's margin (0) to the root (1), columns once around. The mean albedo over the iris' area is 1;
    heights are above the plane of the iris, 0 at margin and root.
    """
    # Every part has its own numbers, so that it stays when the strength of another changes.
    rng, fibrous, furrowed, holed, grained, fringed = (np.random.default_rng((0x1815, k, iris.seed)) for k in range(6))
    shape = (RADIAL, ANGULAR)
    s = ((np.arange(RADIAL, dtype=np.float32) + 0.5) / RADIAL)[:, None]
    turn = ((np.arange(ANGULAR, dtype=np.float32) + 0.5) / ANGULAR)[None, :]
    place, ragged = rng.uniform(0.24, 0.44), rng.uniform(0.5, 1.8)
    collarette = place + ragged * (
        0.026 * _noise(rng, (1, ANGULAR), (0, 1), (0, 7), True)
        + 0.019 * _noise(rng, (1, ANGULAR), (0, 1), (9, 30), True)
    )
    off = s - collarette
    ciliary = step(off, -0.06, 0.07)
    # Fibres are angular noise that is elongated along the radius; a slow sideways warp bends its columns.
    warp = 3.0 * _noise(rng, shape, (0, 2.2), (0, 14)) + 0.8 * _noise(rng, shape, (0, 6), (0, 60))
    albedo, height = _fibres(fibrous, np.float32(rng.uniform(0.15, 0.9)) * warp, ciliary, iris.fibres)

    # The stroma is thinner inside the collarette, which is a ridge of varying height.
    along = np.clip(1 + 0.8 * _noise(rng, (1, ANGULAR), (0, 1), (3, 30), True), 0, 2.4)
    crest = np.exp(-((off / rng.uniform(0.025, 0.06)) ** 2)) * along
    height += iris.collarette * (0.035 * crest - 0.05 * (1 - ciliary) + 0.03 * np.exp(-((off / 0.12) ** 2)))
    albedo += iris.collarette * (0.09 * crest + 0.06 * (1 - ciliary))
    slow = _noise(rng, shape, (0, 2.0), (0, 5))
    albedo += 0.045 * slow + 0.03 * _noise(rng, shape, (0, 8), (0, 60)) - 0.04 * step(s, 0.72, 1.0)
    height += 0.02 * slow
    # The stroma is a felt of collagen, drawn out along the radius, whose grain shows more in some irises than others.
    albedo += grained.uniform(0.01, 0.045) * _noise(grained, shape, (4, 20), (60, 200))
    albedo += grained.uniform(0.01, 0.04) * _noise(grained, shape, (2, 9), (20, 80))

    grooves = iris.furrows * _furrows(furrowed, s, turn)
    polar = _Polar(s=s, off=off, turn=turn, warp=warp)
    depth, trabeculae = _crypts(holed, iris.crypts, polar)
    gaps, rims = _fringe(fringed, iris.collarette, polar)
    depth, trabeculae = np.maximum(depth, gaps), np.maximum(trabeculae, rims)
    specks = _specks(fringed)
    height += 0.03 * trabeculae - 0.07 * grooves - 0.2 * depth - 0.03 * specks
    albedo = albedo * (1 + 0.45 * trabeculae) * (1 - 0.24 * grooves) * (1 - 0.65 * depth) * (1 - 0.4 * specks)

    # The ruff is the pigment epithelium turned over the margin, a dark seam.
    beads = np.maximum(0.018 * (1 + 0.35 * _noise(rng, (1, ANGULAR), (0, 1), (30, 75), True)), 0.006)
    albedo = np.clip(albedo * (1 - 0.45 * np.exp(-((s / beads) ** 2))), 0.30, 1.9)
    area = (MARGIN_MM + s * WIDTH_MM).astype(float)
    albedo /= np.sum(albedo * area) / np.sum(np.broadcast_to(area, shape))
    # Tissue has no edges as sharp as those between the lattice's cells.
    height = ndimage.gaussian_filter(height, _SOFT, mode=("nearest", "wrap"))
    height *= step(s, 0.0, 0.10) * (1 - step(s, 0.90, 1.0))
    return np.stack([albedo, height]).astype(np.float32)


def _fibres(rng: np.random.Generator, warp: Singles, ciliary: Singles, strength: float) -> tuple[Singles, Singles]:
    """Compute the relative albedo and height (mm) of the radial fibres."""
    shape = (RADIAL, ANGULAR)

    def bent(field: Singles, share: float) -> Singles:
        out = np.empty_like(field)
        kernels.shift(field, np.float32(share) * warp, out)
        return out

    fine_by, long_by = rng.uniform(0.6, 1.35), rng.uniform(1.0, 3.0)
    coarse = bent(_noise(rng, shape, (0, 1.6), (22 * fine_by, 60 * fine_by)), 1.0)
    medium = bent(_noise(rng, shape, (0, 2.5 * long_by), (50 * fine_by, 120 * fine_by)), 1.0)
    fine = bent(_noise(rng, shape, (0, 3.0), (80, 150)), 0.7)
    ridges = 0.8 - np.abs(medium)  # bright strands between darker gaps
    # Some strands protrude from the stroma, thick and pale, each over a part of the radius; sectors have more of them.
    sector = np.clip(1 + 0.7 * _noise(rng, (1, ANGULAR), (0, 1), (0, 4), True), 0, 2)
    strands = np.maximum(bent(_noise(rng, shape, (0, 2.6 * long_by), (30 * fine_by, 85 * fine_by)), 1.2) - 0.9, 0)
    strands = (strands - 0.08) * sector
    outer = ciliary * (0.065 * coarse + 0.065 * ridges + 0.03 * fine + 0.2 * strands)
    inner = (1 - ciliary) * (0.04 * coarse + 0.065 * fine + 0.04 * medium)
    height = ciliary * (0.016 * coarse + 0.016 * ridges + 0.04 * strands)
    height += (1 - ciliary) * (0.006 * coarse + 0.006 * fine)
    return 1 + strength * (outer + inner), strength * height


def _furrows(rng: np.random.Generator, s: NDArray[Any], turn: NDArray[Any]) -> Singles:
    """Compute the depth 0 to 1 of the contraction furrows: arcs in the outer half, each over a part of the circle."""
    out = np.zeros(np.broadcast_shapes(s.shape, turn.shape), np.float32)
    count = int(rng.integers(2, 9))
    common = 0.012 * _noise(rng, (1, ANGULAR), (0, 1), (0, 6), True)
    for place in np.linspace(rng.uniform(0.5, 0.7), rng.uniform(0.84, 0.95), count) + rng.uniform(-0.03, 0.03, count):
        start, span = rng.uniform(0, 1), rng.uniform(0.15, 0.8)
        wave = common + 0.006 * _noise(rng, (1, ANGULAR), (0, 1), (2, 16), True)
        uneven = np.clip(0.7 + 0.4 * _noise(rng, (1, ANGULAR), (0, 1), (3, 24), True), 0, 1.4)
        along = np.mod(turn - start, 1.0)
        mask = step(along, 0.0, 0.08) * (1 - step(along, span - 0.08, span)) * uneven
        width = rng.uniform(0.008, 0.022)
        # The depth is less than 1e-15 in other rows.
        ends = place + wave.min() - 6 * width, place + wave.max() + 8 * width
        near = slice(*np.searchsorted(s[:, 0], ends))
        d = (s[near] - place - wave) / width
        out[near] += mask * rng.uniform(0.3, 1.0) * (np.exp(-(d**2)) - 0.4 * np.exp(-((d - 1.8) ** 2)))
    return out


@dataclass(frozen=True, kw_only=True)
class _Polar:
    """Places on the iris, for rows s and columns of the map."""

    s: NDArray[Any]  # share of the way from margin to root, (RADIAL, 1)
    off: NDArray[Any]  # s outside of the collarette, (RADIAL, ANGULAR)
    turn: NDArray[Any]  # share of a turn, (1, ANGULAR)
    warp: Singles  # how far the fibres swing aside, columns, (RADIAL, ANGULAR)

    def lattice(
        self, rng: np.random.Generator, rows: NDArray[Any], cell_mm: float, long_by: float
    ) -> tuple[Singles, Ints, int]:
        """Cover rows of the map with random cells that are `long_by` times as long, along the radius, as wide.

        Returns the difference (mm) of the distances to the two nearest cells' middles, which is 0 on the walls, the
        numbers (2, rows, ANGULAR) of these cells, and the number of cells.
        """
        # The lattice is in mm of an iris of 3.8 mm from margin to root.
        around, along = 2 * np.pi * 3.2, WIDTH_MM / long_by
        low, high = (float(self.s[row, 0]) * along for row in (rows[0], rows[-1]))
        count = max(int(around * (high - low + 2 * cell_mm) / cell_mm**2), 8)
        seeds = np.stack([rng.uniform(0, around, count), rng.uniform(low - cell_mm, high + cell_mm, count)], axis=-1)
        copies = np.concatenate([seeds + np.array([shift, 0.0]) for shift in (-around, 0.0, around)])
        some = slice(rows[0], rows[0] + -(-len(rows) // 8) * 8)  # a few rows more, as `nearest_two` requires
        # The cells bend like the fibres beside them.
        x = (self.turn + 0.0025 * self.warp[some]) * around
        y = np.broadcast_to(self.s[some] * along, x.shape) + 0.02 * np.roll(self.warp[some], 97, axis=1)
        lead, cells = nearest_two(copies, x, y)
        return lead[: len(rows)], np.tile(np.arange(count), 3)[cells[:, : len(rows)]], count

    def empty(self) -> Singles:
        """Zeros over the map."""
        return np.zeros(self.off.shape, np.float32)


def _crypts(rng: np.random.Generator, strength: float, polar: _Polar) -> tuple[Singles, Singles]:
    """Compute Fuchs' crypts, lens-shaped gaps in the front layer, as depth 0 to 1, and the trabeculae between them.

    They form a lattice outside the collarette that is deep in some sectors and closed in others, with a few single
    crypts towards the root.
    """
    depth, walls = polar.empty(), polar.empty()
    if strength == 0:
        return depth, walls
    rows = np.flatnonzero((polar.s[:, 0] > 0.12) & (polar.s[:, 0] < 0.88))
    gap, cells, count = polar.lattice(rng, rows, rng.uniform(0.28, 0.6), rng.uniform(1.3, 2.4))
    open_ = rng.uniform(size=count) < rng.uniform(0.35, 0.8)
    deep = np.where(open_, rng.uniform(0.12, 0.6, count), rng.uniform(0, 0.06, count)).astype(np.float32)
    pale = (rng.uniform(0.1, 0.5, count) * (rng.uniform(size=count) < 0.8)).astype(np.float32)
    sector = np.clip(0.72 + 0.5 * _noise(rng, (1, ANGULAR), (0, 1), (0, 5), True), 0.05, 1.35)
    away, spread = polar.off[rows], rng.uniform(0.08, 0.24)
    zone = np.exp(-(((away - 0.08) / spread) ** 2)) * sector + 0.2 * step(away, 0.08, 0.2) * (polar.s[rows] < 0.8)
    ridge = np.maximum(pale[cells[0]], pale[cells[1]]) * np.exp(-((gap / 0.06) ** 2))
    depth[rows] = np.clip(strength * zone * deep[cells[0]] * step(gap, 0.02, 0.2), 0, 0.85)
    walls[rows] = min(strength, 1.0) * zone * ridge
    return depth, walls


def _fringe(rng: np.random.Generator, strength: float, polar: _Polar) -> tuple[Singles, Singles]:
    """Compute the small long gaps that line the collarette in most irises, as depth 0 to 1, and their pale rims."""
    depth, walls = polar.empty(), polar.empty()
    spread = rng.uniform(0.035, 0.08)
    near = np.flatnonzero(np.any(np.abs(polar.off) < 2.5 * spread, axis=1) & (polar.s[:, 0] > 0.05))
    rows = np.arange(near[0], min(near[-1] + 1, RADIAL - 8))
    gap, cells, count = polar.lattice(rng, rows, rng.uniform(0.13, 0.26), rng.uniform(1.6, 3.0))
    deep = (rng.uniform(0.1, 0.75, count) * (rng.uniform(size=count) < rng.uniform(0.4, 0.9))).astype(np.float32)
    sector = np.clip(0.7 + 0.4 * _noise(rng, (1, ANGULAR), (0, 1), (0, 8), True), 0, 1.2)
    zone = np.exp(-(((polar.off[rows] - 0.02) / spread) ** 2)) * sector
    depth[rows] = np.clip(strength * zone * deep[cells[0]] * step(gap, 0.01, 0.09), 0, 0.7)
    walls[rows] = min(strength, 1.0) * zone * 0.22 * np.exp(-((gap / 0.035) ** 2))
    return depth, walls


def _specks(rng: np.random.Generator) -> Singles:
    """Compute the depth 0 to 1 of small round pits, from none to dozens, anywhere outside the pupillary zone."""
    out = np.zeros((RADIAL, ANGULAR), np.float32)
    for _ in range(int(rng.integers(0, 12) * rng.integers(0, 5))):
        at, radius, depth = rng.uniform(0.35, 0.95), rng.uniform(0.02, 0.07), rng.uniform(0.2, 1.0)
        row, column = int(at * RADIAL), int(rng.integers(ANGULAR))
        row_mm, column_mm = WIDTH_MM / RADIAL, 2 * np.pi * (MARGIN_MM + at * WIDTH_MM) / ANGULAR
        rows = np.arange(max(row - 14, 0), min(row + 15, RADIAL))
        columns = np.arange(-14, 15)
        far = np.square((rows - row) * row_mm)[:, None] + np.square(columns * column_mm)
        place = np.ix_(rows, (column + columns) % ANGULAR)
        out[place] = np.maximum(out[place], depth * np.exp(-far / radius**2))
    return out
