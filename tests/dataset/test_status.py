"""The state of a run, from its log and its shards, and the rounding of the processes that made these."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import time

import pytest

from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.dataset import estimate as rates
from eyerender.dataset.environment import rounding
from eyerender.dataset.estimate import Rate, keep_rate, last_rate
from eyerender.dataset.run import generate
from eyerender.dataset.status import SILENT_S, status
from tests.support.dataset_specs import make_or_skip, plan
from tests.support.paths import ROOT
from tests.support.stages import unassemble


def stamp(ago):
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() - ago))


def event(host, part, kind, seconds, ago, **more):
    line = {"time": stamp(ago), "host": host, "part": part, "event": kind, "seconds": seconds, **more}
    return json.dumps(line) + "\n"


@pytest.fixture
def folder(tmp_path):
    """A run of 1000 samples in shards of 50 on three hosts, one of which is silent and one of which was stopped."""
    made = plan(count=1000, shard_size=50, subjects=10)
    data = {"schema": "eyerender/run/1", "digest": made.digest, **made.to_mapping(), "versions": {}}
    (tmp_path / "run.json").write_text(json.dumps(data))
    for shard in (0, 1, 2, 19):
        (tmp_path / "shards" / f"{shard:05d}").mkdir(parents=True)
        (tmp_path / "shards" / f"{shard:05d}" / "done.json").write_text("{}")
    shards = {"images": 50, "bytes": 50 * 1000}
    lines = [
        event("a", "1/3", "start", 0, 900),
        event("a", "1/3", "shard", 50, 850, **shards, made=50),
        event("a", "1/3", "retry", 60, 840),
        event("a", "1/3", "shard", 100, 5, **shards, made=100),
        event("a", "1/3", "progress", 120, 1, made=130),
        event("b", "2/3", "start", 0, 2 * SILENT_S),
        event("b", "2/3", "progress", 50, SILENT_S + 20, made=30),
        event("c", "3/3", "start", 0, 900),
        event("c", "3/3", "stop", 50, 850),
        '{"time": "20',
    ]
    (tmp_path / "log.jsonl").write_text("".join(lines))
    return tmp_path


def test_a_run_says_how_far_it_is(folder, capsys):
    found = status(folder)
    assert (found["state"], found["shards_finished"], found["shards"]) == ("running", 4, 20)
    assert (found["samples_finished"], found["samples"]) == (200, 1000)
    assert found["images_per_s"] == pytest.approx(130 / 120, abs=1e-4)
    assert found["seconds_left"] == pytest.approx(800 / (130 / 120), rel=1e-3)
    assert found["bytes_left"] == 800 * 1000
    assert (found["retries"], found["stalled"]) == (1, ["b, part 2/3"])
    assert [part["state"] for part in found["parts"]] == ["running", "stalled", "stopped"]
    assert run(["status", str(folder)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("running: 200 of 1000 samples, 4 of 20 shards, 1 retries\n1.08 images/s, 12 min 18 s left\n")
    assert "b 2/3: stalled" in text
    log = folder / "log.jsonl"
    log.write_text(log.read_text().rpartition("\n")[0] + "\n" + event("c", "3/3", "end", 90, 1))
    (folder / "dataset.json").write_text("{}")
    assert status(folder)["state"] == status(folder)["parts"][2]["state"] == "finished"


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"run\.json: no such file"):
        status(tmp_path)


@pytest.mark.slow
def test_the_time_of_a_status_grows_with_the_number_of_shards(folder):
    made = plan(count=10**7, shard_size=500, subjects=10)
    data = {"schema": "eyerender/run/1", "digest": made.digest, **made.to_mapping(), "versions": {}}
    (folder / "run.json").write_text(json.dumps(data))
    first = (folder / "log.jsonl").read_text()

    def extend(shards):
        for shard in range(20, shards):
            (folder / "shards" / f"{shard:05d}").mkdir(exist_ok=True)
            (folder / "shards" / f"{shard:05d}" / "done.json").touch()
        more = (event("a", "1/3", "shard", 5 * k, 1, images=500, bytes=1, made=50 * k) for k in range(20, shards))
        (folder / "log.jsonl").write_text(first + "".join(more))

    extend(5_000)
    start = time.process_time()
    assert status(folder)["samples_finished"] == 500 * (4 + 4_980)
    quarter = time.process_time() - start
    extend(20_000)
    start = time.process_time()
    assert status(folder)["samples_finished"] == 500 * (4 + 19_980)
    assert time.process_time() - start < 8 * quarter


def test_a_short_run_does_not_replace_the_rate_of_a_long_one(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = plan()

    def kept(samples, seconds):
        data = {"how": "run", "time": rates.now(), "backend": "llvm", "samples": samples, "seconds": seconds}
        keep_rate(made, Rate(**data, start_seconds=0, subject_seconds=0, images=1, bytes=1))
        return last_rate(made).seconds

    assert kept(1, 9.0) == 9.0
    assert kept(24, 2.0) == 2.0
    assert kept(1, 9.0) == 2.0
    assert kept(12, 3.0) == 3.0
    assert kept(10_000, 1.0) == 1.0
    assert kept(99, 5.0) == 1.0
    assert kept(100, 1.5) == 1.5
    assert last_rate(plan(count=7)).seconds == 1.5


def elsewhere(**settings):
    """The fingerprint of a process with other settings."""
    code = "from eyerender.dataset.environment import rounding; print(rounding())"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **settings}
    return subprocess.check_output([sys.executable, "-P", "-c", code], env=environment, text=True).strip()


def test_a_fingerprint_is_of_the_rounding_and_not_of_the_process():
    assert elsewhere() == rounding()
    assert len(rounding()) == 16


@pytest.mark.packaging
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names code for x86")
def test_the_code_of_blas_changes_it():
    assert elsewhere(OPENBLAS_CORETYPE="Prescott") != rounding()


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
