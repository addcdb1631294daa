"""The documentation site, the examples of docstrings and of the page on Python, and the stored data."""

from __future__ import annotations

import datetime
import doctest
import importlib.util
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest
import yaml
from PIL import Image

import eyerender as er
from docs.tools import keys, origins, references, validation
from eyerender.cli.app import app
from eyerender.scene import Scene
from eyerender.scene.spec import SceneSpec
from tests.support.paths import DATA, ROOT

DOCS = ROOT / "docs"
GALLERY = "gallery/index"  # made by sphinx-gallery


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, str]:
    """The text of every page by its name, with those that are made from the code."""
    folder = tmp_path_factory.mktemp("docs") / "generated"
    for tool in (keys, references, validation):
        tool.write(folder)
    own = {path.stem: path.read_text(encoding="utf-8") for path in DOCS.glob("*.md")}
    made = {f"generated/{path.stem}": path.read_text(encoding="utf-8") for path in folder.glob("*.md")}
    return {**own, **made}


def schema_keys(kind: str) -> set[tuple[str, str]]:
    """(record, key) of every property in the JSON Schema of a kind of file."""
    schema = keys.FILES[kind].json_schema()
    records = {schema["title"]: schema, **schema.get("$defs", {})}
    return {(name, key) for name, record in records.items() for key in record.get("properties", ())}


@pytest.mark.parametrize("kind", ["scene", "eye", "dataset"])
def test_every_key_of_a_schema_has_a_row_with_a_description(kind):
    rows = {(row.record, row.key): row for record in keys.records_of(keys.FILES[kind]) for row in keys.rows_of(record)}
    assert schema_keys(kind) <= rows.keys()
    assert not [name for name, row in rows.items() if len(row.description) < 3]


def test_rows_state_unit_range_default_and_source():
    rows = {(row.record, row.key): row for record in keys.records_of(er.SceneSpec) for row in keys.rows_of(record)}
    lid = rows["Lid", "upper_follows"]
    assert (lid.kind, lid.range, lid.default, lid.source) == ("number", "≥ 0.6, ≤ 1", "`0.9`", "Becker")
    assert rows["Sensor", "pixel_pitch_um"].unit == "µm"
    assert rows["Panel", "radiance_w_m2_sr"].unit == "W/(m² sr)"
    assert rows["Rig", "cameras"].range == "0 to 100 entries"
    assert rows["Camera", "resolution_px"].default == "**required**"
    assert rows["Led", "position_mm"].kind == "3 of number"


def test_a_record_is_described_once_and_links_lead_to_it(pages):
    own = {page: re.findall(r"^\((keys-\w+)\)=$", pages[f"generated/{page}"], re.MULTILINE) for page in keys.BLOCKS}
    everywhere = [name for names in own.values() for name in names]
    assert len(everywhere) == len(set(everywhere)) > 90
    for page in keys.BLOCKS:
        for other, name in re.findall(r"\((?:(keys_\w+)\.md)?#(keys-\w+)\)", pages[f"generated/{page}"]):
            assert name in own[other or page]


@pytest.mark.parametrize("page", keys.BLOCKS)
def test_the_example_of_a_page_of_keys_is_read(page):
    block = keys.BLOCKS[page]
    example = yaml.safe_load(block.example)
    if "" not in block.paths:
        whole = er.load_eye("E4").to_mapping() if block.kind == "eye" else er.load_scene("headset").spec.to_mapping()
        if "sequence" in example:
            del whole["targets"]
        if "population" in example:
            del whole["eye"], whole["region"]
        example = {**whole, **example}
    spec = keys.FILES[block.kind].from_mapping(example)
    if block.kind == "scene":
        assert len(Scene.of(cast(SceneSpec, spec)).frames()) > 0


def test_every_public_name_has_a_docstring_page(pages):
    texts = (text for name, text in pages.items() if "/api_" in name and not name.endswith("/api_torch"))
    found = references.names_on("".join(texts))
    spaces = {name for name in er.__all__ if isinstance(getattr(er, name), ModuleType)}
    assert found == (set(er.__all__) - spaces - {"__version__"}).union(*(getattr(er, s).__all__ for s in spaces))


def test_every_command_is_in_the_reference(pages):
    texts = [pages[f"generated/{page}"] for page in references.COMMANDS]
    assert len(re.findall(r"^## eyerender ", "".join(texts), re.MULTILINE)) > 25
    assert all(text.count("**Examples**") == text.count("\n## eyerender ") for text in texts)
    assert "\neyerender render --output PATH [OPTIONS] SCENE\n" in pages["generated/commands_scenes"]


def test_every_page_is_in_a_table_of_contents(pages):
    listed = {"index", "generated/validation_tables", "generated/api_names"}  # the last two are included, no pages
    for text in pages.values():
        for body in re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL):
            lines = (line for line in body.splitlines() if line and not line.startswith(":"))
            listed |= {re.sub(r".*<(.+)>", r"\1", line).lstrip("/") for line in lines}
    assert set(pages) == listed - {GALLERY}


@pytest.mark.parametrize("source", ["docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"])
def test_relative_links_resolve(pages, source):
    texts = pages if source == "docs" else {source: (ROOT / source).read_text(encoding="utf-8")}
    wrong = []
    for name, text in texts.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL)):
            if re.match(r"[a-z]+:|#", target):
                continue
            path, _, anchor = target.partition("#")
            here = (DOCS / name).parent if source == "docs" else ROOT
            place = os.path.relpath(here / path, DOCS)
            page = pages.get(place.removesuffix(".md"))
            exists = page is not None or (here / path).exists() or place.startswith("gallery/")
            if not exists or (anchor and (page is None or anchor not in anchors_of(page))):
                wrong.append(f"{name}: {target}")
    assert wrong == []


def test_no_page_names_another_by_its_file(pages):
    """A page of the site is a link. Pages in `code` are files of the checkout, such as those to edit."""
    plain = {name: re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", text, flags=re.DOTALL) for name, text in pages.items()}
    assert [(name, found) for name, text in plain.items() for found in re.findall(r"docs/\w+\.md", text)] == []


def anchors_of(page: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    heads = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads)
    return {*plain, *re.findall(r"^\(([\w-]+)\)=$", page, re.MULTILINE)}


def test_measurements_are_those_of_tests_that_there_are():
    """Every row of the validation page was measured by the assertion that it names, within its tolerance."""
    wanted = yaml.safe_load((DOCS / "data" / "validation.yaml").read_text(encoding="utf-8"))
    measured = json.loads((DOCS / "data" / "validation.json").read_text(encoding="utf-8"))["groups"]
    named = {group: [tuple(case.values()) for case in cases] for group, cases in wanted.items()}
    assert {group: [tuple(row.values())[:5] for row in rows] for group, rows in measured.items()} == named
    for row in (row for rows in measured.values() for row in rows):
        path, _, name = row["test"].partition("::")
        text = (ROOT / path).read_text(encoding="utf-8")
        body = re.split(r"\ndef ", text.partition(f"def {name}(")[2])[0]
        assert row["assertion"] in body, row["what"]
        assert 0 <= row["value"] <= row["limit"]


def own_pages() -> dict[str, str]:
    """The pages that people wrote, with the README."""
    return {path.stem: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *DOCS.glob("*.md")]}


def test_every_figure_of_a_page_has_an_origin():
    known = origins.load()
    missing = [
        f"{name}: {path[-1]}"
        for name, text in own_pages().items()
        for path, body in origins.sections(text)
        if origins.states_figures(body) and origins.origin(known.get(name, {}), path) is None
    ]
    assert missing == [], "docs/data/figures.yaml has no origin for these sections"


def test_origins_are_of_sections_and_programs_that_there_are():
    pages = own_pages()
    for name, rows in origins.load().items():
        titles = {title for path, _ in origins.sections(pages[name]) for title in path}
        assert rows.keys() <= {"", *titles}, name
        for where in rows.values():
            done = origins.measured(where)
            command = where if done is None else done[1]
            assert done is None or done[0] <= datetime.date.today(), f"{name}: {where}"
            if command.startswith("eyerender "):
                assert command.split()[1] in app, f"{name}: {where}"
            elif command and command not in ("defined", "cited"):
                assert (ROOT / command).exists(), f"{name}: {where}"
            if done is None and command.startswith("tests/"):
                assert "README" in (ROOT / command).read_text(encoding="utf-8"), f"{where} reads no page"


def test_a_section_takes_its_origin_from_the_one_above():
    text = "# Page\n## A\n1.5 px\n### B\n| 1 | 2 | 3 |\n## C\nin 3 ways\n"
    found = {path[-1]: (path, body) for path, body in origins.sections(text)}
    assert [origins.states_figures(found[title][1]) for title in "ABC"] == [True, True, False]
    assert origins.origin({"A": "cited"}, found["B"][0]) == "cited"
    assert origins.origin({"A": "cited"}, found["C"][0]) is None
    assert origins.measured("2026-11-24 scripts/test") == (datetime.date(2026, 11, 24), "scripts/test")


def test_every_bench_is_on_its_page():
    page = (DOCS / "benches.md").read_text(encoding="utf-8")
    assert [path.name for path in (ROOT / "scripts").glob("bench_*.py") if f"`{path.name}`" not in page] == []


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (DOCS / "images").iterdir()}
    assert max(sizes.values()) < 100_000, sizes
    assert sum(sizes.values()) < 1_000_000


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("sphinx") is None, reason="the extra `docs` is not installed")
def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-q", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "EYERENDER_DOCS_EXAMPLES": "0"}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (Path(tmp_path) / "generated" / "keys_scene.html").is_file()


def test_the_page_on_stability_names_the_formats_of_the_code():
    """A format that rises in the code must rise on the page, too."""
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "eyerender").rglob("*.py"))
    newest: dict[str, int] = {}
    for name, version in re.findall(r"eyerender/([a-z-]+)/(\d+)", code):
        newest[name] = max(newest.get(name, 0), int(version))
    page = (DOCS / "stability.md").read_text(encoding="utf-8")
    on_page: dict[str, int] = {}
    for name, version in re.findall(r"eyerender/([a-z-]+)/(\d+)", page):
        on_page[name] = max(on_page.get(name, 0), int(version))
    assert {"record", "image", "gaze", "gaze-calibration"} <= on_page.keys()
    assert on_page == {name: newest[name] for name in on_page}
    rows = {
        kind: line for line in page.splitlines() for kind in ("scene", "dataset spec") if line.startswith(f"| {kind}")
    }
    assert rows["scene"] == f"| scene (YAML) | {er.SceneSpec.FORMAT} |"
    assert rows["dataset spec"] == f"| dataset spec, eye (YAML) | {er.EyeSpec.FORMAT} |"
    assert er.EyeSpec.FORMAT == er.DatasetSpec.FORMAT


def test_the_first_hour_leaves_no_file_in_the_checkout():
    page = (DOCS / "first_hour.md").read_text(encoding="utf-8")
    lines = [line for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) for line in block.splitlines()]
    start = lines.index("cd out/first_hour")
    assert not [line for line in lines[start + 1 :] if line.startswith("cd ") or " -o /" in line or "-o .." in line]
    environment = next(line.split()[-1] for line in lines if "-m venv" in line)
    for place in ("out/first_hour/x", f"{environment}/x"):
        assert subprocess.run(["git", "check-ignore", "-q", place], cwd=ROOT, check=False).returncode == 0, place


@pytest.fixture(scope="module")
def makers():
    return runpy.run_path(str(ROOT / "scripts" / "tools" / "make_docs_pictures.py"))["PICTURES"]


def test_one_script_makes_every_picture(makers):
    assert set(makers) == {path.name for path in (DOCS / "images").iterdir()}


@pytest.mark.parametrize("name", ["view_eye.png", "view_scene.png", "frames.png", "eye_angles.png", "pixels.png"])
def test_a_drawing_of_the_pages_is_the_one_of_today(makers, name, tmp_path):
    """Rendered pictures take minutes, and are left to the script."""
    makers[name](tmp_path / name, tmp_path)
    mine, told = (
        np.asarray(Image.open(path).convert("L"), dtype=float) for path in (tmp_path / name, DOCS / "images" / name)
    )
    assert mine.shape == told.shape
    assert np.mean(np.abs(mine - told) > 64) < 1e-3  # fonts may differ by a little


ROWS = [line for line in (DATA / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `")]


def test_every_file_is_listed_once():
    listed = [name for row in ROWS for name in re.findall(r"`([^`]+)`", row.split("|")[1])]
    assert sorted(listed) == sorted(p.name for p in DATA.iterdir() if p.name != "README.md")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: re.findall(r"`([^`]+)`", row)[0])
def test_a_row_names_the_program_how_it_was_used_and_its_licence(row):
    _, _, program, how, licence, _ = row.split("|")
    assert all(cell.strip() for cell in (program, how, licence))


SPACES = [getattr(er, name) for name in er.__all__ if isinstance(getattr(er, name), ModuleType)]
FOUND = {name: getattr(er, name) for name in er.__all__ if name != "__version__"} | {
    f"{space.__name__}.{name}": getattr(space, name) for space in SPACES for name in space.__all__
}
EXAMPLES = {name: one for name, one in FOUND.items() if ">>>" in (one.__doc__ or "")}


def test_every_name_at_the_root_has_an_example():
    assert [name for name in er.__all__ if name not in EXAMPLES and name in FOUND and FOUND[name] not in SPACES] == []


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_prints_what_it_says(name):
    wanted = doctest.DocTestParser().get_doctest(EXAMPLES[name].__doc__, {"er": er, "np": np}, name, None, None)
    output: list[str] = []
    assert doctest.DocTestRunner().run(wanted, out=output.append).failed == 0, "".join(output)


PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")


def blocks():
    return re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_every_name_on_the_page_exists():
    names = set(re.findall(r"\ber\.((?:gaze\.)?\w+)", PAGE)) - {"gaze"}
    assert len(names) > 20
    for name in names:
        found = er
        for part in name.split("."):
            found = getattr(found, part)
    for name in re.findall(r"^\| `(\w+)\(", PAGE, re.MULTILINE):
        assert hasattr(er.gaze, name)


def test_the_example_of_statuses_runs(capsys):
    (block,) = [block for block in blocks() if "er.Status" in block]
    exec(block, {"er": er, "np": np})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "270 of 270 pupils"
    assert lines[2:] == ["<Status.OK: 0> None"]


def test_the_examples_of_gaze_run(capsys):
    space: dict[str, Any] = {"er": er}
    for block in blocks():
        if "leave_one_target_out" in block or "class Middle" in block:
            exec(block, space)
    mean, largest = map(float, capsys.readouterr().out.split())
    assert 0 < mean < largest < 5
    middle = space["Middle"]().fit(space["truth"], space["scene"].rig)
    again = type(middle).from_mapping(middle.to_mapping())
    gaze = again.predict(space["truth"], space["scene"].rig)
    assert gaze.ok.all()
    assert gaze == middle.predict(space["truth"], space["scene"].rig)
