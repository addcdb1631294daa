"""
People instead of parameters
============================

Eyes drawn from a joint distribution: long eyes are myopic, old eyes have small pupils, and the glints of steep corneas
lie closer together. Eyes whose parameters are drawn independently have features that no group of people has.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

PEOPLE = 150  # small: 12

people = er.Population("adults").draw(PEOPLE, seed=1)
camera = er.Camera(position_mm=(600, 0, -150), look_at_mm=(0, 0, 0), focal_length_px=4000, resolution_px=(1600, 600))
leds = [er.Led((600, 150, -150)), er.Led((600, -150, -150))]
rig = er.Rig(cameras=[camera], lights=leds)

# %%
# One frame of each person, traced by ray optics: the distance of the glints, and the pupil in a dim room of 1 cd/m2.
# Physics refuses the eyes of few people, for instance where a flat iris would lie before the limbus.
kept, glints, pupils = [], [], []
for row in range(PEOPLE):
    subject = people.subject(row, eyes=["right"], luminance_cd_m2=1)
    try:
        seen = er.trace(subject.fixating((600, 0, 0), rig))
    except er.InputError:
        continue
    kept.append(row)
    glints.append(np.linalg.norm(np.diff(seen.glints.xy_px[0], axis=0)))
    pupils.append(2 * seen.pupil.semi_axes_px[0, 0])

# %%
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
right = {name: people[name][kept, 0] for name in ("axial_length_mm", "refraction_d", "corneal_radius_mm")}
axes[0].scatter(right["refraction_d"], right["axial_length_mm"], s=9)
axes[0].set(xlabel="refraction (D)", ylabel="axial length (mm)")
axes[1].scatter(right["corneal_radius_mm"], glints, s=9)
axes[1].set(xlabel="corneal radius (mm)", ylabel="distance of the glints (px)")
axes[2].scatter(people["age_years"][kept], pupils, s=9)
axes[2].set(xlabel="age (years)", ylabel="apparent pupil (px)")
plt.show()
