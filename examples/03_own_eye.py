"""
Your own eye
============

An eye model is a file, or a mapping of the same keys. Here the cornea of a published model becomes steeper or flatter,
and with it the pupil that a camera sees.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

data = er.load_eye("E4").to_mapping()
front, back = (surface["shape"] for surface in data["cornea"])
print("front of the cornea:", front)
print("back of the cornea: ", back)

# %%
# Any key can be changed. The geometry is checked at once: surfaces that cross are refused.
rig = er.Rig(
    cameras=[er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, 0), focal_length_px=8000, size_px=(640, 640))],
    lights=[er.Led((600, 100, 0))],
)
scales = np.linspace(0.88, 1.12, 7)
diameters = []
for scale in scales:
    for surface, shape in zip(data["cornea"], (front, back), strict=True):
        surface["shape"] = {**shape, "radius_mm": shape["radius_mm"] * scale}
    eye = er.Eye(er.EyeSpec.from_mapping(data), pupil_diameter_mm=4.0)
    seen = er.trace(er.Subject.one_eye(eye).looking([(0, 0)], rig))
    diameters.append(2 * seen.pupil.semi_axes_px[0, 0] / rig.build().cameras[0].scale_at(np.zeros(3)))

# %%
# A steeper cornea magnifies the pupil more. On the left the fronts of the seven corneas (conics) with the 4 mm stop; on
# the right the diameter that the camera sees.
height = np.linspace(-5.5, 5.5, 101)
figure, (section, curve) = plt.subplots(1, 2, figsize=(9, 4), width_ratios=(0.5, 1), layout="constrained")
for scale, diameter, colour in zip(scales, diameters, plt.cm.plasma(np.linspace(0, 0.85, 7)), strict=True):
    radius = front["radius_mm"] * scale
    depth = height**2 / (radius + np.sqrt(radius**2 - (1 + front["conic_constant"]) * height**2))
    section.plot(depth, height, color=colour, lw=2)
    curve.plot(radius, diameter, "o", color=colour, ms=10)
    curve.annotate(f"{diameter:.2f} mm", (radius, diameter), (0, 9), textcoords="offset points", ha="center")
stop = -eye.build().stop.centre_mm[0]
section.plot([stop, stop], [2, 5.5], "k", lw=4)
section.plot([stop, stop], [-2, -5.5], "k", lw=4, label="iris")
section.set(title="front of the cornea", xlabel="depth (mm)", ylabel="height (mm)", aspect="equal")
section.legend(loc="center right")
curve.axhline(4, color="k", ls="--")
curve.annotate("stop: 4 mm", (8.5, 4), (0, 4), textcoords="offset points", ha="center")
curve.set(title="apparent diameter of the pupil", xlabel="radius of the cornea (mm)", ylabel="mm", ylim=(3.95, 4.62))
curve.margins(x=0.1)
plt.show()
