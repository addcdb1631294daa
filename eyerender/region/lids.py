"""Lids and skin as one sheet: from the conjunctiva under the lids over their margins out to the face.

The sheet is a grid of `ROWS` rows by columns once around the fissure (see `contour`). Its topology never changes.
Beyond the margin's inner edge, where rows are smooth, every second column lies halfway between its neighbours, and the
mesh omits it. From inside out the rows are:

    conjunctiva   from the globe (just below its surface, so that no gap shows) to the margin's inner edge; off the
                  globe, beside the nose, it carries the plica and the caruncle
    margin        the lid's edge, `margin_mm` thick, its two edges rounded
    lid           from the lash line to the crease
    face          from the crease to far outside

The skin's depth is the greater of the lids' shell about the globe and the face, joined smoothly; the crease's fold is
added. The sheet is kept `film_mm` clear of the globe wherever it lies on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..base.arrays import ArrayValue, Bools, Floats, frozen, sealed
from ..optics.vectors import crosses, dots, lengths
from .anatomy import Region
from .contour import LATERAL, Contour, canthi, contour, step, unit
from .face import face_depth
from .globe import Globe

CONJUNCTIVA, MARGIN, LID, FACE = 7, 7, 12, 20
_HELD = step(np.arange(LID + FACE, dtype=float), LID + 0.19 * FACE, LID + 0.68 * FACE)[:, None]  # share of rest
ROWS = CONJUNCTIVA + MARGIN + LID + FACE
FINE = CONJUNCTIVA + 1  # rows with a position in every column; the others have one in every second column
_DIP_MM = 0.031
EDGE_MM = 0.14  # depth of the margin's rounded edges: it is a flat strip
LOWER_TILT_DEG = 16.0  # the upper margin faces down and is seen edge-on; the lower one opens upwards by so much more
_FAR_MM = (66.0, 58.0)
# Rows are dense at both ends of the lid: at the lash line for what is wet, at the crease for its fold.
_LID_ROWS = np.array([1, 2, 3, 4, 6, 8, 10, 12, 13, 14, 15, 16]) / 16
_GROWTH = 4.0  # natural logarithm of the last row's width over that of the first one beyond the crease
_JOINT_MM = 2.4
_ROLL_MM = 0.7  # fullness below the lower lashes of an eye that squints (chosen)
_SOFT_MM = 9.0
_ON_GLOBE = (1.0, 0.8, 0.5, 0.2)  # share of the globe's normal in those of the conjunctiva's first rows


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Sheet(ArrayValue):
    """The posed sheet."""

    fine: Floats  # (FINE + 1, columns, 3) points of the first rows, mm
    fine_normals: Floats  # (FINE + 1, columns, 3) their unit normals
    coarse: Floats  # (ROWS - FINE - 1, columns / 2, 3) points of the other rows, in every second column
    coarse_normals: Floats  # (ROWS - FINE - 1, columns / 2, 3) their unit normals
    contour: Contour  # frame of the lash line
    lash_line: Floats  # (columns, 3) outer edge of the margin

    @property
    def vertices(self) -> Floats:
        """Return all rows in all columns, (ROWS, columns, 3) mm."""
        return np.concatenate([self.fine, halved(self.coarse)])

    @property
    def normals(self) -> Floats:
        """Return the normals of all rows in all columns, (ROWS, columns, 3)."""
        return np.concatenate([self.fine_normals, unit(halved(self.coarse_normals))])


def sheet(spec: Region, globe: Globe) -> Sheet:
    """Compute the sheet for a posed globe, in the region's frame."""
    c = contour(spec, globe)
    margin, lash_line = _margin(spec, globe, c)
    skin = _skin(spec, globe, c.every(2), lash_line[::2])
    beyond = np.concatenate([margin[FINE - CONJUNCTIVA - 1 :, ::2], skin])
    fine = np.concatenate([_conjunctiva(spec, globe, c), margin[: FINE - CONJUNCTIVA], halved(beyond[1:2])])
    normals, normals_beyond = grid_normals(fine), grid_normals(beyond)
    normals[-1:] = unit(halved(normals_beyond[1:2]))
    # The conjunctiva leaves the globe without an edge.
    share, first = np.array(_ON_GLOBE)[:, None, None], slice(len(_ON_GLOBE))
    normals[first] = unit(share * unit(fine[first] - globe.centre) + (1 - share) * normals[first])
    coarse, coarse_normals = sealed(beyond[2:]), sealed(normals_beyond[2:])
    return Sheet(
        fine=sealed(fine),
        fine_normals=sealed(normals),
        coarse=coarse,
        coarse_normals=coarse_normals,
        contour=c,
        lash_line=frozen(lash_line),
    )


def halved(grid: Floats) -> Floats:
    """Insert a column halfway between each two of a closed grid (rows, n, 3), giving (rows, 2 n, 3)."""
    rows, columns, _ = grid.shape
    out = np.empty((rows, 2 * columns, 3))
    out[:, ::2] = grid
    out[:, 1:-1:2] = 0.5 * (grid[:, :-1] + grid[:, 1:])
    out[:, -1] = 0.5 * (grid[:, -1] + grid[:, 0])
    return out


def grid_normals(vertices: Floats) -> Floats:
    """Compute unit normals of a grid (rows, columns, 3) that is closed along its columns."""
    across, out = np.empty_like(vertices), np.empty_like(vertices)
    across[:, 1:-1] = vertices[:, 2:] - vertices[:, :-2]
    across[:, 0], across[:, -1] = vertices[:, 1] - vertices[:, -1], vertices[:, 0] - vertices[:, -2]
    out[1:-1] = vertices[2:] - vertices[:-2]
    out[0], out[-1] = vertices[1] - vertices[0], vertices[-1] - vertices[-2]
    normal = crosses(out, across)
    length = lengths(normal)
    normal /= np.maximum(length, 1e-9)[..., None]
    normal[length <= 1e-9] = 1.0, 0.0, 0.0  # where rows meet in a point
    return normal


def margin_width(spec: Region, c: Contour) -> Floats:
    """Compute the thickness (columns,) mm of the margin of a contour."""
    return margin_width_mm(spec.lids.margin_mm, c.angle, c.upper > 0, c.openness)


def margin_width_mm(thickest_mm: float, angle: Floats, upper: Bools, openness: float) -> Floats:
    """Compute the thickness (columns,) mm of the margin at angles about it; the lower one is thinner (Zhu et al. 2022).

    It decreases towards the canthi. The margins of closed lids are equally thick, so that neither overhangs the other's
    lashes.
    """
    middle = thickest_mm * np.where(upper, 1.0, 1 - 0.2 * min(openness, 1.0))
    return np.asarray(0.45 * thickest_mm + (middle - 0.45 * thickest_mm) * step(np.abs(np.sin(angle)), 0.0, 0.55))


def lash_line(spec: Region, globe: Globe, c: Contour) -> Floats:
    """Compute the outer edge (columns, 3) mm of the margin of a contour."""
    return _margin(spec, globe, c)[1]


def _across() -> tuple[Floats, Floats]:
    """Return positions of the margin's rows, from its inner edge (0) to the outer one (1), and their rounding (mm)."""
    turn = np.cos(np.pi * np.linspace(0, 1, MARGIN)[:, None, None])
    u = 0.5 - 0.5 * turn * (0.6 + 0.4 * turn**2)
    return u, EDGE_MM * (2 * u - 1) ** 4


_ACROSS = _across()


def _margin(spec: Region, globe: Globe, c: Contour) -> tuple[Floats, Floats]:
    # The upper margin faces down and is seen edge-on from the front; the lower one opens upwards.
    tilt = np.radians(np.where(c.upper > 0, 0.0, LOWER_TILT_DEG) + spec.lids.margin_tilt_deg)[:, None]
    tilt = tilt * (0.25 + 0.75 * min(c.openness, 1.0))
    width = margin_width(spec, c)
    out = np.cos(tilt) * c.normal + np.sin(tilt) * c.away
    u, edge = _ACROSS
    rows = c.point + u * (width[:, None] * out) + edge * ((width / spec.lids.margin_mm)[:, None] * c.away)
    rows = globe.pushed_out(rows, spec.lids.film_mm)
    # The lids meet in the middle between them, never beyond.
    return rows, rows[-1]


def _conjunctiva(spec: Region, globe: Globe, c: Contour) -> Floats:
    """Compute the rows from below the globe's surface to the inner edge (exclusive)."""
    away = c.point - globe.centre
    distance = lengths(away)
    on_globe = step(distance - globe.radial(unit(away)), 0.6, 0.05)
    # It starts under the lids. In the corners of the fissure it starts on lines across them: beside the nose a crescent
    # about the cornea, the plica; at the temple where the globe's tangent leads to the canthus, so that the white
    # continues without an edge.
    y, z = (c.point[:, 1:] - globe.centre[1:]).T
    y_fold = 9.5 + 2.5 * max(float(globe.axis[1]), 0.0)  # an eye that turns nasally flattens the fold
    y_temple = globe.radius_mm * np.sin(LATERAL)
    line = np.where(y > 0, y_fold, y_temple)
    t = np.abs(y) / line
    z_line = np.where(y > 0, _spread(c, y, z, y_fold, True), _spread(c, y, z, -y_temple, False))
    corner = step(t, 0.6, 1.05)
    z_start = z + (1 - corner) * 0.8 * on_globe * c.away[:, 2] + corner * (z_line - z)
    y_start = np.sign(y) * line * (1.2 * t - np.log1p(np.exp(12 * (1.2 * t - 1))) / 12)
    y_start = y_start - _bend(spec) * corner * z_start**2 * np.where(z_start < 0, 1.4, 1.0) * (y > 0)
    x_start = np.sqrt(np.maximum(globe.radius_mm**2 - y_start**2 - z_start**2, (0.4 * globe.radius_mm) ** 2))
    reach = unit(np.array([x_start, y_start, z_start]).T)
    reach = globe.centre + reach * (globe.radial(reach) - _DIP_MM)[:, None]
    u = (np.arange(CONJUNCTIVA) / CONJUNCTIVA)[:, None, None]
    rows = reach + u * (c.point - reach)
    # The plica is a low crescent on the globe, the caruncle a mound beside it.
    s = u[..., 0]
    blink = spec.moved("blink")
    size = step(c.along, 0.66, 0.9)[None, :] * (1 - blink)
    plica = 0.16 * np.exp(-(((s - 0.34) / 0.22) ** 2)) * size
    caruncle = 1.2 * np.exp(-(((s - 0.6) / 0.2) ** 2)) * step(c.along, 0.86, 0.99)[None, :] * (1 - 0.6 * blink)
    rows = rows + (plica + caruncle)[..., None] * c.normal
    # Long pieces are chords of the globe (0.7 of its radius for the cornea), so the points are raised until their
    # midpoints are outside too.
    sag = dots(c.point - reach, c.point - reach) / CONJUNCTIVA**2 / (8 * 0.7 * globe.radius_mm)
    film = spec.lids.film_mm * on_globe + 0.05 * (1 - on_globe) + sag
    clear = globe.pushed_out(rows, np.where(u[..., 0] > 0, film, -_DIP_MM))
    return np.asarray(clear)


def _bend(spec: Region) -> float:
    """Curvature (1/mm) of the plica's free edge, a crescent about the cornea, which differs between people."""
    return float(np.random.default_rng((0x911C, spec.seed)).uniform(0.035, 0.085))


def _spread(c: Contour, y: Floats, z: Floats, y_line: float, nasal: bool) -> Floats:
    """Compute the coordinate z (columns,) on a line across the fissure's corner, evenly between the lids' crossings.

    Near the canthus, where the contour's z values crowd, the distances h from the canthus grow as the square root of
    the contour's.
    """
    corner = 0 if nasal else len(z) // 2
    h = np.abs(z - z[corner])
    out = z.copy()
    for side in (1.0, -1.0):
        mine = np.flatnonzero((c.upper == side) & (c.along > 0 if nasal else c.along < 0))
        most = h[mine][np.argmin(np.abs(y[mine] - y_line))]
        near = mine[h[mine] < most]
        out[near] = z[corner] + np.sign(z[near] - z[corner]) * np.sqrt(h[near] * most)
    return out


def _skin(spec: Region, globe: Globe, c: Contour, lash_line: Floats) -> Floats:
    """Compute the rows from the lash line (exclusive) outwards, in the columns of a contour."""
    crease = _crease(spec, c)
    v, y, z = _spokes(c, crease, lash_line)
    # Lids move their own skin, and move that of the brow and the cheek less the farther away it is.
    y_rest, z_rest = _at_rest(spec.with_lids(), len(c.angle))
    y, z = y + _HELD * (y_rest - y), z + _HELD * (z_rest - z)
    depth = skin_depth(spec, globe, *(np.concatenate([lash_line[None, :, k], a]) for k, a in ((1, y), (2, z))))
    start, x = lash_line[:, 0] - depth[0], depth[1:]
    if c.openness < 1:
        x = x + _fullness(spec, c, y, z)
    # Where the lids leave the globe, the canthi lie in a hollow, which is deeper the wider the gap is.
    x = x + start * np.exp(-((v / (2.2 + 0.8 * np.maximum(-start - 1.2, 0))) ** 2))
    strength = np.where(c.upper > 0, step(np.sin(c.angle), 0.12, 0.75), 0.0)
    lift, drop = _fold(spec, c, v, crease, strength)
    x = x + lift
    z = z - drop * c.upper
    if spec.fissure.epicanthus_mm > 0:
        x, y, z = _epicanthus(spec, c, v, x, y, z)
    rows = np.empty((*x.shape, 3))
    rows[..., 0], rows[..., 1], rows[..., 2] = x, y, z
    return globe.pushed_out(rows, 0.4)


def _spokes(c: Contour, crease: Floats, lash_line: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute the distance from the lash line, y and z (rows, columns) on straight lines out to the border."""
    y0, z0 = lash_line[:, 1], lash_line[:, 2]
    border_y, border_z = _border(c)
    dy, dz = border_y - y0, border_z - z0
    length = np.hypot(dy, dz)
    v = _distances(crease, length)
    q = v / length
    return v, y0 + dy * q, z0 + dz * q


@lru_cache(maxsize=8)
def _at_rest(spec: Region, columns: int) -> tuple[Floats, Floats]:
    """Compute the coordinates y and z (rows, columns) of the skin with the eye open and straight ahead."""
    globe = Globe.sphere()
    c = contour(spec, globe, columns)
    _, lash_line = _margin(spec, globe, c)
    _, y, z = _spokes(c, _crease(spec, c), lash_line)
    return frozen(y), frozen(z)


def _border(c: Contour) -> tuple[Floats, Floats]:
    """Compute the outer end (y, z) of the sheet: a rounded rectangle."""
    cos, sin = np.cos(c.angle), np.sin(c.angle)
    power = 0.72
    return (
        np.asarray(2.0 + _FAR_MM[0] * np.sign(cos) * np.abs(cos) ** power),
        np.asarray(_FAR_MM[1] * np.sign(sin) * np.abs(sin) ** power),
    )


def _crease(spec: Region, c: Contour) -> Floats:
    """Compute the distance (columns,) mm of the crease (for the lower lid, of its faint crease) from the lash line."""
    lids = spec.lids
    openness = min(c.openness, 1.2)
    middle = lids.crease_mm + (min(lids.show_mm, lids.crease_mm - 1.0) - lids.crease_mm) * openness
    arch = 0.72 + 0.28 * np.abs(np.sin(c.angle)) ** 1.5
    upper = step(np.sin(c.angle), -0.3, 0.3)
    return np.asarray((5.5 + upper * (middle - 5.5)) * arch)


def _distances(crease: Floats, length: Floats) -> Floats:
    """Compute the distances v (LID + FACE, columns) mm from the lash line: dense there and around the crease."""
    turn = np.cos(np.pi * _LID_ROWS)
    lid = (0.5 - 0.5 * turn * (0.55 + 0.45 * turn**2))[:, None] * crease
    k = np.arange(1, FACE + 1) / FACE
    share = np.expm1(_GROWTH * k) / np.expm1(_GROWTH)
    face = crease + share[:, None] * (length - crease)
    return np.concatenate([lid, face])


def _fold(spec: Region, c: Contour, v: Floats, crease: Floats, strength: Floats) -> tuple[Floats, Floats]:
    """Compute the depth that the fold adds, and its overhang over the crease (both rows x columns, mm)."""
    lids = spec.lids
    open_ = min(max(c.openness, 0.0), 1.15)
    height = lids.fold_mm * (0.4 + 0.6 * open_) * strength
    w = v - crease
    groove = -0.3 * np.exp(-((w / 0.5) ** 2)) * (0.4 + 0.6 * open_) * (lids.fold_mm > 0)
    swell = step(w, -0.2, 2.2) * np.exp(-(np.maximum(w - 1.6, 0) ** 2) / 30.0)
    lift = height * swell + groove * strength
    drop = 0.55 * height * step(w, 0.0, 0.7) * np.exp(-(np.maximum(w - 0.7, 0) ** 2) / 5.0)
    if lids.hood_mm > 0:
        # A hood hangs over the crease, most at the temple, but not over the lash line.
        hood = lids.hood_mm * (0.6 - 0.4 * c.along) * step(np.sin(c.angle), 0.0, 0.95) * (c.upper > 0) * open_
        hood = np.minimum(hood, np.maximum(crease - 1.3, 0.0))
        drop = drop + hood * step(w, -0.3, 0.9) * np.exp(-(np.maximum(w - 0.9, 0) ** 2) / 12.0)
        lift = lift + 0.5 * hood * step(w, -0.2, 1.6) * np.exp(-(np.maximum(w - 1.6, 0) ** 2) / 14.0)
    # When the lid is closed, the skin of the fold lies in shallow pleats above the crease.
    shut = max(1.0 - open_, 0.0)
    for place, depth in ((2.3, 0.16), (4.1, 0.11)) if shut > 0 else ():
        off = w - place - 0.5 * np.cos(2 * c.angle + place) - 0.35 * np.cos(c.angle)
        lift = lift - depth * shut * strength * np.exp(-((off / 0.55) ** 2)) * (lids.fold_mm > 0)
    bags = np.where(c.upper < 0, 1.0, 0.0) * lids.bags_mm * np.exp(-(((v - 8.5) / 3.5) ** 2)) * np.abs(np.sin(c.angle))
    roll = _ROLL_MM * spec.moved("squint") * np.exp(-(((v - 3.5) / 2.2) ** 2))
    bags = bags + np.where(c.upper < 0, roll, 0.0) * np.abs(np.sin(c.angle))
    line = np.where(c.upper < 0, -0.22, 0.0) * np.exp(-(((v - crease) / 0.7) ** 2)) * np.abs(np.sin(c.angle))
    return lift + bags + line, drop


def _epicanthus(spec: Region, c: Contour, v: Floats, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    """Draw skin from the upper lid and the nose over the medial canthus, as a fold in front of the caruncle."""
    reach = spec.fissure.epicanthus_mm * (1 - 0.5 * spec.moved("blink"))
    along = np.where(c.upper > 0, step(c.along, 0.55, 0.97), step(c.along, 0.86, 1.0))
    fold = along * step(v, 0.1, 1.5) * np.exp(-(np.maximum(v - 1.5, 0) ** 2) / 16.0)
    rise = along * step(v, 0.0, 1.2) * np.exp(-(np.maximum(v - 1.2, 0) ** 2) / 9.0)
    return x + 0.55 * reach * rise, y - reach * fold, z - 0.3 * reach * fold


def _fullness(spec: Region, c: Contour, y: Floats, z: Floats) -> Floats:
    """Compute how much (mm) the hollow above the lid fills as the lid comes down with its skin and fat."""
    shut = 1 - min(c.openness, 1.0)
    return np.asarray(spec.lids.fill_mm * shut * np.exp(-(((z - 10.5) / 6.0) ** 2) - np.square((y - 1.0) / 18.0) ** 2))


def skin_depth(spec: Region, globe: Globe, y: Floats, z: Floats) -> Floats:
    """Compute the depth x (mm) of the skin over (y, z) without margins and folds: lids' shell and face, blended."""
    centre = 0.5 * (globe.centre + globe.rest)
    dy, dz = y - centre[1], z - centre[2]
    outer = globe.radius_mm + spec.lids.thickness_mm
    # Beyond 42 degrees from the front the shell leaves the sphere along its tangent and flattens, because of the
    # orbit's fat.
    rho, limit = np.sqrt(dy * dy + dz * dz), np.radians(42.0)
    rho0 = outer * np.sin(limit)
    past = np.maximum(rho - rho0, 0.0)
    over = np.sqrt(outer * outer - np.minimum(rho, rho0) ** 2)
    shell = centre[0] + over - np.tan(limit) * _SOFT_MM * (1 - np.exp(-past / _SOFT_MM)) - 0.2 * past
    # Towards the canthi it falls faster, because their tendons hold the lids back.
    sideways = dy / np.maximum(rho, 1e-9)
    shell = shell - 2.4 * step(-sideways, 0.45, 1.0) * step(rho, 7.5, 16.0)
    shell = shell - 1.8 * step(sideways, 0.5, 1.0) * step(rho, 8.0, 16.5)
    shell = shell + _bulge(globe, y, z, outer)
    face = face_depth(spec.face, y, z)
    joined = np.maximum(shell, face) + _JOINT_MM * np.log1p(np.exp(-np.abs(shell - face) / _JOINT_MM))
    return np.asarray(joined - _canthal_hollow(spec, y, z))


def _canthal_hollow(spec: Region, y: Floats, z: Floats) -> Floats:
    """Compute the depth (mm) by which the canthal tendons hold back the skin around either canthus."""
    middle, half = canthi(spec)
    out = np.zeros_like(y)
    for end, depth, wide in ((middle - half, 2.2, 4.2), (middle + half, 1.4, 3.5)):
        out = out + depth * np.exp(-(((y - end[0]) / wide) ** 2) - ((z - end[1]) / 4.2) ** 2)
    return out


def _bulge(globe: Globe, y: Floats, z: Floats, outer: float) -> Floats:
    """Compute the lift (mm) of a lid by the cornea below it: a soft hill around the optic axis."""
    axis, centre = globe.axis, globe.centre
    apex = centre + outer * axis
    d2 = (y - apex[1]) ** 2 + (z - apex[2]) ** 2
    return np.asarray(0.75 * np.exp(-d2 / (2 * 3.6**2)))
