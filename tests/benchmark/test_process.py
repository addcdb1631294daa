"""Extractors that misbehave: each costs its own result only, says why, and leaves nothing running."""

from __future__ import annotations

import json
import sys
import textwrap
import time
import tracemalloc

import pytest

from eyerender.apps.benchmark.asking import ask_extractors
from eyerender.apps.benchmark.folder import load_labelled
from eyerender.apps.benchmark.options import BenchOptions
from eyerender.apps.benchmark.process import ExtractorProcess, Failed
from eyerender.apps.benchmark.protocol import Request
from eyerender.apps.benchmark.registry import ExtractorCommand, resolve

HEAD = """
import json, os, subprocess, sys, time
GREETING = {"schema": "eyerender/extractor/1", "name": "test", "reports": ["pupil"]}
def say(data):
    print(json.dumps(data), flush=True)
def ok(request):
    say({"id": request["id"], "record": {"pupil": {"status": "missing", "reason": "blind"}}})
"""


@pytest.fixture
def program(tmp_path):
    """An extractor out of the body of a script."""

    def make(body):
        path = tmp_path / "extractor.py"
        path.write_text(HEAD + textwrap.dedent(body))
        return ExtractorCommand("test", "test", (sys.executable, str(path)))

    return make


@pytest.fixture(scope="module")
def images(drawn):
    return load_labelled(drawn)


def run_extractor(extractor, images, **options):
    return ask_extractors([extractor], images, BenchOptions(**options))[0]


def gone(pid):
    """Whether a process has ended (or only waits to be collected by whoever is its parent now)."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


CASES = {
    "blind": ("say(GREETING)\nfor line in sys.stdin: ok(json.loads(line))", "none", "blind"),
    "dies at start": ("sys.exit('no licence')", "error", "ended with exit code 1: no licence"),
    "no greeting": ("time.sleep(3600)", "error", "no greeting within 0.5 s"),
    "talks first": ("print('Loading ...', flush=True); time.sleep(3600)", "error", "greeting: printed a line"),
    "other version": ("say({**GREETING, 'schema': 'eyerender/extractor/2'})", "error", "greeting: schema: is"),
    "crashes": ("say(GREETING); sys.stdin.readline(); os.abort()", "error", "was killed by SIGABRT"),
    "raises": ("say(GREETING); sys.stdin.readline(); 1 / 0", "error", "exit code 1: ZeroDivisionError: division"),
    "hangs": ("say(GREETING); time.sleep(3600)", "error", "no answer within 0.5 s"),
    "garbage": ("say(GREETING)\nfor line in sys.stdin: print('xyz', flush=True)", "error", "unusable answer: printed"),
    "not a number": (
        "say(GREETING)\nfor line in sys.stdin: print('{\"id\": %d, \"record\": {\"pupil\": {\"status\": \"ok\", "
        "\"centre_px\": [NaN, 1], \"semi_axes_px\": [2, 1], \"angle_rad\": 0}}}' % json.loads(line)['id'], flush=True)",
        "error",
        "unusable answer: pupil.centre_px.0: must be a finite number",
    ),
    "flood": ("say(GREETING)\nwhile True: sys.stdout.write('x' * 100000)", "error", "bytes without an answer"),
    "floods its errors": (
        "os.write(2, b'e' * 50_000_000); say(GREETING)\nfor line in sys.stdin: os.write(2, b'e' * 1_000_000); "
        "ok(json.loads(line))",
        "none",
        "blind",
    ),
    "speaks to the terminal": (
        "say(GREETING)\nfor line in sys.stdin: say({'id': json.loads(line)['id'], 'error': '\\x1b]0;x\\x07' * 999})",
        "error",
        "?]0;x??]0;x?",
    ),
    "deep": ("say(GREETING)\nfor line in sys.stdin: print('[' * 100000, flush=True)", "error", "not JSON: '[[[["),
    "huge": ("say(GREETING)\nfor line in sys.stdin: print('1' * 5000, flush=True)", "error", "not JSON: '1111"),
    "closes its output": ("say(GREETING); os.close(1); time.sleep(3600)", "error", "closed its output"),
    "binary": ("say(GREETING); os.write(1, bytes(range(255, 127, -1)) + b'\\n'); time.sleep(999)", "error", "not JSON"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_it_does_is_its_result(program, images, name):
    body, outcome, words = CASES[name]
    # Only those that hang are given little time; they would end by themselves much later, and otherwise.
    answer, greeting = (0.5 if name == hung else 100.0 for hung in ("hangs", "no greeting"))
    run = run_extractor(program(body), images, timeout_s=answer, start_timeout_s=greeting)
    assert [s.outcome for s in run.scores] == [outcome] * len(images)
    assert words in run.scores[0].reason


def test_a_failure_on_one_image_costs_that_image_only(program, images):
    body = """
    say(GREETING)
    for line in sys.stdin:
        request = json.loads(line)
        if request["id"] == 1: os.abort()
        if request["id"] == 3: time.sleep(3600)
        if request["id"] == 4: say({"id": 4, "error": "too many eyes"})
        else: ok(request)
    """
    run = run_extractor(program(body), images, timeout_s=5.0)  # what answers takes some milliseconds
    assert [s.outcome for s in run.scores] == ["none", "error", "none", "error", "error", "none"]
    assert run.scores[4].reason == "too many eyes"


def test_warming_up_does_not_count_against_the_time_limit(program, images):
    body = """
    say({**GREETING, "warms_up": True})
    for k, line in enumerate(sys.stdin):
        time.sleep(1.2 if k == 0 else 3600 if k == 2 else 0)
        ok(json.loads(line))
    """
    run = run_extractor(program(body), images[:3], timeout_s=1.0, start_timeout_s=20.0)
    assert [s.outcome for s in run.scores] == ["none", "none", "error"]
    assert "no answer within 1 s" in run.scores[2].reason


def test_one_that_reads_nothing_is_not_waited_for(program):
    """A pipe holds some 64 KB; after that, writing would wait for a reader."""
    extractor = program("say(GREETING); time.sleep(3600)")
    with ExtractorProcess(extractor.argv, start_timeout_s=20.0, timeout_s=0.3) as process:
        with pytest.raises(Failed, match="read no request within"):
            process.ask(Request(0, "x" * 1_000_000, 8, {}))
        assert not process.alive


def test_a_flood_of_errors_leaves_only_its_end(program):
    extractor = program("os.write(2, b'e' * 5_000_000 + b'\\nthe last word\\n'); say(GREETING); sys.stdin.readline()")
    tracemalloc.start()
    try:
        with (
            ExtractorProcess(extractor.argv, start_timeout_s=20.0, timeout_s=5.0) as process,
            pytest.raises(Failed, match="ended with exit code 0: the last word"),
        ):
            process.ask(Request(0, "x.png", 8, {}))
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_after_three_failures_in_a_row_it_is_not_asked_again(program, images, tmp_path):
    count = tmp_path / "starts"
    run = run_extractor(
        program(f"open({str(count)!r}, 'a').write('x'); say(GREETING); sys.stdin.readline(); os.abort()"),
        images,
        timeout_s=5.0,
    )
    assert count.read_text() == "xxx"
    assert run.scores[5].reason.startswith("not asked after 3 failures in a row, the last: was killed by SIGABRT")


def test_results_do_not_depend_on_the_number_of_processes(program, images):
    """One that answers about some images, dies on others, and dies three times in a row in the second half."""
    body = """
    say(GREETING)
    for line in sys.stdin:
        request = json.loads(line)
        if request["id"] in (0, 2, 3, 4): os.abort()
        ok(request)
    """
    runs = [run_extractor(program(body), images, jobs=jobs) for jobs in (1, 2, 3, 9)]
    outcomes = [[(s.outcome, s.reason) for s in run.scores] for run in runs]
    assert [o for o, _ in outcomes[0]] == ["error", "none", "error", "error", "error", "error"]
    assert outcomes[0][5][1].startswith("not asked after 3 failures in a row")
    assert outcomes[1:] == outcomes[:1] * 3


def test_what_a_hanging_extractor_started_is_killed_with_it(program, images, tmp_path):
    pids = tmp_path / "pids"
    body = f"""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
    open({str(pids)!r}, "a").write(f"{{os.getpid()}} {{child.pid}} ")
    say(GREETING)
    time.sleep(3600)
    """
    run_extractor(program(body), images[:1], timeout_s=0.3)
    started = [int(p) for p in pids.read_text().split()]
    assert len(started) == 2
    while not all(gone(p) for p in started):  # killed, they are soon gone; else the test never ends
        time.sleep(0.02)


CALLABLE = """
import numpy as np
print("hello from the import")

def mean(image, request):
    print("hello from the call")
    assert image.ndim == 2 and request["hints"]["polarity"] == "dark"
    h, w = image.shape
    # In its own conventions: corners of pixels, full axes, degrees.
    middle = np.array([w / 2, h / 2])
    return {"pupil": {"status": "ok", "centre_px": middle, "axes_px": (20, 10), "angle": np.float32(3)}}

mean.conventions = {"pixel_origin": "corner", "axes": "full", "angle_unit": "deg"}
mean.reports = ["pupil"]

def broken(image, request):
    raise RuntimeError("out of ideas")

class Deep:
    @staticmethod
    def quiet(image, request):
        return {"pupil": {"status": "missing", "reason": None}}
"""


def test_a_python_callable_is_an_extractor(images, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(CALLABLE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    run = run_extractor(resolve("mine:mean"), images[:2], timeout_s=20)
    # The middle of a 200 x 160 image lies at (99.5, 79.5) when the first pixel's centre is (0, 0).
    for s, image in zip(run.scores, images, strict=False):
        assert s.offset_px == pytest.approx(tuple([99.5, 79.5] - image.pupil.centre_px))
        assert s.axes_px == pytest.approx(tuple([10.0, 5.0] - image.pupil.semi_axes_px))
        assert s.glints is None
        assert s.cpu_s < s.trip_s + 1.0
    broken = run_extractor(resolve("label=mine:broken"), images[:2], timeout_s=20)
    assert {s.reason for s in broken.scores} == {"RuntimeError: out of ideas"}
    assert broken.extractor.name == "label"
    deep = run_extractor(resolve("mine:Deep.quiet"), images[:1], timeout_s=20)
    assert deep.scores[0].reason == "gave no reason"
    nothing = run_extractor(resolve("mine:nothing"), images[:1], timeout_s=20)
    assert nothing.scores[0].reason == "ended with exit code 1: mine has no nothing"


def test_an_installed_plug_in_is_found_by_its_name(images, tmp_path, monkeypatch):
    (tmp_path / "plug.py").write_text(CALLABLE)
    info = tmp_path / "plug-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plug\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[eyerender.extractors]\nplugged = plug:mean\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    extractor = resolve("plugged")
    assert "plug" not in sys.modules  # another package's code runs in the worker only
    run = run_extractor(extractor, images[:1], timeout_s=20)
    assert run.scores[0].outcome in ("right", "wrong")
    assert json.dumps(run.greeting.conventions.to_mapping()).count("corner") == 1
