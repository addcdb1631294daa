"""The tables of docs/studies*.md: they are those of the stored results, and a run gives the stored results."""

from __future__ import annotations

import importlib.util
import json

import pytest

from eyerender.apps.study import literature as lit
from eyerender.apps.study.run import run_study
from tests.support.paths import ROOT

spec = importlib.util.spec_from_file_location("study_tables", ROOT / "scripts/study_tables.py")
script = importlib.util.module_from_spec(spec)
spec.loader.exec_module(script)


def test_the_pages_have_the_tables_of_the_stored_results():
    data, people = (json.loads(path.read_text(encoding="utf-8")) for path in (script.DATA, script.PEOPLE_DATA))
    for path, text in script.pages_with({**script.tables(data), **script.people_tables(people)}).items():
        assert path.read_text(encoding="utf-8") == text, "run scripts/study_tables.py"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", ["guestrin2006", "stereo"])
def test_a_run_over_people_gives_the_stored_results(name, tmp_path):
    """As many people as are stored, to four digits."""
    stored = json.loads(script.PEOPLE_DATA.read_text(encoding="utf-8"))[name]
    run_study(name, tmp_path / "out", people=stored["people"][0]["people"])
    assert_same(script.people_of(tmp_path / "out")[name]["people"], stored["people"])


def test_the_page_lists_every_sentence_with_its_rules():
    page = (ROOT / "docs/studies_sentences.md").read_text(encoding="utf-8")
    for rule in lit.RULES.values():
        sentence = lit.SENTENCES.get(rule["sentence"])
        if sentence:
            (line,) = [line for line in page.splitlines() if f"| {sentence} |" in line]
            assert rule["finding"] in line.rsplit("|", 2)[1]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", script.KNOWN)
def test_a_run_gives_the_stored_results(name, tmp_path):
    """To four digits; those after them differ between libraries of linear algebra."""
    run_study(name, tmp_path / "out")
    stored = json.loads(script.DATA.read_text(encoding="utf-8"))[name]
    found = script.numbers_of(tmp_path / "out")[name]
    if "means" in stored:
        stored["means"] = {key: by for key, by in stored["means"].items() if key.endswith(", analytic")}
    assert_same(found, stored)


def assert_same(found, stored):
    """Compare nested values; p-values of paired tests span many orders of magnitude, so these are compared as such."""
    if isinstance(stored, dict):
        assert found.keys() == stored.keys()
        for key in stored:
            assert_same(found[key], stored[key])
    elif isinstance(stored, list):
        assert len(found) == len(stored)
        for pair in zip(found, stored, strict=True):
            assert_same(*pair)
    elif isinstance(stored, float):
        assert found == pytest.approx(stored, rel=1e-3, abs=1e-6)
    else:
        assert found == stored
