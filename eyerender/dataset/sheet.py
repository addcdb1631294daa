"""A contact sheet of sixteen images, from a dataset spec's samples or a scene's windows; or their outlines alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ..backends.choose import BackendChoice
from ..base.arrays import Bytes, Floats
from ..base.errors import InputError, Warn
from ..base.progress import Progress, notify
from ..base.storage.files import written
from ..folders.imagefile import preview as eight_bit
from ..imaging.capture import make_renderer, render_windows
from ..imaging.labels import EyeInWindow, known_labels, lid_landmarks
from ..optics.ellipse import points_on_ellipse
from ..rig.plausibility import is_saturated, saturation_warnings
from ..scene import Frames, Scene, is_dataset, load_scene, refuse_folder, shipped_files
from ..scene.observation import Observations
from .maker import Maker
from .plan import Plan, is_function
from .realise import frames_of, realise
from .spec import DatasetSpec, shipped_datasets

TILES = 16
_COLUMNS, _WIDTH, _GAP = 4, 320, 4
FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP"}
Tile = tuple[Bytes, str]


def preview(
    given: str | Path | DatasetSpec | Plan | Scene,
    path: str | Path,
    *,
    eye: str | None = None,
    seed: int | None = None,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> int:
    """Render a contact sheet of up to sixteen images into an image file, for viewing rather than measuring.

    >>> er.preview("people_openeds", "sheet.png")  # doctest: +SKIP

    Args:
        given: a scene or a dataset: a file, the name of a shipped one, or an object.
        path: the image file; its suffix is one of `FORMATS`.
        eye: replaces the eye model of a file: a name of the catalogue or an eye file.
        seed: replaces the seed of a file.
        backend: the render backend.
        threads: total number of processor threads; by default all.
        progress: called with (images done, images in all, "images").
        warn: called with warnings about the scene or spec before anything is rendered, and about saturated images
            before the file is written; if it raises, nothing is written.

    Returns:
        The number of images on the sheet.

    Raises:
        InputError: the suffix is not that of an image format, or no sample of the spec can be made.
        EyerenderError: the file cannot be written.
    """
    path = _checked(path)
    what = _found(given, eye, seed)
    if warn is not None:
        warn(what.warnings())
    maker = _of_plan(what, backend, threads) if isinstance(what, Plan) else _of_scene(what, backend, threads)
    tiles: list[Tile] = []
    saturated = 0
    for total, tile, is_white in maker:
        tiles.append(tile)
        saturated += is_white
        notify(progress, len(tiles), total, "images")
    if warn is not None:
        warn(saturation_warnings(saturated, len(tiles), what.source))
    _write(path, tiles)
    return len(tiles)


def preview_outlines(
    given: str | Path | DatasetSpec | Plan | Scene,
    path: str | Path,
    *,
    eye: str | None = None,
    seed: int | None = None,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> int:
    """Draw the outlines of pupil, iris and lids and the glints of up to sixteen samples, without rendering.

    The arguments, and what is returned and raised, are as for `preview`; a scene is refused.
    """
    path = _checked(path)
    plan = _found(given, eye, seed)
    if not isinstance(plan, Plan):
        raise InputError("takes a dataset spec, not a scene", source="--planned")
    if warn is not None:
        warn(plan.warnings())
    tiles, chosen, frames = list[Tile](), plan.spread(TILES), frames_of(plan)
    for index in chosen:
        found = realise(plan, index, frames)
        if found.sample is None or found.frames is None or found.observations is None:
            raise InputError(f"sample {index} cannot be made: {found.rejections[-1].reason}", source=plan.source)
        caption = f"{found.sample.split} sample {index} subject {found.sample.turn.subject}"
        tiles.append((outlines(found.frames, found.observations), caption))
        notify(progress, len(tiles), len(chosen), "samples")
    _write(path, tiles)
    return len(tiles)


def _checked(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"must end with one of {', '.join(FORMATS)}", source=str(path))
    return path


def _write(path: Path, tiles: list[Tile]) -> None:
    with written(path) as file:
        contact_sheet(tiles).save(file, format=FORMATS[path.suffix.lower()])


def _found(given: str | Path | DatasetSpec | Plan | Scene, eye: str | None, seed: int | None) -> Plan | Scene:
    if isinstance(given, Scene):
        return given
    if is_function(given):
        return Plan.load(str(given), eye=eye, seed=seed, count=TILES)
    if isinstance(given, str | Path):
        if str(given) not in shipped_files():
            refuse_folder(Path(given), "a scene or dataset file, or the name of a shipped one")
        if str(given) not in shipped_datasets() and not is_dataset(Path(given)):
            return load_scene(given, eye=eye, seed=seed)
    return Plan.load(given, eye=eye, seed=seed)


def contact_sheet(tiles: list[Tile]) -> Image.Image:
    """Arrange captioned tiles, four per row."""
    shown = []
    for image, caption in tiles:
        picture = Image.fromarray(image)
        if picture.width > _WIDTH:
            picture = picture.resize((_WIDTH, round(picture.height * _WIDTH / picture.width)), Image.Resampling.BOX)
        shown.append((picture, caption))
    width, height = max(p.width for p, _ in shown), max(p.height for p, _ in shown) + 14
    columns = min(_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    sheet = Image.new("L", (columns * (width + _GAP) + _GAP, rows * (height + _GAP) + _GAP), 255)
    pen = ImageDraw.Draw(sheet)
    for k, (picture, caption) in enumerate(shown):
        x, y = _GAP + k % columns * (width + _GAP), _GAP + k // columns * (height + _GAP)
        sheet.paste(picture, (x, y + 12))
        pen.text((x, y), caption, fill=0)
    return sheet


def _of_plan(plan: Plan, backend: BackendChoice, threads: int | None) -> Iterator[tuple[int, Tile, bool]]:
    maker = Maker(plan, frames_of(plan), backend=backend, threads=threads)
    chosen = plan.spread(TILES)
    for sample in chosen:
        made = maker.make(sample)
        if not made.images:
            raise InputError(f"sample {made.index} cannot be made: {made.rejections[-1].reason}", source=plan.source)
        image = made.images[0]
        caption = f"{image.line['split']} sample {made.index} subject {image.line['subject']}"
        yield len(chosen), _tile(image.pictures["images"], image.line, caption), image.saturated


def outlines(frames: Frames, observations: Observations) -> Bytes:
    """Draw what the first row of frames will show: outlines of pupil, iris and lids, and glints; black on white."""
    view = EyeInWindow.of(frames, 0)
    x0, y0, width, height = view.window
    labels, lids = known_labels(frames.scene, observations, view), lid_landmarks(frames.scene, view)
    picture = Image.new("L", (width, height), 255)
    pen, stroke = ImageDraw.Draw(picture), max(1, width // 160)

    def line(points: Floats, *, closed: bool) -> None:
        places = [(float(x - x0), float(y - y0)) for x, y in points]
        pen.line(places + places[:1] if closed else places, fill=0, width=stroke)

    for part in ("iris", "pupil"):
        amodal = labels[part]["amodal"]
        if amodal["centre_px"] is not None:
            line(points_on_ellipse(amodal["centre_px"], amodal["semi_axes_px"], amodal["angle_rad"], 90), closed=True)
    for lid in (lids or {}).values():
        line(np.array(lid), closed=False)
    for glint in labels["glints"]:
        if glint["xy_px"] is not None:
            x, y = glint["xy_px"][0] - x0, glint["xy_px"][1] - y0
            pen.ellipse((x - 2 * stroke, y - 2 * stroke, x + 2 * stroke, y + 2 * stroke), outline=0)
    return np.asarray(picture)


def _of_scene(scene: Scene, backend: BackendChoice, threads: int | None) -> Iterator[tuple[int, Tile, bool]]:
    frames = scene.frames()
    count = min(TILES, len(frames))
    rows = np.array([k * len(frames) // count for k in range(count)])
    renderer = make_renderer(backend, threads)
    for image in render_windows(frames.take(rows), renderer=renderer):
        sensor = scene.spec.sensor
        tile = _tile(image.counts, {"bit_depth": sensor.bit_depth}, image.name)
        yield count, tile, is_saturated(image.counts, scene.spec.sensor)


def _tile(dn: Any, line: dict[str, Any], caption: str) -> Tile:
    return eight_bit(dn, 2.0 ** line["bit_depth"] - 1), caption
