"""Checks of an image's files: sizes and values, and masks against outlines and labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools, Floats
from ...folders.imagefolder import ImageEntry
from ...imaging.labels import moments_ellipse, whole_pixels
from ...optics.ellipse import points_on_ellipse
from ...rig.camera import PinholeCamera, Window
from ...scene.parts import FRAME, IRIS, PUPIL, SPECTACLES
from .problems import differences

# A mask is traced in single precision, which moves an outline by at most .004 px (measured on the shipped eyes, seen at
# up to 35 deg). The polygon of `_POINTS` chords is within r pi^2 / (2 n^2) of the curve, 0.02 px at r = 500 px.
EXACT_PX = 0.05
# Tolerances where only the best-fitting ellipse is known. The limbus deviates from it by .06 px at most, in E5.
# Irregular pupils and pupils seen from the side deviate by up to 1.05 px.
LIMBUS_PX, PUPIL_PX = 0.25, 1.5
# Moments of a moving picture are at most half a pixel apart, and each row of a mask is that of the nearest one.
MOMENT_PX = 0.3
_POINTS = 360


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """A closed polygon `curve` (n, 2) px, and the tolerance for a pixel's centre on either side."""

    curve: Floats
    tolerance_px: float

    @classmethod
    def through(cls, points_px: Floats) -> Outline:
        """Interpolate a closed curve through boundary points (k, 2) px at equal parameter steps, k >= 6.

        The interpolation is trigonometric, which is exact for a curve with fewer than k / 2 harmonics. The outline of a
        stop has few, so the size of the harmonics above k / 4 estimates the interpolation error.
        """
        k = len(points_px)
        harmonics = np.fft.fft(points_px[:, 0] + 1j * points_px[:, 1]) / k
        order = np.fft.fftfreq(k, 1 / k)
        error = float(np.abs(harmonics[np.abs(order) > k / 4]).sum())
        t = np.arange(_POINTS) / _POINTS
        # For an even number of points the highest harmonic has both signs.
        waves = np.exp(2j * np.pi * np.outer(t, order))
        if k % 2 == 0:
            waves[:, k // 2] = np.cos(np.pi * k * t)
        curve = waves @ harmonics
        return cls(np.stack([curve.real, curve.imag], axis=1), EXACT_PX + error)

    @classmethod
    def ellipse(cls, centre_px: Floats, semi_axes_px: Floats, angle_rad: float, tolerance_px: float) -> Outline:
        """Create the outline from an ellipse, if only the best-fitting ellipse is known."""
        return cls(points_on_ellipse(centre_px, semi_axes_px, angle_rad, _POINTS), tolerance_px)

    def inside(self, window: Window) -> Bools:
        """Return whether each pixel's centre in a window (x0, y0, width, height) lies inside, (height, width)."""
        from skimage.draw import polygon2mask

        x0, y0, width, height = window
        corners = (self.curve - np.array([x0, y0]))[:, ::-1]  # (row, column)
        return np.asarray(polygon2mask((height, width), corners))  # type: ignore[no-untyped-call]

    def beyond(self, pixels: Bools, window: Window) -> Floats:
        """Return the distances (px) from the outline of those pixels of a window that exceed the tolerance."""
        v, u = np.nonzero(pixels)
        at = np.stack([u + window[0], v + window[1]], axis=1).astype(float)
        p, way = self.curve, np.roll(self.curve, -1, axis=0) - self.curve
        length2 = np.maximum(np.sum(way * way, axis=1), 1e-300)
        out = []
        for part in np.array_split(at, max(1, len(at) // 1024)):
            away = part[:, None, :] - p
            t = np.clip(np.sum(away * way, axis=2) / length2, 0, 1)
            gap = away - t[..., None] * way
            out.append(np.sqrt(np.sum(gap * gap, axis=2)).min(axis=1, initial=np.inf))
        distance = np.concatenate(out)
        return np.asarray(distance[distance > self.tolerance_px])


SKIN, SCLERA = 0, 1
_RIMS = 11  # instance of the frame of spectacles
_VISIBLE = 1e-8  # relative; numbers of packed lines are rounded to 5e-9
_SAME_S = 1e-9  # times that differ by less are equal
_UNIT, _FACING = 1e-3, 1e-3  # of normals, which half precision rounds by up to 5e-4
_BENT = 0.5  # largest cosine behind spectacles, which turn the pixel's ray by up to 30 degrees
_EDGES = 1e-3  # share of pixels in which two rays through one place may meet different sides of an edge
Mask = NDArray[Any]


class Tally:
    """Running statistics of pixel values."""

    def __init__(self) -> None:
        self.images = 0
        self.level = self.saturated = 0.0

    def take(self, image: NDArray[Any], full: float) -> None:
        """Add one image, whose largest possible value is `full`."""
        self.images += 1
        self.level += float(image.mean()) / full
        self.saturated += float(np.mean(image >= full))

    def to_mapping(self) -> dict[str, Any]:
        """Return means over all images; empty if there were none."""
        if not self.images:
            return {}
        return {
            "mean_level": round(self.level / self.images, 4),
            "saturated_share": round(self.saturated / self.images, 6),
        }


def check_images(entry: ImageEntry, limbus_px: Floats | None, tally: Tally) -> Iterator[str]:
    """Describe what is wrong with an image's files; `limbus_px` (k, 2) is the limbus if it was recomputed.

    Raises:
        InputError: a file cannot be read.
    """
    line = entry.line
    found = entry.picture("file_name")
    assert found is not None
    image, stored = found
    w, h = entry.window[2:]
    if image.shape != (h, w):
        yield f"is {_size(image)} px, but its window is {w} x {h}"
        return
    depth = int(line.get("bit_depth") or stored)
    if depth > stored and not (stored == 16 and depth <= 16):
        yield f"is stored with {stored} bits, but its bit depth is {depth}"
    full = float(2**depth - 1)
    if float(image.max()) > full:
        yield f"has values above {full:g}"
    tally.take(image, full)
    names = ("noiseless", "mask", "amodal_mask", "highlight_mask", "lens_reflection_mask")
    pictures = (entry.picture(f"{name}_file_name") for name in names)
    quiet, mask, whole, *marked = (None if picture is None else picture[0] for picture in pictures)
    if quiet is not None and (quiet.shape != image.shape or float(quiet.max()) > full):
        yield "its noiseless image has another shape or values above its range"
    for what, marks in zip(("highlights", "lens reflections"), marked, strict=True):
        if marks is not None and (marks.shape != image.shape or int(marks.max()) > 1):
            yield f"its mask of {what} has another shape or values above 1"
    if mask is not None:
        yield from _masks(entry, mask, whole, limbus_px)
    yield from _geometry(entry, mask)


def _geometry(entry: ImageEntry, mask: Mask | None) -> Iterator[str]:
    """Compare arrays of geometry with each other and with the mask."""
    depth, normals, iris, instances = entry.depth(), entry.normals(), entry.iris_coordinates(), entry.instance_mask()
    if depth is not None and np.nanmin(depth, initial=1.0) <= 0:
        yield "its depth holds values <= 0"
    if normals is not None:
        length, away = np.linalg.norm(normals, axis=2), np.sum(normals * _rays(entry), axis=2)
        facing = _BENT if any(record.get("lens_glints") for record in entry.line["records"]) else _FACING
        if np.nanmax(np.abs(length - 1), initial=0.0) > _UNIT or np.nanmax(away, initial=-1.0) > facing:
            yield "its normals are no unit vectors to the camera"
    if instances is None:
        return
    if mask is not None and instances.shape == mask.shape:
        own = np.where(instances == _RIMS, SPECTACLES, np.where(instances > FRAME, SKIN, instances))
        if np.count_nonzero(own != mask) > _EDGES * mask.size:
            yield "its mask of instances differs from its mask"
    for name, values, there in (
        ("depth", depth, (instances != SKIN) & (instances != FRAME)),
        ("iris coordinates", iris, (instances == IRIS) | (instances == PUPIL)),
    ):
        if values is not None and np.any(np.isnan(values if values.ndim == 2 else values[..., 0]) == there):
            yield f"its {name} are not where its mask of instances says"


def _rays(entry: ImageEntry) -> Floats:
    """Compute unit directions (h, w, 3) out of the camera through the pixels, in the frame of its normals."""
    (x0, y0, w, h), camera = entry.window, PinholeCamera.from_labels(entry.line["labels"]["camera"])
    v, u = np.mgrid[y0 : y0 + h, x0 : x0 + w].astype(float)
    return np.asarray(camera.rays(np.stack([u, v], axis=-1)) @ camera.sensor_axes.T)


def _masks(entry: ImageEntry, mask: Mask, whole: Mask | None, limbus_px: Floats | None) -> Iterator[str]:
    """Return masks of the visible parts and, if available, of the whole parts."""
    w, h = entry.window[2:]
    drawn = entry.annotated_mask()
    for name, picture in (("mask", mask), ("amodal mask", whole), ("annotated mask", drawn)):
        if picture is None:
            continue
        if picture.shape != (h, w):
            yield f"its {name} is {_size(picture)} px"
            return
        if int(picture.max()) > (PUPIL if picture is whole else SPECTACLES):
            yield f"its {name} holds the value {int(picture.max())}"
    if drawn is not None and np.any((mask != SKIN) & (drawn != mask)):
        yield "its annotated mask lacks a part that its mask shows there"
    yield from _visible(entry.line, mask, entry.window)
    yield from _outlines(entry.line, mask, whole, limbus_px, entry.window)


def _iris(mask: Mask) -> Bools:
    """Return a mask of iris and pupil together."""
    return np.asarray((mask == IRIS) | (mask == PUPIL))


def _size(picture: NDArray[Any]) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"


def _visible(line: dict[str, Any], mask: Mask, window: Window) -> Iterator[str]:
    """Compare the visible ellipses with ellipses of the mask's own pixels."""
    for name, inside in (("pupil", mask == PUPIL), ("iris", _iris(mask))):
        own = line.get("labels", {}).get(name)
        if isinstance(own, dict):
            again = moments_ellipse(inside, window)
            # Packed lines have fewer digits.
            if next(differences(again, own["visible"], _VISIBLE), None) is not None:
                yield f"the visible ellipse of its {name} does not match its mask"


def _outlines(
    line: dict[str, Any], mask: Mask, whole: Mask | None, limbus_px: Floats | None, window: Window
) -> Iterator[str]:
    """Compare masks with the apparent outlines of pupil and limbus.

    Pixels within an outline show the part or something that hides it. So a pixel of the eye must show the part exactly
    if its centre lies within the outline, with or without lids. Skin within the outline is correct unless the labels
    state that nothing hides the part.
    """
    labels = line.get("labels", {})
    pupil, iris = pupil_outline(line), iris_outline(line, limbus_px)
    if _has_own_times(line):
        pupil, iris = (
            None if o is None else replace(o, tolerance_px=o.tolerance_px + MOMENT_PX) for o in (pupil, iris)
        )
    shares = [_share(labels, name) for name in ("pupil", "iris")]
    # The iris' visible fraction ignores what hides the pupil, so both must be whole.
    bare = all(share is not None and share >= 1.0 for share in shares)
    within = None if iris is None else iris.inside(window)
    for picture, what, alone in ((mask, "mask", bare), (whole, "amodal mask", True)):
        if picture is None:
            continue
        other = (picture == SKIN) if alone else np.zeros(picture.shape, dtype=bool)
        if pupil is not None:
            # Where the rim of the cornea is opaque like sclera, it hides the pupil behind it.
            clear = picture == IRIS if within is None else (picture == IRIS) | ((picture == SCLERA) & within)
            yield from _compare(f"{what} of its pupil", picture == PUPIL, clear | other, pupil, window)
        if iris is not None:
            yield from _compare(f"{what} of its iris", _iris(picture), (picture == SCLERA) | other, iris, window)
    if whole is not None:
        if np.any(~np.isin(mask, (SKIN, FRAME, SPECTACLES)) & (mask != whole)):
            yield "its mask shows a part that its amodal mask lacks there"
        for name, part, share in zip(("pupil", "iris"), (PUPIL, IRIS), shares, strict=True):
            there = whole_pixels(whole, labels, name, window)
            seen = np.count_nonzero((whole == part) & (mask == part))
            if share is not None and (not there or abs(share - seen / there) > 2 * _VISIBLE):
                yield f"the visible fraction of its {name} does not match its masks"


def _has_own_times(line: dict[str, Any]) -> bool:
    """Return whether rows are exposed at their own times, so that masks are put together from moments."""
    seen = [part["time_s"] for record in line["records"] for part in (record["pupil"], *record["glints"])]
    return any(time_s is not None and abs(time_s - line["time_s"]) > _SAME_S for time_s in seen)


def _compare(name: str, shown: Bools, not_shown: Bools, outline: Outline, window: Window) -> Iterator[str]:
    """Describe pixels that show a part beyond its outline, and pixels within it that show something else."""
    area = outline.inside(window)
    for wrong, words in ((shown & ~area, "leaves its outline"), (not_shown & area, "does not fill its outline")):
        if wrong.any():
            far = outline.beyond(wrong, window)
            if len(far):
                yield f"the {name} {words}: {len(far)} pixels, by up to {far.max():.2f} px"


def pupil_outline(line: dict[str, Any]) -> Outline | None:
    """Return the apparent outline of the pupil from the record; None if it is missing or incomplete."""
    if len(line["records"]) != 1:
        return None
    pupil = line["records"][0]["pupil"]
    if pupil["status"] != "ok":
        return None
    points = np.array(pupil["points_px"] or [], dtype=float)
    if len(points) >= 6 and np.isfinite(points).all():
        return Outline.through(points)
    return _ellipse(pupil, PUPIL_PX)


def iris_outline(line: dict[str, Any], limbus_px: Floats | None) -> Outline | None:
    """Return the visible limbus, recomputed or as the ellipse of the labels; None if the cornea hides a part of it."""
    if limbus_px is not None:
        return Outline(limbus_px, EXACT_PX)
    own = line.get("labels", {}).get("iris")
    if not isinstance(own, dict) or own["amodal"]["status"] != "ok" or own["amodal"].get("rim_hidden"):
        return None
    return _ellipse(own["amodal"], LIMBUS_PX)


def _ellipse(values: dict[str, Any], tolerance_px: float) -> Outline:
    centre, axes = np.array(values["centre_px"]), np.array(values["semi_axes_px"])
    return Outline.ellipse(centre, axes, values["angle_rad"], tolerance_px)


def _share(labels: dict[str, Any], name: str) -> float | None:
    """Return the visible fraction of a part from the labels of a dataset or a rendered folder."""
    own = labels.get(name)
    value = own["visible_fraction"] if isinstance(own, dict) else labels.get(f"{name}_visible_fraction")
    return None if value is None else float(value)
