"""Name files of other programs that are not read, and say what to do with them."""

from __future__ import annotations

import re

_TABLE = "write its samples as a table (CSV) of time, eye, pupil_x, pupil_y, ..."
_PICTURE = "convert it to PNG"
_KINDS = (
    (rb"\*\* CONVERTED FROM", f"is an .asc file of EyeLink; {_TABLE}"),
    (rb"SR_RESEARCH_", f"is an .edf file of EyeLink; convert it with edf2asc, then {_TABLE}"),
    (rb"\x89HDF", f"is an HDF5 file; {_TABLE}, or its pictures as PNG"),
    (rb"MATLAB 5", f"is a file of MATLAB; {_TABLE}"),
    (rb"PAR1", f"is a Parquet file; {_TABLE}"),
    (rb"SQLite format", f"is a database; {_TABLE}"),
    (rb"\x93NUMPY", "is an array of NumPy; write its pictures as PNG, or its numbers as a table (CSV)"),
    (rb".{4}ftyp(avif|avis|heic|heix|mif1|msf1)", f"is an AVIF or HEIF picture; {_PICTURE}"),
    (rb".{128}DICM", f"is a DICOM file; {_PICTURE}"),
    (rb"v/1\x01", f"is an OpenEXR picture; {_PICTURE}"),
    (rb"FLV\x01|OggS", "is a video of a kind that is not read; convert it with ffmpeg -i FILE -c:v ffv1 OUT.mkv"),
    (rb"PK\x03\x04|\x1f\x8b|7z\xbc\xaf|Rar!", "is an archive or a spreadsheet; unpack it, or save it as CSV"),
    (rb"%PDF|<!DOCTYPE|<html", "is a document, not a recording"),
)
_PICTURES = (
    rb"\x89PNG|\xff\xd8\xff|II\*|P5|RIFF.{4}AVI|\x1aE\xdf\xa3|.{4}(ftyp|moov|mdat)|\0\0\x01[\xba\xb3]|G.{187}G|"
    rb"YUV4MPEG2"
)


def foreign_kind(head: bytes) -> str | None:
    """Return what a file is and what to do, by its first bytes (at least 132); None for other files."""
    return next((text for pattern, text in _KINDS if re.match(pattern, head, re.DOTALL)), None)


def not_records(head: bytes) -> str | None:
    """Return like `foreign_kind` what a file is that holds no records of features; pictures and videos hold none."""
    pictures = re.match(_PICTURES, head, re.DOTALL)
    what = "is a picture or a video; extract its features first: eyerender extract FILE -o features.csv"
    return foreign_kind(head) or (what if pictures else None)
