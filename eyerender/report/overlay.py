"""Images of an eye with the features of both observers, as SVG around an embedded PNG."""

from __future__ import annotations

import base64
import html
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats
from ..folders.imagefile import png_bytes, preview
from ..scene.observation import Observations
from .style import ANALYTIC_ON_DARK, IMAGE_ON_DARK


def eye_picture(
    image: NDArray[Any],  # (h, w) linear counts of a window
    origin_px: tuple[int, int],  # the window's first pixel on the full sensor
    full_scale: float,  # counts that are drawn white
    truth: Observations,  # observations of the analytic observer
    found: Observations,  # observations of the image observer
    row: int,  # this image's row in both
    *,
    crop_px: tuple[int, int] = (128, 96),  # width and height of the crop, centred on the iris (or the window)
    scale: int = 4,  # screen pixels per sensor pixel
    title: str = "",  # text alternative
) -> str:
    """Draw an enlarged <svg> of the eye with analytic (blue) and image-derived (orange) pupil and glints."""
    h, w = image.shape
    cw, ch = min(crop_px[0], w), min(crop_px[1], h)
    centre = np.array([(w - 1) / 2, (h - 1) / 2]) + origin_px
    if truth.pupil.ok[row] and truth.pupil.in_image[row]:
        centre = truth.pupil.centre_px[row]
    x0 = int(np.clip(round(centre[0] - origin_px[0] - (cw - 1) / 2), 0, w - cw))
    y0 = int(np.clip(round(centre[1] - origin_px[1] - (ch - 1) / 2), 0, h - ch))
    shown = preview(image[y0 : y0 + ch, x0 : x0 + cw], full_scale)
    shift = np.array([x0 + origin_px[0] - 0.5, y0 + origin_px[1] - 0.5])  # pixel i covers [i, i + 1) in the drawing
    marks = feature_marks(truth, row, shift, analytic=True) + feature_marks(found, row, shift, analytic=False)
    return picture(png_bytes(shown), "png", (cw, ch), width=cw * scale, over=marks, title=title)


def picture(
    data: bytes, kind: str, size: tuple[int, int], *, width: int | None = None, over: str = "", title: str = ""
) -> str:
    """Embed a picture in an <svg>.

    Args:
        data: the content of its file.
        kind: png or jpeg.
        size: width and height of the drawing's coordinates, px of the picture.
        width: width on the screen; None: as wide as its place.
        over: markup to draw over it.
        title: text alternative.
    """
    w, h = size
    wide = "" if width is None else f' width="{width}"'
    pixels = ' style="image-rendering:pixelated"' if kind == "png" else ""
    return (
        f'<svg viewBox="0 0 {w} {h}"{wide} role="img" xmlns="http://www.w3.org/2000/svg">'
        f"<title>{html.escape(title)}</title>"
        f'<image width="{w}" height="{h}" preserveAspectRatio="none"{pixels} '
        f'href="data:image/{kind};base64,{base64.b64encode(data).decode()}"/>{over}</svg>'
    )


def feature_marks(seen: Observations, row: int, shift: Floats, *, analytic: bool, scale: float = 1.0) -> str:
    """Draw the pupil and the glints of one observer as an SVG group.

    Args:
        seen: observations of the observer.
        row: the row to draw.
        shift: (2,) full-sensor pixel that lies at the origin of the drawing.
        analytic: draw blue upright crosses and a solid outline, else orange diagonal crosses and a dashed outline.
        scale: size of crosses and lines, relative to those of a small image.
    """
    name, colour = ("analytic", ANALYTIC_ON_DARK) if analytic else ("found", IMAGE_ON_DARK)
    parts = [f'<g class="{name}" fill="none" stroke="{colour}" vector-effect="non-scaling-stroke">']
    if seen.pupil.ok[row]:
        cx, cy = seen.pupil.centre_px[row] - shift
        a, b = seen.pupil.semi_axes_px[row]
        turn = np.degrees(seen.pupil.angle_rad[row])
        dash = "" if analytic else f' stroke-dasharray="{1.6 * scale:g} {1.2 * scale:g}"'
        parts.append(
            f'<ellipse cx="{cx:.3f}" cy="{cy:.3f}" rx="{a:.3f}" ry="{b:.3f}" '
            f'transform="rotate({turn:.3f} {cx:.3f} {cy:.3f})" stroke-width="{_thin(0.45 * scale)}"{dash}/>'
        )
        parts.append(_cross(seen.pupil.centre_px[row] - shift, 2.2 * scale, diagonal=not analytic, scale=scale))
    for j in np.flatnonzero(seen.glints.ok[row]):
        place = seen.glints.xy_px[row, j] - shift
        if seen.glints.light[row, j] >= 0:
            parts.append(_cross(place, 3.2 * scale, diagonal=not analytic, scale=scale))
        else:  # detected but without a light: small and faint, with the reason
            reason = html.escape(str(seen.glints.reason[row, j] or "of no known light"))
            cross = _cross(place, 1.6 * scale, diagonal=not analytic, scale=scale)
            parts.append(f'<g opacity=".6"><title>{reason}</title>{cross}</g>')
    parts.append("</g>")
    return "".join(parts)


def _cross(at: Floats, size: float, *, diagonal: bool, scale: float = 1.0) -> str:
    """Draw a cross with an open centre, so that the marked point stays visible."""
    x, y = at
    arms = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    if diagonal:
        arms = [(0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)]
    inner = 0.35
    path = "".join(
        f"M{x + dx * size * inner:.3f} {y + dy * size * inner:.3f}L{x + dx * size:.3f} {y + dy * size:.3f}"
        for dx, dy in arms
    )
    return f'<path d="{path}" stroke-width="{_thin(0.5 * scale)}"/>'


def _thin(width: float) -> str:
    return f"{width:g}".removeprefix("0")
