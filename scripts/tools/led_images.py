"""Drawn eyes with the glints that real LEDs give, between lids: for fitting and testing the glint detector.

Every image is a pure function of its seed; seeds below 10,000 are for development. An eye of `make_ideal_images.py`
gets two lids of bright, textured skin with highlights, wet margins with chains of highlights, a dark line of lashes,
and the glints: one lamp, two, an arc or a ring of eight, as far as the cornea reaches. A glint is a uniform ellipse of
any slant, blurred by the optics, often many times as bright as the sensor can show, in one rig up to four times as
bright as another; some have a streak, up to almost as wide as the glint, or a star. Three kinds of spots are no glints:
the same lamps mirrored in the tear menisci along the lid margins, wet roots of lashes, and faint sharp ghosts inside
the pupil (reflections off the lens). The camera clips at 225 to 255 DN, and some sharpen or compress the image.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import make_ideal_images as ideal

Array = NDArray[np.float64]
FINE = 4  # samples per pixel, each way
EYE = ideal.Condition(
    size=(320, 240), semi_axis=(11, 42), aspect=(0.75, 1.0), blur=(0.8, 2.0), pupil_level=(6, 45), step=(20, 90),
    texture=(0, 8), glints="none", bit_depth=16, log_size=True, iris=(1.6, 4.5),
)  # fmt: skip


def draw(seed: int) -> ideal.Drawing:
    """The image and label of one seed; the label's glints carry their radius."""
    rng = np.random.default_rng([seed, zlib.crc32(b"led")])
    eye = ideal.draw(EYE, seed)
    image = eye.image.astype(np.float64) * (255.0 / 65535.0)
    pupil, about = eye.label["pupil"], eye.parameters
    centre, b = np.array(pupil["centre_px"]), pupil["semi_axes_px"][1]
    size = about["iris_px"] / 2.4  # lids and glints keep their places before the iris, however wide the pupil is
    open_eye, margins = _add_lids(image, centre, size, about["pupil_level_dn"] + about["step_dn"], rng)
    blur = about["blur_px"] * rng.uniform(0.7, 1.2)
    lamps = _glints(centre, size, blur, rng)
    # Beyond the limbus the sclera scatters the lamps' light. A glint at a lid's margin spills over it.
    cornea = [spot for spot in lamps if np.hypot(*(spot["xy_px"] - centre)) < about["iris_px"]]
    spots = [spot for spot in cornea if _inside(open_eye, spot["xy_px"], 0.5 * spot["radius_px"])]
    light = np.zeros_like(image)
    wet = [one for one in _wet_spots(lamps, margins, size, rng) if 0.0 <= one["xy_px"][1] < image.shape[0]]
    for spot in spots + [one for one in wet if _apart(one, spots)]:
        light += _spot(image.shape, spot, blur)
    for _ in range(int(rng.integers(0, 3)) if spots else 0):
        away = rng.uniform(0.1, 0.8) * b
        ghost = _lamp(centre + away * _unit(rng.uniform(0.0, 2.0 * math.pi)), rng.uniform(0.3, 1.0), rng)
        peak = min(spots[0]["peak"] * math.exp(rng.uniform(math.log(0.005), math.log(0.08))), 300.0)
        ghost |= {"peak": peak, "streak": 0.0, "star": 0.0}
        if _apart(ghost, spots):
            light += _spot(image.shape, ghost, rng.uniform(0.5, 1.0) * blur)
    label = {"pupil": pupil, "glints": [{"status": "ok", **spot} for spot in spots]}
    parameters = {**about, "condition": "led", "bit_depth": 8, "visible_fraction": float(_seen(open_eye, centre, b))}
    return ideal.Drawing(_developed(image + light, rng), label, parameters)


def _unit(turn: float) -> Array:
    return np.array([math.cos(turn), math.sin(turn)])


def _apart(one: dict[str, Any], spots: list[dict[str, Any]]) -> bool:
    """Whether a spot is clear of all glints."""
    return all(np.hypot(*(spot["xy_px"] - one["xy_px"])) > spot["radius_px"] + 6.0 for spot in spots)


def _wet_spots(
    lamps: list[dict[str, Any]], margins: tuple[Array, Array], b: float, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """The lamps mirrored in the menisci, near their glints' columns and drawn out along the lid, and wet lash roots."""
    spots, width = [], margins[0].size
    for margin in margins:
        for _ in range(int(rng.integers(0, 4))):
            lamp = lamps[int(rng.integers(0, len(lamps)))]
            x = float(np.clip(lamp["xy_px"][0] + rng.normal(0.0, 0.3) * b, 2.0, width - 3.0))
            slope = math.atan(float(np.gradient(margin)[int(x)]))
            one = _lamp(np.array([x, margin[int(x)] + rng.uniform(-2.0, 2.0)]), lamp["radius_px"], rng)
            one["semi"] = lamp["radius_px"] * np.array([rng.uniform(0.3, 1.0), rng.uniform(0.1, 0.4)]) + 0.2
            peak = lamp["peak"] * math.exp(rng.uniform(math.log(0.02), math.log(0.5)))
            spots.append({**lamp, **one, "turn": slope, "peak": peak})
    for _ in range(int(rng.integers(0, 15)) if rng.uniform() < 0.4 else 0):
        x = float(np.clip(lamps[0]["xy_px"][0] + rng.normal(0.0, 1.0) * b, 2.0, width - 3.0))
        root = _lamp(np.array([x, margins[0][int(x)] - rng.uniform(0.0, 0.5) * b]), rng.uniform(0.4, 1.2), rng)
        peak = lamps[0]["peak"] * math.exp(rng.uniform(math.log(0.02), math.log(0.3)))
        spots.append({**root, "peak": peak, "streak": 0.0, "star": 0.0})
    return spots


def _add_lids(
    image: Array, centre: Array, b: float, iris_dn: float, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], tuple[Array, Array]]:
    """Draw skin, wet margins and lashes over the image.

    Returns:
        The mask of what lies between the lids, and the rows of the upper and lower margin in every column.
    """
    height, width = image.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    t = (x - centre[0]) / (3.0 * b)
    upper = centre[1] - b * rng.uniform(0.8, 3.6) + b * rng.uniform(0.2, 1.2) * t**2 + b * rng.uniform(-0.4, 0.4) * t
    lower = centre[1] + b * rng.uniform(1.2, 3.6) - b * rng.uniform(0.2, 1.2) * t**2 + b * rng.uniform(-0.4, 0.4) * t
    skin_dn = iris_dn * rng.uniform(0.8, 2.2)
    fields = [cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), sigma) * sigma for sigma in (1.0, 2.5, 8.0)]
    skin = skin_dn * (1.0 + 0.1 * fields[0] + 0.1 * fields[1] + 0.25 * fields[2])
    shine = rng.uniform(0.0, 1.5) * skin_dn
    skin += shine * np.clip(2.0 * fields[0] + fields[2] - rng.uniform(1.5, 3.5), 0.0, 1.0)
    for margin, lid in ((upper, y < upper), (lower, y > lower)):
        image[lid] = skin[lid]
        wet = np.abs(y - margin) < rng.uniform(0.5, 2.0)
        chain = cv2.GaussianBlur(rng.normal(size=(1, width)), (0, 0), rng.uniform(1.0, 5.0))
        bright = np.clip(chain / chain.std() - rng.uniform(0.8, 2.5), 0.0, 1.0) * (np.abs(t) < rng.uniform(0.2, 1.0))
        image += rng.uniform(0.0, 300.0) * wet * cv2.GaussianBlur(bright, (0, 0), 1.0)
        dark, wide = rng.uniform(0.0, 0.9) * (rng.uniform() < 0.6), rng.uniform(0.04, 0.25) * b
        away = (y - margin) * (-1.0 if lid[0, 0] else 1.0)  # into the lid
        line = np.exp(-0.5 * ((away - rng.uniform(0.0, 2.0) * wide) / wide) ** 2)
        image *= 1.0 - dark * line * ((away > -1.0) & (upper < lower))
    for _ in range(int(rng.integers(0, 40))):
        root = int(rng.integers(0, width))
        side = 1.0 if rng.uniform() < 0.7 else -1.0
        start = np.array([root, (upper if side > 0 else lower)[0, root]])
        tip = start + b * np.array([rng.uniform(-0.8, 0.8), side * rng.uniform(-0.8, 0.5)])
        lash = np.zeros(image.shape)
        cv2.line(lash, tuple(map(int, start)), tuple(map(int, tip)), 1.0, int(rng.integers(1, 3)), cv2.LINE_AA)
        image *= 1.0 - rng.uniform(0.4, 0.9) * lash
    image[:] = cv2.GaussianBlur(image, (0, 0), 0.7)
    return np.asarray((y > upper) & (y < lower)), (upper[0], lower[0])


def _inside(mask: NDArray[np.bool_], xy: Array, radius: float) -> bool:
    """Whether a disc lies in the mask."""
    turns = [xy + (radius + 1.5) * _unit(k * math.pi / 4.0) for k in range(8)]
    places = np.rint(np.array([xy, *turns])).astype(int)
    if (places < 0).any() or (places >= np.array(mask.shape[::-1])).any():
        return False
    return bool(mask[places[:, 1], places[:, 0]].all())


def _seen(mask: NDArray[np.bool_], centre: Array, b: float) -> float:
    y, x = np.nonzero(np.ones_like(mask))
    disc = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < b * b
    return float(mask[y[disc], x[disc]].mean())


def _lamp(xy: Array, radius: float, rng: np.random.Generator) -> dict[str, Any]:
    shape = math.exp(rng.uniform(0.0, math.log(2.2)))
    semi = radius * np.array([math.sqrt(shape), 1.0 / math.sqrt(shape)])
    return {"xy_px": xy, "semi": semi, "turn": rng.uniform(0.0, math.pi), "radius_px": float(semi[0])}


def _glints(centre: Array, b: float, blur: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The glints of one rig: places, shapes, peaks, streaks and stars."""
    kind = rng.choice(["one", "one", "two", "arc", "arc", "eight"])
    count = {"one": 1, "two": 2, "eight": 8}.get(kind) or int(rng.integers(4, 12))
    middle = centre + b * rng.uniform(0.0, 2.2 if count == 1 else 1.0) * _unit(rng.uniform(0.0, 2.0 * math.pi))
    ring = b * (0.0 if count == 1 else rng.uniform(0.4, 0.8) if kind == "eight" else rng.uniform(0.5, 2.8))
    if count > 2:  # the glints must not run together
        ring = max(ring, 3.5 * blur / math.sin(math.pi / max(count, 8)))
    turns = rng.uniform(0.0, 2.0 * math.pi) + np.arange(count) * (2.0 * math.pi / max(count, 8))
    pitch = ring * 2.0 * math.sin(math.pi / max(count, 8)) if count > 2 else 40.0
    radius = min(math.exp(rng.uniform(math.log(0.5), math.log(5.0))), 0.3 * pitch, 0.25 * b)
    peak = math.exp(rng.uniform(math.log(120.0), math.log(4000.0)))
    streak, star = (rng.uniform(0.01, 0.3) if rng.uniform() < share else 0.0 for share in (0.3, 0.15))
    broad = rng.uniform(0.3, 0.95)  # width of the streak over that of the lamp
    first, along = _lamp(centre, radius, rng), rng.choice([0.0, 0.5 * math.pi, rng.uniform(0.0, math.pi)])
    unlike = rng.uniform() < 0.5  # lamps at unequal distances and angles, with streaks of their own
    first |= {"streak": streak, "star": star, "along": float(along), "broad": broad}
    spots = []
    for turn in turns:
        spot = {**first, "xy_px": middle + ring * _unit(turn)}
        spot["peak"] = peak * math.exp(rng.uniform(math.log(0.25), 0.0))
        if unlike:
            spot |= _lamp(spot["xy_px"], radius * rng.uniform(0.6, 1.0), rng)
            spot |= {"streak": streak * rng.uniform(0.0, 1.0), "along": float(along + rng.normal(0.0, 0.5))}
        spots.append(spot)
    return spots


def _spot(shape: tuple[int, ...], spot: dict[str, Any], blur: float) -> Array:
    """Light of one glint: the blurred ellipse of the lamp, with a one-sided streak and a star of four rays."""
    reach = math.ceil(6.0 * (spot["radius_px"] + blur)) + 12
    x0, y0 = (int(v) - reach for v in np.rint(spot["xy_px"]))
    side = 2 * reach + 1
    at = (np.arange(side * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(at + x0 - spot["xy_px"][0], at + y0 - spot["xy_px"][1])
    (c, s), (long, short) = _unit(spot["turn"]), spot["semi"]
    source = (((x * c + y * s) / long) ** 2 + ((y * c - x * s) / short) ** 2 < 1.0).astype(np.float64)
    for share, rays, length, wide in (
        (spot["streak"], [spot.get("along", 0.0)], 2.0 * spot["radius_px"] + 3.0, spot.get("broad", 0.4)),
        (spot["star"], [spot.get("along", 0.0) + k * math.pi / 2.0 for k in range(4)], spot["radius_px"] + 2.0, 0.4),
    ):
        for turn in rays if share else []:
            u, v = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
            ray = (u > 0.0) * np.exp(-np.maximum(u, 0.0) / length) * (np.abs(v) < wide * short + 0.3)
            source = np.maximum(source, share * ray)
    source = cv2.GaussianBlur(source, (0, 0), blur * FINE)
    source *= spot["peak"] / source.max()
    pixels = source.reshape(side, FINE, side, FINE).mean(axis=(1, 3))
    out = np.zeros((shape[0] + 2 * side, shape[1] + 2 * side))
    out[y0 + side : y0 + 2 * side, x0 + side : x0 + 2 * side] = pixels
    return np.asarray(out[side : side + shape[0], side : side + shape[1]])


def _developed(image: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The 8-bit image of a camera: clipping, noise, and in some, sharpening or compression."""
    top = rng.choice([255.0, 255.0, rng.uniform(225.0, 255.0)])
    image = np.minimum(image, top) + rng.normal(0.0, 1.0, image.shape) * rng.uniform(0.5, 4.0)
    if rng.uniform() < 0.3:
        image = image + rng.uniform(0.3, 2.0) * (image - cv2.GaussianBlur(image, (0, 0), rng.uniform(1.0, 2.0)))
    stored = np.clip(np.rint(image), 0, top).astype(np.uint8)
    return ideal.compressed(stored, int(rng.integers(40, 90))) if rng.uniform() < 0.3 else stored
