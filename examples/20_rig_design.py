"""
Where should the LEDs go?
=========================

A rig sees the pupil's outline and the glints with the noise of its sensor. What can be known of gaze from them at best
is the Cramer-Rao bound. Here it tells which of twelve places for LEDs in a headset are worth the most. See
:doc:`/rig_design`.
"""

# %%
# The camera is that of the shipped headset. The LEDs stand around the lens of the display.
import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

angles = 2 * np.pi * np.arange(12) / 12
places = np.stack([np.full(12, 24.0), -31.5 + 21 * np.cos(angles), 17 * np.sin(angles)], axis=1)
lights = [er.Led(place, radius_mm=0.5, aim_mm=(0, -31.5, 0), intensity_mw_sr=0.1) for place in places]
scene = er.load_scene("headset").with_({"rig.lights": lights})

# %%
# What each LED adds to what is known of a frame in which the headset may have slipped. The best ones are chosen by
# greedy exchange.
added = er.design.site_information(scene.frames(), noise=er.design.noise_of_some(scene, 4))
chosen = {count: er.design.choose_lights(added, count) for count in (1, 2, 4, 6)}
for count, numbers in chosen.items():
    print(f"{count} LEDs: {numbers}")

# %%
# The bound with these LEDs, direction by direction: six hardly beat two. They pay where lids hide some of them, which
# ``eyerender rig`` counts over a population.
bounds = {}
for count, numbers in chosen.items():
    some = scene.with_({"rig.lights": [lights[k] for k in numbers]})
    bounds[count] = er.information(some.frames(), unknowns=er.Unknowns(slippage_mm=3.0))["right"].gaze_deg

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
left.scatter(*places[:, 1:].T, color="lightgrey", s=90)
for count, numbers in list(chosen.items())[1:3]:
    left.scatter(*places[list(numbers), 1:].T, s=200 - 35 * count, label=f"best {count}", alpha=0.7)
left.set(xlabel="y (mm)", ylabel="z (mm)", title="places for LEDs", aspect="equal")
left.legend()
right.boxplot(list(bounds.values()), tick_labels=[str(count) for count in bounds])
right.set(xlabel="number of LEDs", ylabel="noise of gaze (deg)", yscale="log", title="bound, noise only")
figure.tight_layout()
plt.show()
