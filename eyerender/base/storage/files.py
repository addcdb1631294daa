"""Files: durable, atomic writes; reads of untrusted files; strict JSON.

A file is published in four steps: it is written under a temporary name in the same folder, synced, renamed, and the
folder is synced. After a power cut, the path holds the old content or the new one, never a part of either. Files may
come from other people, so only regular files within a size limit are read.
"""

from __future__ import annotations

import csv
import ctypes
import errno
import glob
import io
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from io import BufferedRandom, BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import EyerenderError, InputError

# Text files that people write: scenes, specs, eye files, calibrations.
MAX_TEXT_BYTES = 16 * 2**20
# Files that this package or a user's own scene names: images, maps, meshes.
MAX_FILE_BYTES = 2**31
PART = ".part"
# Patterns of a number that is too large for a float, or of an integer that takes long to parse: many digits, or three
# in its exponent.
_TO_ZEROS = bytes.maketrans(b"123456789E", b"000000000e")
_LONG = (b"0" * 200, b"e000", b"e+000")
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]{1,30}):/+")  # a single letter is a drive
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # .xlsx, .xls
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_PLAIN = re.compile(r"[^\x00-\x1f\x7f/\\:]+")


@contextmanager
def written(path: str | Path, *, sync: bool = True, ending: str = PART) -> Iterator[BinaryIO]:
    """Open a new file for writing; it replaces `path` if the block succeeds, and leaves nothing if it fails.

    Args:
        path: the file to write; an old one is replaced.
        sync: make it durable before the block's end: the file is synced before the rename, its folder after it. Without
            it a power cut may leave an empty file, so use False only for files that are synced later as a whole.
        ending: suffix of the temporary name, for libraries that open the file by `name` and choose the format by its
            suffix.

    Raises:
        InputError: the path is a folder, pipe, device or socket.
        EyerenderError: the disk is full or not writable.
    """
    path = Path(path)
    refuse_special(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{ending}")
    made = False
    try:
        # Exclusive mode does not follow or overwrite a link or a file that somebody put there.
        with open(part, "xb") as file:
            made = True
            yield file
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)
        made = False
        if sync:
            sync_folder(path.parent)
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        if made:
            with suppress(OSError):
                part.unlink()


def refuse_special(path: str | Path) -> None:
    """Check that a file may be written, so that no device is harmed and no pipe blocks.

    A link may be replaced unless it leads to something other than a file. Raises InputError if the path is an address,
    a folder, a pipe, a device or a socket, or lies in a folder of devices.
    """
    refuse_address(path)
    path = Path(path)
    try:
        state = path.stat()
        folder = path.parent.resolve()
    except (OSError, ValueError, RuntimeError):  # missing, or refused when it is created
        return
    if not stat.S_ISREG(state.st_mode):
        raise InputError(f"is {_kind(state.st_mode)}, so it is not written to", source=str(path))
    if folder in (Path("/dev"), Path("/dev/fd")):  # /dev/stdout may be a link to a file
        raise InputError("is in a folder of devices, so it is not written to", source=str(path))


def refuse_address(path: str | Path) -> None:
    """Refuse an output path that is an address such as `s3://bucket/x`: it would become the folder `s3:/bucket/x`.

    Raises:
        InputError: the path is an address.
    """
    address = _ADDRESS.match(str(path))
    if address is not None:
        where = f"{address[1]}://{str(path)[address.end() :]}"
        raise InputError("is an address, and only files of this machine are written", source=where)


def write_bytes(path: str | Path, data: bytes, *, sync: bool = True) -> None:
    """Write a file atomically; raises like `written`."""
    with written(path, sync=sync) as file:
        file.write(data)


def write_text(path: str | Path, text: str, *, sync: bool = True) -> None:
    """Write UTF-8 text atomically; raises like `written`."""
    write_bytes(path, text.encode(), sync=sync)


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Format rows as CSV; empty cells for None."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def write_json(path: str | Path, data: Any, *, sync: bool = True) -> None:
    """Write JSON atomically; raises like `written`, and `ValueError` for NaN and infinity."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n", sync=sync)


def sync_file(path: str | Path) -> None:
    """Make a file's content durable; OSError if the file cannot be synced."""
    _sync(path, os.O_RDONLY)


def sync_folder(path: str | Path) -> None:
    """Make the file names in a folder durable.

    Does nothing if folders cannot be opened (Windows) or the file system cannot sync them (some network file systems).
    Raises OSError if the folder cannot be synced.
    """
    if hasattr(os, "O_DIRECTORY"):
        try:
            _sync(path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
                raise


def make_folder(path: str | Path) -> bool:
    """Create a folder and its missing parents, durably; return whether it is new.

    Raises InputError if the path is an address; OSError if the folder cannot be created.
    """
    refuse_address(path)
    path = Path(path)
    missing = [p for p in (path, *path.parents) if not p.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for place in missing:
        sync_folder(place.parent)
    return bool(missing)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the disk has no hard links or the files lie on two disks.

    Raises:
        OSError: the target exists, or the disk is full or not writable.
    """
    try:
        os.link(source, target, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        with open(source, "rb") as read, open(target, "xb") as write:
            shutil.copyfileobj(read, write)
        sync_file(target)


def exchange_folders(one: Path, other: Path) -> None:
    """Exchange two folders on one disk: in one step where the system can do that (Linux, local disks).

    Raises:
        OSError: a folder cannot be moved.
    """
    with suppress(AttributeError):  # not Linux
        if not ctypes.CDLL(None).renameat2(_HERE, bytes(one), _HERE, bytes(other), _EXCHANGE):
            return
    aside = one.with_name(f"{one.name}.{secrets.token_hex(4)}")
    os.rename(other, aside)
    os.rename(one, other)
    os.rename(aside, one)


def remove_file(path: str | Path) -> None:
    """Remove a file durably, if there is one; OSError if the file cannot be removed."""
    path = Path(path)
    try:
        path.unlink()
    except FileNotFoundError:
        return
    sync_folder(path.parent)


def remove_parts(path: str | Path) -> None:
    """Remove temporary files left next to a file by writers that were killed; OSError if one cannot be removed."""
    path = Path(path)
    for part in path.parent.glob(f".{glob.escape(path.name)}.*{PART}"):
        part.unlink(missing_ok=True)


def sync_files(paths: Sequence[Path]) -> None:
    """Make the content of files durable, in several threads as in `sync_tree`; OSError if a file cannot be synced."""
    with ThreadPoolExecutor(8) as threads:
        for _ in threads.map(sync_file, paths):
            pass


def sync_tree(path: str | Path) -> None:
    """Make a folder durable with everything in it; links are not followed.

    Several threads sync files, because a file system writes one journal entry for all waiting threads: 0.4 ms per file
    instead of 4 on ext4. Raises OSError if a file cannot be synced.
    """
    with ThreadPoolExecutor(8) as threads:
        for place, _, names in os.walk(path, topdown=False):
            paths = (os.path.join(place, name) for name in names)
            files = (file for file in paths if stat.S_ISREG(os.lstat(file).st_mode))
            # Files are taken in batches, because each one that waits for a thread takes some KB.
            while batch := list(islice(files, 1024)):
                for _ in threads.map(sync_file, batch):
                    pass
            sync_folder(place)


@contextmanager
def opened(path: str | Path, *, limit: int = MAX_FILE_BYTES, follow: bool = True) -> Iterator[BufferedReader]:
    """Open a regular file for reading.

    `path`: the file; `limit`: largest accepted size in bytes; `follow`: whether the file may be a symbolic link. Raises
    InputError if the file is missing, not regular (a pipe, a device, a folder), too large, or not readable.
    """
    handle, state = _regular(path, os.O_RDONLY, follow)
    size = state.st_size
    with open(handle, "rb") as file:
        if size > limit:
            raise InputError(f"is too large ({_size(size)}; at most {_size(limit)} is read)", source=str(path))
        yield file


def read_slice(path: str | Path, start: int, length: int) -> tuple[bytes, os.stat_result]:
    """Read `length` bytes of a regular file, not a link, from `start` on; fewer beyond its end.

    One slice takes half the system calls of `opened`, on which reading small pictures spends much of its time. Returns
    the bytes, and the state of the file. Raises InputError as for `opened`.
    """
    handle, state = _regular(path, os.O_RDONLY, follow=False)
    try:
        return os.pread(handle, length, start), state
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", source=str(path)) from None
    finally:
        os.close(handle)


def appended(path: str | Path) -> BufferedRandom:
    """Open a regular file, which is not a link, for appending and reading; create it if it is missing.

    Raises InputError if the path is a link, or something else than a file; OSError if the disk is full or not writable.
    """
    return open(_regular(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, follow=False)[0], "ab+")


def _regular(path: str | Path, flags: int, follow: bool) -> tuple[int, os.stat_result]:
    """Open a regular file and return its handle and state; raises `InputError` like `opened`."""
    source = str(path)
    try:
        # Opening a pipe for reading would wait for a writer.
        flags |= getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
        handle = os.open(path, flags | (0 if follow else getattr(os, "O_NOFOLLOW", 0)), 0o644)
    except OSError as error:
        if flags & os.O_CREAT and not (os.path.islink(path) or os.path.isdir(path)):  # the disk is full or not writable
            raise
        raise InputError(_why_unreadable(path, error), source=source) from None
    except ValueError:
        raise InputError("is not a valid file name", source=source) from None
    state = os.fstat(handle)
    if not stat.S_ISREG(state.st_mode):
        os.close(handle)
        raise InputError(f"is {_kind(state.st_mode)}, not a file", source=source)
    return handle, state


def read_bytes(path: str | Path, *, limit: int = MAX_FILE_BYTES, follow: bool = True) -> bytes:
    """Read a regular file; raises `InputError` like `opened`."""
    source = str(path)
    handle, state = _regular(path, os.O_RDONLY, follow)
    size = state.st_size
    try:
        if size > limit:
            raise InputError(f"is too large ({_size(size)}; at most {_size(limit)} is read)", source=source)
        data = os.read(handle, size + 1)  # Python allocates memory for everything that it is asked to read
        # A signal ends a read early, and a file may have grown.
        while len(data) != size and len(data) <= limit and (more := os.read(handle, limit + 1 - len(data))):
            data += more
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", source=source) from None
    finally:
        os.close(handle)
    if len(data) > limit:
        raise InputError(f"is too large (at most {_size(limit)} is read)", source=source)
    return data


def read_text(path: str | Path, *, limit: int = MAX_TEXT_BYTES, follow: bool = True) -> str:
    """Read a UTF-8 text file; raises `InputError` like `read_bytes`, and for other encodings and Excel workbooks."""
    data = read_bytes(path, limit=limit, follow=follow)
    if data.startswith(_WORKBOOKS):
        reason = "is an Excel workbook or another archive, not text; save the sheet as CSV and give that"
        raise InputError(reason, source=str(path))
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise InputError("cannot be read (not UTF-8 text)", source=str(path)) from None


def read_table(
    path: str | Path, columns: Iterable[str] = (), *, limit: int = MAX_TEXT_BYTES, follow: bool = True
) -> Iterator[dict[str, str]]:
    """Yield the rows of a CSV file with a header as mappings; a short row has only its first columns.

    A byte order mark, as spreadsheets write it, is skipped.

    Raises:
        InputError: as `read_text`; the file is not valid CSV, lacks one of `columns`, or a row is too long.
    """
    source = str(path)
    text = read_text(path, limit=limit, follow=follow).removeprefix("\ufeff")
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = next(reader, [])
        for name in sorted(set(columns) - set(header)):
            apart = next((sign for sign in ";\t" if len(header) == 1 and sign in header[0]), "")
            hint = f"; its cells are separated by {apart!r}, not by commas" if apart else ""
            raise InputError(f"has no column {name}{hint}", source=source)
        for row in filter(None, reader):
            if len(row) > len(header):
                hint = "; write decimal points, not commas" if len(row) == 2 * len(header) else ""
                reason = f"has {len(row)} cells; the header has {len(header)}{hint}"
                raise InputError(reason, source=source, path=f"line {reader.line_num}")
            yield dict(zip(header, row, strict=False))
    except csv.Error as error:
        raise InputError(f"is not valid CSV: {error}", source=source, path=f"line {reader.line_num}") from None


def parse_json(text: str | bytes, *, source: str = "", path: str = "") -> Any:
    """Parse a JSON value: finite numbers only, integers of at most 300 digits; InputError if the text is not valid."""
    try:
        data, text = (text, text.decode()) if isinstance(text, bytes) else (text.encode(errors="replace"), text)
        # Checking each number takes longer than everything else, so it is done only if a number is long enough to
        # matter.
        zeros = data.translate(_TO_ZEROS)
        hooks: dict[str, Any] = {}
        if any(long in zeros for long in _LONG):
            hooks = {"parse_int": _integer, "parse_float": _finite}
        found = json.loads(text, parse_constant=_refuse, **hooks)
        if "\\ud" in text or "\\uD" in text:
            json.dumps(found, ensure_ascii=False).encode()
        return found
    except UnicodeEncodeError:
        raise InputError("is not valid JSON: half of a surrogate pair", source=source, path=path) from None
    except RecursionError:
        raise InputError("is not valid JSON: nested too deeply", source=source, path=path) from None
    except UnicodeDecodeError:
        raise InputError("is not valid JSON: not UTF-8 text", source=source, path=path) from None
    except json.JSONDecodeError as error:
        is_cut = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated")
        reason = "ends too early; the file may have been cut off" if is_cut else error.msg
        raise InputError(f"is not valid JSON: {reason}", source=source, path=path or f"line {error.lineno}") from None
    except ValueError as error:
        raise InputError(f"is not valid JSON: {error}", source=source, path=path) from None


def read_json(path: str | Path, *, limit: int = MAX_TEXT_BYTES, follow: bool = True) -> dict[str, Any]:
    """Read a JSON file that contains an object.

    Raises:
        InputError: the file cannot be read, or does not contain an object.
    """
    data = parse_json(read_bytes(path, limit=limit, follow=follow), source=str(path))
    if not isinstance(data, dict):
        raise InputError("must be a JSON object", source=str(path))
    return data


def inside(folder: Path, name: object, *, source: str = "", path: str = "") -> Path:
    """Resolve the path of the regular file `name` in a folder that is not trusted.

    The name must be relative, with plain parts (no `..`, no control characters), and no part of it may be a link.
    Raises InputError if the name leads out of the folder, or is not a regular file in it.
    """
    if not is_plain(name):
        raise InputError(f"must be a path inside the folder, not {shown(name)}", source=source, path=path)
    # This uses text instead of paths for speed, because folders may have a million images.
    place = str(folder)
    parts = str(name).split("/")
    for k, part in enumerate(parts):
        place = os.path.join(place, part)
        try:
            mode = os.lstat(place).st_mode
        except OSError as error:
            raise InputError(f"{shown(name)}: {_why_unreadable(place, error)}", source=source, path=path) from None
        if not (stat.S_ISREG(mode) if k == len(parts) - 1 else stat.S_ISDIR(mode)):
            raise InputError(f"{shown(name)}: is {_kind(mode)}", source=source, path=path)
    return Path(place)


def is_plain(name: object) -> bool:
    """Return whether a name is a relative path of plain parts, with `/` between them."""
    return (
        isinstance(name, str)
        and len(name) <= 1024
        and all(_PLAIN.fullmatch(part) and part not in (".", "..") for part in name.split("/"))
    )


def printable(text: str, keep: str = "") -> str:
    """Replace characters that a terminal could act upon, except those in `keep`."""
    return text if text.isprintable() else "".join(c if c.isprintable() or c in keep else "?" for c in text)


def shown(value: object, limit: int = 80) -> str:
    """Format a value from a file for a message: one line of printable characters, shortened to `limit`."""
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**limit else "a huge number"
    text = printable(text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _sync(path: str | Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _why_unreadable(path: str | Path, error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if os.path.islink(path):
        return "is a symbolic link, not a file"
    return f"cannot be read ({error.strerror or error})"


def _kind(mode: int) -> str:
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISREG, "a file"),
        (stat.S_ISLNK, "a symbolic link"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    return next((name for test, name in kinds if test(mode)), "a device")


def _size(count: int) -> str:
    return f"{count / 2**20:.0f} MiB" if count >= 2**20 else f"{count} bytes"


def _refuse(text: str) -> Any:
    raise ValueError(f"{text} is not a number")


def _integer(text: str) -> int:
    if len(text) > 300:
        raise ValueError(f"an integer of {len(text)} digits")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"the number {text[:40]} is too large")
    return value
