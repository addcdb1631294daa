"""
Your own eye
============

An eye model is a file, or a mapping of the same keys. Here the cornea of a published model is made steeper and more
prolate, and the pupil that a camera sees is compared.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

data = er.load_eye("E4").to_mapping()
shape = data["cornea"][0]["shape"]
print("front cornea:", shape)

# %%
# Any key can be changed. The geometry is checked at once: surfaces that cross are refused.
rig = er.Rig(
    cameras=[er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, 0), focal_length_px=8000, size_px=(640, 640))],
    lights=[er.Led((600, 100, 0))],
)
radii = np.linspace(0.94, 1.06, 7)
width = []
for scale in radii:
    data["cornea"][0]["shape"] = {**shape, "radius_mm": shape["radius_mm"] * scale}
    eye = er.Eye(er.EyeSpec.from_mapping(data), pupil_diameter_mm=4.0)
    frames = er.Subject.one_eye(eye).looking([(0, 0)], rig)
    seen = er.trace(frames)
    width.append(2 * seen.pupil.semi_axes_px[0, 0] / rig.build().cameras[0].scale_at(np.zeros(3)))

# %%
# A steeper cornea magnifies the pupil more: 4 mm of the stop look like 4.5 mm from the front.
figure, axes = plt.subplots(figsize=(5, 3.5))
axes.plot(radii * shape["radius_mm"], width, "o-")
axes.set(xlabel="radius of the front cornea (mm)", ylabel="apparent pupil diameter (mm)")
figure.tight_layout()
plt.show()
