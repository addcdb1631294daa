"""README.md of an export: its content, and how to read and decode its images."""

from __future__ import annotations

from typing import Any

from ..card import WEBDATASET, WHOLE
from . import gaze
from .encoding import LARGEST_GAIN, LEVEL, SAMPLED, SHARE

_GAINS = {
    "measured": f"""\
It was measured on {SAMPLED} images spread evenly over the dataset (on all images if there are fewer). It maps
{SHARE:.1%} of their pixels to at most {LEVEL:g} of the full scale, and lies within 1 to {LARGEST_GAIN:g}.
Glints may be clipped.""",
    "given": "It was set explicitly.",
    "none": "The brightness of the images is that of the dataset.",
}

_COLUMNS = " Their columns are `camera_line_of_sight_x`, `_y`, `_z` and `camera_optic_axis_x`, `_y`, `_z`."
_GAZE = {
    "csv": gaze.CARD.format(columns=_COLUMNS),
    "parquet": gaze.CARD.format(columns=_COLUMNS),
    "labels": gaze.CARD.format(columns=_COLUMNS),
    "coco": gaze.CARD.format(columns=" They are keys of each image."),
}


def export_card(name: str, done: dict[str, Any], layout: str, licence: str | None = None) -> str:
    """Return the text of README.md; `layout` describes the files."""
    splits = "\n".join(f"| {split} | {count} |" for split, count in done["images_by_split"].items())
    terms = "" if licence is None else f"\n## Licence\n{licence}\n"
    values = "" if done["image"] is None else _values(done, done["image"])
    return f"""# {name}: {done["format"]}

{done["images"]} synthetic near-infrared images of eyes with exact labels, exported from the dataset "{name}".
README.md of the dataset explains how they were made and what the labels mean.

| split | images |
|---|---|
{splits}

## Files
{layout.strip()}
{_GAZE.get(done["format"], "")}
{values}{terms}"""


def _values(done: dict[str, Any], image: dict[str, Any]) -> str:
    """Describe the values of the images, and how to decode them."""
    if image["encoding"] == "stored":
        gamma = "several gammas" if image["gamma"] is None else f"a gamma of {image['gamma']:g}"
        return f"""## Values of the images
Encoding `stored`: each pixel has the code that its camera stored, so the cameras' tone curves ({gamma}) are still in
the pictures. For the linear share of full scale, use `--encoding linear`, or bit depth and gamma of each image:

    {image["inverse"]}
"""
    depths = " or ".join(str(depth) for depth in done["source_bit_depths"])
    read = ""
    if image["bits"] == 16:
        read = f"\n## Reading 16 bits\n{WHOLE}{WEBDATASET if done['format'] == 'webdataset' else ''}"
    return f"""## Values of the images
The images have {image["bits"]} bits, encoding `{image["encoding"]}`, and one exposure gain of {image["gain"]:g}.
{_GAINS[image["gain_from"]]}
Images of two exports have the same scale only if their gains are the same (`--gain`).

    {image["formula"]}
    {image["inverse"]}

`s` is the count of the sensor as a share of the full scale: s = count / (2^bits - 1), with {depths} bits in the
dataset. The inverse is exact to half a code, except where the image was clipped at {2 ** image["bits"] - 1}.
`export.json` holds the same values for programs.
{read}"""
