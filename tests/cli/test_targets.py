"""No command writes over one of its inputs, under whatever name, nor to an address; both are found before any work."""

from __future__ import annotations

import inspect
import os
from pathlib import Path

import pytest
import yaml

from eyerender.cli import targets
from eyerender.cli.app import app
from eyerender.cli.gaze import gaze
from eyerender.cli.main import run
from eyerender.scene import shipped_scenes

# Each command with its inputs. The check comes before the inputs are read, so they need not be what they seem.
COMMANDS = {
    "features": ["scene.yaml", "--eye", "eye.yaml"],
    "extract": ["video.mp4", "--scene", "scene.yaml"],
    "compare": ["folder"],
    "generate": ["spec.yaml", "--eye", "eye.yaml"],
    "sample": ["spec.yaml", "0", "--eye", "eye.yaml"],
    "preview": ["scene.yaml"],
    "validate": ["folder"],
    "export-dataset": ["folder", "--format", "csv"],
    "gaze fit": [
        "records.json",
        "--estimator",
        "regression",
        "--scene",
        "scene.yaml",
        "--columns",
        "columns.yaml",
        "--targets",
        "targets.csv",
    ],
    "gaze predict": ["records.csv", "-c", "calibration.json", "--rig", "rig.yaml"],
    "render": ["scene.yaml", "--eye", "eye.yaml"],
    "quickstart": ["--eye", "eye.yaml"],
    "bench-extractors": ["folder"],
    "export-scene": ["scene.yaml"],
    "eyes": ["eye.yaml"],
    "view": ["eye", "eye.yaml"],
    "population": ["people.yaml"],
    "realism": ["folder", "other"],
    "study": ["conditions", "--eyes", "E2, eye.yaml"],
    "budget": ["scene.yaml", "--estimator", "regression", "--eye", "eye.yaml"],
    "doctor": [],
    "fit-eye": ["records.csv", "--rig", "rig.yaml", "--columns", "columns.yaml"],
    "rig": ["scene.yaml", "--unknowns", "unknowns.yaml"],
    "status": ["folder"],
    "merge": ["folder", "other"],
    "inspect": ["folder", "other"],
    "sweep": ["layouts.yaml"],
}
NO_OUTPUT = {"setup-llvm", "schema", "live"}
OPTIONS = {"output": "-o", "overlay": "--overlay", "json": "--json"}
CASES = [
    (command, output)
    for command in COMMANDS
    for output in inspect.signature((gaze[command[5:]] if " " in command else app[command]).default_command).parameters
    if output in OPTIONS
]


def call(command: str, output: str, place: str, *more: str) -> list[str]:
    """Arguments of a command that shall write one of its outputs to a place."""
    needed = ["-o", "needed"] if output != "output" and (command, "output") in CASES else []
    given = [OPTIONS[output], place]
    if command == "quickstart":  # its folder has no option
        needed, given = ([], [place]) if output == "output" else (["needed"], given)
    return [*command.split(), *COMMANDS[command], *needed, *given, *more]


def files() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with all inputs, as the current folder."""
    monkeypatch.chdir(tmp_path)
    for words in COMMANDS.values():
        for name in (part.strip() for word in words for part in word.split(",")):
            if "." in name:
                Path(name).write_text(f"content: {name}\n")
    for name in ("folder", "other"):
        Path(name, "images").mkdir(parents=True)
        for file in ("dataset.json", "metadata.jsonl", "report.html", "images/000000.png"):
            Path(name, file).write_text("{}")
    return tmp_path


def test_every_command_and_every_output_is_in_the_table():
    names = {name for name in app if not name.startswith("-")} - {"gaze"} | {f"gaze {n}" for n in gaze if n[0] != "-"}
    assert names == set(COMMANDS) | NO_OUTPUT
    assert set(OPTIONS) == set(targets.OUTPUTS)
    # What a command writes to has one of these names; these are all others of paths and texts.
    inputs = {
        "scene", "images", "folder", "other", "spec", "records", "rig", "columns", "targets", "calibration", "eye",
        "eyes", "name", "preset", "extractor", "estimator", "reference", "function", "terms_x", "terms_y", "fixations",
        "side", "shard", "address", "against", "recording", "population", "unknowns", "require", "folders", "scenes",
        "roi", "tolerances",
    }  # fmt: skip
    for name in sorted(names):
        function = (gaze[name[5:]] if " " in name else app[name]).default_command
        for parameter in inspect.signature(function).parameters.values():
            if "Path" in str(parameter.annotation) or "str" in str(parameter.annotation):
                literal = "Literal" in str(parameter.annotation) or "Choice" in str(parameter.annotation)
                assert literal or parameter.name in inputs | set(OPTIONS), (name, parameter)


@pytest.mark.parametrize("how", ["the same", "hard link", "link"])
@pytest.mark.parametrize(("command", "output"), CASES)
def test_an_input_is_not_written_to(command, output, how, place, capsys):
    names = [part.strip() for word in COMMANDS[command] for part in word.split(",") if "." in part]
    for k, name in enumerate(names):
        target = name if how == "the same" else f"t{k}.mp4" if command == "extract" else f"t{k}.svg"
        if how == "hard link":
            os.link(name, target)
        elif how == "link":
            Path(target).symlink_to(name)
        before = files()
        assert run(call(command, output, target)) == 2
        said = capsys.readouterr()
        assert said.err == f"error: {target}: is an input of this command, so it is not written to\n"
        assert said.out == ""
        assert files() == before


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
@pytest.mark.parametrize("target", ["folder", "link", "folder/../folder"])
@pytest.mark.parametrize("command", ["export-dataset", "bench-extractors"])
def test_an_input_folder_is_not_written_to(command, target, overwrite, place, capsys):
    Path("link").symlink_to("folder")
    before = files()
    assert run(call(command, "output", target, *overwrite)) == 2
    assert capsys.readouterr().err == f"error: {target}: is an input of this command, so it is not written to\n"
    assert files() == before


@pytest.mark.parametrize("target", ["folder/dataset.json", "folder/metadata.jsonl", "folder/images/000000.png"])
@pytest.mark.parametrize("command", [c for c, words in COMMANDS.items() if "folder" in words])
def test_a_file_of_an_input_folder_is_not_written_to(command, target, place, capsys):
    before = files()
    assert run(call(command, "json", target)) == 2
    assert capsys.readouterr().err == f"error: {target}: belongs to the input folder, so it is not written to\n"
    assert files() == before


def test_a_page_of_an_input_folder_is_not_written_to(place, capsys):
    assert run(["realism", "other", "folder", "-o", "folder/report.html"]) == 2
    assert "belongs to the input folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["generate", "render", "export-scene", "population", "study", "quickstart"])
def test_a_folder_that_holds_an_input_is_not_emptied(command, place, capsys):
    Path("eyes").mkdir()
    name = next(name for word in COMMANDS[command] for name in word.split(", ") if "." in name)
    Path(name).rename(Path("eyes", name))
    words = call(command, "output", "eyes", "--overwrite")
    words = [word.replace(name, f"eyes/{name}") for word in words]
    assert run(words) == 2
    assert capsys.readouterr().err == f"error: eyes: holds the input eyes/{name}, so it is not overwritten\n"


@pytest.mark.parametrize("named", ["maps/room.exr", "maps/../maps/room.exr", "heads/head.json", "heads/head.ply"])
def test_a_file_that_an_input_names_is_not_written_to(named, place, capsys):
    scene = yaml.safe_load(shipped_scenes()["quickstart"].read_text(encoding="utf-8"))
    Path("maps").mkdir()
    Path("maps/room.exr").write_text("map")
    Path("heads").mkdir()
    Path("heads/head.json").write_text('{"file": ["head.ply"]}')
    Path("heads/head.ply").write_text("ply")
    scene["note"] = {"map": [named if "room" in named else "maps/room.exr"], "head": "heads/head.json"}
    Path("scene.yaml").write_text(yaml.safe_dump(scene))
    before = files()
    assert run(["features", "scene.yaml", "--json", named]) == 2
    assert capsys.readouterr().err == f"error: {named}: is an input of this command, so it is not written to\n"
    assert files() == before


def test_files_that_name_each_other_are_followed_once(place, capsys):
    Path("scene.yaml").write_text("{a: scene.yaml, b: other.yaml}")
    Path("other.yaml").write_text("{a: scene.yaml, b: other.yaml, c: third.json}")
    Path("third.json").write_text('["other.yaml", "", "\\u0000", 5]')
    Path("free.json").write_text("{}")
    assert run(["features", "scene.yaml", "--json", "third.json"]) == 2
    assert "is an input" in capsys.readouterr().err
    targets.check_outputs({"scene": "scene.yaml", "json": "free.json"})


def test_names_of_shipped_things_are_no_folders(place):
    """`render quickstart -o quickstart --overwrite` names a shipped scene, not the folder of an earlier run."""
    Path("quickstart").mkdir()
    targets.check_outputs({"scene": "quickstart", "output": Path("quickstart"), "overwrite": True})


def test_a_result_beside_the_images_of_an_input_folder_can_be_replaced(place):
    Path("folder/result.json").write_text("{}")
    targets.check_outputs({"folder": Path("folder"), "json": "folder/result.json"})


def test_two_outputs_have_two_names(place, capsys):
    assert run(["extract", "video.mp4", "-o", "out", "--json", "./out"]) == 2
    assert "is given for two outputs" in capsys.readouterr().err


@pytest.mark.parametrize("folder", [".", "pictures"])
def test_pictures_of_what_was_found_do_not_replace_the_images(folder, place, capsys):
    Path("pictures").mkdir()
    Path("a.png").write_text("image")
    os.link("a.png", "pictures/a.png")
    before = files()
    assert run(["extract", "a.png", "--overlay", folder]) == 2
    picture = Path(folder, "a.png")
    assert capsys.readouterr().err == f"error: {picture}: is one of the images, so it is not written to\n"
    assert files() == before


@pytest.mark.parametrize(("command", "output"), CASES)
def test_an_address_is_refused_in_one_line(command, output, place, capsys):
    before = files()
    for address in ("s3://bucket/x.mp4", "https://host/x.svg", "gs:/bucket/x.svg", "host:/x.html"):
        assert run(call(command, output, address)) == 2
        whole = address.replace(":/", "://").replace("///", "//")
        said = f"error: {whole}: is an address, and only files of this machine are written\n"
        assert capsys.readouterr().err == said
    assert files() == before
    assert not [path for path in place.iterdir() if ":" in path.name]


def test_the_api_refuses_addresses_too(place):
    from eyerender.base.errors import InputError
    from eyerender.base.storage.files import make_folder, write_text

    for write in (make_folder, lambda path: write_text(path, "")):
        with pytest.raises(InputError, match="is an address"):
            write("s3://bucket/x")


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no /dev")
@pytest.mark.parametrize("target", ["/dev/null", "/dev/zero", "/dev/stdout", "pipe", "folder"])
@pytest.mark.parametrize("command", [command for command, output in CASES if output == "json"])
def test_a_json_target_is_a_file(command, target, place, capsys):
    os.mkfifo("pipe")
    state = os.lstat(target)
    assert run(call(command, "json", target)) == 2
    assert capsys.readouterr().err.startswith(f"error: {target}: is ")
    assert os.path.samestat(state, os.lstat(target))
