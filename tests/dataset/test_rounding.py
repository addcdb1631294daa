"""Runs record how their processes round, and warn or refuse where parts of a dataset differ in it."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys

import pytest

from eyerender.base.errors import InputError
from eyerender.dataset.rounding import rounding
from eyerender.dataset.run import generate
from tests.support.dataset_specs import make_or_skip, plan
from tests.support.paths import ROOT
from tests.support.stages import unassemble


def elsewhere(**settings):
    """The fingerprint of a process with other settings."""
    code = "from eyerender.dataset.rounding import rounding; print(rounding())"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **settings}
    return subprocess.check_output([sys.executable, "-P", "-c", code], env=environment, text=True).strip()


def test_a_fingerprint_is_of_the_rounding_and_not_of_the_process():
    assert elsewhere() == rounding()
    assert len(rounding()) == 16


@pytest.mark.packaging
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names code for x86")
def test_the_code_of_blas_changes_it_and_the_processor_of_numba_does_not():
    assert elsewhere(OPENBLAS_CORETYPE="Prescott") != rounding()
    assert elsewhere(NUMBA_CPU_NAME="haswell") == rounding()


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A dataset of two shards of one image."""
    return make_or_skip(tmp_path_factory.mktemp("rounding") / "two", small())


def small():
    return plan(count=2, shard_size=1, subjects=2)


def content(path):
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.render
def test_parts_that_round_differently_are_named_or_refused(two, tmp_path):
    assert content(two / "run.json")["rounding"] == rounding()
    assert content(two / "dataset.json")["rounding"] == [rounding()]
    folder = shutil.copytree(two, tmp_path / "copy")
    path = folder / "shards" / "00001" / "done.json"
    path.write_text(json.dumps({**content(path), "rounding": "0" * 16}), encoding="utf-8")
    unassemble(folder)
    with pytest.raises(InputError, match=r"another rounding made the shards 1,.*--same-bytes"):
        generate(small(), folder, workers=1, same_bytes=True)
    said: list[str] = []
    generate(small(), folder, workers=1, say=said.append)
    assert [line for line in said if "another rounding" in line] == [
        "warning: another rounding made the shards 1, so single pixels may differ"
    ]
    assert content(folder / "dataset.json")["rounding"] == sorted(["0" * 16, rounding()])
