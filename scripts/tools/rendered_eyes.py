"""Labelled rendered images for testing the extractor: the eyes of the catalogue in front of two rigs.

A photograph is a pure function of (eye model, rig, seed, look): small gaze angles, pupil sizes and head positions
are random; the head position varies the phase of the outline on the pixels. Exposure and black level place the pupil at
20 DN of 255 and the iris at 75. The point-spread function is 1 px wide, as in the ideal images. `developed` adds noise.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from eyerender.analytic.observer import trace
from eyerender.imaging.capture import render_windows
from eyerender.optics.ellipse import Ellipse, signed_distance
from eyerender.scene import Scene
from eyerender.scene.parts import PUPIL
from eyerender.scene.spec import SceneSpec
from make_ideal_images import Drawing

Array = NDArray[np.float64]

MODELS = ("E1", "E2", "E3", "E4", "E5")
STEP_DN = 55.0
PUPIL_DN = 20.0
PSF_PX = 1.0
SPP = 64
# rig -> camera, lamps' places about it, range of pupil diameters, size of the window
RIGS: dict[str, dict[str, Any]] = {
    "remote": {  # semi-axes of about 13 to 17 px
        "camera": {"position_mm": [615, 0, -150.5], "look_at_mm": [0, -31.5, 0], "focal_length_px": 4666.7},
        "lamps": [[615, 208.5, 0], [615, -208.5, 0]], "lamp": {"radius_mm": 2.5, "intensity_mw_sr": 200},
        "pupil_mm": (3.2, 4.2), "window": [240, 180],
    },
    "close": {  # semi-axes of about 28 to 48 px
        "camera": {"position_mm": [30.64, -39.71, -14.79], "look_at_mm": [0, -31.5, 0], "focal_length_px": 600},
        "lamps": [[32.9, -36.2, -3.3], [32.9, -46.0, -21.0]], "lamp": {"radius_mm": 0.5, "intensity_mw_sr": 0.3},
        "pupil_mm": (3.3, 4.9), "window": [400, 300],
    },
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Photograph:
    """levels: (h, w) expected grey levels without noise, clipping and rounding, DN; label: as of an ideal image;
    visible: share of the pupil that is seen."""

    levels: Array
    label: dict[str, Any]
    visible: float


def scene_of(
    model: str, rig: str, seed: int, *, contrast: float, region: dict[str, Any] | None = None, spp: int = SPP
) -> Scene:
    """One frame of a right eye."""
    rng = np.random.default_rng([seed, zlib.crc32(rig.encode())])
    about = RIGS[rig]
    azimuth, elevation = rng.uniform(-8.0, 8.0, 2)
    mapping: dict[str, Any] = {
        "format": 2,
        "name": "rendered",
        "eye": {"model": model, "pupil_diameter_mm": float(rng.uniform(*about["pupil_mm"]))},
        "subject": {"eyes": ["right"], "head_positions_mm": [rng.uniform(-0.5, 0.5, 3).tolist()]},
        "rig": {
            "cameras": [{"name": rig, "resolution_px": [640, 480], **about["camera"]}],
            "lights": [{"position_mm": place, "aim_mm": [0, 0, 0], **about["lamp"]} for place in about["lamps"]],
        },
        "poses": [{"azimuth_deg": float(azimuth), "elevation_deg": float(elevation)}],
        "image": {"window_px": about["window"], "spp": spp},
        "sensor": {"psf_sigma_px": PSF_PX, "noise": False},
        "look": {"iris_contrast": contrast, "iris_seed": seed},
        "seed": seed,
    }
    if region is not None:
        mapping["region"] = region
    return Scene.of(SceneSpec.from_mapping(mapping))


def with_edge_glint(scene: Scene, seed: int) -> Scene:
    """The scene with its first lamp moved in the camera's plane until its glint sits on the pupil's edge.

    A random one of the bearings about the camera along which the glint crosses the edge; the place by Brent's method.
    """
    camera, spec = scene.rig.cameras[0], scene.spec
    first, *others = spec.rig.lights
    unit = float(np.linalg.norm(camera.nodal_point_mm - scene.eye_position_mm("right")))

    def lamps(places: list[Array]) -> Scene:
        moved = [first.model_copy(update={"position_mm": tuple(place.tolist())}) for place in places]
        rig = spec.rig.model_copy(update={"lights": (*moved, *others)})
        return scene.replaced(spec.model_copy(update={"rig": rig}))

    def place(bearing: float, reach: float) -> Array:
        across = math.cos(bearing) * camera.R[0] + math.sin(bearing) * camera.R[1]
        return np.asarray(camera.nodal_point_mm + reach * unit * across)

    def off(places: list[Array]) -> Array:
        """Signed distance of each lamp's glint from the apparent pupil's outline, px."""
        seen = trace(lamps(places))
        pupil = Ellipse(seen.pupil.centre_px[0], seen.pupil.semi_axes_px[0], float(seen.pupil.angle_rad[0]))
        out = np.full(len(places), np.nan)
        for k in range(len(places)):
            column = np.nonzero((seen.glints.light[0] == k) & seen.glints.ok[0])[0]
            if column.size:
                out[k] = signed_distance(pupil, seen.glints.xy_px[0, column])[0]
        return out

    bearings = np.random.default_rng([seed, 3]).permutation(np.arange(12) * (math.pi / 6.0))
    reaches = [0.05, 0.15, 0.25, 0.35, 0.5, 0.7]
    for bearing in bearings:
        distance = off([place(bearing, reach) for reach in reaches])
        crossing = np.nonzero(distance[:-1] * distance[1:] < 0.0)[0]
        if crossing.size:
            k = int(crossing[0])
            reach = optimize.brentq(
                lambda r, at=bearing: float(off([place(at, r)])[0]), reaches[k], reaches[k + 1], xtol=1e-4
            )
            return lamps([place(bearing, reach)])
    raise RuntimeError("no lamp's glint was found on the pupil's edge")


def photograph(renderer: Any, scene: Scene) -> Photograph:
    """Render a scene's one window, exposed for the step at the pupil's outline."""
    frames = scene.frames()
    truth = trace(frames)
    (shot,) = render_windows(frames, renderer=renderer)
    corner = np.array(shot.window[:2])
    pupil = truth.pupil
    ellipse = Ellipse(pupil.centre_px[0] - corner, pupil.semi_axes_px[0], float(pupil.angle_rad[0]))
    irradiance = shot.irradiance.astype(np.float64)
    inside, outside = (
        _median_near(irradiance, ellipse, shot.parts, part, away) for part, away in ((3, -4.0), (2, 4.0))
    )
    places = [
        (xy - corner).tolist() if ok else None for xy, ok in zip(truth.glints.xy_px[0], truth.glints.ok[0], strict=True)
    ]
    label = {
        "pupil": {
            "centre_px": ellipse.centre_px.tolist(), "semi_axes_px": ellipse.semi_axes_px.tolist(),
            "angle_rad": ellipse.angle_rad,
        },
        "glints": [{"status": "ok" if xy is not None else "missing", "xy_px": xy} for xy in places],
    }  # fmt: skip
    levels = PUPIL_DN + (irradiance - inside) * (STEP_DN / (outside - inside))
    labels = shot.rendered.labels
    visible = float(np.nan_to_num(labels.visible_fraction(PUPIL))) if labels is not None else 0.0
    return Photograph(levels, label, visible)


def _median_near(image: Array, ellipse: Ellipse, mask: NDArray[np.uint8], part: int, away: float) -> float:
    """Median level of a part's pixels between 3 and 5 px to one side of the outline."""
    y, x = np.nonzero(mask == part)
    distance = signed_distance(ellipse, np.stack([x, y], axis=-1).astype(np.float64))
    near = np.abs(distance - away) < 1.0
    return float(np.median(image[y[near], x[near]]))


def developed(shot: Photograph, seed: int, *, noise_dn: float = 0.0, blur_px: float = PSF_PX) -> Drawing:
    """The photograph as an 8-bit image with added noise, and further blur up to `blur_px`."""
    rng = np.random.default_rng([seed, 4])
    extra = math.sqrt(max(blur_px**2 - PSF_PX**2, 0.0))
    levels = ndimage.gaussian_filter(shot.levels, extra, mode="nearest", truncate=5.0) if extra > 0.0 else shot.levels
    data = np.rint(levels + noise_dn * rng.normal(0.0, 1.0, levels.shape))
    parameters = {"noise_dn": noise_dn, "blur_px": blur_px, "step_dn": STEP_DN, "bit_depth": 8}
    return Drawing(np.clip(data, 0, 255).astype(np.uint8), shot.label, parameters)
