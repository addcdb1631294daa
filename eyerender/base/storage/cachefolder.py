"""The private cache folder: `$XDG_CACHE_HOME/eyerender`, by default `~/.cache/eyerender`.

Caches contain executable code (compiled kernels, a libLLVM, numba's index, which is a pickle), so a folder is used only
if nobody but this user and root can have written to it. The rule covers every part of its path, because a user who can
write to a parent can put another folder in its place:

- It belongs to this user or to root, and so does a symbolic link on the way.
- Nobody else can write to it. A parent with the sticky bit, such as `/tmp`, may be open to all, because there only
  the owner of an entry can rename it. The private group of a user counts as the user.

Missing folders are made for this user alone. A folder of this user that others can read becomes private.
"""

from __future__ import annotations

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

from ..errors import MAX_MESSAGE, one_line

_PRIVATE = 0o700
_MAX_LINKS = 40  # on one path, as in Linux
# Owner of everything outside a user namespace, as seen from inside: a container without root sees root's folders so.
_UNMAPPED = 65534
_WARNED = "EYERENDER_CACHE_WARNED"  # informs processes that this one starts


class _Refused(Exception):
    """An unsafe part of a path; the message says why."""


def cache_folder() -> Path | None:
    """Return the private folder for compiled, fetched and computed files; create it if it is missing.

    Returns:
        The folder. None if the user has no home folder, if the folder cannot be created, and, with one warning on
        stderr, if somebody else may have written to it.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        return private_folder(Path(given) / "eyerender")
    try:
        home = Path.home()
    except RuntimeError:
        return None
    known = home.is_absolute() and home != Path("/")
    return private_folder(home / ".cache" / "eyerender") if known else None


def private_folder(path: Path) -> Path | None:
    """Create a folder if it is missing, and make sure that nobody else can write to it.

    `path`: an absolute path. Returns the path; None if the folder cannot be created and, with one warning on stderr, if
    it is not safe.
    """
    try:
        if hasattr(os, "geteuid"):
            _follow(path)
        else:  # Windows: the folders of a user's profile are private
            path.mkdir(parents=True, exist_ok=True)
    except _Refused as reason:
        _warn(path, str(reason))
    except OSError:
        pass
    else:
        return path
    return None


def _follow(path: Path) -> None:
    """Check every folder and link on a path, and create the missing folders.

    Each part is checked before anything is made in it, and what was just made is checked like everything else, so a
    folder or a link that somebody puts there in the meantime is found.
    """
    place, left, links = Path(path.anchor), list(path.parts[1:]), 0
    _check_folder(place, place.lstat(), last=False)
    while left:
        part = left.pop(0)
        if part == "..":  # of a link; `place` has no links in it
            place = place.parent
            continue
        here = place / part
        state = _made(here)
        if not stat.S_ISLNK(state.st_mode):
            _check_folder(here, state, last=not left)
            place = here
            continue
        links += 1
        if links > _MAX_LINKS:
            raise _Refused(f"{path} leads through too many links")
        _check_owner(here, state)
        target = Path(os.readlink(here))
        if target.is_absolute():
            place = Path(target.anchor)
        left = [*(p for p in target.parts if p != target.anchor), *left]


def _made(place: Path) -> os.stat_result:
    try:
        return place.lstat()
    except FileNotFoundError:
        with suppress(FileExistsError):  # another process was faster
            place.mkdir(_PRIVATE)
        return place.lstat()


def _check_folder(place: Path, state: os.stat_result, *, last: bool) -> None:
    """Check one folder of a path, without links; the last one must be private, or become so."""
    _check_owner(place, state)
    if not stat.S_ISDIR(state.st_mode):
        raise NotADirectoryError(place)
    if _others_write(state) and (last or not state.st_mode & stat.S_ISVTX):
        raise _Refused(f"other users can write to {place}")
    if last and state.st_uid == os.geteuid() and stat.S_IMODE(state.st_mode) & 0o077:
        place.chmod(_PRIVATE)


def _check_owner(place: Path, state: os.stat_result) -> None:
    if state.st_uid in (0, os.geteuid()) or (state.st_uid == _UNMAPPED and os.path.ismount(place)):
        return
    raise _Refused(f"{place} belongs to another user")


def _others_write(state: os.stat_result) -> bool:
    if state.st_mode & stat.S_IWOTH:
        return True
    return bool(state.st_mode & stat.S_IWGRP) and not _is_private_group(state.st_gid)


def _is_private_group(group: int) -> bool:
    """Return whether a group is root's, or the private group of the user that many Linux systems create."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(os.geteuid())
        found = grp.getgrgid(group)
    except KeyError:
        return group == 0
    own = user.pw_gid == group and found.gr_name == user.pw_name
    return group == 0 or (own and set(found.gr_mem) <= {user.pw_name})


def _warn(path: Path, reason: str) -> None:
    """Print a warning once for this process and the processes that it starts."""
    known = os.environ.get(_WARNED, "").split(os.pathsep)
    if reason in known:
        return
    os.environ[_WARNED] = os.pathsep.join([*filter(None, known), reason])
    text = f"warning: the cache folder {path} is not used, because {reason}; XDG_CACHE_HOME can name a private folder"
    sys.stderr.write(f"{one_line(text, MAX_MESSAGE)}\n")
