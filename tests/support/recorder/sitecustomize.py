"""Loaded by every Python process that finds it on PYTHONPATH: records what the process does to the files of a folder.

POWERCUT_ROOT is the folder; POWERCUT_JOURNAL is the journal, one JSON list a line, and a folder of the same name with
`.blobs` gets the content of each file at the moment it was synced. Names are journalled just before they change, syncs
after they are done.
"""

import hashlib
import json
import os
import sys

_ROOT = os.environ["POWERCUT_ROOT"]
_JOURNAL = os.environ["POWERCUT_JOURNAL"]
_handle = os.open(_JOURNAL, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
_fsync = os.fsync


def _note(what, *arguments):
    os.write(_handle, json.dumps([what, *arguments]).encode() + b"\n")


def _inside(path, folder=-1):
    """The path relative to the root, None for one outside."""
    if isinstance(path, int):
        return None
    path = os.fsdecode(path)
    if isinstance(folder, int) and folder >= 0:
        path = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), path)
    path = os.path.relpath(os.path.abspath(path), _ROOT)
    return None if path.startswith("..") else path


def _audit(event, arguments):
    if event == "open":
        if isinstance(arguments[2], int) and arguments[2] & os.O_CREAT and (path := _inside(arguments[0])):
            _note("create", path)
    elif event == "os.rename":
        path, other = _inside(arguments[0], arguments[2]), _inside(arguments[1], arguments[3])
        if path:
            _note("rename", path, other)
    elif event in ("os.remove", "os.rmdir"):
        if path := _inside(*arguments[:2]):
            _note("remove", path)
    elif event == "os.mkdir" and (path := _inside(arguments[0], arguments[2])):
        _note("mkdir", path)


def _synced(file):
    _fsync(file)
    place = os.readlink(f"/proc/self/fd/{file if isinstance(file, int) else file.fileno()}")
    path = _inside(place)
    if path is None:
        return
    if os.path.isdir(place):
        _note("sync folder", path)
        return
    with open(place, "rb") as opened:
        data = opened.read()
    blob = hashlib.sha256(data).hexdigest()
    with open(f"{_JOURNAL}.blobs/{blob}", "wb") as copy:
        copy.write(data)
    _note("sync", path, blob)


os.makedirs(f"{_JOURNAL}.blobs", exist_ok=True)
sys.addaudithook(_audit)
os.fsync = _synced
