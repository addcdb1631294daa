"""Runs that die or stop at a stage of their work, not at a time: a hook counts the files that they put in place.

The hook comes into the run's own process and all its workers as `sitecustomize`, which Python imports when it starts.
"""

from __future__ import annotations

import os
import random
import re
import subprocess
from pathlib import Path

from eyerender.dataset.lines import restore_lines

_HOOK = """
import os
import re
import signal
import sys


def hook(event, args):
    if event != "os.rename" or not re.search(os.environ["STAGE_MATCH"], os.path.abspath(os.fsdecode(args[1]))):
        return
    counter = os.open(os.environ["STAGE_COUNTER"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(counter, b"x")
    count = os.fstat(counter).st_size
    os.close(counter)
    if count == int(os.environ["STAGE_AT"]):
        how = os.environ["STAGE_HOW"]
        if how == "kill":
            os.kill(os.getpgrp(), signal.SIGKILL)  # the run's first process leads its group; its workers go on for now
        else:
            os.killpg(0, signal.SIGKILL if how == "kill all" else signal.SIGSTOP)


sys.addaudithook(hook)
"""


def environment(place: Path, folder: Path, *, match: str = "", at: int = 0, how: str = "kill") -> dict[str, str]:
    """The environment of a run that ends or stops just before it puts the `at`-th file or folder in its place.

    The run must lead a process group (`start_new_session=True`).

    Args:
        place: a folder for the hook and its count; `count` reads it afterwards.
        folder: what the run writes; renames elsewhere do not count.
        match: a regular expression; only names in `folder` that it is found in count.
        at: which one, from 1; 0: the run ends by itself.
        how: kill (the run's first process), kill all (its workers too) or stop (all, until they get SIGCONT).
    """
    (place / "hook").mkdir(parents=True, exist_ok=True)
    (place / "hook" / "sitecustomize.py").write_text(_HOOK)
    (place / "count").unlink(missing_ok=True)
    path = [str(place / "hook"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(path),
        "STAGE_COUNTER": str(place / "count"),
        "STAGE_MATCH": f"^{re.escape(str(folder.resolve()))}(?=/).*{match}",
        "STAGE_AT": str(at),
        "STAGE_HOW": how,
    }


def wait_until_stopped(process: subprocess.Popen[str]) -> None:
    """Wait until a run has stopped at its stage; raises `AssertionError` where it has ended instead."""
    _, status = os.waitpid(process.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status), f"ended with status {status}"


def count(place: Path) -> int:
    """How many files and folders the last run put in place."""
    return (place / "count").stat().st_size


def cuts(draws: random.Random, total: int, parts: int) -> list[int]:
    """Random whole numbers >= 1, all parts but the last of `total`.

    A run of `total` stages that is killed at these, one after the other, is still unfinished: killed before the n-th
    rename, a run has finished n - 1 of them at most.
    """
    ends = sorted(draws.sample(range(1, total), parts - 1))
    return [end - start for start, end in zip([0, *ends], ends, strict=False)]


def unassemble(folder: Path) -> None:
    """Take a finished dataset back to the stage before its assembly: shards have their own lines, no dataset.json."""
    restore_lines(folder)
    (folder / "dataset.json").unlink()
