"""Texts of strangers that would make a careless search start again and again: reading them takes linear time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from eyerender.base.errors import EyerenderError
from eyerender.base.storage.files import read_json
from eyerender.gaze.records import load_observations
from eyerender.optics.meshfile import read_objects
from eyerender.rig.opencv import read_opencv
from tests.support.growth import growth

SIZE = 40_000
TEXTS = {
    "camera.xml": ["<" + "<!--", "<?x <!-- ", "<!-- -", "<a>", "<a b='", "<a>&#65;", "<![CDATA[", "<a><m>1 "],
    "camera.json": ["[", '{"a":', '{"a": "\\', "1", "{" + " "],
    "camera.yml": ["%YAML:", "a: >\n\n", "&a ", "1:", "1_", "- ", "[", "{a: ", "a: '', ", "? ", "# ", "a: [*a,"],
    "data.json": ["[", '{"a":', '"\\u0000', "1", "-", "1e", " "],
    "records.csv": ["a,", "a\n", '"', '"a""b', ";", "pupil_x_px_", "-mm", "pupil_x,pupil_y\n1,"],
    "records.jsonl": ["{}\n", "["],
    "head.obj": [
        "v 0 0 0\n",
        "f 1 1 1\n",
        "f 1//",
        "o a\n",
        "g a\n",
        "\\\n",
        "v 1 ",
        "usemtl a\n",
        "usemtl a\nf 1 1 1\n",
    ],
    "head.stl": ["solid a\n", "facet normal 0 0 1\n", "vertex 0 0 0\n", "endfacet\n", "\n", "a "],
    "head.ply": ["ply\n", "ply\ncomment ", "ply\nelement vertex 1\n", "ply\nproperty float x\n"],
}
READERS: dict[str, Callable[[Path], object]] = {
    "camera": read_opencv,
    "data": read_json,
    "records": lambda path: load_observations(path, None),
    "head": read_objects,
}


@pytest.mark.parametrize("name", TEXTS)
def test_repeated_text_takes_linear_time(name, tmp_path):
    path = tmp_path / name

    def read(first: str, repeated: str, size: int) -> None:
        path.write_text(first + repeated * (size // len(repeated)))
        try:
            READERS[path.stem](path)
        except EyerenderError as error:
            assert "\n" not in str(error)  # noqa: PT017

    for text in TEXTS[name]:
        assert growth(partial(read, "", text), SIZE) < 8, text
        assert growth(partial(read, text, text[-2:]), SIZE) < 8, text
