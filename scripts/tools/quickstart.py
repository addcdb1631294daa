"""The quickstart in Python: python scripts/tools/quickstart.py out/twin (as `eyerender quickstart`, step by step)."""

import argparse
from pathlib import Path

import eyerender as er

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path)
out = parser.parse_args().folder
scene = er.load_scene("quickstart")  # eyes, rig, targets: a YAML file; try eye="E1"

truth = er.AnalyticObserver().observe(scene.frames())  # ray optics: apparent pupil and glints
er.render_folder(scene, out)  # near-infrared images with labels
folder = er.ImageFolder.load(out)
found = er.ImageObserver().observe_folder(folder, scene)  # the same features from the pixels

result = er.compare(truth, found, scene.rig, er.gaze.Regression("R3"))
er.write_report(out / "report.html", scene, result, folder.entries)

errors = result.features.summary()
print(f"pupil centre, median error: {errors['pupil_centre_px']['median']:.3f} px")
print(f"glint, median error:        {errors['glint_px']['median']:.3f} px")
for name, gaze in (("analytic features", result.gaze_truth), ("image features", result.gaze_found)):
    if gaze is not None:
        print(f"gaze error, {name}: {gaze.mean_deg:.3f} deg")
