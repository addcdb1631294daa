"""
A keratoconus, and your own topography
======================================

A cornea may be a grid of measured heights. Here a Gaussian cone imitates a keratoconus: 40 micrometres high at the
front and 60 at the back, so that the cornea is thinnest there, 1.2 mm from the axis towards the temple and the cheek.
These numbers are chosen. For heights from a topographer, give `file:` in the eye file instead.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

SIZE, SPP = (560, 420), 32  # small: (140, 105), 4
SPACING = 0.25
place = SPACING * np.arange(-18, 19)
y, z = np.meshgrid(place, place)  # rows run along z (up), columns along y (nasal)


def conic(radius, conic_constant):
    square = y**2 + z**2
    return -square / radius / (1 + np.sqrt(1 - (1 + conic_constant) * square / radius**2))


def cone(height, sigma=1.2, nasal=-0.85, up=-0.85):
    return height * np.exp(-((y - nasal) ** 2 + (z - up) ** 2) / (2 * sigma**2))


def eye_with(front_cone_mm, back_cone_mm):
    data = er.load_eye("E4").to_mapping()
    heights = (conic(7.72, -0.26) + cone(front_cone_mm), conic(6.5, 0.0) + cone(back_cone_mm))
    for surface, x in zip(data["cornea"], heights, strict=True):
        surface["shape"] = {"kind": "grid", "spacing_mm": SPACING, "heights_mm": x.tolist()}
    return er.EyeSpec.from_mapping({**data, "name": "keratoconus" if front_cone_mm else "healthy"})


healthy, ill = eye_with(0.0, 0.0), eye_with(0.040, 0.060)

# %%
# A headset's ring of LEDs shows the cone: its glints no longer lie on a circle.
scale = SIZE[0] / 560
camera = er.Camera.looking_at((-2, 0, 0), position_mm=(34, -8, -12), focal_length_px=1650 * scale, size_px=SIZE)
rig = er.Rig(cameras=[camera], lights=[er.Led(ring=er.rig.LedRing(radius_mm=22, count=20), intensity_mw_sr=0.2)])
look = er.Look(iris_contrast=0.8)
pictures, seen = [], []
for spec in (healthy, ill):
    frames = er.Subject.one_eye(er.Eye(spec, pupil_diameter_mm=4.0), look=look).looking([(0, 0)], rig)
    pictures.append(er.render(frames, spp=SPP)[0].counts)
    seen.append(er.trace(frames))

glints = [found.glints.xy_px[0] for found in seen]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.7))
for ax, picture, spec in zip(axes, pictures, (healthy, ill), strict=True):
    ax.imshow(picture, cmap="gray", vmin=0, vmax=np.quantile(picture, 0.99))
    ax.set_title(spec.name)
    ax.set_axis_off()
axes[1].plot(*np.vstack([glints[0], glints[0][:1]]).T, "-", color="tab:cyan", lw=0.7, label="glints of the healthy eye")
axes[1].plot(*seen[0].pupil.points_px[0].T, ":", color="tab:green", lw=1.0, label="its pupil")
axes[1].legend(loc="lower left", fontsize=7)
figure.tight_layout()

# %%
# Trackers that use glint and pupil see the displacement as gaze, unless they are calibrated for this eye: even then it
# changes with every turn of the eye.
shift = np.linalg.norm(glints[1] - glints[0], axis=1) / camera.build().scale_at(np.zeros(3))
print(f"glints move by {shift.min():.2f} to {shift.max():.2f} mm; 0.1 mm is about one degree of gaze")
plt.show()
