"""The Croissant description of a dataset (MLCommons Croissant 1.0), croissant.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..folders.imagefolder import METADATA
from .plan import Plan

CROISSANT = "croissant.json"
_TEXT, _INTEGER = "sc:Text", "sc:Integer"
_FIELDS = (
    ("file_name", _TEXT, "The image, relative to the dataset's folder"),
    ("mask_file_name", _TEXT, "The mask: 0 background or skin, 1 sclera, 2 iris, 3 pupil, 4 what frames the view"),
    ("sample", _INTEGER, "Which sample of the spec"),
    ("subject", _INTEGER, "Subject; each subject is in one split only"),
    ("split", _TEXT, "Which split"),
    ("sequence_index", _INTEGER, "Index in the subject's sequence of frames"),
    ("bit_depth", _INTEGER, "Of the image's values"),
    ("gamma", "sc:Float", "The values store the linear share of full scale^(1 / gamma)"),
)
_CONTEXT = Path(__file__).parent / "data" / "croissant_context.json"  # terms of Croissant, as the standard gives them


def croissant(plan: Plan, metadata_sha256: str) -> dict[str, Any]:
    """Return the Croissant description as JSON-LD."""
    spec = plan.spec
    name = "".join(c if c.isalnum() else "_" for c in spec.name)
    return {
        "@context": json.loads(_CONTEXT.read_text(encoding="utf-8")),
        "@type": "sc:Dataset",
        "name": name,
        "description": spec.description or "Rendered near-infrared images of eyes with exact labels.",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "version": "1.0.0",
        **({} if spec.licence is None else {"license": spec.licence}),
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": METADATA,
                "name": METADATA,
                "description": "One line per image: labels and parameters.",
                "contentUrl": METADATA,
                "encodingFormat": "application/jsonlines",
                "sha256": metadata_sha256,
            }
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "images",
                "name": "images",
                "description": "One record an image.",
                "field": [
                    {
                        "@type": "cr:Field",
                        "@id": f"images/{field}",
                        "name": field,
                        "description": words,
                        "dataType": kind,
                        "source": {"fileObject": {"@id": METADATA}, "extract": {"column": field}},
                    }
                    for field, kind, words in _FIELDS
                ],
            }
        ],
    }
