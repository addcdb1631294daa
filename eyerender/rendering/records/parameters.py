"""Frame parameters: the numbers that change from frame to frame, by name.

Host and device use the same classes. On the host (`job.parameters_of`) the leaves are NumPy numbers in float64. On the
device (`frame.DeviceFrame`) they are Dr.Jit arrays of size one: a Float, a Vector3f for three numbers, or a tuple of
Floats.
Nothing here depends on Mitsuba.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

# Types of numbers and vectors on either side. Dr.Jit resolves these annotations, so they must not name Mitsuba.
Number: TypeAlias = Any
Vector: TypeAlias = Any

Kind = Literal["quadric", "biconic", "measured"]
_Tree = TypeVar("_Tree")


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceParameters:
    """One refracting surface in the eye frame, lengths in mm.

    Attributes:
        origin: (3,) origin of the surface's frame.
        shape: (a.x, a.y, a.z, b, c) of a quadric, (Ry, Rz, py, pz, 0) of a biconic, (R, p, cells per mm, cells in a
            row, 0) of a measured surface (see `surfaces`).
        eta: refractive index in front of the surface over that behind it, for light that enters the eye.
        axes: three unit axes (3,) of the surface's frame; None if they are those of the eye.
        film: refractive index in front of the surface over that of a film on it; None if there can be no film.
    """

    origin: Vector
    shape: tuple[Number, ...]
    eta: Number
    axes: tuple[Vector, Vector, Vector] | None
    film: Number | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StopParameters:
    """The aperture stop: centre, normal, directions u and v of its semi-axes (all (3,)), and the semi-axes (mm)."""

    centre: Vector
    normal: Vector
    u: Vector
    v: Vector
    axes: tuple[Number, Number]


@dataclass(frozen=True, slots=True, kw_only=True)
class IrisParameters:
    """Iris parameters.

    These are the radius of the root (mm), mean albedo, contrast of the texture, darkening at the root, scale of the
    heights, and convexity (mm).
    """

    root_radius: Number
    albedo: Number
    contrast: Number
    ring: Number
    relief: Number
    convexity: Number


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbusParameters:
    """The limbus and the cornea in front of it.

    Attributes:
        radius: radius about the front surface's axis, mm.
        floor: lowest x of the cornea in that surface's frame, mm.
        gain: 1 / width, 1/mm.
        albedo: albedo of the limbus.
        up: (2,) upward direction in that surface's y, z plane.
        lowering: 1 / aspect^2 - 1, with the height of the visible limbus over its width.
        bulge: (3,) centre of a sphere that contains the front of the cornea.
        bulge_radius: radius of that sphere, mm.
    """

    radius: Number
    floor: Number
    gain: Number
    albedo: Number
    up: tuple[Number, Number]
    lowering: Number
    bulge: Vector
    bulge_radius: Number


@dataclass(frozen=True, slots=True, kw_only=True)
class ScleraParameters:
    """The sclera: centre (3,) and radius (mm), mean albedo, contrast of the texture, slope of the film's ripples."""

    centre: Vector
    radius: Number
    albedo: Number
    contrast: Number
    ripples: Number


@dataclass(frozen=True, slots=True)
class PoseParameters:
    """The pose x_scene = columns x_eye + shift: three columns of the rotation (3,) each, and the shift (3,) mm."""

    columns: tuple[Vector, Vector, Vector]
    shift: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraParameters:
    """Camera parameters for the kernels.

    These are the centre of projection (3,) mm, the axes right, down and forward (3,), focal lengths and principal point
    (px), the coefficients of the lens distortion, and a fisheye's `ray_polynomials` (`rig/distortion.py`).
    """

    centre: Vector
    right: Vector
    down: Vector
    forward: Vector
    focal: tuple[Number, Number]
    principal: tuple[Number, Number]
    distortion: tuple[Number, ...]
    polynomials: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LensParameters:
    """A worn lens in the frame of its surfaces: the scene's for camera rays, the eye's for light of the lamps.

    Attributes:
        front: the surface on the world's side.
        back: the surface on the eye's side.
        centre: (3,) centre of the outline.
        axes: three unit axes (3,) of the lens; x points out of the face.
        half: half axes of the outline along y and z, mm.
        reach: distance from the frame's origin (mm) from which on rays are moved to the lens before they are traced.
        gain: factor on Fresnel's transmittance of both surfaces.
        edge: weight of rays that meet the edge: 0, or 1 at index 1, where nobody sees it.
    """

    front: SurfaceParameters
    back: SurfaceParameters
    centre: Vector
    axes: tuple[Vector, Vector, Vector]
    half: tuple[Number, Number]
    reach: Number
    gain: Number
    edge: Number


@dataclass(frozen=True, slots=True)
class ImageParameters:
    """The stop's Gaussian image seen from outside: lateral magnification, and shift along x (mm)."""

    scale: Number
    shift: Number


@dataclass(kw_only=True)
class FrameParameters:
    """Parameters that host and device share; lengths in mm, in the eye frame or the scene's frame.

    Attributes:
        inner_index: refractive index of the medium in front of the iris.
        stop: the aperture stop.
        iris: the iris.
        limbus: the limbus.
        sclera: the sclera.
        image: the stop's Gaussian image.
        pose: the pose of the eye.
        camera: the camera.
        pupil_albedo: share of the light that the pupil reflects.
        globe_reach: radius (mm) of the sphere about the sclera's centre that contains the cornea too.
        backdrop_x: the background's plane, x in the scene's frame (mm).
        ambient_irradiance: irradiance of uniform light from all sides, mW/mm^2.
    """

    inner_index: Number
    stop: StopParameters
    iris: IrisParameters
    limbus: LimbusParameters
    sclera: ScleraParameters
    image: ImageParameters
    pose: PoseParameters
    camera: CameraParameters
    pupil_albedo: Number
    globe_reach: Number
    backdrop_x: Number
    ambient_irradiance: Number


@dataclass(kw_only=True)
class Parameters(FrameParameters):
    """All parameters of a frame on the host.

    Attributes:
        surfaces: the refracting surfaces in front of the iris, from outside inwards.
        lenses: worn lenses in the scene's frame, from outside inwards.
        turned_lenses: the same in the eye's frame.
    """

    surfaces: tuple[SurfaceParameters, ...]
    lenses: tuple[LensParameters, ...] = ()
    turned_lenses: tuple[LensParameters, ...] = ()


def packed(tree: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Pack the leaves of host parameters into one vector, in the order of the fields."""
    return np.concatenate([np.asarray(leaf, dtype=np.float64).reshape(-1) for leaf in _leaves(tree)]).astype(np.float32)


def rebuilt(tree: _Tree, leaf: Callable[[int], Any]) -> _Tree:
    """Rebuild a tree of parameters; `leaf(size)` returns each leaf, in the order of `packed`."""
    node: Any = tree
    made: Any
    if names := names_of(type(node)):  # type: ignore[arg-type]  # classes are hashable
        made = type(node)(**{name: rebuilt(getattr(node, name), leaf) for name in names})
    elif _is_branch(node):
        made = tuple(rebuilt(part, leaf) for part in node)
    else:
        made = None if node is None else leaf(np.size(node))
    return made  # type: ignore[no-any-return]


def _leaves(node: Any) -> Iterator[Any]:
    if names := names_of(type(node)):  # type: ignore[arg-type]  # classes are hashable
        for name in names:
            yield from _leaves(getattr(node, name))
    elif _is_branch(node):
        for part in node:
            yield from _leaves(part)
    elif node is not None:
        yield node


def _is_branch(node: Any) -> bool:
    """Return whether a tuple holds parameters or vectors; a tuple of plain numbers is a leaf."""
    return isinstance(node, tuple) and any(names_of(type(part)) or np.ndim(part) for part in node)  # type: ignore[arg-type]


@cache
def names_of(kind: type) -> tuple[str, ...]:
    """Return the attribute names of a dataclass; none of another class."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()
