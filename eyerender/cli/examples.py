"""Examples at the end of each command's `--help`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cyclopts import App

EXAMPLES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "bench-extractors": (
            "eyerender bench-extractors images -o bench",
            "eyerender bench-extractors images -o bench --extractor own-refined --extractor mine=my_module:find",
        ),
        "budget": ("eyerender budget quickstart --estimator regression --no-images",),
        "compare": ("eyerender compare images", "eyerender compare images --function R2 --json -"),
        "doctor": ("eyerender doctor",),
        "export-dataset": ("eyerender export-dataset data -o coco --format coco",),
        "export-scene": ("eyerender export-scene quickstart -o meshes",),
        "extract": (
            "eyerender extract eye1.png eye2.png --json -",
            "eyerender extract images -o records.jsonl --overlay drawn",
            "eyerender extract recording.mp4 -o records.jsonl --gamma 2.2",
        ),
        "eyes": ("eyerender eyes", "eyerender eyes E4 > my_eye.yaml"),
        "features": ("eyerender features quickstart", "eyerender features my_scene.yaml --eye E4 --json features.json"),
        "fit-eye": ("eyerender fit-eye recording.csv --rig rig.yaml -o fitted",),
        "gaze fit": (
            "eyerender gaze fit recording.csv --rig rig.yaml --estimator regression -o calibration.json",
            "eyerender gaze fit one_eye.csv --rig rig.yaml --estimator regression --monocular -o calibration.json",
        ),
        "gaze predict": (
            "eyerender gaze predict recording.csv --rig rig.yaml -c calibration.json --screen-px 1920 1080",
            "eyerender gaze predict features.json -c calibration.json --json gaze.json",
        ),
        "generate": (
            "eyerender generate dataset_quick --dry-run --measure",
            "eyerender generate dataset_quick -o data --count 100",
            "eyerender generate people_openeds -o data --count 1000000 --layout webdataset",
            "eyerender generate my_scenes:scene -o data --count 1000 --seed 7",
        ),
        "inspect": (
            "eyerender inspect data -o page.html",
            "eyerender inspect data older_data -o page.html --json found.json",
        ),
        "live": ("eyerender live quickstart --browser",),
        "merge": ("eyerender merge part1 part2 part3 -o data",),
        "population": ("eyerender population adults -o people --faces 0",),
        "preview": ("eyerender preview headset -o sheet.png",),
        "quickstart": ("eyerender quickstart first", "eyerender quickstart -o first --eye E4 --overwrite"),
        "realism": ("eyerender realism my_frames images -o looks.html",),
        "render": (
            "eyerender render quickstart -o images",
            "eyerender render my_scene.yaml -o images --eye E4 --spp 64 --auto-exposure 0.7",
        ),
        "rig": ("eyerender rig headset -o report", "eyerender rig my_scene.yaml --population elderly -o report"),
        "sample": ("eyerender sample dataset_quick 5", "eyerender sample dataset_quick 5 -o sample5"),
        "schema": ("eyerender schema dataset > dataset.schema.json",),
        "setup-llvm": ("eyerender setup-llvm",),
        "status": ("eyerender status data", "eyerender status data --watch"),
        "study": ("eyerender study guestrin2006 -o study --eyes E1,E4",),
        "sweep": ("eyerender sweep layouts.yaml -o layouts", "eyerender sweep layouts.yaml -o layouts --shard 2/8"),
        "validate": (
            "eyerender validate data",
            "eyerender validate data --quick --json -",
            "eyerender validate data --render 8",
        ),
        "view": ("eyerender view eye E4 -o eye.svg", "eyerender view scene quickstart -o rig.pdf"),
    }
)
"""Example command lines, by command."""


def add_examples(app: App) -> None:
    """Add the examples to the help of each command."""
    for command, lines in EXAMPLES.items():
        found = app
        for word in command.split():
            found = found[word]
        found.help_epilogue = "Examples:\n\n" + "\n".join(f"    {line}" for line in lines)
