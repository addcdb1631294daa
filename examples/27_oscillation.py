"""
What the pupil's oscillation does to a tracker
==============================================

When a saccade stops, the iris swings on for some 50 ms, and the pupil with it. The cornea does not. A tracker that
estimates gaze from the vector between pupil and corneal reflection therefore reports an overshoot that the eye never
made (Hooge et al. 2015; Bouzat et al. 2018). Here the pupil's motion can be switched off, which no eye allows. See
:doc:`/sequences`.
"""

import matplotlib.pyplot as plt
import numpy as np

import eyerender as er

SACCADES = 20  # small: 4

# %%
# An EyeLink-like rig, and a calibration on nine targets that the eye fixates without moving.
still = er.load_scene("eyelink_desktop")
calibrated = er.gaze.Regression("R3", normalised=False).fit(er.trace(still), still.rig)

# %%
# Saccades of 10 degrees to and fro, at 1,000 Hz, by ray optics alone; drift, blinks and hippus are off.
half_mm = np.tan(np.radians(5)) * 700
motion = {
    "duration_s": 0.4 * (SACCADES + 1),
    "gaze": {
        "targets": [[700, half_mm, 20], [700, -half_mm, 20]],
        "fixation_ms": 350,
        "fixation_spread": 0,
        "drift_arcmin2_s": 0,
        "microsaccades_per_s": 0,
    },
    "lids": {"blinks_per_minute": 0},
    "pupil": {"hippus": 0},
}
figure, axes = plt.subplots(figsize=(6.5, 4), layout="constrained")
for oscillation, colour in ((True, "#E69F00"), (False, "#0072B2")):
    motion["gaze"]["oscillation"] = oscillation
    scene = still.with_({"targets": None, "region": None, "sequence": motion})
    seen = er.sample_sequence(scene, er.Tracker(rate=1000)).observations
    found = calibrated.predict(seen, scene.rig).point_mm
    gaze = np.degrees(np.arctan2(found[:, 1], 700))

    # Each saccade ends where its last sample is; 150 ms later everything is at rest again.
    moving = np.array(["saccade" in words.split("+") for words in seen.index.events])
    ends = np.flatnonzero(moving[:-1] & ~moving[1:]) + 1
    after = np.stack([gaze[end - 60 : end + 150] for end in ends if end + 150 < len(gaze)])
    way = np.sign(after[:, -1] - after[:, 0])
    after = way[:, None] * (after - after[:, -1:])
    overshoot, swing = after[:, 60:].max(axis=1), np.ptp(after[:, 60:], axis=1)
    name = "with oscillation" if oscillation else "without"
    print(
        f"{name:<17} overshoot of the estimated gaze {overshoot.mean():6.3f} +- {overshoot.std():.3f} deg, "
        f"peak to peak {swing.mean():.3f} deg ({len(after)} saccades of 10 deg)"
    )
    axes.plot(np.arange(-60, 150), after.T, color=colour, alpha=0.3, lw=0.8)
    axes.plot([], [], color=colour, label=name)
axes.set(xlabel="ms after the end of the saccade", ylabel="estimated gaze (degrees)", ylim=(-2, 1.5))
axes.legend()
plt.show()
