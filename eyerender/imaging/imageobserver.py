"""The image observer: extracts features from pixels and reports them like the analytic observer."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backends.choose import BackendChoice
from ..base.arrays import Floats, Ints
from ..base.errors import WRONG, InputError, InputWarning, Warn
from ..base.processes import mapper
from ..base.progress import Progress, followed, followed_by
from ..base.storage.files import parse_json
from ..extraction import Extraction, ExtractionSettings, extract
from ..extraction.glints.matching import assign_lights, predict_glints
from ..extraction.overlay import overlay
from ..extraction.pair import extract_eyes
from ..extraction.preprocessing import single_threaded
from ..extraction.region import SearchRegion
from ..folders.imagefile import image_files, read_any_image, write_png
from ..folders.imagefolder import METADATA, ImageEntry, ImageFolder
from ..rig.camera import PinholeCamera
from ..rig.rig import Rig, RigGeometry, RigLike
from ..scene import Frames, Scene
from ..scene.observation import (
    EYES,
    GlintFeatures,
    Index,
    Observations,
    PoseTruth,
    PupilFeatures,
    concatenate,
)
from .capture import EyeImage, render_windows

# Distance of the reflections of a real eye from those of a typical eye that is placed by its pupil.
_PLACE_MM = 1.5
# A process takes 1 to 1.5 s to start; two processes gain that after 100 to 150 images of 20 ms each.
LEAST_FOR_POOL = 128
_BATCH = 256  # of observations that are joined at once


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageObserver:
    """Observer of pixels: extracts pupil ellipse and glints; it never uses the truth.

    >>> er.ImageObserver(spp=16).observe(er.load_scene("headset")).pupil.ok.all()  # doctest: +SKIP

    Args:
        settings: settings of the extractor; if the rig is known, the range of pupil sizes is narrowed.
        gamma: encoding gamma of the images; 1 is linear.
        camera: number of the scene's camera that took single images and videos; None: the first one.
        rois: part of single images and videos that is searched for each eye, as in `extract`; empty: all.
        backend: backend that renders the frames.
        threads: number of processor threads for rendering; None: all.
        progress: called with (images done, images in all, "images") after each image.
    """

    settings: ExtractionSettings = field(default_factory=ExtractionSettings)
    gamma: float = 1.0
    camera: int | None = None
    rois: tuple[SearchRegion, ...] = ()
    backend: BackendChoice = "auto"
    threads: int | None = None
    progress: Progress | None = None

    def observe(self, frames: Frames, rig: RigLike | None = None) -> Observations:
        """Render every (frame, eye) and extract its features; `rig` replaces that of the frames."""
        images = render_windows(frames.seen_by(rig), backend=self.backend, threads=self.threads, progress=self.progress)
        return self.observe_images(images)

    def observe_images(self, images: Iterable[EyeImage]) -> Observations:
        """Extract the features of rendered images, one row each."""
        return concatenate(
            [
                self._observe_rows(
                    image.counts,
                    image.scene.spec.sensor.bit_depth,
                    image.window[:2],
                    image.frame.index,
                    np.array([0]),
                    image.scene.rig,
                    image.scene.spec.sensor.gamma,
                )
                for image in images
            ]
        )

    def observe_folder(
        self, folder: ImageFolder, scene: Scene | None = None, *, progress: Progress | None = None
    ) -> Observations:
        """Extract the features of a folder's images, in the order of its records; `scene` replaces their rigs."""
        if self.rois:
            raise InputError("is for images of a camera; this folder states the windows of its eyes", path="roi")
        index = folder.truth().index
        rigs = rigs_of(folder) if scene is None else [scene.rig] * len(index)
        return self.observe_entries(folder.entries, index, rigs, progress=progress)

    def observe_entries(
        self,
        entries: Sequence[ImageEntry],
        index: Index,
        rigs: Sequence[RigGeometry],
        *,
        progress: Progress | None = None,
        exposed: Callable[[NDArray[Any], ImageEntry], NDArray[Any]] | None = None,
    ) -> Observations:
        """Extract the features of images; `index` has a row, and `rigs` an entry, for each of their records.

        `exposed` converts each image before extraction, for instance to another exposure.
        """
        found, row = Gathering(), 0
        for entry in followed(entries, progress, "images"):
            if len(entry.records) == 0:
                raise InputError("has no records", source=str(entry.path))
            image = entry.image() if exposed is None else exposed(entry.image(), entry)
            rows = np.arange(row, row + len(entry.records))
            depth = int(entry.line.get("bit_depth") or 8 * image.itemsize)
            found.add(self._observe_rows(image, depth, entry.window[:2], index, rows, rigs[row], entry.gamma))
            row = int(rows[-1]) + 1
        return found.all()

    def observe_files(
        self,
        paths: Sequence[str | Path],
        *,
        scene: Scene | None = None,
        progress: Progress | None = None,
        eyes: int = 1,
        processes: int = 1,
        pictures: Path | None = None,
        warn: Warn | None = None,
    ) -> Observations:
        """Extract the features of image files, or of a folder: one of this package, or any with image files.

        Each image is a frame; with a scene its glints are assigned to lights. Images of a folder that cannot be used
        are skipped with a warning; their frames are missing.

        Args:
            paths: images, or one folder.
            scene: the scene whose rig took the images. With it, files of a folder of this package are seen with their
                windows.
            progress: called after each image.
            eyes: 1, or 2 for images of both eyes, arranged as the settings say. By default, the eye on the image's left
                is the right eye, as a camera in front of the subject sees it.
            processes: number of images processed at the same time.
            pictures: folder for overlays of the results over the images.
            warn: receives a warning if images have colour, and one for each image that is skipped.
        """
        lenient = len(paths) == 1 and os.path.isdir(paths[0])
        if lenient and os.path.isfile(os.path.join(paths[0], METADATA)):
            folder = ImageFolder.load(paths[0])
            return self.observe_folder(folder, scene, progress=progress)
        paths = files_of(paths)
        if scene is not None and eyes == 1 and pictures is None and not self.rois and (entries := _rendered(paths)):
            index = concatenate([entry.truth() for entry in entries]).index
            return self.observe_entries(entries, index, [scene.rig] * len(index), progress=progress)
        if pictures is not None:
            _refuse_inputs([_picture_of(path, pictures) for path in paths], paths)
        gathered, skipped, coloured = Gathering(), list[InputWarning](), 0
        job = _FileJob(
            settings=self.settings, gamma=self.gamma, eyes=eyes, rois=self.rois, pictures=pictures, lenient=lenient
        )
        count = processes if len(paths) >= LEAST_FOR_POOL else 1
        with mapper(count, initializer=single_threaded, chunksize=4) as each:
            for k, done in enumerate(followed_by(each(job, paths), len(paths), progress, "images")):
                try:
                    if isinstance(done, InputError):
                        raise done
                    found, shape, colour = done
                    gathered.add(self.observe_found(found, k, shape, scene=scene, source=str(paths[k])))
                    coloured += colour
                except InputError as error:
                    if not lenient:
                        raise
                    skipped.append(
                        InputWarning(code="skipped", reason=f"is skipped: {error.reason}", source=str(paths[k]))
                    )
        if warn is not None:
            warn(
                [
                    *self.camera_warnings(scene),
                    *skipped,
                    *([colour_warning(coloured, "images" if coloured > 1 else "image")] if coloured else []),
                ]
            )
        if len(skipped) == len(paths):
            raise InputError(f"holds no image that can be used ({skipped[0].reason})", source=skipped[0].source)
        return gathered.all()

    def camera_of(self, scene: Scene) -> PinholeCamera:
        """Return the scene's camera that took single images.

        Raises:
            InputError: the scene has no camera of this number.
        """
        cameras = scene.rig.cameras
        if not 0 <= (self.camera or 0) < len(cameras):
            raise InputError(f"must be 0 to {len(cameras) - 1}, the cameras of the scene", source="--camera")
        return cameras[self.camera or 0]

    def camera_warnings(self, scene: Scene | None) -> list[InputWarning]:
        """Warn if a scene has several cameras, and none was named."""
        if scene is None or self.camera is not None or len(scene.rig.cameras) == 1:
            return []
        names = ", ".join(f"{k} {camera.name}" for k, camera in enumerate(scene.rig.cameras))
        reason = f"the scene has several cameras ({names}); --camera says which one took the images; default: 0"
        return [InputWarning(code="camera", reason=reason)]

    def observe_found(
        self,
        found: Sequence[Extraction],
        frame: int,
        shape: tuple[int, int],
        *,
        scene: Scene | None,
        source: str,
        time_s: float = math.nan,
    ) -> Observations:
        """Convert extractions of a whole sensor image (h, w) to observations: of one eye, or of both halves.

        A single eye has a name if the scene's camera sees only one of the scene's eyes.
        """
        parts = []
        for side, one in enumerate(found):
            lights: Sequence[int] = [-1] * len(one.glints)
            reasons: Sequence[str | None] = [None] * len(one.glints)
            eye = side if len(found) > 1 else -1
            if scene is not None:
                # The part of the sensor that a single image shows is unknown, so only a whole sensor image can be
                # placed.
                camera = self.camera_of(scene)
                if shape != (camera.resolution_px[1], camera.resolution_px[0]):
                    w, h = camera.resolution_px
                    reason = f"is {shape[1]} x {shape[0]} px, but the scene's sensor is {w} x {h}"
                    hint = "windows that `render` or `generate` wrote are read by `eyerender compare FOLDER`"
                    raise InputError(f"{reason}; {hint}", source=source)
                sides = [EYES.index(name) for name in scene.spec.subject.eyes if camera.sees(name)]
                eye = sides[0] if len(found) == len(sides) == 1 else eye
                lights, reasons = _lights(one, np.zeros(2), scene.rig, camera, np.full(3, np.nan), eye)
            number = np.array([-1 if scene is None or not self.camera else self.camera])
            index = Index(frame=np.array([frame]), eye=np.array([eye]), camera=number, time_s=np.array([time_s]))
            parts.append(_observation(one, lights, reasons, np.zeros(2), index))
        return concatenate(parts)

    def _observe_rows(
        self,
        image: NDArray[Any],
        depth: int,
        origin: tuple[int, int],
        index: Index,
        rows: Ints,
        rig: RigGeometry,
        gamma: float,
    ) -> Observations:
        """Extract the eyes of one image; if there are two, each is searched in its own part of the image."""
        parts = []
        for row in rows:
            camera = rig.cameras[int(index.camera[row])]
            eye_mm = index.eye_position_mm[row] + index.head_mm[row]
            px_per_mm = camera.scale_at(eye_mm)
            cut, corner = image, np.array(origin)
            if len(rows) > 1:
                cut, corner = _around(image, corner, camera.project(eye_mm)[0], 16.0 * px_per_mm)
            # Human pupils are 2 to 8 mm wide, the cornea magnifies them by up to 1.2, and tilt foreshortens them.
            settings = self.settings.model_copy(
                update={"radius_min_px": max(0.6 * px_per_mm, 3.0), "radius_max_px": max(5.0 * px_per_mm, 8.0)}
            )
            found = extract(cut, bit_depth=depth, gamma=gamma if gamma != 1 else self.gamma, settings=settings)
            lights, reasons = _lights(found, corner, rig, camera, eye_mm, int(index.eye[row]))
            parts.append(_observation(found, lights, reasons, corner, index.take([row])))
        return concatenate(parts)


def _rendered(paths: Sequence[str | Path]) -> list[ImageEntry]:
    """Return the entries of files in the metadata of the folder of this package that holds them all; else none."""
    files = [Path(path).absolute() for path in paths]
    home = next((place for place in files[0].parents[:3] if (place / METADATA).is_file()), None)
    with suppress(InputError):
        entries = {} if home is None else {entry.path: entry for entry in ImageFolder.load(home)}
        return [entries[file] for file in files] if entries.keys() >= set(files) else []
    return []


@dataclass(frozen=True, slots=True, kw_only=True)
class _FileJob:
    """Extraction of one image file, which a separate process may run."""

    settings: ExtractionSettings
    gamma: float
    eyes: int
    rois: tuple[SearchRegion, ...]
    pictures: Path | None
    lenient: bool

    def __call__(self, path: str | Path) -> tuple[tuple[Extraction, ...], tuple[int, int], bool] | InputError:
        """Extract a file's features, with its (h, w) and whether it has colour; or return why it cannot be read."""
        try:
            image, depth, colour = read_any_image(path)
        except InputError as error:
            if not self.lenient:
                raise
            return error
        options: dict[str, Any] = {
            "bit_depth": depth if depth <= 16 else None,
            "gamma": self.gamma,
            "settings": self.settings,
        }
        if self.eyes == 2:
            found: tuple[Extraction, ...] = extract_eyes(image, rois=self.rois, **options)
        else:
            found = (extract(image, roi=self.rois[0] if self.rois else None, **options),)
        if self.pictures is not None:
            full = float(2**depth - 1) if depth <= 16 else float(max(image.max(), 1e-9))
            picture = overlay(image, found, full)
            write_png(_picture_of(path, self.pictures), np.ascontiguousarray(picture[..., ::-1]))
        return found, (image.shape[0], image.shape[1]), colour


def files_of(paths: Sequence[str | Path]) -> list[Path]:
    """Return the image files of paths, or of one folder."""
    if len(paths) == 1 and os.path.isdir(paths[0]):
        return [Path(paths[0]) / name for name in image_files(paths[0])]
    return [Path(path) for path in paths]


def _picture_of(path: str | Path, folder: Path) -> Path:
    return folder / f"{Path(path).stem}.png"


class Gathering:
    """Observations that come one by one, joined in batches: single ones take ten times the memory of joined ones."""

    def __init__(self) -> None:
        self._joined: list[Observations] = []
        self._single: list[Observations] = []

    def add(self, one: Observations) -> None:
        """Add observations after those so far."""
        self._single.append(one)
        if len(self._single) == _BATCH:
            self._joined.append(concatenate(self._single))
            self._single = []

    def all(self) -> Observations:
        """Return what was added, in order; there must be something."""
        return concatenate([*self._joined, *self._single])


def _refuse_inputs(pictures: Sequence[Path], paths: Sequence[str | Path]) -> None:
    """Check that no output picture is one of the input images."""
    inputs = set()
    for path in paths:
        with suppress(OSError, ValueError):  # `read_any_image` says so
            state = os.stat(path)
            inputs.add((state.st_dev, state.st_ino))
    for picture in pictures:
        with suppress(OSError, ValueError):
            state = picture.stat()
            if (state.st_dev, state.st_ino) in inputs:
                raise InputError("is one of the images, so it is not written to", source=str(picture))


def lights_of(scene: Scene | None) -> int | None:
    """Return the number of lights by which glints are named; None without a scene."""
    return None if scene is None else len(scene.rig.lights)


def colour_warning(count: int, what: str) -> InputWarning:
    """Create a warning that images or frames have colour."""
    return InputWarning(
        code="colour", reason=f"{count} {what} in colour; the luminance is taken, but near-infrared images are grey"
    )


def detect(
    images: EyeImage | Iterable[EyeImage], rig: RigLike | None = None, *, settings: ExtractionSettings | None = None
) -> Observations:
    """Extract pupils and glints from rendered images, one row for each.

    >>> scene = er.load_scene("headset")  # doctest: +SKIP
    >>> er.detect(er.render(scene), scene.rig).pupil.ok  # doctest: +SKIP

    Args:
        images: images from `render`; their labels are not used.
        rig: rig for the assignment of glints, instead of the rendered one.
        settings: settings of the extraction.
    """
    several = [images] if isinstance(images, EyeImage) else images
    on_rig = (replace(image, frame=image.frame.seen_by(rig)) for image in several)
    return ImageObserver(settings=settings or ExtractionSettings()).observe_images(on_rig)


def rigs_of(folder: ImageFolder) -> list[RigGeometry]:
    """Return the rig of each record of a folder, in order; rigs that differ in power alone are one object.

    Raises:
        InputError: an image's scene is missing or wrong.
    """
    found: dict[str, RigGeometry] = {}
    rigs = []
    for entry in folder:
        source = str(folder.path / entry.name)
        try:
            text = entry.line["parameters"]["scene_json"]
            if not isinstance(text, str):
                raise TypeError
            rig = parse_json(text)["rig"]
            key = json.dumps([{**rig, "lights": None}, [{**light, "intensity_mw_sr": 0} for light in rig["lights"]]])
        except (InputError, *WRONG):
            raise InputError("has no parameters", source=source) from None
        if key not in found:
            found[key] = Rig.from_mapping(rig, source=source).resolved().build()
        rigs += [found[key]] * len(entry.records)
    return rigs


def _around(image: NDArray[Any], corner: Floats, centre_px: Floats, half_px: float) -> tuple[NDArray[Any], Floats]:
    """Crop an image to `half_px` around a full-sensor point; also return the crop's first pixel."""
    h, w = image.shape
    x0, y0 = np.clip(np.floor(centre_px - corner - half_px), 0, [w - 16, h - 16]).astype(int)
    x1, y1 = np.clip(np.ceil(centre_px - corner + half_px), [x0 + 16, y0 + 16], [w, h]).astype(int)
    return image[y0:y1, x0:x1], corner + np.array([x0, y0])


def _lights(
    found: Extraction, corner: Floats, rig: RigGeometry, camera: PinholeCamera, eye_mm: Floats, eye: int
) -> tuple[list[int], Sequence[str | None]]:
    """Assign glints to lights that light the eye (-1: none, with the reason), from the rig and the eye's position."""
    if not found.glints or found.pupil.ellipse is None:
        return [-1] * len(found.glints), ["no pupil to place the reflections by"] * len(found.glints)
    spots = np.array([g.xy_px for g in found.glints]) + corner
    pupil = np.asarray(found.pupil.ellipse.centre_px) + corner
    numbers = rig.lights_of(eye)
    if not numbers:
        return [-1] * len(found.glints), ["no light of the rig lights this eye"] * len(found.glints)
    places = np.array([rig.lights[k].position_mm for k in numbers]).reshape(-1, 3)
    flat = camera.flattened(pupil)
    predicted, px_per_mm = predict_glints(
        camera.ideal(pupil, flat),
        K=flat.K,
        R=flat.sensor_axes,
        t_mm=flat.sensor_offset,
        lights_mm=places,
        eye_mm=eye_mm,
    )
    assigned = assign_lights(camera.ideal(spots, flat), predicted, shift_sd_px=_PLACE_MM * px_per_mm)
    return [numbers[k] if k >= 0 else -1 for k in assigned.light], assigned.reasons


def _observation(
    found: Extraction, lights: Sequence[int], reasons: Sequence[str | None], corner: Floats, index: Index
) -> Observations:
    """Convert the extraction of one image to a batch of one; `corner` shifts it to full-sensor pixels.

    Glints are in the order of the rig's lights, and those of no light follow.
    """
    order = sorted(range(len(lights)), key=lambda i: (lights[i] < 0, lights[i]))
    lights, reasons = [lights[i] for i in order], [reasons[i] for i in order]
    pupil, glints = found.pupil, [found.glints[i] for i in order]
    m = len(glints)
    known: dict[str, Any] = {"status": [pupil.status], "reason": [pupil.reason], "confidence": [pupil.confidence]}
    if pupil.ellipse is not None:
        known["centre_px"] = [pupil.ellipse.centre_px + corner]
        known["semi_axes_px"] = [pupil.ellipse.semi_axes_px]
        known["angle_rad"] = [pupil.ellipse.angle_rad]
    if pupil.covariance is not None:
        known["covariance"] = [pupil.covariance]
    spreads = [np.full((2, 2), np.nan) if g.covariance is None else g.covariance for g in glints]
    why = [g.reason or reason for g, reason in zip(glints, reasons, strict=True)]
    # A feature that was measured in an image lies in it.
    return Observations(
        index=index,
        pose=PoseTruth(azimuth_rad=np.array([np.nan])),
        pupil=PupilFeatures(**known, in_image=np.array([pupil.ok])),
        glints=GlintFeatures(
            status=np.array([g.status for g in glints], np.int8).reshape(1, m),
            light=np.array(lights, np.int64).reshape(1, m),
            reason=np.array(why, object).reshape(1, m),
            in_image=np.array([g.ok for g in glints], bool).reshape(1, m),
            xy_px=np.array([g.xy_px + corner for g in glints]).reshape(1, m, 2),
            covariance=np.array(spreads).reshape(1, m, 2, 2),
        ),
    )
