"""Translate containers/Dockerfile into shell scripts, so that its steps can be proved where nothing can build an image.

    _dockerfile.py build DOCKERFILE CONTEXT   what builds the image, in the root folder of a bare system
    _dockerfile.py run DOCKERFILE             what starts it: ENTRYPOINT with the script's arguments, else with CMD

An instruction that is not translated is an error, so the scripts never do less than the image.
"""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path


def instructions(text: str) -> Iterator[tuple[str, str]]:
    """Yield the instructions with their arguments, without comments and with continued lines joined."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    for statement in re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines():
        word, _, rest = statement.strip().partition(" ")
        yield word.upper(), rest.strip()


def build_script(text: str, context: str) -> str:
    """Translate the instructions that build the image; `context` is the folder that COPY copies from."""
    lines = ["set -e"]
    for word, rest in instructions(text):
        if word == "RUN":
            lines.append(f"( {rest} )")
        elif word == "WORKDIR":
            lines.append(f"mkdir -p {rest} && cd {rest}")
        elif word == "COPY":
            *sources, place = rest.split()
            lines += [f"cp -RT {shlex.quote(f'{context}/{source}')} {_inside(place, source)}" for source in sources]
        elif word == "ENV":
            lines.append(f"export {rest}")
        elif word not in ("FROM", "ENTRYPOINT", "CMD"):
            raise SystemExit(f"error: {word} is not translated")
    return "\n".join(lines) + "\n"


def run_script(text: str) -> str:
    """Translate the instructions on which a started container depends."""
    found = list(instructions(text))
    last = dict(found)  # of ENTRYPOINT, CMD and WORKDIR the last one counts
    lines = [f"export {rest}" for word, rest in found if word == "ENV"]
    lines.append(f"cd {last['WORKDIR']}")
    lines.append(f"[ $# -gt 0 ] || set -- {shlex.join(json.loads(last['CMD']))}")
    lines.append(f'exec {shlex.join(json.loads(last["ENTRYPOINT"]))} "$@"')
    return "\n".join(lines) + "\n"


def _inside(place: str, source: str) -> str:
    """The path to which COPY copies: a place that ends with / is a folder for files."""
    return shlex.quote(place + Path(source).name if place.endswith("/") else place)


def main(arguments: list[str]) -> None:
    match arguments:
        case ["build", file, context]:
            print(build_script(Path(file).read_text(encoding="utf-8"), context), end="")
        case ["run", file]:
            print(run_script(Path(file).read_text(encoding="utf-8")), end="")
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
