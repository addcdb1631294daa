"""State of one tab of the live page: a scene modified by its knobs, and the selected frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ...base.arrays import Floats
from ...base.errors import InputError
from ...dataset.picturesize import scaled
from ...rig.camera import Camera
from ...rig.distortion import FisheyeDistortion
from ...rig.rig import Rig
from ...scene import Frames, Scene
from ...scene.observation import EYES
from ...scene.scene import demand_d
from ...scene.spec import MOST_ACCOMMODATION_D, EyeDirection, SceneSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """A scene with one fixation and one head position, selected from a scene that may have many.

    Methods that change something return a new setup, and raise `InputError` for a value that does not fit.
    """

    origin: SceneSpec  # the spec as it was loaded, with all of its fixations and head positions
    scene: Scene  # the current scene, with one fixation and one head position
    eye: str  # the selected eye, "right" or "left"
    camera: int = 0  # number of the selected camera
    fixation: int | None = 0  # number of the current fixation of `origin`; None for a gaze set by the user
    head: int = 0  # number of the head position of `origin`
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # how far all head positions were moved by hand

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Start with the fixation of a scene that is nearest to the middle of all, at its first head position."""
        scene.refuse_spectacles("the live page shows scenes")
        spec = scene.spec
        # Eyes respond to the mean of all targets, so they must not respond to the current one only.
        if spec.person is not None or spec.subject.accommodation_d == "targets":
            demand = min(demand_d(spec, scene.targets_mm), MOST_ACCOMMODATION_D)
            scene = scene.with_({"subject.accommodation_d": demand})
        start = cls(origin=spec, scene=scene, eye=EYES[scene.index().eye[0]])
        return start.showing(eye=start.eye).following(_middle(scene)).with_head(0)

    @property
    def fixations(self) -> int:
        """Number of fixations of the loaded scene."""
        targets = self._targets()
        return len(targets) if targets is not None else len(self.origin.poses or ())

    @property
    def apex_mm(self) -> Floats:
        """Apex of the selected unrotated eye, (3,) mm in the world."""
        head = np.array(self.scene.spec.subject.head_positions_mm[0])
        return np.asarray(self.scene.eye_position_mm(self.eye) + head)

    def frames(self) -> Frames:
        """Compute all frames of the current fixation: a row for each camera and eye."""
        return self.scene.frames()

    def row(self, frames: Frames) -> int:
        """Return the selected row of `frames`."""
        index = frames.index
        return int(np.flatnonzero((index.camera == self.camera) & (index.eye == EYES.index(self.eye)))[0])

    def showing(self, *, eye: str | None = None, camera: int | None = None) -> Self:
        """Select an eye or a camera, and with it a camera that sees the eye or an eye that the camera sees.

        Raises:
            InputError: the camera sees no observed eye.
        """
        index = self.scene.index()
        seen = list(zip(index.camera.tolist(), [EYES[side] for side in index.eye], strict=True))
        chosen = (self.camera if camera is None else camera, self.eye if eye is None else eye)
        fitting = [pair for pair in seen if (camera in (None, pair[0])) and (eye in (None, pair[1]))]
        if not fitting:
            raise InputError(f"does not see the {chosen[1]} eye", path=f"rig.cameras.{chosen[0]}.eyes")
        number, side = chosen if chosen in fitting else fitting[0]
        return replace(self, camera=number, eye=side)

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """Change keys of the scene by their paths."""
        return replace(self, scene=self.scene.with_(changes))

    def looking(self, azimuth_deg: float, elevation_deg: float) -> Self:
        """Turn the optic axes of the eyes in a direction, ignoring targets."""
        return replace(self, scene=self.scene.with_(gaze_deg=(azimuth_deg, elevation_deg)), fixation=None)

    def following(self, fixation: int) -> Self:
        """Fixate a target of the loaded scene, or take one of its poses."""
        if not 0 <= fixation < self.fixations:
            raise InputError(f"there is no fixation {fixation}, only {self.fixations}", path="fixation")
        targets = self._targets()
        if targets is not None:
            scene = self.scene.with_(target_mm=targets[fixation])
        else:
            pose = (self.origin.poses or ())[fixation]
            scene = self.scene.with_(gaze_deg=(pose.azimuth_deg, pose.elevation_deg))
        return replace(self, scene=scene, fixation=fixation)

    def with_head(self, head: int) -> Self:
        """Move the head to one of the positions of the loaded scene."""
        place = np.round(np.add(self.origin.subject.head_positions_mm[head], self.shift_mm), 6)
        return replace(self.changed({"subject.head_positions_mm": [place.tolist()]}), head=head)

    def with_shift(self, shift_mm: tuple[float, float, float]) -> Self:
        """Move the head against the rig: towards it (eye relief), to the subject's left and up (slippage)."""
        return replace(self, shift_mm=shift_mm).with_head(self.head)

    def with_opening(self, share: float) -> Self:
        """Open the lids to a share of their opening: 1 open, 0 shut."""
        if self.scene.spec.region is None:
            raise InputError("the scene has no lids; add a region to it", path="region.blink")
        return self.changed({"region.blink": round(1 - share, 6)})

    def with_light(self, light: int, **changes: Any) -> Self:
        """Change a light; rings are replaced by single LEDs (`Rig.with_light`)."""
        return self._with_rig(self.scene.spec.rig.with_light(light, **changes))

    def with_light_added(self, light: int) -> Self:
        """Add a copy of a light, shifted sideways by a twelfth of its distance to the eye."""
        place = self.scene.rig.lights[light].position_mm
        aside = np.cross(place - self.apex_mm, [0.0, 0.0, 1.0])
        if not aside.any():
            aside = np.array([0.0, np.linalg.norm(place - self.apex_mm), 0.0])
        return self._with_rig(self.scene.spec.rig.with_light_copied(light, np.round(aside / 12, 3)))

    def without_light(self, light: int) -> Self:
        """Remove a light."""
        return self._with_rig(self.scene.spec.rig.without_light(light))

    def with_camera_added(self, camera: int) -> Self:
        """Add a copy of a camera at the same position, with another name."""
        cameras = self.scene.spec.rig.cameras
        copy = {**cameras[camera].to_mapping(), "name": f"camera {len(cameras)}"}
        return self.changed({"rig.cameras": [*(one.to_mapping() for one in cameras), copy]})

    def without_camera(self, camera: int) -> Self:
        """Remove a camera and select the first one."""
        fewer = self._with_rig(self.scene.spec.rig.without_camera(camera))
        return replace(fewer, camera=0).showing(eye=fewer.eye)

    def with_focal_length(self, camera: int, focal_length: float) -> Self:
        """Change a camera's focal length, in the unit used by the scene (mm or px)."""
        key, _ = self.focal_length(camera)
        return self.changed({f"rig.cameras.{camera}.{key}": focal_length})

    def focal_length(self, camera: int) -> tuple[str, float | None]:
        """Return key and value of a camera's focal length; the value is None if a calibration defines the lens."""
        spec = self.scene.spec.rig.cameras[camera]
        key = "focal_length_px" if spec.focal_length_mm is None else "focal_length_mm"
        return key, getattr(spec, key)

    def field_deg(self, camera: int) -> float | None:
        """Return the horizontal field of view of a camera; None if it has a calibration or is a fisheye."""
        built = self.scene.rig.cameras[camera]
        fisheye = isinstance(self.scene.spec.rig.cameras[camera].distortion, FisheyeDistortion)
        if self.focal_length(camera)[1] is None or fisheye:
            return None
        return float(np.degrees(2 * np.arctan(built.resolution_px[0] / (2 * built.K[0, 0]))))

    def with_field(self, camera: int, field_deg: float) -> Self:
        """Change the focal length of a camera so that its picture is so wide.

        Raises:
            InputError: the angle is not between 1 and 150 degrees, or the camera has no single focal length.
        """
        old = self.field_deg(camera)
        if old is None or not 1.0 <= field_deg <= 150.0:
            raise InputError("must be 1 to 150 degrees, of a camera with a focal length", path=f"rig.cameras.{camera}")
        longer = np.tan(np.radians(old / 2)) / np.tan(np.radians(field_deg / 2))
        return self.with_focal_length(camera, round(float(longer * (self.focal_length(camera)[1] or 0.0)), 6))

    def with_width(self, width_px: int) -> Self:
        """Change the number of pixels of the pictures, which show the same (`generate --size`)."""
        spec = self.scene.spec
        width, height = spec.image.window_px or spec.rig.cameras[0].resolution_px
        data = scaled(spec.to_mapping(), (width_px, max(1, round(height * width_px / width))))
        return replace(self, scene=self.scene.replaced(SceneSpec.from_mapping(data)))

    def with_camera_at(self, camera: int, position_mm: ArrayLike) -> Self:
        """Move a camera. A camera with a target point keeps looking at it; any other keeps its direction."""
        spec = self.scene.spec.rig.cameras[camera]
        # For a camera with a mirror, the numeric position is that of the mirror image.
        place = np.round(np.asarray(position_mm if spec.mirror is None else spec.mirror.image_of(position_mm)), 6)
        if spec.calibration is None:
            return self.changed({f"rig.cameras.{camera}.position_mm": place.tolist()})
        turn = spec.unmirrored().R
        return self.changed({f"rig.cameras.{camera}.calibration.t_mm": (-turn @ place).tolist()})

    def with_camera_aimed(self, camera: int) -> Self:
        """Turn a camera to the selected eye."""
        spec = self.scene.spec.rig.cameras[camera]
        if spec.calibration is not None:
            raise InputError("has a calibration, which fixes its direction", path=f"rig.cameras.{camera}")
        path = f"rig.cameras.{camera}"
        aim = self.apex_mm if spec.mirror is None else spec.mirror.image_of(self.apex_mm)
        return self.changed({f"{path}.look_at_mm": aim.tolist(), f"{path}.pan_deg": None, f"{path}.tilt_deg": None})

    def saved(self) -> SceneSpec:
        """Return the spec to save: the changes of the knobs, with all fixations and head positions of the loaded scene.

        A gaze set by the user replaces the fixations. Files are absolute paths, so the scene means the same in every
        folder.
        """
        shown = self.scene.located()
        data = shown.to_mapping()
        places = np.round(np.add(self.origin.subject.head_positions_mm, self.shift_mm), 6)
        data["subject"] = {**data["subject"], "head_positions_mm": places.tolist()}
        if self.fixation is not None:
            data["subject"]["accommodation_d"] = self.origin.subject.accommodation_d
            data.pop("targets", None)
            data.pop("poses", None)
            kept = self.origin.to_mapping()
            data |= {key: kept[key] for key in ("targets", "poses") if key in kept}
        model = data["eye"].get("model")
        if isinstance(model, str) and model.endswith((".yaml", ".yml")) and self.scene.base is not None:
            data["eye"]["model"] = str((self.scene.base / model).resolve())
        return SceneSpec.from_mapping(data)

    def with_all_fixations(self) -> Scene:
        """Restore all targets of the loaded scene, on the current screen, or all its poses."""
        kept = {"targets": self.origin.targets, "poses": self.origin.poses}
        return self.scene.replaced(self.scene.spec.model_copy(update=kept), rig=self.scene.rig)

    @property
    def rows(self) -> Frames:
        """Return the frames of all fixations that the selected camera has of the selected eye."""
        frames = self.with_all_fixations().frames()
        shown = (frames.index.camera == self.camera) & (frames.index.eye == EYES.index(self.eye))
        return frames.take(np.flatnonzero(shown))

    def _with_rig(self, rig: Rig) -> Self:
        return replace(self, scene=self.scene.with_(rig=rig))

    def _targets(self) -> Any:
        """Return the targets of the loaded scene on the current screen, (f, 3); None if it gives poses."""
        return None if self.origin.targets is None else self.with_all_fixations().targets_mm


def _middle(scene: Scene) -> int:
    """Return the fixation whose direction is nearest to the mean of all."""
    frames = scene.frames()
    fixations = np.unique(frames.index.fixation)
    pose = np.stack([frames.pose.azimuth_rad, frames.pose.elevation_rad], axis=1)
    mean = np.array([pose[frames.index.fixation == k].mean(axis=0) for k in fixations])
    return int(fixations[np.linalg.norm(mean - mean.mean(axis=0), axis=1).argmin()])


def half_width_deg(exponent: float) -> float:
    """Return the angle at which a lobe cos^m has half of its intensity; 90 degrees for an isotropic one."""
    return float(np.degrees(np.arccos(0.5 ** (1.0 / exponent)))) if exponent > 0.0 else 90.0


def lobe_exponent(half_width: float) -> float:
    """Return the exponent m of a lobe cos^m with this half-width in degrees."""
    if not 1.0 <= half_width <= 90.0:
        raise InputError("must be 1 to 90 degrees", path="half-width of the lobe")
    return 0.0 if half_width >= 89.9 else round(float(np.log(0.5) / np.log(np.cos(np.radians(half_width)))), 6)


def ring_note(rig: Rig, light: int) -> str:
    """Say whether a light, counted over all LEDs of rings, belongs to a ring, and which camera it moves with."""
    first = 0
    for led in rig.lights:
        count = 1 if led.ring is None else led.ring.count
        if light < first + count:
            if led.ring is None:
                return ""
            bound = "" if led.ring.centre_mm is not None else f" that moves with camera {led.ring.camera}"
            return f"One of a ring of {count}{bound}; a change makes them single LEDs."
        first += count
    return ""


def named(cameras: tuple[Camera, ...]) -> list[str]:
    """Return labels of cameras: number and name."""
    return [f"{k}: {camera.name}" for k, camera in enumerate(cameras)]


def directions(setup: Setup) -> EyeDirection:
    """Return the direction of the selected eye's optic axis, rounded to a knob's precision."""
    frames = setup.frames()
    row = setup.row(frames)
    azimuth, elevation = np.degrees([frames.pose.azimuth_rad[row], frames.pose.elevation_rad[row]])
    return EyeDirection(azimuth_deg=round(float(azimuth), 2), elevation_deg=round(float(elevation), 2))
