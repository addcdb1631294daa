"""Eyes as triangle meshes: every surface is a patch, and patches form closed bodies.

Vertices lie exactly on the surfaces of the model, normals are analytic, and faces point outwards (towards the air). A
patch between two transparent media has both indices; an opaque one has none. Bodies share the vertices of their
patches, so they close without gaps:

    contact_lens   front, rim, cornea's front          (where one is worn)
    cornea     front, rim, back                        (models with a posterior cornea)
    aqueous    cornea's back, chamber wall, hyaloid, lens
    lens       front, equator, back                    (a gradient lens: one body a shell, each inside the last)
    vitreous   hyaloid, lens' back, retinal wall
    interior   cornea's front, chamber wall, retinal wall      (models of one medium)
    globe      the outermost front, sclera

Where a model leaves a gap, it is closed as follows: the posterior cornea ends where it meets the plane of the iris or
at the limbus; a lens without a rim of its own ends at 4.5 mm or where its surfaces meet; the retinal wall is a sphere 1
mm inside the sclera. The renderer itself intersects the surfaces in closed form unless a scene asks for meshes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from ..base.arrays import Floats, Ints
from ..optics.surfaces import Surface, components, join
from .model import EyeModel
from .worn import WornLens

_LENS_RADIUS_MM = 4.5
_BEFORE_MM = 100.0  # distance from which the surfaces of worn lenses are met
_WALL_MM = 1.0


@dataclass(frozen=True, slots=True)
class Patch:
    """A piece of surface."""

    name: str  # name of the patch
    vertices: Floats  # (n, 3) mm
    normals: Floats  # (n, 3) unit normals
    faces: Ints  # (m, 3) indices of vertices
    exterior: float | None = None  # refractive index on the side of the normal; None if opaque
    interior: float | None = None  # refractive index behind the surface; None if opaque

    @property
    def mesh(self) -> Any:
        """Convert to a `trimesh.Trimesh`."""
        return _trimesh(self.vertices, self.faces, self.normals)


@dataclass(frozen=True, slots=True)
class EyeMeshes:
    """Patches of an eye by name, and its closed bodies as trimeshes, each facing outwards."""

    patches: dict[str, Patch]
    bodies: dict[str, Any] = field(default_factory=dict)


def eye_meshes(eye: EyeModel, rings: int = 48, sectors: int = 128) -> EyeMeshes:
    """Compute all meshes of an eye, in the eye frame (mm); a gradient lens is approximated by shells."""
    eye = eye.shelled()
    angle = 2 * np.pi * np.arange(sectors) / sectors
    cornea = cornea_patches(eye, rings, sectors)
    front, innermost = cornea[0], cornea[-1]
    patches = {patch.name: patch for patch in cornea}
    bodies: dict[str, Any] = {}
    rim, inner_rim = _rim(front, sectors), _rim(innermost, sectors)
    for outer, inner in pairwise(cornea):
        body = outer.name.removesuffix("_front")
        edge = _band(f"{body}_rim", _rim(outer, sectors), _rim(inner, sectors))
        patches[edge.name], bodies[body] = edge, _closed((outer, 1), (edge, 1), (inner, -1))
    aqueous = float(eye.front_indices[-1])

    lenses = _lenses(eye, aqueous, rings, sectors, angle)
    behind = float(eye.back_indices[-1]) if lenses else aqueous
    equator = _rim(lenses[0][2], sectors) if lenses else None
    depth = float(np.mean(equator[:, 0])) if equator is not None else float(eye.stop.centre_mm[0]) - 1.0
    wall, wall_ring = _retinal_wall(eye, depth, rings, sectors, angle)
    chamber = _band("chamber_wall", inner_rim, wall_ring)
    patches |= {"chamber_wall": chamber, "retina": wall}
    if equator is None:
        bodies["interior"] = _closed((front, 1), (chamber, 1), (wall, 1))
    else:
        lens_front, lens_side, lens_back = lenses[0]
        hyaloid = _band("hyaloid", equator, wall_ring, aqueous, behind)
        patches["hyaloid"] = hyaloid
        bodies["aqueous"] = _closed(
            (innermost, 1), (chamber, 1), (hyaloid, -1), (lens_front, -1), (lens_side, -1)
        )  # fmt: skip
        bodies["vitreous"] = _closed((hyaloid, 1), (lens_back, -1), (wall, 1))
        for k, (a, side, b) in enumerate(lenses):
            name = "lens" if k == 0 else f"lens_shell_{k}"
            patches |= {p.name: p for p in (a, side, b)}
            bodies[name] = _closed((a, 1), (side, 1), (b, 1))
    sclera = _sclera(eye, rim, rings)
    patches |= {"sclera": sclera, "iris": _iris(eye, sectors)}
    bodies["globe"] = _closed((front, 1), (sclera, 1))
    return EyeMeshes(patches, bodies)


def cornea_patches(eye: EyeModel, rings: int, sectors: int) -> tuple[Patch, ...]:
    """Compute the patches of the refracting surfaces before the stop, outside in.

    They are the front of a contact lens if one is worn, the cornea's front, and its back if it has one.
    """
    names = [*(["contact_lens_front"] if eye.has_contact_lens else []), "cornea_front", "cornea_back"]
    indices = [1.0, *(float(n) for n in eye.front_indices)]
    patches = []
    for k, (name, surface) in enumerate(zip(names, eye.front, strict=False)):
        rho = np.full(sectors, float(eye.limbus_radius_mm))
        if name == "cornea_back":
            angle = 2 * np.pi * np.arange(sectors) / sectors
            rho = chamber_rim(surface, eye.stop.centre_mm, eye.stop.normal, float(eye.limbus_radius_mm), angle)
        patches.append(_cap(name, surface, rho, rings, indices[k], indices[k + 1]))
    return tuple(patches)


def _cap(name: str, surface: Surface, rho: Floats, rings: int, exterior: float, interior: float,
         inward: bool = False) -> Patch:  # fmt: skip
    """Compute the part of a surface within radius rho (sectors,) of its axis; faces towards +x, or -x if `inward`."""
    sectors = len(rho)
    angle = 2 * np.pi * np.arange(sectors) / sectors
    y, z = _disc(rho * np.cos(angle), rho * np.sin(angle), rings)
    local = np.stack([np.asarray(surface.sag(y, z)), y, z], axis=1)
    vertices = local @ surface.rotation.T + surface.origin_mm
    normals, faces = surface.normal(vertices), _disc_faces(rings, sectors)
    if inward:
        normals, faces = -normals, faces[:, ::-1]
    return Patch(name, vertices, normals, faces, exterior, interior)


def lens_patches(lens: WornLens, name: str, rings: int, sectors: int) -> tuple[Patch, ...]:
    """Compute front, back and edge of a worn lens inside its outline, in its frame; the edge is opaque."""
    angle, way = 2 * np.pi * np.arange(sectors) / sectors, -lens.rotation[:, 0]
    y, z = _disc(lens.half_mm[0] * np.cos(angle), lens.half_mm[1] * np.sin(angle), rings)
    start = lens.centre_mm + np.stack([np.full(len(y), _BEFORE_MM), y, z], axis=1) @ lens.rotation.T
    ways, out = components(np.broadcast_to(way, start.shape)), []
    for side, outer, inner in (("front", 1.0, lens.index), ("back", lens.index, 1.0)):
        surface = getattr(lens, side)
        points = join(surface.hit(components(start), ways, True).point)
        faces = _disc_faces(rings, sectors)
        out.append(Patch(f"{name}_{side}", points, surface.normal(points), faces, outer, inner))
    return *out, _band(f"{name}_edge", _rim(out[0], sectors), _rim(out[1], sectors))


def _disc(y: Floats, z: Floats, rings: int) -> tuple[Floats, Floats]:
    """Return places across the axis of a disc's vertices: its middle, then rings up to a rim (sectors,)."""
    share = np.arange(1, rings + 1)[:, None] / rings
    a, b = (np.concatenate([[0.0], (share * rim).ravel()]) for rim in (y, z))
    return a, b


def _disc_faces(rings: int, sectors: int) -> Ints:
    return _fan(sectors) if rings == 1 else np.concatenate([_fan(sectors), _strips(1, rings, sectors)])


def _fan(sectors: int) -> Ints:
    j = np.arange(sectors)
    return np.stack([np.zeros_like(j), 1 + j, 1 + (j + 1) % sectors], axis=1)


def _strips(first: int, rings: int, sectors: int) -> Ints:
    """Return quads between consecutive rings of `sectors` vertices; the innermost ring starts at vertex `first`."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(sectors), indexing="ij")
    a, k = first + i * sectors, (j + 1) % sectors
    upper = np.stack([a + j, a + sectors + j, a + sectors + k], axis=-1)
    lower = np.stack([a + j, a + sectors + k, a + k], axis=-1)
    return np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])


def _rim(patch: Patch, sectors: int) -> Floats:
    """Return the outermost ring of a patch."""
    return patch.vertices[-sectors:]


def _trimesh(vertices: Floats, faces: Ints, normals: Floats | None = None) -> Any:
    import trimesh  # its import takes a quarter of a second, and few processes need it

    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)


def _band(
    name: str, inner: Floats, outer: Floats, exterior: float | None = None, interior: float | None = None
) -> Patch:
    """Compute the strip between two rings, oriented like a cap that continues from `inner` to `outer`."""
    sectors = len(inner)
    vertices = np.concatenate([inner, outer])
    faces = _strips(0, 2, sectors)
    normals = np.asarray(_trimesh(vertices, faces).vertex_normals)
    return Patch(name, vertices, normals, faces, exterior, interior)


def chamber_rim(surface: Surface, centre: Floats, normal: Floats, limbus_mm: float, angle: Floats) -> Floats:
    """Compute the radius (sectors,) mm where the posterior cornea meets the iris plane, at most that of the limbus."""
    low, high = np.zeros_like(angle), np.full_like(angle, limbus_mm * 0.995)
    for _ in range(60):
        middle = 0.5 * (low + high)
        y, z = middle * np.cos(angle), middle * np.sin(angle)
        x = np.stack([np.asarray(surface.sag(y, z)), y, z], axis=1) @ surface.rotation.T + surface.origin_mm
        above = (x - centre) @ normal > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return low


def _lenses(eye: EyeModel, outside: float, rings: int, sectors: int, angle: Floats) -> list[tuple[Patch, Patch, Patch]]:
    """Compute the front, equator and back of the lens and of every shell inside it; all face out of the lens."""
    found = []
    count = len(eye.back) // 2
    before = [outside, *(float(n) for n in eye.back_indices)]
    for k in range(count):
        a, b = eye.back[k], eye.back[-1 - k]
        rim = min(float(eye.back_rims_mm[k]), float(eye.back_rims_mm[-1 - k]), _LENS_RADIUS_MM)
        rim = _meeting(a, b, rim, angle)
        rho = np.full(sectors, rim)
        tag = "lens" if k == 0 else f"lens_shell_{k}"
        front = _cap(f"{tag}_front", a, rho, rings, before[k], before[k + 1])
        # The back's surface normal points to +x, into the lens.
        back = _cap(f"{tag}_back", b, rho, rings, before[len(eye.back) - k], before[len(eye.back) - 1 - k], inward=True)
        side = _band(f"{tag}_equator", _rim(front, sectors), _rim(back, sectors), before[k], before[k + 1])
        found.append((front, side, back))
    return found


def _meeting(front: Surface, back: Surface, rim: float, angle: Floats) -> float:
    """Compute the largest radius, at most `rim`, at which the front is at least a hundredth of a mm before the back."""
    low, high = 0.0, rim
    for _ in range(50):
        middle = 0.5 * (low + high) if high != rim or low > 0 else rim
        y, z = middle * np.cos(angle), middle * np.sin(angle)
        x = [
            (np.stack([np.asarray(s.sag(y, z)), y, z], axis=1) @ s.rotation.T + s.origin_mm)[:, 0]
            for s in (front, back)
        ]
        if np.all(x[0] - x[1] > 0.01):
            if middle == rim:
                return rim
            low = middle
        else:
            high = middle * (1 - 1e-12) if middle == rim else middle
    return low


def _retinal_wall(eye: EyeModel, depth: float, rings: int, sectors: int, angle: Floats) -> tuple[Patch, Floats]:
    """Compute the sphere 1 mm inside the sclera from the plane x = depth to its back pole, and its first ring."""
    centre, radius = np.asarray(eye.sclera.centre_mm), float(eye.sclera.radius_mm) - _WALL_MM
    start = np.arccos(np.clip((depth - centre[0]) / radius, -1, 1))
    polar = start + (np.pi - start) * np.arange(rings) / rings
    patch = _polar("retina", centre, radius, polar[:, None] * np.ones(sectors), angle)
    return patch, patch.vertices[:sectors]


def _sclera(eye: EyeModel, rim: Floats, rings: int) -> Patch:
    """Compute the sphere of the sclera from the cornea's rim to its back pole; its first ring is that rim."""
    centre, radius = np.asarray(eye.sclera.centre_mm), float(eye.sclera.radius_mm)
    r = rim - centre
    start = np.arctan2(np.hypot(r[:, 1], r[:, 2]), r[:, 0])
    polar = start + (np.pi - start) * (np.arange(rings) / rings)[:, None]
    patch = _polar("sclera", centre, radius, polar, np.arctan2(r[:, 2], r[:, 1]))
    vertices = patch.vertices.copy()
    vertices[: len(rim)] = rim
    return Patch("sclera", vertices, patch.normals, patch.faces)


def _polar(name: str, centre: Floats, radius: float, polar: Floats, angle: Floats) -> Patch:
    """Compute the part of a sphere by rings of polar angle (rings, sectors) from +x, closed at its back pole."""
    rings, sectors = polar.shape
    n = np.stack(
        [np.cos(polar), np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle)], axis=-1
    ).reshape(-1, 3)  # fmt: skip
    normals = np.concatenate([n, [[-1.0, 0.0, 0.0]]])
    last, j = (rings - 1) * sectors, np.arange(sectors)
    pole = np.stack([last + j, np.full(sectors, rings * sectors), last + (j + 1) % sectors], axis=1)
    faces = np.concatenate([_strips(0, rings, sectors), pole])
    return Patch(name, centre + radius * normals, normals, faces)


def _iris(eye: EyeModel, sectors: int) -> Patch:
    """Compute the annulus in the stop's plane from the pupil's margin to the root, facing the cornea."""
    inner = eye.stop.boundary(sectors)
    if float(eye.stop.handed) < 0:
        inner = np.roll(inner[::-1], 1, axis=0)
    angle = np.arctan2(inner[:, 2], inner[:, 1])
    y, z = float(eye.iris_root_radius_mm) * np.cos(angle), float(eye.iris_root_radius_mm) * np.sin(angle)
    n, c = eye.stop.normal, eye.stop.centre_mm
    outer = np.stack([c[0] - (n[1] * (y - c[1]) + n[2] * (z - c[2])) / n[0], y, z], axis=1)
    patch = _band("iris", inner, outer)
    return Patch("iris", patch.vertices, np.broadcast_to(n, patch.vertices.shape).copy(), patch.faces)


def _closed(*parts: tuple[Patch, int]) -> Any:
    """Join patches into one closed body with their common rims merged; sign -1 turns a patch around."""
    vertices, faces, count = [], [], 0
    for patch, sign in parts:
        vertices.append(patch.vertices)
        faces.append((patch.faces if sign > 0 else patch.faces[:, ::-1]) + count)
        count += len(patch.vertices)
    mesh = _trimesh(np.concatenate(vertices), np.concatenate(faces))
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=9)
    return mesh
