"""Files are read in `base/storage/`, links in folders are not followed, and no control character is printed."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import warnings

import pytest

from eyerender.base.errors import InputError
from eyerender.base.spec import parse_yaml
from eyerender.base.storage.files import appended, parse_json, read_table
from eyerender.cli.output import progress, say
from eyerender.report.style import figure, log_scale, svg
from tests.support.paths import ROOT
from tests.support.readings import OPENERS, calls, other_ways

# Other calls that open something, and why they may.
EXCEPTIONS = {
    "base.storage.files._regular: os.open": "the opener itself",
    "base.storage.files.opened: open": "the opener itself",
    "base.storage.files.appended: open": "the opener itself",
    "base.storage.files._sync: os.open": "to sync a file or folder, not to read it",
    "base.apart.imported_apart: os.open": "the current folder, to come back to it",
    "base.storage.lock._take: os.open": "a lock, not a link, whose content is not used",
    "base.jit._folder: source.read_bytes": "this package's sources",
    "region.mapcache._code: path.read_bytes": "this package's sources",
    "dataset.environment.source_sum: path.read_bytes": "this package's sources",
    "dataset.environment.packages: one.read_text": "metadata of installed packages",
    "dataset.croissant.croissant: _CONTEXT.read_text": "this package's data",
    "extraction.weights._content: FILE.read_text": "this package's data",
    "scene.shipped.is_shipped_dataset: path.read_text": "this package's data",
    "apps.live.page.Tab._build: STYLE.read_text": "this package's data",
    "apps.live.page.Tab.wake: self._studio.painter.open": "no file",
    "cli.examples: (Path(__file__).parent / 'examples.txt').read_text": "this package's data",
    "cli.live.live.announce: webbrowser.open": "no file",
    "cli.main.run: os.open": "the null device",
    "cli.main._fill_closed_streams: os.open": "the null device",
    "dataset.cluster.drive: os.open": "the null device",
    "dataset.cluster._members: (place / 'stat').read_text": "the kernel's /proc",
    "backends.choose._cuda_driver: Path('/proc/driver/nvidia/version').read_text": "the kernel's /proc",
    "backends.llvm._mapped: Path('/proc/self/maps').read_text": "the kernel's /proc",
    "backends.probe.cpu_name: open": "the kernel's /proc",
    "apps.benchmark.worker.main: os.fdopen": "pipes of this process",
    "apps.benchmark.separate.main: os.fdopen": "pipes of this process",
    "apps.benchmark.separate.eight_bits: Image.open": "in another environment, an image that was checked here",
    "apps.realism.separability._equalised: Image.open": "bytes that were just encoded",
    "dataset.training.augment.Augmentation._recorded: Image.open": "bytes that were just encoded",
    "apps.study.literature.texts: (Path(__file__).with_name('texts') / f'{name}.csv').open": "a file of this package",
    "folders.imagefile.compressed: Image.open": "bytes that were just encoded",
    "folders.imagefile._image: Image.open": "an opened file",
    "folders.imagefile.array_of: zipfile.ZipFile": "bytes that were read",
    "folders.imagefile.array_of: archive.open": "a member, of which no more is unpacked than its array has",
    "folders.imagefile.picture_bytes: zipfile.ZipFile": "a new file in memory",
    "region.head._picture: Image.open": "an opened file",
    "optics.meshfile.read_objects: trimesh.load_scene": "bytes that were read",
    "rig.opencv._archive: np.load": "bytes that were read",
    "rig.opencv._archive: zipfile.ZipFile": "bytes that were read",
    "base.storage.files.link_or_copy: open": "a file of this run, which is copied where it cannot be linked",
    "eye.topography._mesh: trimesh.load": "bytes that were read",
    "population.synteyes._arrays: np.load": "bytes that were read",
    "population.synteyes._arrays: zipfile.ZipFile": "bytes that were read",
    "rendering.transport.environmentmap._decoded: mi.Bitmap": "by name; `_refuse_size` has checked it",
    "rendering.transport.environmentmap._decoded: np.lib.format.read_array": "an opened file",
    "rendering.scene.exr.write_exr: mi.Bitmap": "an array",
    "folders.video._capture: cv2.VideoCapture": "FFmpeg opens by name; `VideoReader` has checked the file",
    "dataset.export.video.LosslessVideo.close: cv2.VideoCapture": "the file just written",
    "dataset.export.coco._Annotations.__init__: open": "a new temporary file",
    "dataset.export.imagefolder.write.lines: open": "the file just written",
    "dataset.export.webdataset.write: tarfile.open": "a new file",
    "dataset.packing._write_tar: tarfile.open": "a new file",
}
# Writers of lines: to stderr and stdout of a command; of a protocol; of this package's own words.
PRINTERS = {
    "cli.output.emit", "cli.output.say", "cli.main._one_line_warnings.show", "cli.main._reported", "cli.main._fail",
    "cli.dataset.preview", "cli.eyes.view", "cli.live.live.announce", "cli.environment.setup_llvm",
    "cli.environment.schema", "base.jit._compile_missing", "base.storage.cachefolder._warn", "apps.live.server._end",
    "apps.benchmark.worker._check", "apps.benchmark.separate.main", "backends.set_up.main",
    "backends.set_up.main.say", "backends.probe.main",
}  # fmt: skip


def test_files_are_opened_in_one_place():
    assert other_ways() == EXCEPTIONS.keys()


def test_no_link_is_followed_to_a_file_of_a_fixed_name_in_a_folder():
    found = []
    for name, call in calls():
        joined = bool(call.args) and isinstance(call.args[0], ast.BinOp) and isinstance(call.args[0].op, ast.Div)
        if joined and ast.unparse(call.func) in OPENERS - {"mapped_array", "JsonLines.index"}:
            found += [name] if all(keyword.arg != "follow" for keyword in call.keywords) else []
    assert found == []


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_no_error(closed):
    command = ["sh", "-c", f"{sys.executable} -P -m eyerender eyes {closed}"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    said = [line for line in done.stderr.splitlines() if not line.startswith("compiling")]
    assert (done.returncode, said) == (0, [])


def test_only_these_functions_print():
    found = {
        name for name, call in calls() if ast.unparse(call.func) in ("print", "sys.stderr.write", "sys.stdout.write")
    }
    assert found == PRINTERS


def test_a_log_that_is_a_link_or_a_pipe_is_not_written_to(tmp_path):
    (tmp_path / "theirs").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "theirs")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe", "."):
        with pytest.raises(InputError):
            appended(tmp_path / name)
    for _ in range(2):
        with appended(tmp_path / "log") as file:
            file.write(b"a\n")
    assert (tmp_path / "log").read_bytes() == b"a\na\n"
    assert (tmp_path / "theirs").read_bytes() == b"x"


@pytest.mark.parametrize(
    ("text", "words"), [("a,b\n1,2,3\n", "3 cells"), ("b\n1\n", "column a"), ("a\n" + "x" * 200_000, "CSV")]
)
def test_wrong_tables_are_refused(tmp_path, text, words):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        list(read_table(tmp_path / "a.csv", ("a",)))


def test_halves_of_surrogates_are_refused():
    """No file could hold them, no terminal show them, and no figure draw them."""
    for read in (parse_json, lambda text: parse_yaml(text, "a")):
        assert read('{"a": "\\u00df"}') == {"a": "ß"}
        with pytest.raises(InputError, match="half of a surrogate pair"):
            read('{"a": {"\\ud800": 1}}')
    assert parse_json('"\\ud83d\\ude00"') == "\U0001f600"


@pytest.mark.parametrize("name", ["$\\frac{", "$a_", "\\", "a\x1b[31m\x00\n", "$$"])
def test_names_of_strangers_may_stand_in_figures_and_lines(name, capsys):
    with figure(2, 2) as (fig, ax), warnings.catch_warnings(action="ignore"):
        ax.plot([1, 10, 100], [1, 2, 3], label=name)
        ax.set_yticks([1], [name])
        log_scale(ax.xaxis)
        ax.set(title=name, xlabel=name)
        fig.legend()
        assert svg(fig).startswith("<svg")
    with progress(name) as steps:
        steps(1, 1, "[/red]" + name)
    say(name)
    assert all(line.replace("\t", "").isprintable() for line in capsys.readouterr().err.splitlines())
