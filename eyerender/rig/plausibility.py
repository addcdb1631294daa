"""Warnings about probable mistakes: values that can be computed with but make no sense.

Every function is pure and returns warnings. A scene collects its own (`Scene.warnings`), and a dataset's plan those of
some of its samples (`Plan.warnings`). The command line prints them, or refuses them with `--strict`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats
from ..base.errors import InputError, InputWarning
from .camera import Camera, PinholeCamera, Window, serves
from .distortion import FARTHEST_RAD
from .light import Lamp
from .rig import RigGeometry
from .screen import ScreenPlane
from .sensor import Sensor
from .timing import FrameTimes

# Human pupils are about 2 to 8 mm wide (Watson and Yellott 2012, J. Vision 12(10):12); drugs extend the range slightly.
PUPIL_MM = (1.0, 9.0)
# Quantum efficiency, albedos and reflectances are those at 850 nm; silicon loses half of its efficiency by 940 nm.
WAVELENGTHS_NM = (830.0, 870.0)
# Lengths of a scene below these values were probably given in metres: 2 (mm) is a screen or an interpupillary distance
# of 2 m, 0.02 (mm) an LED of 20 mm.
_LEAST_MM = {
    "rig.screen.size_mm": 2.0,
    "subject.ipd_mm": 2.0,
    "lens.focus_mm": 2.0,
    "rig.lights.*.ring.radius_mm": 0.5,
    "rig.cameras.*.focal_length_mm": 0.2,
    "rig.cameras.*.sensor_mm": 0.2,
    "rig.lights.*.radius_mm": 0.02,
}
_VERTEX_MM = 8.0  # from the cornea to a lens of spectacles; lids and lashes reach about as far (chosen)
# The same for positions: nothing can be this close to the world's origin, the bridge of the nose.
_LEAST_DISTANCE_MM = 2.0
# Globe and head, as spheres about the corneal apex and the head's position. Both are smaller than real ones, so that
# parts worn on a face (a headset's lamps, a frame of glasses) do not count as inside it.
_GLOBE_CENTRE_MM, _GLOBE_RADIUS_MM = np.array([-12.0, 0.0, 0.0]), 13.0
_HEAD_CENTRE_MM, _HEAD_SEMI_AXES_MM = np.array([-100.0, 0.0, 0.0]), np.array([85.0, 70.0, 115.0])
# Depth from which something counts as behind the screen's surface: the frames of screens are uneven.
_BEHIND_MM = 1.0
# Points of an eye that may be in view: the corneal apex and points of the limbus, within what rotation of the eye
# moves.
_LIMBUS_MM = np.array([[0, 0, 0], [-3, 6, 0], [-3, -6, 0], [-3, 0, 6], [-3, 0, -6]], dtype=float)
_PUPIL_REACH_MM = np.array([[0, 0, 0], [0, 4, 0], [0, -4, 0], [0, 0, 4], [0, 0, -4]], dtype=float)
# A camera that is farther than this from an eye's axis sees no cornea in any pose of the eye.
_FURTHEST_RAD = np.radians(140.0)

# A lamp that sends a smaller share of its axial intensity to the nearest eye is probably not aimed.
_LEAST_AIMED = 0.8
# Largest distance of a target from the screen's plane; real screens are no flatter.
_OFF_PLANE_MM = 1.0
# An image counts as saturated if more than this share of its pixels is.
SATURATED_SHARE = 0.2


def pupil_warnings(diameter_mm: float, path: str) -> list[InputWarning]:
    """Warn of a pupil diameter (mm) that no human eye has; `path` is its key in the input."""
    low, high = PUPIL_MM
    if low <= diameter_mm <= high:
        return []
    return [
        InputWarning(
            code="pupil", reason=f"is {diameter_mm:g} mm; human pupils are {low:g} to {high:g} mm wide", path=path
        )
    ]


def wavelength_warnings(wavelength_nm: float) -> list[InputWarning]:
    """Warn of a wavelength at which the quantum efficiency and albedos used here do not hold."""
    low, high = WAVELENGTHS_NM
    if low <= wavelength_nm <= high:
        return []
    reason = (
        f"is {wavelength_nm:g} nm; quantum efficiency and albedos are for 850 nm (good from {low:g} to {high:g}), "
        "so levels of pictures are wrong"
    )
    return [InputWarning(code="wavelength", reason=reason, path="wavelength_nm")]


def length_warnings(scene: Mapping[str, Any]) -> list[InputWarning]:
    """Warn of lengths in a scene's mapping that were probably given in metres."""
    found = []
    for pattern, least in _LEAST_MM.items():
        for path, value in _values(scene, pattern.split(".")):
            sizes = value if isinstance(value, list | tuple) else [value]
            # A lamp of size 0 is a point.
            if any(0 < size < least for size in sizes):
                found.append(InputWarning(code="metres", reason=f"is {_shown(sizes, ' x ')} mm; {_METRES}", path=path))
    return found


def vertex_warnings(scene: Mapping[str, Any]) -> list[InputWarning]:
    """Warn of spectacle lenses in a scene's mapping that stand among lids and lashes."""
    found = []
    for form in ("", ".*", ".right", ".right.*", ".left", ".left.*"):
        for path, value in _values(scene, f"subject.spectacles{form}.vertex_mm".split(".")):
            if value < _VERTEX_MM:
                reason = f"is {value:g} mm, among lids and lashes; spectacles stand about 10 to 16 mm before the cornea"
                found.append(InputWarning(code="vertex", reason=reason, path=path))
    return found


def timing_warnings(timings: Sequence[FrameTimes]) -> list[InputWarning]:
    """Warn of frames that begin before the last one is exposed and read, which no sensor takes."""
    found = []
    for k, times in enumerate(timings):
        taken = times.exposure_s + (times.rows - 1) * times.row_s
        if taken > times.period_s * (1 + 1e-9):
            every_ms = 1e3 * times.period_s
            reason = f"a frame is exposed and read for {1e3 * taken:.4g} ms, but one begins every {every_ms:.4g} ms"
            found.append(InputWarning(code="frame-rate", reason=reason, path=f"rig.cameras.{k}.frame_rate_hz"))
    return found


def place_warnings(
    rig: RigGeometry,  # the rig
    eyes_mm: Mapping[str, Floats],  # corneal apexes (3,) in the world by their name in a message
    heads_mm: Mapping[str, Floats],  # head positions (3,) in the world by their name in a message
    camera_paths: Sequence[str],  # path of each camera in the input, for messages
    light_paths: Sequence[str],  # path of each lamp in the input; lamps of one ring share a path and get one warning
) -> list[InputWarning]:
    """Warn of impossible places: cameras and lamps in a face, in a head or behind the screen, and a screen in a face.

    A lamp in none of these places gets a warning if its axis points past the nearest eye.
    """
    places = [
        *((path, "camera", camera.nodal_point_mm) for path, camera in zip(camera_paths, rig.cameras, strict=True)),
        *((path, "lamp", light.position_mm) for path, light in zip(light_paths, rig.lights, strict=True)),
    ]
    found: dict[str, InputWarning] = {}
    for path, what, place in places:
        code, reason = _misplaced(place, what, rig.screen, eyes_mm, heads_mm) or (None, None)
        if code is not None and reason is not None:
            found.setdefault(path, InputWarning(code=code, reason=reason, path=path))
    for path, lamp in zip(light_paths, rig.lights, strict=True):
        lit = _served(eyes_mm, lamp.eyes)
        if lit and (reason := _unaimed(lamp, lit)) is not None:
            found.setdefault(path, InputWarning(code="aim", reason=reason, path=path))
    if rig.screen is not None and np.linalg.norm(rig.screen.centre_mm) < _LEAST_DISTANCE_MM:
        path = "rig.screen.centre_mm"
        found[path] = InputWarning(
            code="metres", reason=f"is ({_shown(rig.screen.centre_mm)}) mm; {_METRES}", path=path
        )
    return list(found.values())


def mirror_warnings(cameras: Sequence[Camera], eyes_mm: Mapping[str, Floats]) -> list[InputWarning]:
    """Warn of a mirror between its camera and an eye (named in messages) that hides the eye instead of showing it."""
    found = []
    for k, camera in enumerate(cameras):
        if camera.mirror is None:
            continue
        normal, offset = camera.mirror.plane
        own = float(normal @ camera.unmirrored().nodal_point_mm) - offset
        hidden = [
            name for name, eye in _served(eyes_mm, camera.eyes).items() if (float(normal @ eye) - offset) * own < 0
        ]
        if hidden:
            reason = f"stands between the camera and {hidden[0]}, so the camera cannot see it in the mirror"
            found.append(InputWarning(code="mirror", reason=reason, path=f"rig.cameras.{k}.mirror"))
    return found


def view_warnings(
    rig: RigGeometry, views: Mapping[int, Iterable[tuple[Window, Floats]]], camera_paths: Sequence[str]
) -> list[InputWarning]:
    """Warn of cameras whose images show no eye at any head position; a camera without windows is none of them.

    `views` are, by camera, the windows to be rendered, each with the corneal apex (3,) it shows.
    """
    seen = {c: [_in_view(rig.cameras[c], window, eye) for window, eye in views[c]] for c in range(len(rig.cameras))}
    blind = [c for c, shown in seen.items() if shown and not any(shown)]
    everywhere = "; nothing of any eye is in view" if len(blind) == len(rig.cameras) else ""
    return [InputWarning(code="out-of-view", reason=f"sees no eye{everywhere}", path=camera_paths[c]) for c in blind]


def fold_warnings(
    rig: RigGeometry, views: Mapping[int, Iterable[tuple[Window, Floats]]], camera_paths: Sequence[str]
) -> list[InputWarning]:
    """Warn of lenses that fold the image back inside a window; `views` and `camera_paths` as for `view_warnings`.

    Raises:
        InputError: a pupil, or a whole window, lies beyond the fold.
    """
    found = []
    for c, camera in enumerate(rig.cameras):
        dark = [camera.without_rays(window) for window, _ in views[c]]
        reach, limit = camera.fold
        apexes = np.array([apex + _PUPIL_REACH_MM for _, apex in views[c]]).reshape(-1, 3)
        x, y, _ = camera.plane(apexes @ camera.R.T + camera.t)
        outside = np.hypot(x, y) > reach
        ends = reach in (FARTHEST_RAD, camera.reach)
        what = "ends the picture" if ends else "folds the picture back"
        reason = f"{what} {limit * camera.K[0, 0]:.0f} px from the principal point; "
        if outside.any() or any(one is not None and one.all() for one in dark):
            raise InputError(f"{reason}an eye lies beyond", path=camera_paths[c])
        if any(one is not None for one in dark) and not ends:
            reason += "pixels beyond are black, and class 4 of masks"
            found.append(InputWarning(code="fold", reason=reason, path=camera_paths[c]))
    return found


EXPOSURE_REMEDY = (
    "lower sensor.exposure_ms, or leave it and sensor.gain_dn_per_e out, so that the scene sets them by its lights"
)
"""What helps against white pictures."""


def is_saturated(dn: NDArray[Any], sensor: Sensor) -> bool:
    """Return whether more than 20 % of an image's pixels, counts `dn` (h, w), are saturated."""
    return bool(np.count_nonzero(dn >= sensor.saturation_dn) > SATURATED_SHARE * dn.size)


def saturation_warnings(saturated: int, images: int, source: str, excess: float | None = None) -> list[InputWarning]:
    """Warn if some of the images, `saturated` out of `images`, are mostly white.

    `excess` is the factor by which the exposure exceeds the one that the scene would set by itself.
    """
    if not saturated:
        return []
    by_factor = excess is not None and excess > 1
    remedy = f"divide sensor.exposure_ms by {excess:.2g}, or leave it out" if by_factor else EXPOSURE_REMEDY
    reason = f"in {saturated} of {images} images more than {SATURATED_SHARE:.0%} of the pixels are saturated; {remedy}"
    return [InputWarning(code="saturated", reason=reason, source=source)]


def target_warnings(targets_mm: Floats, screen: ScreenPlane | None, source: str) -> list[InputWarning]:
    """Warn of targets (n, 3) in the world that are off the screen, where estimators place every gaze point."""
    if screen is None or not len(targets_mm):
        return []
    off = np.abs((targets_mm - screen.centre_mm) @ screen.normal)
    count = int(np.count_nonzero(off > _OFF_PLANE_MM))
    if not count:
        return []
    reason = (
        f"{count} of {len(off)} targets lie off the plane of the rig's screen, by up to {off.max():.4g} mm; "
        "gaze points are always on that plane"
    )
    return [InputWarning(code="off-screen-plane", reason=reason, source=source, path="target_mm")]


def rig_warnings(rig: RigGeometry, calibrated: RigGeometry, source: str) -> list[InputWarning]:
    """Warn if a rig differs from the rig on which the estimator was calibrated."""
    path = next(_differences(rig.to_mapping(), calibrated.to_mapping(), "rig"), None)
    if path is None:
        return []
    return [
        InputWarning(
            code="other-rig",
            reason="differs from the rig of the calibration; calibrate again with this rig",
            source=source,
            path=path,
        )
    ]


def _differences(one: Any, other: Any, path: str) -> Iterator[str]:
    """Yield the paths at which two values of the same kind differ by more than rounding."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for key in one:
            yield from _differences(one[key], other.get(key), f"{path}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _differences(a, b, f"{path}.{k}")
    elif isinstance(one, int | float) and isinstance(other, int | float):
        if not np.isclose(one, other, rtol=1e-6, atol=1e-6):
            yield path
    elif one != other:
        yield path


def _misplaced(
    place: Floats, what: str, screen: ScreenPlane | None, eyes_mm: Mapping[str, Floats], heads_mm: Mapping[str, Floats]
) -> tuple[str, str] | None:
    """Return code and reason of a warning about one position; None if it is plausible."""
    if np.linalg.norm(place) < _LEAST_DISTANCE_MM:
        return "metres", f"the {what} is at ({_shown(place)}) mm, in the face; {_METRES}"
    for name, eye in eyes_mm.items():
        if np.linalg.norm(place - eye - _GLOBE_CENTRE_MM) < _GLOBE_RADIUS_MM:
            away = np.linalg.norm(place - eye)
            return "in-eye", f"the {what} is in the {name} ({away:.3g} mm from its corneal apex)"
    for name, head in heads_mm.items():
        if np.linalg.norm((place - head - _HEAD_CENTRE_MM) / _HEAD_SEMI_AXES_MM) < 1:
            behind = head[0] - place[0]
            return "in-head", f"the {what} is in the {name}, {behind:.3g} mm behind the corneas"
    if screen is not None and (screen.centre_mm - place) @ screen.normal > _BEHIND_MM:
        for name, eye in eyes_mm.items():
            on_screen, ok = screen.intersect(place, eye - place)
            if ok and np.all(np.abs(on_screen) < np.array(screen.size_mm) / 2):
                return "behind-screen", f"the {what} is behind the screen, as the {name} sees it"
    return None


def _served(eyes_mm: Mapping[str, Floats], eyes: Sequence[str] | None) -> dict[str, Floats]:
    """Return the apexes of the eyes that a camera sees or a lamp lights; their names begin with the side."""
    return {name: eye for name, eye in eyes_mm.items() if serves(eyes, name.split()[0])}


def _unaimed(lamp: Lamp, eyes_mm: Mapping[str, Floats]) -> str | None:
    """Return the reason of a warning if a lamp points past the nearest eye; None if it is aimed."""
    ways = {name: eye - lamp.position_mm for name, eye in eyes_mm.items()}
    distances = {name: float(np.linalg.norm(way)) for name, way in ways.items()}
    name = min(distances, key=lambda eye: distances[eye])
    cosine = float(lamp.axis @ ways[name]) / max(distances[name], 1e-9)
    share = max(cosine, 0.0) ** lamp.lobe_exponent
    return None if share >= _LEAST_AIMED else f"sends {share:.0%} of its axial intensity to the {name}; set aim_mm"


def _in_view(camera: PinholeCamera, window: Window, apex: Floats) -> bool:
    """Return whether a window shows any part of the front of an eye."""
    towards = camera.nodal_point_mm - apex
    if towards[0] < np.cos(_FURTHEST_RAD) * np.linalg.norm(towards):
        return False
    pixels, front = camera.project(apex + _LIMBUS_MM)
    x0, y0, width, height = window
    middle, half = np.array([x0 + (width - 1) / 2, y0 + (height - 1) / 2]), np.array([width, height]) / 2
    with np.errstate(invalid="ignore"):
        inside = (np.abs(pixels - middle) <= half).all(axis=-1)
    return bool(np.any(front & inside))


_METRES = "lengths are in mm; did you mean metres?"


def _values(node: Any, keys: Sequence[str], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value at a dotted path of a mapping, with its path; `*` stands for each entry of a list."""
    if not keys:
        if node is not None:
            yield path, node
        return
    if keys[0] == "*":
        for k, entry in enumerate(node if isinstance(node, list | tuple) else ()):
            yield from _values(entry, keys[1:], f"{path}.{k}")
    elif isinstance(node, Mapping) and keys[0] in node:
        yield from _values(node[keys[0]], keys[1:], f"{path}.{keys[0]}" if path else keys[0])


def _shown(values: Iterable[float], between: str = ", ") -> str:
    return between.join(f"{value:.4g}" for value in values)
