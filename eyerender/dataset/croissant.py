"""The Croissant description of a dataset (MLCommons Croissant 1.0), croissant.json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..folders.imagefolder import KINDS, METADATA
from ..folders.packed import INDEX
from .done import picture_file
from .packing import ENDINGS
from .plan import Plan

CROISSANT = "croissant.json"
_TEXT, _INTEGER = "sc:Text", "sc:Integer"
_FIELDS = (
    ("file_name", _TEXT, "The image, relative to the dataset's folder"),
    (
        "mask_file_name",
        _TEXT,
        "The mask: 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 what frames the view, 5 spectacles",
    ),
    ("sample", _INTEGER, "Which sample of the spec"),
    ("subject", _INTEGER, "Subject; each subject is in one split only"),
    ("split", _TEXT, "Which split"),
    ("sequence_index", _INTEGER, "Index in the subject's sequence of frames"),
    ("instant", _INTEGER, "Number that the cameras of one moment share"),
    ("bit_depth", _INTEGER, "Of the image's values"),
    ("gamma", "sc:Float", "The values store the linear share of full scale^(1 / gamma)"),
)
_LINES = (
    "One line per image: window_px, records (pose, target, pupil, glints), labels (ellipses, lids, points in space, "
    "camera), parameters (draws, scene and eye), and the fields of the record set images."
)
_INDEX = (
    "One row per image, a NumPy array: sample, subject, split (its place among `splits` of dataset.json), shard, row "
    "in the shard, and block (first byte of the gzip member of the shard's lines.jsonl.gz that holds its labels)."
)
_CONTEXT = Path(__file__).parent / "data" / "croissant_context.json"  # terms of Croissant, as the standard gives them


def croissant(plan: Plan, sums: Mapping[str, str]) -> dict[str, Any]:
    """Return the Croissant description as JSON-LD.

    `sums` are the SHA-256, by name, of the table of images and, in a packed dataset, of each shard's tar.
    """
    spec = plan.spec
    name = "".join(c if c.isalnum() else "_" for c in spec.name)
    files = [_file_set(kind, list(sums)[1:]) for kind in spec.labels.pictures]
    own = {"fileObject": {"@id": METADATA}}
    columns = [_field("images", *field, {**own, "extract": {"column": field[0]}}) for field in _FIELDS]
    table = [] if spec.is_packed else [_records("images", "One record per image.", columns)]
    return {
        "@context": json.loads(_CONTEXT.read_text(encoding="utf-8")),
        "@type": "sc:Dataset",
        "name": name,
        "description": spec.description or "Rendered near-infrared images of eyes with exact labels.",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "version": "1.0.0",
        **({} if spec.licence is None else {"license": spec.licence}),
        "distribution": [*(_file(file, sha256) for file, sha256 in sums.items()), *files],
        "recordSet": [*table, *(_pictures(one) for one in files if one["encodingFormat"] == "image/png")],
    }


def _file(name: str, sha256: str) -> dict[str, Any]:
    words, encoding = {METADATA: (_LINES, "application/jsonlines"), INDEX: (_INDEX, "application/octet-stream")}.get(
        name, ("The pictures of a shard.", "application/x-tar")
    )
    own = {"@type": "cr:FileObject", "@id": name, "name": name, "description": words, "contentUrl": name}
    return {**own, "encodingFormat": encoding, "sha256": sha256}


def _file_set(kind: str, tars: Sequence[str]) -> dict[str, Any]:
    """Describe the files of a kind of pictures, in its folder or in some tars."""
    suffix = picture_file(kind, "")
    # In a tar, names of images end with the side of the eye, right or left.
    includes = f"*t{ENDINGS[kind]}{suffix}" if tars else f"{kind}/*/*{suffix}"
    own = {"@type": "cr:FileSet", "@id": f"{kind}_files", "name": f"{kind}_files", "includes": includes}
    own["description"] = f"The files that {KINDS[kind]} names."
    own["encodingFormat"] = "image/png" if suffix == ".png" else "application/octet-stream"
    return {**own, **({"containedIn": [{"@id": tar} for tar in tars]} if tars else {})}


def _pictures(files: dict[str, Any]) -> dict[str, Any]:
    """Describe the pictures in a set of files; those named images have another name than the records of the table."""
    name = files["@id"].removesuffix("_files").replace("images", "pictures")
    source = {"fileSet": {"@id": files["@id"]}, "extract": {"fileProperty": "content"}}
    return _records(name, files["description"], [_field(name, "content", "sc:ImageObject", "The picture", source)])


def _records(name: str, words: str, fields: list[dict[str, Any]]) -> dict[str, Any]:
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": words, "field": fields}


def _field(owner: str, name: str, kind: str, words: str, source: dict[str, Any]) -> dict[str, Any]:
    own = {"@type": "cr:Field", "@id": f"{owner}/{name}", "name": name, "description": words}
    return {**own, "dataType": kind, "source": source}
