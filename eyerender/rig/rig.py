"""The rig: cameras, lights and screen together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..base.arrays import ArrayValue, Body, Bools, Floats, Ints, remembered
from ..base.errors import InputError
from ..base.spec import EYES, KeyProblem, Side, Spec
from ..optics.triangles import holds
from .camera import Camera, PinholeCamera, serves
from .light import MAX_LIGHTS, Lamp, Led
from .mount import IpdAdjustment, Mount, RigidMotion
from .obstacles import Obstacle
from .screen import Screen, ScreenPlane
from .unit import UnitCalibration

# Every camera has its own frame for every target and head position.
MAX_CAMERAS = 100
MAX_OBSTACLES = 32


class Rig(Spec):
    """The hardware in front of the subject; it does not move with the head.

    >>> camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -150), focal_length_px=4000, size_px=(640, 480))
    >>> er.Rig(cameras=[camera], lights=[er.Led((600, 120, 0))]).build().cameras[0].resolution_px
    (640, 480)
    """

    cameras: Annotated[tuple[Camera, ...], Field(max_length=MAX_CAMERAS)] = Field(
        default=(), description="the cameras; each takes frames of its own"
    )
    lights: Annotated[tuple[Led, ...], Field(max_length=MAX_LIGHTS)] = Field(
        default=(),
        description="the infrared LEDs; all of them are on in every frame, and light the eyes that they name",
    )
    calibration: UnitCalibration | None = Field(
        default=None, description="the cameras and LEDs of a device from its file, before those of `cameras`, `lights`"
    )
    screen: Screen | None = Field(default=None, description="the screen that holds the targets")
    mount: Mount | None = Field(
        default=None,
        description="moves cameras, lights and obstacles together, not the screen: a tilted headset, a tolerance",
    )
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=MAX_OBSTACLES)] = Field(
        default=(),
        description="bodies that block light from LEDs to eyes and from eyes to cameras: a barrel, a bezel, a seal",
    )

    ipd_adjust: IpdAdjustment | None = Field(
        default=None,
        description="moves the cameras and LEDs of each eye (whose `eyes` names it alone) to the wearer's eyes, before "
        "the mount",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.calibration is not None:
            return self  # the whole rig is checked when the file is read
        for name in ("cameras", "lights"):
            if not getattr(self, name):
                raise KeyProblem(name, "needs at least 1 entries" if name in self.model_fields_set else "missing")
        for i, light in enumerate(self.lights):
            if light.ring is not None and light.ring.camera >= len(self.cameras):
                raise ValueError(f"lights.{i}.ring.camera: there is no camera {light.ring.camera}")
        if self.obstacles and any(camera.mirror is not None for camera in self.cameras):
            raise ValueError("obstacles: cannot be given with a camera that looks past a mirror")
        for i, light in enumerate(self.lights):
            _check_pulse(light, self._rates_hz(light), f"lights.{i}")
        if self.light_count > MAX_LIGHTS:
            raise ValueError(f"lights: are {self.light_count} with those of the rings; at most {MAX_LIGHTS}")
        return self

    @property
    def light_count(self) -> int:
        """Number of lights, counting each LED of a ring."""
        return sum(1 if light.ring is None else light.ring.count for light in self.lights)

    def _rates_hz(self, light: Led) -> tuple[float, ...]:
        """Return the rates of the cameras whose frames start a light's pulses; cameras in step count once."""
        sides = [side for side in EYES if serves(light.eyes, side)]
        seeing = [camera for camera in self.cameras if any(serves(camera.eyes, side) for side in sides)]
        clocks = {(camera.frame_rate_hz, camera.phase_ms or 0.0, camera.clock_ppm or 0.0) for camera in seeing}
        return tuple(rate for rate, _, _ in clocks if rate is not None)

    def with_light(self, number: int, **changes: Any) -> Self:
        """Change one light of the rig.

        Changing an LED of a ring replaces the ring by single LEDs at the same positions. Positions are those before the
        mount moves the rig.

        Args:
            number: number of the light, from 0, counting each LED of a ring.
            changes: new values of the fields of `Led`; or `moved_mm` (3,), a shift of the LED.

        Raises:
            InputError: there is no such light, or a value does not fit.
        """
        leds = self.single_leds(number)
        moved = np.asarray(changes.pop("moved_mm", (0.0, 0.0, 0.0)), dtype=float)
        leds[number] = {**leds[number], **changes}
        leds[number]["position_mm"] = np.asarray(leds[number]["position_mm"], dtype=float) + moved
        return self._with_leds(leds)

    def with_light_copied(self, number: int, moved_mm: ArrayLike) -> Self:
        """Append a copy of a light, moved by `moved_mm` (3,); rings are replaced by single LEDs, each with its number.

        Raises:
            InputError: there is no such light, or there are too many.
        """
        leds = self.single_leds(number)
        place = np.asarray(leds[number]["position_mm"], dtype=float) + np.asarray(moved_mm, dtype=float)
        return self._with_leds([*leds, {**leds[number], "position_mm": place.tolist()}])

    def without_light(self, number: int) -> Self:
        """Remove a light; rings are replaced by single LEDs.

        Raises:
            InputError: there is no such light, or it is the only one.
        """
        leds = self.single_leds(number)
        return self._with_leds([*leds[:number], *leds[number + 1 :]])

    def without_camera(self, number: int) -> Self:
        """Remove a camera; rings are replaced by single LEDs, which stay.

        Raises:
            InputError: there is no such camera, or it is the only one.
        """
        if not 0 <= number < len(self.cameras):
            raise InputError(f"there is no camera {number}, only {len(self.cameras)}", path="cameras")
        cameras = [*self.cameras[:number], *self.cameras[number + 1 :]]
        return self._with_leds(self.single_leds(), cameras=cameras)

    def of_eye(self, side: Side) -> Self:
        """Return the rig that one eye meets: cameras that see it and LEDs that light it; rings become single LEDs.

        Without `eyes` in any camera or LED, this is the rig itself.

        Raises:
            InputError: no camera sees the eye, or no LED lights it.
        """
        if not any([camera.eyes for camera in self.cameras] + [led.eyes for led in self.lights]):
            return self
        cameras = [camera for camera in self.cameras if serves(camera.eyes, side)]
        leds = [led for led in self.single_leds() if serves(led.get("eyes"), side)]
        for name, kept, verb in (("cameras", cameras, "sees"), ("lights", leds, "lights")):
            if not kept:
                raise InputError(f"none {verb} the {side} eye", path=f"rig.{name}")
        return self._with_leds(leds, cameras=cameras)

    def single_leds(self, number: int = 0) -> list[dict[str, Any]]:
        """Return the fields of all LEDs, with rings split into single ones; check that light `number` exists."""
        if not 0 <= number < self.light_count:
            raise InputError(f"there is no light {number}, only {self.light_count}", path="lights")
        bare = tuple(led.model_copy(update={"mirror": None}) for led in self.lights)
        geometry, leds = self.model_copy(update={"lights": bare, "mount": None, "ipd_adjust": None}).build(), []
        for led in self.lights:
            if led.ring is None:
                leds.append(led.to_mapping())
                continue
            same = {key: value for key, value in led.to_mapping().items() if key != "ring"}
            places = [light.position_mm for light in geometry.lights[len(leds) : len(leds) + led.ring.count]]
            leds += [{**same, "position_mm": place.tolist()} for place in places]
        return leds

    def _with_leds(self, leds: list[dict[str, Any]], **fields: Any) -> Self:
        kept = {"cameras": self.cameras, "lights": leds}
        kept |= {name: getattr(self, name) for name in ("screen", "mount", "obstacles", "ipd_adjust")}
        return type(self).from_mapping({**kept, **fields})

    def resolved(self, base: Path | None = None) -> Self:
        """Return the rig with calibration files of the device and its cameras read in; paths are relative to `base`.

        Raises:
            InputError: a file cannot be read, or does not fit its camera.
        """
        if self.calibration is not None:
            own, leds = self.calibration.read(base)
            kept = {key: value for key, value in self.to_mapping().items() if key != "calibration"}
            kept |= {"cameras": [*own, *kept["cameras"]], "lights": [*leds, *kept["lights"]]}
            return type(self).from_mapping(kept, source=self.calibration.file).resolved(base)
        cameras = tuple(camera.resolved(base) for camera in self.cameras)
        changed = any(new is not old for new, old in zip(cameras, self.cameras, strict=True))
        return self.model_copy(update={"cameras": cameras}) if changed else self

    def located(self, base: Path | None = None) -> Self:
        """Return the rig with the files of its obstacles as absolute paths; they are relative to `base`."""
        folder = Path.cwd() if base is None else base.resolve()
        placed = tuple(
            o if o.file is None else o.model_copy(update={"file": str(folder / o.file)}) for o in self.obstacles
        )
        return self.model_copy(update={"obstacles": placed}) if placed else self

    def set_to(self, ipd_mm: float) -> Self:
        """Adjust the rig to a wearer's distance of the eyes, within its range; without `ipd_adjust` this is the rig."""
        if self.ipd_adjust is None:
            return self
        setting = {"set_mm": self.ipd_adjust.nearest_mm(ipd_mm)}
        return self.model_copy(update={"ipd_adjust": self.ipd_adjust.model_copy(update=setting)})

    def build(self, ipd_mm: float | None = None) -> RigGeometry:
        """Build the numeric rig, adjusted to a wearer's distance of the eyes if it has `ipd_adjust`."""
        if self.calibration is not None:
            return self.resolved().build(ipd_mm)
        cameras = tuple(camera.build() for camera in self.cameras)
        # A ring of LEDs surrounds the real camera, not its mirror image.
        places = tuple(camera.unmirrored() for camera in self.cameras)
        lights = tuple(light for spec in self.lights for light in spec.build(places, self._rates_hz(spec)))
        if self.ipd_adjust is not None:
            cameras = tuple(self.ipd_adjust.camera(camera, ipd_mm) for camera in cameras)
            lights = tuple(self.ipd_adjust.lamp(light, ipd_mm) for light in lights)
        if self.mount is not None:
            cameras = tuple(map(self.mount.camera, cameras))
            lights = tuple(map(self.mount.lamp, lights))
        screen, moved_by = self.screen.build() if self.screen else None, self.mount if self.obstacles else None
        return RigGeometry(cameras, lights, screen, self.obstacles, moved_by)


class RigLike(Protocol):
    """An authored `Rig` or a computed `RigGeometry`.

    Functions that accept either begin with `rig = rig.build()`.
    """

    def build(self, ipd_mm: float | None = None) -> RigGeometry:
        """Build the numeric rig, adjusted to a wearer's distance of the eyes if it can be."""
        ...


@remembered
def _inside(camera: PinholeCamera, body: Body) -> bool:
    return holds(body, camera.nodal_point_mm)


@dataclass(frozen=True, slots=True, eq=False)
class RigGeometry(ArrayValue):
    """Cameras, lights, the screen, if there is one, and obstacles as authored, before a mount moves them.

    `to_mapping` leaves obstacles out. Their files are read where their bodies are needed.
    """

    cameras: tuple[PinholeCamera, ...]
    lights: tuple[Lamp, ...]
    screen: ScreenPlane | None
    obstacles: tuple[Obstacle, ...] = ()
    mount: Mount | None = None
    moved_by: RigidMotion | None = None

    def moved(self, rotation: Floats, translation_mm: Floats) -> RigGeometry:
        """Move cameras, lights and obstacles, not the screen: x' = R x + t in the world."""
        motion = RigidMotion(rotation, translation_mm)
        cameras, lights = tuple(map(motion.camera, self.cameras)), tuple(map(motion.lamp, self.lights))
        return replace(self, cameras=cameras, lights=lights, moved_by=motion if self.obstacles else None)

    def build(self, ipd_mm: float | None = None) -> RigGeometry:
        """Return this rig, which is already numeric and adjusted."""
        return self

    def bodies(self) -> tuple[Body, ...]:
        """Build the obstacles in the world; the same objects until a file changes.

        Raises:
            InputError: the file of an obstacle cannot be read, or a camera is inside an obstacle.
        """
        out = []
        for k, obstacle in enumerate(self.obstacles):
            try:
                body = obstacle.build(self.mount)
                out.append(body if self.moved_by is None else self.moved_by.body(body))
            except InputError as error:
                raise error.placed(under=f"rig.obstacles.{k}.file") from None
            for number, camera in enumerate(self.cameras):
                if _inside(camera, out[-1]):
                    raise InputError(f"camera {number} is inside it, and sees nothing", path=f"rig.obstacles.{k}")
        return tuple(out)

    def lights_of(self, eye: int) -> tuple[int, ...]:
        """Return the numbers of the lights that light an eye: 0 right, 1 left, -1 unknown (then all)."""
        return tuple(k for k, light in enumerate(self.lights) if light.lights(eye))

    def lit(self, eye: Ints) -> Bools:
        """Return whether each light lights each eye: (n, lights) for eyes (n,), 0 right, 1 left, -1 unknown."""
        by_eye = np.array([[light.lights(side) for light in self.lights] for side in (0, 1, -1)], dtype=bool)
        return np.asarray(by_eye[eye])

    def to_mapping(self) -> dict[str, Any]:
        """Convert to the mapping that `features --json` writes (see docs/formats.md)."""
        screen = self.screen
        return {
            "cameras": [{**c.to_mapping(), "eyes": _listed(c.eyes)} for c in self.cameras],
            "lights_mm": [light.position_mm.tolist() for light in self.lights],
            "light_eyes": [_listed(light.eyes) for light in self.lights],
            "screen": None
            if screen is None
            else {
                "centre_mm": screen.centre_mm.tolist(),
                "size_mm": list(screen.size_mm),
                "right": screen.right.tolist(),
                "up": screen.up.tolist(),
            },
        }


def _check_pulse(light: Led, rates_hz: tuple[float, ...], path: str) -> None:
    """Refuse a pulse that does not fit into a frame, or that contradicts the duty cycle."""
    if light.pulse is None or not rates_hz:
        return
    end_s, share = light.pulse.span_s[1], light.pulsed_share(rates_hz)
    if end_s > (1.0 + 1e-9) / max(rates_hz):
        raise KeyProblem(
            f"{path}.pulse", f"ends after {1e3 * end_s:g} ms, but a frame takes {1e3 / max(rates_hz):g} ms"
        )
    if light.duty_cycle is not None and abs(light.duty_cycle - share) > 0.01 * share:
        raise KeyProblem(
            f"{path}.duty_cycle", f"is {light.duty_cycle:g}, but the pulses and frame rates make {share:g}"
        )


def _listed(eyes: tuple[Side, ...] | None) -> list[Side] | None:
    return None if eyes is None else list(eyes)
