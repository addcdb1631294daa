"""What a folder is being filled with: run.json, and the refusal of anything else, with the difference shown."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import write_json
from ..imagefolder import RUN, STAGE
from .lock import LOCK
from .plan import Plan
from .shard import run_versions

RUN_SCHEMA = "eyerender/run/1"
_SHOWN = 4


def refuse_taken(folder: Path) -> None:
    """Raise `InputError` where a folder holds something else than a run, before anything is put into it."""
    try:
        taken = folder.is_dir() and any(not p.name.startswith((LOCK, STAGE)) for p in folder.iterdir())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", source=str(folder)) from None
    if taken and not (folder / RUN).is_file():
        raise InputError("is not empty; give another folder or --overwrite", source=str(folder))


def begin(folder: Path, plan: Plan) -> bool:
    """Claim a folder for a plan, or find that it was claimed for the same one before (True).

    Raises:
        InputError: it holds something else, or a run of another spec or other versions.
    """
    path = folder / RUN
    mine = {"schema": RUN_SCHEMA, "digest": plan.digest, **plan.to_mapping(), "versions": run_versions()}
    if not path.is_file():
        refuse_taken(folder)
        write_json(path, mine)
        return False
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["schema"] != RUN_SCHEMA:
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError("does not describe a run of this version", source=str(path)) from None
    # Python's own version shapes no byte; it may differ from machine to machine.
    skip = ("versions.python:", "digest:", "files.", "files:")
    changes = [c for c in differences(found, json.loads(json.dumps(mine))) if not c.startswith(skip)]
    old = found.get("files", {})
    changes = [f"{name}: other content" for name, content in plan.files.items() if old.get(name) != content] + changes
    if changes:
        more = f"; and {len(changes) - _SHOWN} more" if len(changes) > _SHOWN else ""
        raise InputError(
            f"holds a run of another spec or version; give another folder or --overwrite "
            f"({'; '.join(changes[:_SHOWN])}{more})",
            source=str(folder),
        )
    return True


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Where two JSON values differ, as `path: old -> new`."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in [*old, *(k for k in new if k not in old)]:
            yield from differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differences(a, b, f"{path}.{k}")
    elif old != new:
        yield f"{path}: {_short(old)} -> {_short(new)}"


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
