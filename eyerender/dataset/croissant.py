"""The Croissant description of a dataset (MLCommons Croissant 1.0), croissant.json."""

from __future__ import annotations

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
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def croissant(plan: Plan, metadata_sha256: str) -> dict[str, Any]:
    """Return the Croissant description as JSON-LD."""
    spec = plan.spec
    name = "".join(c if c.isalnum() else "_" for c in spec.name)
    return {
        "@context": _CONTEXT,
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
