"""Estimators that the targets of a calibration do not determine are fitted with a warning."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from eyerender.cli.main import run
from eyerender.gaze.determined import LEAST_SHARE, UndeterminedWarning, seen_shares
from eyerender.gaze.regression import Regression, highest_determined
from eyerender.gaze.validation import leave_one_target_out
from tests.support.regression import RIG, synthetic


def grid(columns, rows):
    """Vectors on a regular grid, away from the origin, in pixels."""
    x, y = np.meshgrid(np.linspace(5, 25, columns), np.linspace(-8, 4, rows))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


@pytest.mark.parametrize(
    ("columns", "rows", "name"),
    # A power of x up to p needs p + 1 columns, and one of y needs as many rows.
    [(2, 2, "R2"), (3, 3, "R4"), (4, 3, "R8"), (4, 4, "R11"), (6, 4, "R12"), (2, 1, None)],
)
def test_the_highest_function_is_that_of_the_grids_columns_and_rows(columns, rows, name):
    assert highest_determined(grid(columns, rows)) == name


def exact_rank(rows):
    """Rank by elimination in rational numbers, which needs no tolerance."""
    rows, rank = [list(row) for row in rows], 0
    for k in range(len(rows[0])):
        pivot = next((row for row in rows[rank:] if row[k]), None)
        if pivot is None:
            continue
        rows.remove(pivot)
        rows.insert(rank, pivot)
        for i in range(rank + 1, len(rows)):
            share = rows[i][k] / pivot[k]
            rows[i] = [a - share * b for a, b in zip(rows[i], pivot, strict=True)]
        rank += 1
    return rank


@pytest.mark.parametrize("name", ["R3", "R8", "R12"])
@pytest.mark.parametrize(("columns", "rows"), [(3, 3), (4, 4), (6, 5)])
def test_the_rank_is_that_of_exact_arithmetic(name, columns, rows):
    terms = Regression(name).terms[0]
    u = [(Fraction(2 * i, columns - 1) - 1, Fraction(2 * j, rows - 1) - 1) for i in range(columns) for j in range(rows)]
    exact = exact_rank([x**i * y**j for i, j in terms] for x, y in u)
    shares = seen_shares(np.array(u, dtype=float), terms)
    assert np.count_nonzero(shares >= LEAST_SHARE) == exact


def test_the_share_is_what_a_function_keeps_at_the_targets():
    # With one term there is one function: its share is its rms at the targets over that of the area.
    vectors = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.2]])
    steps = np.linspace(0, 1, 15)
    expected = np.sqrt(np.mean(vectors[:, 0] ** 4) / np.mean(steps**4))
    np.testing.assert_allclose(seen_shares(vectors, ((2, 0),)), [expected], rtol=1e-12)


def test_a_cubic_on_three_columns_warns_and_names_another_function():
    calibration = synthetic(3, 3)
    with pytest.warns(UndeterminedWarning, match=r"right eye: .* 6 of the 8 terms of R8.*; R4 is"):
        Regression("R8").fit(calibration, RIG)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for columns, rows, name in ((3, 3, "R4"), (4, 3, "R8"), (5, 4, "R9")):
            Regression(name).fit(synthetic(columns, rows), RIG)


def test_what_the_warning_says_is_so():
    """With the same noise, the undetermined function is far worse, and the suggested one is not."""
    test, random = synthetic(8, 6, seed=3), np.random.default_rng(0)
    calibration = synthetic(3, 3)
    moved = calibration.pupil.centre_px + random.normal(0, 0.05, calibration.pupil.centre_px.shape)
    noisy = replace(calibration, pupil=replace(calibration.pupil, centre_px=moved))

    def error(name):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UndeterminedWarning)
            gaze = Regression(name).fit(noisy, RIG).predict(test, RIG)
        return np.linalg.norm(gaze.point_mm - test.index.target_mm, axis=1).max()

    assert error("R8") > 3 * error("R4")


def test_a_held_out_target_gives_one_warning():
    with pytest.warns(UndeterminedWarning) as caught:
        leave_one_target_out(Regression("R9"), synthetic(3, 3), RIG)
    assert len(caught) == 1
    assert "without one of the targets" in str(caught[0].message)


def test_the_commands_say_so(tmp_path, capsys):
    records = tmp_path / "records.json"
    calibration = synthetic(3, 3)
    data = {"rig": RIG.to_mapping(), "records": list(calibration.records())}
    records.write_text(json.dumps(data), encoding="utf-8")
    argv = [
        "gaze",
        "fit",
        str(records),
        "--estimator",
        "regression",
        "--function",
        "R8",
        "-o",
        str(tmp_path / "c.json"),
    ]
    assert run(argv) == 0
    # Another warning says that these features are no eye's.
    printed = [line for line in capsys.readouterr().err.splitlines() if "terms of" in line]
    assert [line.split(":")[0] for line in printed] == ["warning", "warning"]  # one for each eye
    assert "6 of the 8 terms of R8" in printed[0]
    (tmp_path / "c.json").unlink()
    assert run([*argv, "--strict"]) == 2
    assert not (tmp_path / "c.json").exists()
