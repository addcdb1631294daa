"""Every file of reference data has a stated source."""

from __future__ import annotations

import re

import pytest

from tests.support.paths import DATA

ROWS = [line for line in (DATA / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `")]


def test_every_file_is_listed_once():
    listed = [name for row in ROWS for name in re.findall(r"`([^`]+)`", row.split("|")[1])]
    assert sorted(listed) == sorted(p.name for p in DATA.iterdir() if p.name != "README.md")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: re.findall(r"`([^`]+)`", row)[0])
def test_a_row_names_the_program_how_it_was_used_and_its_licence(row):
    _, _, program, how, licence, _ = row.split("|")
    assert all(cell.strip() for cell in (program, how, licence))
