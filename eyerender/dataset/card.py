"""The data card: a description of a dataset in words."""

from __future__ import annotations

from typing import Any

from ..folders.imagefolder import CONVENTIONS
from .done import run_versions
from .plan import RANKED_SUBJECTS, Plan

_LABELS = """\
- `records`: the record of the analytic observer: pose, target, apparent pupil (ellipse and boundary points), glints.
- `labels.pupil`, `labels.iris`: the `amodal` ellipse of the outline without anything in front of the eye, the
  `visible` ellipse with the second moments of the visible pixels, and the visible share of the amodal pixels. The
  pupil also has the visible arcs of its outline, `visible_arcs_deg`, and two diameters: `entrance_diameter_mm` as seen
  on the optic axis through the cornea, and `stop_diameter_mm` of the anatomical pupil.
- `labels.glints`: for each light the position of the reflection by ray optics (`xy_px`), the energy-weighted position
  in the image (`spot_xy_px`), whether it is visible, the visible share of the lamp's image, and the occluder
  (`hidden_by`).
- `labels.lid_margins_px`: landmarks along the lid margins, if the scene has lids.
- `labels.space`: centres of globe, corneal curvature and pupil, corneal apex, optic axis, line of sight and target, in
  the world frame and the camera frame (mm; unit vectors from the eye outwards; the camera's x is right, y down, z
  away from it). Gaze for training is `camera.line_of_sight`; yaw = atan2(-x, -z) and pitch = asin(-y) are 0 towards
  the camera. The centres of rotation in azimuth and elevation are fixed in
  the head; `head` has them without the head position.
- `labels.pose`: x_world = rotation x_eye + translation. `labels.camera`: K, R, t, distortion (OpenCV). `lights_mm`.
- `mask_file_name`: {mask}.{more}
- `parameters`: every drawn value by its path in the spec (`draws`), and the whole scene and eye as JSON text.
- `subject`, `split`, `sample`, `sequence_index` (index in the subject's sequence of frames), `window_px`."""

_MORE = {
    "amodal_masks": "\n- `amodal_mask_file_name`: the same without anything in front of the eye.",
    "as_annotated": "\n- `annotated_mask_file_name`: the mask as people draw it: lids cut the eye, lashes do not.",
    "noiseless": "\n- `noiseless_file_name`: the same rendering exposed without sensor noise.",
    "highlights": "\n- `highlight_mask_file_name`: 1 where wet and oily surfaces mirror a lamp; these are no glints.",
    "lens_reflections": "\n- `lens_reflection_mask_file_name`: 1 where a spectacle lens mirrors more light than comes "
    "from behind it.",
    "depth": "\n- `depth_file_name` (.npz, array `data`): mm along the camera's axis to the first surface; NaN: none.",
    "normals": "\n- `normals_file_name` (.npz): its unit normals in the camera's frame (x right, y down, z forward).",
    "iris_coordinates": "\n- `iris_coordinates_file_name` (.npz): the place in the plane of the iris that the pixel "
    "shows, mm toward the nose and up from the centre of the pupil.",
    "instances": "\n- `instance_mask_file_name`: 0 background, 1 to 4 as the mask, 5 skin, 6 upper lid, 7 lower lid, "
    "8 lashes, 9 brow, 10 caruncle, 11 frame of spectacles, 12 tears of a head mesh.",
}


_FILES = """\
`metadata.jsonl` has one line per image, with the same keys in every line. The column `split` names the image's split.
`datasets.load_dataset("imagefolder", data_dir=..., split="train", filters=[("split", "==", "test")])` reads one split
of the folder (the loader itself calls all images `train`); without `filters` it reads all images."""

_PACKED = """\
The pictures are in `shards/*/images.tar`, which `webdataset` and `datasets` read. The lines of metadata are packed in
`shards/*/lines.jsonl.gz`, with numbers of 9 digits; `eyerender.ImageFolder` and `eyerender.torch.FolderDataset` read
pictures and labels, and `eyerender export-dataset` converts all of it. A line has these keys:"""


# How to read images of 16 bits.
WHOLE = """\
Pillow's `convert("L")` and `convert("RGB")` clip at 255, so they turn nearly every pixel of a 16-bit image white.
OpenCV without `IMREAD_UNCHANGED` drops the low 8 bits, which leaves 2 to 3 values in a pupil. Read the counts:

```python
import cv2
import numpy as np
from PIL import Image

counts = np.asarray(Image.open(path))  # (h, w) uint16
counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # the same
```
"""

IMAGEFOLDER = """\
Rows of `datasets` hold Pillow images, so `np.asarray(row["image"])` gives the counts; do not cast the column to a mode.
For 8-bit copies, use `eyerender export-dataset`, or apply one gain for the whole dataset and a curve:

```python
picture = np.round(255 * np.minimum(1, gain * (counts / 65535)) ** (1 / 2.2)).astype(np.uint8)
```
"""

WEBDATASET = """\
The decoders of webdataset itself ("pil", "rgb8", "l" and so on) also convert to 8 bits and turn these images white. Use
your own:

```python
import io

import webdataset as wds


def counts_of(data):
    return np.asarray(Image.open(io.BytesIO(data)))


samples = wds.WebDataset(tar, shardshuffle=False).decode(wds.handle_extension("png", counts_of))
```
"""


def data_card(plan: Plan, statistics: dict[str, Any]) -> str:
    """Return the text of README.md."""
    spec = plan.spec
    splits = sorted(statistics["images_by_split"])
    shown = {name: number for name, number in run_versions().items() if name not in ("python", "results")}
    versions = ", ".join(f"{name} {number}" for name, number in shown.items())
    by_split = "\n".join(
        f"| {name} | {statistics['subjects_by_split'][name]} | {statistics['images_by_split'][name]} |"
        for name in splits
    )
    drawn = ""
    if spec.subject_count > RANKED_SUBJECTS and len(spec.splits) > 1:
        drawn = (
            " Each subject was drawn into a split at random, so the sizes of the splits are only close to their shares."
        )
    licence = "" if spec.licence is None else f"## Licence\n{spec.licence}\n\n"
    eight = spec.scene.get("sensor", {}).get("bit_depth") == 8
    reading = "Images of 8 bits are read as they are.\n" if eight else WHOLE
    if not eight:
        reading += "\n" + (WEBDATASET if spec.is_packed else IMAGEFOLDER)
    size = statistics["pupil_semi_axis_px"]
    pupils = "" if size is None else f" The long semi-axis of the pupil is {size[0]:.1f} to {size[2]:.1f} px."
    return f"""# {spec.name}

{spec.description or "Rendered near-infrared images of eyes."}

{statistics["images"]} synthetic near-infrared images of eyes, rendered through refracting corneas, with exact labels.
No person was recorded. Subjects are eyes with drawn parameters, and each subject is in one split only.{drawn}{pupils}

| split | subjects | images |
|---|---|---|
{by_split}

Values are {CONVENTIONS["values"]}. Of {statistics["samples"]} samples, {statistics["samples_given_up"]} could not be
made; {statistics["attempts_rejected"]} attempts were drawn again (`failures.jsonl` gives the reasons).

## Labels
{_PACKED if spec.is_packed else _FILES}

{_LABELS.format(mask=CONVENTIONS["mask"], more="".join(_MORE.get(kind, "") for kind in spec.labels.pictures))}

## Reading the images
The images are PNG files of `bit_depth` bits, 16 unless the spec says otherwise. They hold linear sensor counts where
`gamma` is 1; otherwise count / full scale = linear^(1 / gamma). `eyerender.torch` gives the codes as stored here, and
so does `eyerender export-dataset` for images of 8 bits (`encoding: stored`).
{reading}
## Conventions
- World frame: {CONVENTIONS["world_frame"]}.
- Pixels: {CONVENTIONS["pixels"]}.
- Ellipses: {CONVENTIONS["ellipse"]}.

{licence}## What to know before training on it
Lids and lashes are those of the scene. The textures of skin, iris and sclera are procedural. Their albedos at 850 nm
were chosen, not measured. Test a network trained on this dataset on recorded images.

## Made by
{versions}. The spec is in `dataset.json`; sample i is a pure function of the spec and i.
"""
