"""
Which layout is best, and for whom does it fail?
================================================

A sweep compares layouts of a rig over a population, and a report on a rig shows where and for whom the best one fails.
Both are commands, ``eyerender sweep`` and ``eyerender rig``, and write pages. See :doc:`/rig_design`.
"""

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

PEOPLE = 6  # small: 2

folder = Path(tempfile.mkdtemp())


def eyerender(*arguments: object) -> None:
    """Run a command of the package."""
    subprocess.run([sys.executable, "-m", "eyerender", *map(str, arguments)], check=True)


# %%
# Two places of the camera, and two or four LEDs in the best of six places.
(folder / "sweep.yaml").write_text(f"""
format: 1
scene: headset
people: {PEOPLE}
sweep:
  cameras: [{{camera: 0, places: {{points_mm: [[40, -52, -8], [40, -38, -18]]}}}}]
  lights:
    places: {{surface_mm: [[28, -48, 14], [28, -15, 14], [28, -15, -14], [28, -48, -14]], count: [3, 2]}}
    number: [2, 4]
""")
eyerender("sweep", folder / "sweep.yaml", "-o", folder / "layouts")
summary = json.loads((folder / "layouts" / "summary.json").read_text())
layouts = [summary["rows"][number] for number in summary["pareto"]]
for layout in layouts:
    print(f"{layout['leds']} LEDs, camera at {layout['values']['camera 0 (mm)']}: noise {layout['noise_deg']:.4f} deg")

# %%
# The report on a rig: lost glints, hidden pupils and the noise of gaze, person by person. Nothing is rendered.
eyerender("rig", "headset", "--people", PEOPLE, "--sample", 0, "-o", folder / "rig")
with (folder / "rig" / "gaze.csv").open() as file:
    rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
left.scatter([row["leds"] for row in summary["rows"]], [row["noise_deg"] for row in summary["rows"]])
left.set(xlabel="number of LEDs", ylabel="noise of gaze (deg)", title="layouts", xticks=[2, 4])
across, up, noise = ([row[key] for row in rows] for key in ("azimuth_deg", "elevation_deg", "frame_to_frame_deg"))
spots = right.scatter(across, up, c=noise)
right.set(xlabel="azimuth (deg)", ylabel="elevation (deg)", title="noise of gaze over its directions (deg)")
figure.colorbar(spots)
figure.tight_layout()
plt.show()
