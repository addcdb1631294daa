#!/usr/bin/env python3
"""Draw ideal labelled eye images by supersampling, for developing and testing pupil and glint extractors.

    make_ideal_images.py DIR --condition noise2 --count 40 --seed 10000

Every image is a pure function of (condition, seed). The scene is a set of sharp-edged regions; each pixel is sampled
16 times in x and in y (regions on a 4 x 4 grid of cells, and every cell that an outline crosses again 4 x 4; glints
directly 16 x 16). The fine grid is blurred by a Gaussian and averaged; then noise is added and the values are
quantised. No code is shared with any extractor. Seeds below 10,000 are for development, the others for reports.

The folder holds `metadata.jsonl` (one record per image), `images/` and `dataset.json`.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

CELLS = 4  # cells a pixel, each way
SAMPLES = 4  # samples a cell, each way: 16 a pixel
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Condition:
    """What varies between the rows of the bench. Grey levels are 8-bit (DN) whatever the bit depth."""

    size: tuple[int, int] = (640, 480)
    semi_axis: tuple[float, float] = (28.0, 48.0)
    aspect: tuple[float, float] = (0.7, 1.0)
    noise: tuple[float, float] = (0.0, 0.0)  # log-uniform when the ends differ
    blur: tuple[float, float] = (1.0, 1.0)
    pupil_level: tuple[float, float] = (20.0, 20.0)
    step: tuple[float, float] = (55.0, 55.0)  # pupil to iris
    texture: tuple[float, float] = (0.0, 0.0)
    shading: tuple[float, float] | None = None  # change of the light over a semi-axis a of the pupil, in any direction
    lid: tuple[float, float] | None = None  # covered part of the pupil, in units of its vertical semi-axis
    glints: str = "isolated"  # isolated | edge | saturated | ring | eight | scatter | none
    glint_peak: float = 225.0  # grey level at the spot's centre, background included
    glint_sigma: tuple[float, float] = (1.0, 1.6)  # of the blurred spot
    bare_globe: bool = False  # the eyeball before a darker backdrop
    bright_pupil: bool = False
    bit_depth: int = 8
    jpeg: tuple[int, int] | None = None  # range of the quality with which the image is compressed
    log_size: bool = False  # the semi-axis is drawn evenly in its logarithm
    iris: tuple[float, float] | None = None  # radius over that of the pupil; None: 2.4


CONDITIONS: dict[str, Condition] = {
    "clean": Condition(),
    "noise2": Condition(noise=(2, 2)),
    "noise2-17px": Condition(noise=(2, 2), semi_axis=(17, 17)),
    "noise2-13px": Condition(noise=(2, 2), semi_axis=(13, 13)),
    "noise8": Condition(noise=(8, 8)),
    "noise16": Condition(noise=(16, 16)),
    "blur4": Condition(noise=(2, 2), blur=(4, 4), glint_sigma=(4.0, 4.4)),
    "texture6": Condition(noise=(2, 2), texture=(6, 6)),
    "shading": Condition(noise=(2, 2), shading=(0.05, 0.3)),
    "edge-glint": Condition(noise=(2, 2), glints="edge"),
    "lid": Condition(noise=(2, 2), lid=(0.2, 0.6)),
    "saturated-glint": Condition(noise=(2, 2), glints="saturated", glint_peak=1000.0),
    "bright-pupil": Condition(noise=(2, 2), bright_pupil=True, pupil_level=(110, 110), step=(-55, -55)),
    "remote": Condition(
        size=(320, 240), semi_axis=(12, 14), noise=(1, 3), blur=(0.7, 1.0), pupil_level=(12, 20), step=(38, 58),
        aspect=(0.8, 1.0), glints="scatter", glint_peak=250.0, glint_sigma=(0.75, 1.05), bare_globe=True, bit_depth=16,
    ),
    "head-mounted": Condition(
        semi_axis=(60, 90), noise=(2, 4), aspect=(0.6, 1.0), glints="ring", glint_sigma=(1.2, 2.0), texture=(0, 6)
    ),
    "eight-glints": Condition(noise=(2, 2), glints="eight"),
    # A ring light close to the eye: eight spots fill a small pupil.
    "ring-light": Condition(
        size=(320, 240), semi_axis=(14, 28), aspect=(0.85, 1.0), noise=(1, 4), glints="eight",
        glint_sigma=(1.2, 2.2), texture=(0, 6),
    ),
    "jpeg": Condition(
        size=(320, 240), semi_axis=(11, 40), noise=(1, 4), blur=(0.8, 2.0), texture=(0, 6), glints="scatter",
        jpeg=(20, 50),
    ),
    # The pupil has 0.3 to 0.6 of the iris' level.
    "grey-pupil": Condition(
        size=(320, 240), semi_axis=(12, 40), noise=(1, 4), pupil_level=(40, 66), step=(44, 90), texture=(0, 5),
        glints="scatter",
    ),
    "any-size": Condition(
        size=(1280, 960), semi_axis=(5, 200), noise=(1, 3), blur=(0.7, 1.2), texture=(0, 4), glints="two",
        glint_sigma=(0.8, 1.4), log_size=True,
    ),
    # Wide: what a calibrated confidence has to stand; about one image in five is beyond any extractor.
    "mixed": Condition(
        size=(320, 240), semi_axis=(13, 45), aspect=(0.6, 1.0), noise=(0.5, 30), blur=(0.7, 4.0), pupil_level=(8, 45),
        step=(12, 75), texture=(0, 12), lid=(-1.5, 1.0), glints="scatter", glint_peak=240.0, glint_sigma=(0.8, 2.5),
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Drawing:
    """One image with its label."""

    image: NDArray[Any]
    label: dict[str, Any]
    parameters: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Conic:
    """A filled ellipse by its implicit function."""

    centre: Array
    semi: Array
    angle: float

    def local(self, x: Array, y: Array) -> tuple[Array, Array]:
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        dx, dy = x - self.centre[0], y - self.centre[1]
        return (dx * cos + dy * sin) / self.semi[0], (-dx * sin + dy * cos) / self.semi[1]

    def distance(self, x: Array, y: Array) -> Array:
        """About the distance to the outline, px, negative inside; its sign is exact."""
        u, v = self.local(x, y)
        r = np.hypot(u, v)
        return np.asarray((r - 1.0) * r / np.maximum(np.hypot(u / self.semi[0], v / self.semi[1]), 1e-12))

    def at(self, radius: float, t: float) -> Array:
        """The point at `radius` times the outline, at parameter t."""
        u, v = radius * self.semi[0] * math.cos(t), radius * self.semi[1] * math.sin(t)
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return np.array([self.centre[0] + u * cos - v * sin, self.centre[1] + u * sin + v * cos])


def coverage(distance: Callable[[Array, Array], Array], x: Array, y: Array) -> Array:
    """Covered share of every cell: 0 or 1 away from the outline, counted on 4 x 4 samples where it may cross."""
    d = distance(x[None, :], y[:, None])
    share = (d < 0.0).astype(np.float64)
    rows, columns = np.nonzero(np.abs(d) < 2.0 / CELLS)
    offsets = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) / CELLS
    sx = x[columns][:, None, None] + offsets[None, None, :]
    sy = y[rows][:, None, None] + offsets[None, :, None]
    share[rows, columns] = (distance(*np.broadcast_arrays(sx, sy)) < 0.0).mean(axis=(1, 2))
    return share


def draw(condition: str | Condition, seed: int) -> Drawing:
    """The image and label of one seed."""
    name = condition if isinstance(condition, str) else "custom"
    c = CONDITIONS[condition] if isinstance(condition, str) else condition
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])

    def pick(span: tuple[float, float]) -> float:
        return float(rng.uniform(*span))

    width, height = c.size
    noise = c.noise[0] if c.noise[0] == c.noise[1] else float(np.exp(rng.uniform(*np.log(c.noise))))
    blur, step, texture = pick(c.blur), pick(c.step), pick(c.texture)
    pupil_level = pick(c.pupil_level)
    iris_level = pupil_level + step
    sclera_level = min(2.0 * max(iris_level, 40.0), 200.0)
    a = float(np.exp(rng.uniform(*np.log(c.semi_axis)))) if c.log_size else pick(c.semi_axis)
    reach = min((2.4 if c.iris is None else pick(c.iris)) * a, 0.42 * height)
    spread = 0.12 * np.array([width, height])
    pupil = _Conic(
        np.array([(width - 1) / 2, (height - 1) / 2]) + rng.uniform(-spread, spread),
        a * np.array([1.0, pick(c.aspect)]),
        pick((0.0, math.pi)),
    )
    iris = _Conic(pupil.centre + rng.uniform(-0.03, 0.03, 2) * a, pupil.semi * max(reach / a, 1.4), pupil.angle)
    lid = _lid(c, pupil, rng)
    glints = _place_glints(c, pupil, iris, rng)

    x0, x1, y0, y1 = 0, width, 0, height
    if lid is None and not c.bare_globe:  # nothing changes outside the iris
        pad = math.ceil(5.0 * blur) + 2
        half = math.ceil(iris.semi[0]) + pad
        x0, x1 = max(0, int(iris.centre[0]) - half), min(width, int(iris.centre[0]) + half + 2)
        y0, y1 = max(0, int(iris.centre[1]) - half), min(height, int(iris.centre[1]) + half + 2)
    cell_x = x0 - 0.5 + (np.arange((x1 - x0) * CELLS) + 0.5) / CELLS
    cell_y = y0 - 0.5 + (np.arange((y1 - y0) * CELLS) + 0.5) / CELLS

    fine = np.full((cell_y.size, cell_x.size), sclera_level)
    if c.bare_globe:
        globe = _Conic(iris.centre + rng.uniform(-0.5, 0.5, 2) * iris.semi[1], np.full(2, 2.05 * iris.semi[0]), 0.0)
        backdrop = pick((0.0, 0.5)) * iris_level
        fine = backdrop + (sclera_level - backdrop) * coverage(globe.distance, cell_x, cell_y)
    fine += coverage(iris.distance, cell_x, cell_y) * (
        iris_level + _iris_texture(iris, texture, cell_x, cell_y, rng) - fine
    )
    fine += coverage(pupil.distance, cell_x, cell_y) * (pupil_level - fine)
    if lid is not None:
        skin = pick((0.9, 1.6)) * 75.0
        fine += coverage(lid, cell_x, cell_y) * (skin - fine)
    # The cell's own extent is part of the blur.
    sigma_cells = CELLS * math.sqrt(max(blur**2 - 1.0 / (12 * CELLS**2), 0.0))
    fine = ndimage.gaussian_filter(fine, sigma_cells, mode="nearest", truncate=5.0)
    image = np.full((height, width), sclera_level)
    image[y0:y1, x0:x1] = fine.reshape(y1 - y0, CELLS, x1 - x0, CELLS).mean(axis=(1, 3))
    if c.shading is not None:
        image *= _shading(pupil, pick(c.shading), pick((0.0, 2.0 * math.pi)), width, height)
    for glint in glints:
        glint["seen"] = lid is None or float(lid(*glint["xy"])) > 0.0
        if glint["seen"]:
            _add_glint(image, glint, c.glint_peak)

    full = 2**c.bit_depth - 1
    data = (image + rng.normal(0.0, 1.0, image.shape) * noise) * (full / 255.0)
    stored = np.clip(np.rint(data), 0, full).astype(np.uint8 if c.bit_depth == 8 else np.uint16)
    if c.jpeg is not None:
        stored = compressed(stored, int(rng.integers(*c.jpeg, endpoint=True)))
    record = _record(pupil, glints, seed)
    parameters = {
        "condition": name, "seed": seed, "noise_dn": noise, "blur_px": blur, "step_dn": step, "texture_dn": texture,
        "pupil_level_dn": pupil_level, "lid": lid is not None, "visible_fraction": _visible(pupil, lid),
        "bit_depth": c.bit_depth, "iris_px": float(iris.semi[1]),
        "pupil_contrast_to_noise": abs(step) / max(noise, 1e-9), "polarity": "bright" if c.bright_pupil else "dark",
    }  # fmt: skip
    return Drawing(stored, record, parameters)


def _shading(pupil: _Conic, change: float, direction: float, width: int, height: int) -> Array:
    """Light that changes linearly over the image, between 0.2 and 2.5 of that at the pupil's centre."""
    x, y = np.arange(width) - pupil.centre[0], np.arange(height)[:, None] - pupil.centre[1]
    along = (x * math.cos(direction) + y * math.sin(direction)) / pupil.semi[0]
    return np.asarray(np.clip(1.0 + change * along, 0.2, 2.5))


def compressed(image: NDArray[Any], quality: int) -> NDArray[Any]:
    """What JPEG leaves of an image."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "jpeg", quality=quality)
    return np.asarray(Image.open(buffer))


def draw_no_eye(seed: int, size: tuple[int, int] = (320, 240)) -> NDArray[np.uint8]:
    """An 8-bit image without an eye: 1/f fields, rectangles, letters, lines, discs with holes, checks, noise, ramps."""
    rng = np.random.default_rng([seed, zlib.crc32(b"no eye")])
    width, height = size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    kind = rng.choice(["field", "field", "rectangles", "letters", "lines", "checks", "noise", "ramp"])
    canvas = Image.new("L", size, int(rng.integers(90, 230)))
    pen = ImageDraw.Draw(canvas)

    def grey() -> int:
        return int(rng.integers(0, 255))

    if kind == "field":
        power = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.fftfreq(width)[None, :] ** 2
        power[0, 0] = 1.0
        white = np.fft.fft2(rng.normal(size=(height, width)))
        field = np.fft.ifft2(white / power ** rng.uniform(0.4, 1.1)).real
        image = 128.0 + 40.0 * field / field.std()
    elif kind == "checks":
        side = rng.integers(8, 50)
        image = 40.0 + 150.0 * ((x // side + y // side) % 2)
    elif kind == "noise":
        image = np.full((height, width), 120.0) + rng.normal(0.0, 20.0, (height, width))
    elif kind == "ramp":
        image = 128.0 + rng.uniform(-0.4, 0.4) * x + rng.uniform(-0.4, 0.4) * y
    else:
        for _ in range(int(rng.integers(2, 20))):
            left, top = (int(v) for v in rng.integers(-20, (width, height)))
            if kind == "rectangles":
                pen.rectangle([left, top, left + int(rng.integers(5, 90)), top + int(rng.integers(5, 90))], fill=grey())
            elif kind == "lines":
                end = [int(v) for v in rng.integers(0, (width, height))]
                pen.line([left, top, *end], fill=grey(), width=int(rng.integers(1, 20)))
            else:
                text = "".join(rng.choice(list("ABCDGOQSaegos0689"), 5))
                pen.text((left, top), text, fill=grey(), font=ImageFont.load_default(size=int(rng.integers(12, 110))))
        image = np.asarray(canvas, dtype=np.float64)
    image = np.asarray(ndimage.gaussian_filter(image, rng.uniform(0.5, 2.0)))
    image = image + rng.normal(0.0, 1.0, image.shape) * rng.uniform(0.5, 8.0)
    return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)


def _iris_texture(iris: _Conic, sigma: float, x: Array, y: Array, rng: np.random.Generator) -> Array | float:
    """Fibres: 24 harmonics of the angle, amplitude 1 / sqrt(1 + (n/4)^2), each slowly turning with the radius.

    Summed on a polar grid so fine that interpolating linearly in it is 2e-4 of the amplitude off.
    """
    if sigma <= 0.0:
        return 0.0
    n = np.arange(1, 25)
    weight = 1.0 / np.sqrt(1.0 + (n / 4.0) ** 2)
    weight *= sigma * math.sqrt(2.0) / np.linalg.norm(weight)
    phase, twist = rng.uniform(0.0, 2.0 * np.pi, n.size), rng.normal(0.0, 2.0, n.size)
    turns, steps, end = 4096, 97, 1.2
    angle, radius = np.arange(turns) * (2.0 * np.pi / turns), np.linspace(0.0, end, steps)
    wave = np.exp(1j * n * angle[:, None])
    table = (wave @ (weight * np.exp(1j * (phase + twist * radius[:, None]))).T).real
    u, v = iris.local(x[None, :], y[:, None])
    r = np.hypot(u, v)
    near = r < end
    place = [np.arctan2(v[near], u[near]) * (turns / (2.0 * np.pi)) % turns, r[near] * ((steps - 1) / end)]
    out = np.zeros_like(r)
    out[near] = ndimage.map_coordinates(np.concatenate([table, table[:1]]), place, order=1)
    return out


def _lid(c: Condition, pupil: _Conic, rng: np.random.Generator) -> Callable[[Array, Array], Array] | None:
    """An upper lid's margin, a parabola: about its signed distance, negative under the lid."""
    if c.lid is None:
        return None
    covered = rng.uniform(*c.lid)
    if covered <= 0.0:
        return None
    top = math.hypot(pupil.semi[0] * math.sin(pupil.angle), pupil.semi[1] * math.cos(pupil.angle))
    bend = rng.uniform(0.0, 0.15) / pupil.semi[0]
    tilt, middle = rng.uniform(-0.15, 0.15), rng.uniform(-0.4, 0.4) * pupil.semi[0]
    # The lowest point of the margin over the pupil reaches `covered` semi-axes below the pupil's top.
    level = pupil.centre[1] - top + covered * top

    def distance(x: Array, y: Array) -> Array:
        t = x - pupil.centre[0]
        margin = level + tilt * t - bend * (t - middle) ** 2
        return np.asarray((y - margin) / np.sqrt(1.0 + (tilt - 2.0 * bend * (t - middle)) ** 2))

    return distance


def _visible(pupil: _Conic, lid: Callable[[Array, Array], Array] | None) -> float:
    """The share of the pupil that the lid leaves to be seen, to about 0.001."""
    if lid is None:
        return 1.0
    a = pupil.semi.max()
    x, y = (np.linspace(-a, a, 401) + c for c in pupil.centre)
    inside = pupil.distance(x[None, :], y[:, None]) < 0.0
    seen = np.broadcast_to(lid(x[None, :], y[:, None]), inside.shape) > 0.0
    return float(np.count_nonzero(inside & seen) / np.count_nonzero(inside))


def _place_glints(c: Condition, pupil: _Conic, iris: _Conic, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Spots with their true centre and sigma; the wanted clearances are met by drawing again."""
    if c.glints == "none":
        return []
    if c.glints == "eight":
        middle, radius = pupil.at(rng.uniform(0.0, 0.35), rng.uniform(0.0, 2.0 * math.pi)), rng.uniform(0.45, 0.8)
        turn = rng.uniform(0.0, 2.0 * math.pi) + np.arange(8) * (math.pi / 4.0)
        around = radius * pupil.semi[1] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return [
            {"xy": middle + xy, "sigma": float(s)} for xy, s in zip(around, rng.uniform(*c.glint_sigma, 8), strict=True)
        ]
    sigma = [float(s) for s in rng.uniform(*c.glint_sigma, 6)]
    some = {"scatter": 4, "two": 3}
    count = {"isolated": 2, "saturated": 2, "edge": 2, "ring": 6}.get(c.glints) or int(rng.integers(0, some[c.glints]))
    clearance = 4.0 * max(sigma[:count], default=1.0) + 2.0
    spots: list[Array] = []
    start = rng.uniform(0.0, 2.0 * math.pi)
    for index in range(count):
        for _ in range(1000):
            t = rng.uniform(0.0, 2.0 * math.pi)
            if c.glints == "ring":
                radius = 0.35 + 0.5 * (index % 2) if pupil.semi[1] > 40 else 1.4
                spot = pupil.at(radius, start + index * math.pi / 3.0)
                break
            if c.glints == "edge" and index == 0:
                spot = pupil.at(1.0, t) + rng.uniform(-0.7, 0.7, 2)
                break
            if c.glints in some:
                spot = iris.at(math.sqrt(rng.uniform(0.0, 1.0)), t)
                free = True
            else:
                spot = iris.at(rng.uniform(0.0, 1.0), t)
                inside = pupil.distance(*spot) < 0.0
                roomy = pupil.semi[1] > clearance + 3.0
                free = min(abs(float(pupil.distance(*spot))), abs(float(iris.distance(*spot)))) > clearance
                free &= bool(inside) == (index == 0 and roomy)
            if free and all(np.hypot(*(spot - other)) > 2.5 * clearance for other in spots):
                break
        else:
            continue
        spots.append(spot)
    return [{"xy": spot, "sigma": s} for spot, s in zip(spots, sigma, strict=False)]


def _add_glint(image: Array, glint: dict[str, Any], peak: float) -> None:
    """Add a Gaussian spot, every pixel the mean of 16 x 16 samples."""
    x, y = glint["xy"]
    half = math.ceil(6.0 * glint["sigma"]) + 1
    rows = np.arange(max(0, round(y) - half), min(image.shape[0], round(y) + half + 1))
    columns = np.arange(max(0, round(x) - half), min(image.shape[1], round(x) + half + 1))
    if rows.size == 0 or columns.size == 0:
        return
    n = CELLS * SAMPLES
    offsets = (np.arange(n) + 0.5) / n - 0.5
    profile = [
        np.exp(-0.5 * ((axis[:, None] + offsets - centre) / glint["sigma"]) ** 2).mean(axis=1)
        for axis, centre in ((rows, y), (columns, x))
    ]
    background = float(np.median(image[np.ix_(rows, columns)][half - 1 : half + 2, half - 1 : half + 2]))
    image[np.ix_(rows, columns)] += (peak - background) * profile[0][:, None] * profile[1][None, :]


def _record(pupil: _Conic, glints: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """A record of the package's schema; keys that an ideal image does not have are null."""
    axes, angle = pupil.semi, pupil.angle % math.pi
    return {
        "schema": "eyerender/record/3", "frame": seed, "fixation": None, "camera": 0, "eye": None, "eye_model": None,
        "target_mm": None, "head_mm": None, "eye_position_mm": None, "pose": None,
        "pupil": {
            "status": "ok", "reason": None, "in_image": True, "centre_px": pupil.centre.tolist(),
            "semi_axes_px": axes.tolist(), "angle_rad": angle, "anatomical_centre_px": None, "points_px": None,
            "covariance": None, "arcs_deg": None, "arc_ellipse": None,
        },
        "glints": [
            {"light": i, "status": "ok" if glint["seen"] else "missing",
             "reason": None if glint["seen"] else "under the lid", "in_image": True,
             "xy_px": glint["xy"].tolist() if glint["seen"] else None, "covariance": None}
            for i, glint in enumerate(glints)
        ],
    }  # fmt: skip


def write(directory: Path, condition: str, count: int, first_seed: int) -> None:
    """Write `count` images and their labels into `directory`."""
    (directory / "images").mkdir(parents=True, exist_ok=True)
    lines = []
    for seed in range(first_seed, first_seed + count):
        drawing = draw(condition, seed)
        name = f"images/{condition}-{seed:06d}.png"
        Image.fromarray(drawing.image).save(directory / name)
        lines.append({"file_name": name, "masks": None, "records": [drawing.label], "parameters": drawing.parameters})
    (directory / "metadata.jsonl").write_text("".join(json.dumps(line, allow_nan=False) + "\n" for line in lines))
    about = {
        "schema": "eyerender/ideal-images/1",
        "condition": condition,
        "seeds": [first_seed, first_seed + count],
        "conventions": "pixel centres at integers; semi-axes a >= b, angle of a from +x toward +y",
    }
    (directory / "dataset.json").write_text(json.dumps(about, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--condition", choices=sorted(CONDITIONS), default="noise2")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=10_000, help="first seed; below 10,000 is for development")
    options = parser.parse_args()
    if options.directory.exists() and any(options.directory.iterdir()):
        raise SystemExit(f"error: {options.directory}: is not empty")
    write(options.directory, options.condition, options.count, options.seed)


if __name__ == "__main__":
    main()
