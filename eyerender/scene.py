"""A scene (one subject, one rig, and what is looked at), and its frames with poses.

Frames are ordered by head position, then fixation, then camera; within a frame the right eye comes first.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .arrays import ArrayValue, Floats
from .errors import InputError, InputWarning
from .eye.catalogue import load_eye
from .eye.fixation import fixations
from .eye.margin import PupilMargin
from .eye.model import EyeModel
from .eye.pose import listing_torsion
from .eye.spec import EyeSpec
from .observation import EYES, Index, PoseTruth
from .plausibility import length_warnings, place_warnings, pupil_warnings, view_warnings
from .region.anatomy import Region
from .rig.camera import Window
from .rig.imaging import Ambient
from .rig.rig import RigGeometry, RigLike
from .scenespec import DATASET_KIND, NOT_A_SCENE, SceneSpec
from .spec import file_digest, read_yaml
from .status import Status


@dataclass(frozen=True, slots=True, eq=False)
class Frames(ArrayValue):
    """The frames of a scene with the pose of each eye: the input of every observer.

    A row is one eye in one frame (an exposure of one camera). `index` (n) gives its eye, camera and target, and `pose`
    (n) the pose of the eye.
    """

    scene: Scene
    index: Index
    pose: PoseTruth

    def __len__(self) -> int:
        return len(self.index)

    def take(self, rows: Any) -> Frames:
        """Select rows (indices, a slice or a mask)."""
        return Frames(self.scene, self.index.take(rows), self.pose.take(rows))

    def seen_by(self, rig: RigLike | None) -> Frames:
        """Place the same eyes in front of another rig with the same number of cameras; None changes nothing.

        Raises:
            InputError: the rig has another number of cameras.
        """
        if rig is None or (built := rig.build()) == self.scene.rig:
            return self
        if len(built.cameras) != len(self.scene.rig.cameras):
            raise InputError(
                f"are {len(built.cameras)}, but the frames were made for {len(self.scene.rig.cameras)}",
                path="rig.cameras",
            )
        return replace(self, scene=replace(self.scene, rig=built))


@dataclass(frozen=True, slots=True)
class Scene:
    """A scene ready to be observed: the spec, the eye's spec and the numeric rig.

    `base` is the folder to which files of its images (an HDR map, a head mesh) are relative, by default the current
    folder. `source` is the name of the scene's file in messages.
    """

    spec: SceneSpec
    eye_spec: EyeSpec
    rig: RigGeometry
    base: Path | None = None
    source: str = ""

    @classmethod
    def of(cls, spec: SceneSpec, *, base: Path | None = None, eye: str | None = None, source: str = "") -> Scene:
        """Compile a spec.

        Args:
            spec: the spec.
            base: folder to which its files are relative.
            eye: replaces the scene's eye model.
            source: name of the scene's file in messages.

        Raises:
            InputError: an eye is not possible or, where a `base` is given, a file does not exist.
        """
        name = eye if eye is not None else spec.eye.model
        if eye is None and base is not None and name.endswith((".yaml", ".yml")):
            name = str(base / name)
        if eye is not None:
            spec = spec.model_copy(update={"eye": spec.eye.model_copy(update={"model": eye})})
        eye_spec = load_eye(name)
        scene = cls(spec, eye_spec, spec.rig.build(), base, source)
        try:
            scene.eye("right")
            for file in scene.files if base is not None else ():
                if not os.path.isfile(file):
                    raise InputError("no such file", source=str(file))
        except InputError as error:
            raise InputError(error.reason, source=error.source or source, path=error.path) from None
        return scene

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.spec.name

    @property
    def pupil_diameter_mm(self) -> float:
        """Diameter of the anatomical pupil: the scene's, or the eye's own."""
        return float(2 * self.eye("right").stop.semi_axes_mm[0])

    def warnings(self) -> list[InputWarning]:
        """Probable mistakes in the scene: a pupil of 0.4 mm, lengths in metres, a lamp in the head, ...

        Nothing is traced or rendered for this. An empty list does not mean that the scene is good.
        """
        spec, rig = self.spec, self.rig
        positions = [np.array(head) for head in spec.subject.head_positions_mm]
        at = [f" at head position {k}" if len(positions) > 1 else "" for k in range(len(positions))]
        heads = {f"head{where}": head for where, head in zip(at, positions, strict=True)}
        eyes = {
            f"{side} eye{where}": self.eye_position_mm(side) + head
            for where, head in zip(at, positions, strict=True)
            for side in spec.subject.eyes
        }
        cameras = [
            f"rig.cameras.{i}.{'position_mm' if camera.calibration is None else 'calibration'}"
            for i, camera in enumerate(spec.rig.cameras)
        ]
        lights = [
            f"rig.lights.{i}.{'position_mm' if light.ring is None else 'ring'}"
            for i, light in enumerate(spec.rig.lights)
            for _ in range(1 if light.ring is None else light.ring.count)
        ]
        views: dict[int, list[tuple[Window, Floats]]] = {c: [] for c in range(len(rig.cameras))}
        for (c, k, side), window in self.windows().items():
            views[c].append((window, self.eye_position_mm(EYES[side]) + positions[k]))
        pupil = "eye.pupil_diameter_mm" if spec.eye.pupil_diameter_mm is not None else "eye.model"
        found = [
            *pupil_warnings(self.pupil_diameter_mm, pupil),
            *length_warnings(spec.to_mapping()),
            *place_warnings(rig, eyes, heads, cameras, lights),
            *view_warnings(rig, views, [f"rig.cameras.{i}" for i in range(len(rig.cameras))]),
        ]
        return [warning.at(self.source) for warning in found]

    def digest(self) -> str:
        """SHA-256 of everything on which the scene's images depend, including the content of the eye file."""
        parts = [self.spec.digest(), self.eye_spec.digest(), *(file_digest(file) for file in self.files)]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    @property
    def ambient(self) -> Ambient:
        """Ambient light, with the file of its map as an absolute path."""
        ambient = self.spec.ambient
        if ambient.map is None:
            return ambient
        file = str((Path.cwd() if self.base is None else self.base.resolve()) / ambient.map.file)
        return ambient.model_copy(update={"map": ambient.map.model_copy(update={"file": file})})

    @property
    def region(self) -> Region | None:
        """Eye region, with the files of a head mesh as absolute paths."""
        region = self.spec.region
        if region is None or region.head is None:
            return region
        return region.model_copy(update={"head": region.head.resolved(self.base)})

    @property
    def files(self) -> tuple[Path, ...]:
        """Files on which images depend, besides the eye's."""
        ambient, region = self.ambient, self.region
        named = [] if ambient.map is None else [ambient.map.file]
        if self.spec.region is not None and self.spec.region.head is not None and self.spec.region.head.manifest:
            named.append(str((Path.cwd() if self.base is None else self.base) / self.spec.region.head.files[0]))
        if region is not None and region.head is not None:
            named += [*region.head.files, *([] if region.head.texture is None else [region.head.texture])]
        return tuple(Path(name) for name in named)

    def located(self) -> SceneSpec:
        """Spec with its files as absolute paths and a head's manifest read, which means the same in every folder."""
        return self.spec.model_copy(update={"ambient": self.ambient, "region": self.region})

    def eye(self, side: Literal["right", "left"] | str) -> EyeModel:
        """Numeric eye of one side at the scene's wavelength, with the scene's pupil size and margin."""
        eye = self.spec.eye
        same = _Same(self.eye_spec)
        return _built_eye(same, side == "left", self.spec.wavelength_nm, eye.pupil_diameter_mm, eye.margin)

    def eye_position_mm(self, side: str) -> Floats:
        """Apex of the unrotated eye in the world, (3,) mm, head at its reference position."""
        return np.array([0.0, self.spec.subject.ipd_mm / 2 * (1 if side == "left" else -1), 0.0])

    @property
    def targets_mm(self) -> Floats | None:
        """Targets (f, 3) in the world, in fixation order; None where the scene gives poses."""
        targets, screen = self.spec.targets, self.rig.screen
        if targets is None:
            return None
        if targets.world_mm is not None:
            return np.array(targets.world_mm, dtype=float)
        if screen is None:
            raise InputError("targets on a screen need rig.screen")
        if targets.grid is not None:
            return screen.grid(*targets.grid)
        return screen.world(np.array(targets.screen_mm, dtype=float))

    def index(self) -> Index:
        """Index of all (frame, eye) of the scene, in order; n rows."""
        spec = self.spec
        targets = self.targets_mm
        fixations = len(targets) if targets is not None else len(spec.poses or ())
        heads = np.array(spec.subject.head_positions_mm, dtype=float)
        sides = np.array(sorted(EYES.index(e) for e in spec.subject.eyes))
        cameras = len(self.rig.cameras)
        head, fixation, camera, side = (
            a.ravel()
            for a in np.meshgrid(
                np.arange(len(heads)), np.arange(fixations), np.arange(cameras), np.arange(len(sides)), indexing="ij"
            )
        )
        n = len(head)
        eye = sides[side]
        model = np.empty(n, dtype=object)
        model[:] = self.eye_spec.name
        return Index(
            frame=(head * fixations + fixation) * cameras + camera,
            fixation=fixation,
            camera=camera,
            head=head,
            eye=eye,
            eye_model=model,
            target_mm=np.full((n, 3), np.nan) if targets is None else targets[fixation],
            head_mm=heads[head],
            eye_position_mm=np.stack([self.eye_position_mm(EYES[e]) for e in (0, 1)])[eye],
        )

    def frames(self) -> Frames:
        """Make every (frame, eye) of the scene with its pose: the given one, or the one that fixates the target.

        Raises:
            InputError: no pose of an eye fixates a target; the message names it and the reason.
        """
        index = self.index()
        if self.spec.poses is None:
            return Frames(self, index, self._fixating(index))
        wanted = np.radians([[p.azimuth_deg, p.elevation_deg] for p in self.spec.poses])
        azimuth, elevation = wanted[index.fixation].T
        pose = PoseTruth(
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            torsion_rad=listing_torsion(azimuth, elevation),
            residual_mm=np.zeros(len(index)),
        )
        return Frames(self, index, pose)

    def _fixating(self, index: Index) -> PoseTruth:
        # All cameras see the same pose, so each head position, fixation and eye is solved once.
        keys = np.stack([index.head, index.fixation, index.eye], axis=-1)
        _, rows, back = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        found = fixations(
            [self.eye(side) for side in EYES],
            index.eye[rows],
            index.target_mm[rows],
            index.eye_position_mm[rows] + index.head_mm[rows],
            self.spec.eye.line_of_sight,
        )
        bad = np.flatnonzero(found.status != Status.OK)
        if len(bad):
            row = rows[bad[0]]
            target = ", ".join(f"{v:g}" for v in index.target_mm[row])
            raise InputError(
                f"the {EYES[index.eye[row]]} eye cannot fixate ({target}) mm: {found.reason(int(bad[0]))}",
                path=f"targets.{index.fixation[row]}",
            )
        back = back.reshape(-1)
        azimuth, elevation = found.poses.azimuth_rad[back], found.poses.elevation_rad[back]
        return PoseTruth(
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            torsion_rad=listing_torsion(azimuth, elevation),
            residual_mm=found.residual_mm[back],
        )

    def windows(self) -> dict[tuple[int, int, int], Window]:
        """Rendered window (x0, y0, width, height) of each (camera, head position, eye), in full-sensor pixels.

        A window is centred on the image of the unrotated eye's apex, so it does not move with the gaze, and it is kept
        on the sensor. Without `image.window_px` it is the whole sensor.
        """
        out = {}
        for c, camera in enumerate(self.rig.cameras):
            w, h = camera.resolution_px
            for k, head in enumerate(self.spec.subject.head_positions_mm):
                for side in self.spec.subject.eyes:
                    out[c, k, EYES.index(side)] = (0, 0, w, h)
                    if self.spec.image.window_px is None:
                        continue
                    (u, v), front = camera.project(self.eye_position_mm(side) + np.array(head))
                    front = front and np.isfinite(u) and np.isfinite(v)  # distortion can overflow beside the camera
                    ww, wh = self.spec.image.window_px
                    x0 = int(np.floor((u if front else (w - 1) / 2) - (ww - 1) / 2 + 0.5))
                    y0 = int(np.floor((v if front else (h - 1) / 2) - (wh - 1) / 2 + 0.5))
                    out[c, k, EYES.index(side)] = (min(max(x0, 0), w - ww), min(max(y0, 0), h - wh), ww, wh)
        return out

    def rig_mapping(self) -> dict[str, Any]:
        """Rig as `features --json` writes it (docs/formats.md)."""
        return self.rig.to_mapping()


@dataclass(frozen=True, slots=True, eq=False)
class _Same:
    """A spec that equals only itself: comparing the object costs nothing, comparing its content a millisecond."""

    spec: EyeSpec

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.spec is self.spec

    def __hash__(self) -> int:
        return id(self.spec)


@lru_cache(maxsize=32)
def _built_eye(
    eye: _Same, left: bool, wavelength_nm: float, pupil_diameter_mm: float | None, margin: PupilMargin | None
) -> EyeModel:
    """Numeric eye, cached because observers, renderer and labels request the same one repeatedly."""
    spec = eye.spec if margin is None else margin.applied(eye.spec)
    return spec.build(eye="left" if left else "right", wavelength_nm=wavelength_nm, pupil_diameter_mm=pupil_diameter_mm)


def shipped_scenes() -> dict[str, Path]:
    """Map the names of the scenes that come with the package to their files."""
    return {name: path for name, path in shipped_files().items() if not is_shipped_dataset(path)}


@cache
def is_shipped_dataset(path: Path) -> bool:
    """Whether a shipped file is a dataset, cached because the file never changes and parsing all of them is slow."""
    return is_dataset(path)


def shipped_files() -> dict[str, Path]:
    """Map the names of the scenes and dataset specs that come with the package to their files."""
    package = Path(__file__).resolve().parent
    for folder in (package / "data" / "scenes", package.parent / "scenes"):
        if folder.is_dir():
            return {p.stem: p for p in sorted(folder.glob("*.yaml"))}
    return {}


def is_dataset(path: Path) -> bool:
    """Whether a YAML file declares itself the spec of a dataset (`kind: dataset`) instead of a scene."""
    try:
        return read_yaml(path).get("kind") == DATASET_KIND
    except InputError:
        return False


def refuse_folder(path: Path, wanted: str) -> None:
    """Raise an `InputError` for a folder given instead of a file, which names the file that was probably meant."""
    if not os.path.isdir(path):
        return
    hint = ""
    if (path / "scene.yaml").is_file():
        hint = f"; give {path / 'scene.yaml'}"
    elif (path / "images").is_dir():
        hint = f"; the images that were made are in {path / 'images'}"
    raise InputError(f"is a folder; give {wanted}{hint}", source=str(path))


def load_scene(scene: str | Path, *, eye: str | None = None, spp: int | None = None, seed: int | None = None) -> Scene:
    """Load a scene from a file, or by the bare name of a shipped one.

    Args:
        scene: path of a YAML file, or a shipped scene's name.
        eye: replaces the scene's eye model (a catalogue name or an eye file).
        spp: replaces the samples per pixel.
        seed: replaces the seed.

    Raises:
        InputError: one line that names the file and the key, or the option whose value does not fit.
    """
    path = Path(scene)
    shipped = shipped_scenes()
    if not os.path.isfile(path):
        if str(scene) in shipped:
            path = shipped[str(scene)]
        elif str(scene) in shipped_files():
            raise InputError(NOT_A_SCENE, source=str(scene))
        elif path.suffix not in (".yaml", ".yml") and not os.path.exists(path):
            raise InputError(f"no such scene file; shipped scenes: {', '.join(shipped)}", source=str(scene))
    refuse_folder(path, "a scene file, or the name of a shipped scene")
    spec = SceneSpec.load(path)
    if spp is not None:
        spec = spec.with_spp(spp)
    if seed is not None:
        spec = spec.replaced("--seed", {"seed": seed})
    return Scene.of(spec, base=path.parent, eye=eye, source=str(path))
