"""The table of people and draws from it: moments, purity, conditions, memory, and the survey of them."""

from __future__ import annotations

import csv
import json
import tracemalloc

import numpy as np
import pytest
from scipy.special import ndtri

import eyerender as er
from eyerender.base.errors import InputError
from eyerender.cli.main import run
from eyerender.population.marginals import Lognormal, Mixture, Normal, Part, Uniform
from eyerender.population.model import Model, Reference, completed, default_reference, nearest_correlation
from eyerender.population.people import PopulationSpec
from eyerender.population.statistics import refusals, survey
from eyerender.population.table import PopulationTable, default_table
from eyerender.region.anatomy import Skin

PRESETS = ("adults", "emmetropic_adults", "myopes", "children", "elderly")


def standard_errors(x, expected):
    """How many standard errors the mean and the standard deviation of n values are off."""
    mean, sd = expected
    n = len(x)
    centred = x - x.mean()
    kurtosis = np.mean(centred**4) / np.mean(centred**2) ** 2
    of_sd = sd * np.sqrt(max(kurtosis - 1, 1e-9) / (4 * n))
    return (x.mean() - mean) / (sd / np.sqrt(n)), (x.std() - sd) / of_sd


def worst_errors(population, n, seed):
    """Largest |standard errors| of means, spreads and correlations, and the number of comparisons."""
    people, model = population.draw(n, seed), population.model
    found = []
    for name in model.distributions:
        x = people[name] if people[name].ndim == 1 else people[name][:, 0]
        found += [abs(e) for e in standard_errors(x, model.expected(name))]
    names = model.eye_names
    values = np.column_stack([people[name][:, 0] for name in names])
    measured = np.asarray(np.corrcoef(values.T))
    for pair in default_reference().table.correlations:
        i, j = (names.index(name) for name in pair.pair)
        r = model.expected_correlation(*pair.pair)
        found.append(abs(np.arctanh(measured[i, j]) - np.arctanh(r)) * np.sqrt(n - 3))
    return np.array(found)


def test_moments_are_those_of_the_table():
    errors = worst_errors(er.Population("adults"), 20_000, 20)
    # Some 150 comparisons: the largest of as many standard normal numbers is below 4 in all but one of 100 draws.
    assert errors.max() < 4.0
    assert np.mean(errors < 2.0) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_moments_of_a_hundred_thousand(preset):
    errors = worst_errors(er.Population(preset), 100_000, 2)
    assert errors.max() < 4.0
    # 0.27 % of standard normal numbers are beyond 3.
    assert np.mean(errors > 3.0) <= 0.02


def test_correlation_of_the_eyes():
    people, reference = er.Population("adults").draw(20_000, 5), default_reference()
    for name in ("iris_diameter_mm", "pupil_nasal_mm", "corneal_asphericity"):
        right, left = people[name].T
        r = np.asarray(np.corrcoef(right, left))[0, 1]
        assert np.arctanh(r) == pytest.approx(
            np.arctanh(reference.table.quantities[name].eyes), abs=4 / np.sqrt(20_000)
        )
    assert np.asarray(np.corrcoef(people["axial_length_mm"].T))[0, 1] > 0.93


def test_a_subject_depends_on_nothing_but_seed_and_number():
    population = er.Population("adults", where={"axial_length_mm": (23.0, 25.0), "age_years": 40})
    whole = population.draw(60, 9)
    for start, count in ((0, 7), (33, 27), (59, 1)):
        part = population.draw(count, 9, first=start)
        for name in whole.values:
            np.testing.assert_array_equal(part[name], whole[name][start : start + count], err_msg=name)
    assert whole.person(59) == population.person(59, 9)
    assert not np.array_equal(population.draw(60, 10)["ipd_mm"], whole["ipd_mm"])


def test_conditions_equal_selection():
    """People of one axial length are those that a narrow selection from everybody finds."""
    wanted = {"axial_length_mm": 25.0, "male": 1}
    given = er.Population("adults", where=wanted).draw(1500, 1)
    np.testing.assert_allclose(given["axial_length_mm"], 25.0, atol=1e-9)
    assert np.all(given["male"] == 1)
    near = er.Population("adults", where={"axial_length_mm": (24.85, 25.15), "male": 1}).draw(1500, 2)
    for name in ("refraction_d", "corneal_radius_mm", "chamber_depth_mm", "age_years", "ipd_mm"):
        a, b = given[name], near[name]
        error = np.sqrt((a.var() + b.var()) / 1500)
        # The selection's mean length lies up to 0.02 mm below 25, which moves the others by less than 0.02 of a spread.
        assert a.mean() == pytest.approx(b.mean(), abs=4 * error + 0.02 * a.std()), name
        # Four standard errors of the ratio of two spreads of 1,500 normal numbers each.
        assert a.std() == pytest.approx(b.std(), rel=4 / np.sqrt(1500)), name


def test_exact_conditions_on_predictors():
    people = er.Population("adults", where={"age_years": 33, "refraction_d": -4.0, "ipd_mm": 60.0}).draw(50, 3)
    np.testing.assert_allclose(people["age_years"], 33, atol=1e-9)
    np.testing.assert_allclose(people["refraction_d"], -4.0, atol=1e-9)
    np.testing.assert_allclose(people["ipd_mm"], 60.0, atol=1e-9)
    assert people["axial_length_mm"].mean() > 24


def test_trends_with_age():
    """Hyperopic by 0.023 D and against the rule by 0.009 D a year, within four standard errors of 10,000 people."""
    people = er.Population("adults").draw(10_000, 5)
    age = people["age_years"]
    for name, slope in (("refraction_d", 0.0231), ("refraction_j0_d", -0.009)):
        value = people[name][:, 0]
        found, rest = np.polyfit(age, value, 1)[0], value.std()
        assert found == pytest.approx(slope, abs=4 * rest / age.std() / 100), name


def test_a_range_of_ages_has_the_refractions_of_its_age():
    """People of an age range are those that a selection from everybody finds, also where the refraction is given."""
    everybody = er.Population("adults").draw(20_000, 6)
    chosen = (everybody["age_years"] > 60) & (everybody["age_years"] < 65)
    wanted = everybody["refraction_d"][chosen, 0]
    old = er.Population("adults", where={"age_years": (60, 65)}).draw(2000, 7)
    found = old["refraction_d"][:, 0]
    error = np.sqrt(wanted.var() / len(wanted) + found.var() / len(found))
    assert found.mean() == pytest.approx(wanted.mean(), abs=4 * error)
    assert found.mean() > everybody["refraction_d"].mean() + 4 * error
    both = er.Population("adults", where={"age_years": (60, 65), "refraction_d": -4.0}).draw(50, 8)
    assert np.all((both["age_years"] > 60) & (both["age_years"] < 65))
    np.testing.assert_allclose(both["refraction_d"], -4.0, atol=1e-9)


def test_replaced_marginals_are_used():
    population = er.Population("adults", replace={"age_years": {"kind": "uniform", "low": 25, "high": 26}})
    ages = population.draw(200, 1)["age_years"]
    assert ages.min() >= 25
    assert ages.max() <= 26


def test_memory_is_flat():
    population = er.Population("adults")
    next(population.chunks(10))
    peaks = []
    for n in (12_288, 40_960):
        tracemalloc.start()
        for _ in population.chunks(n, 1):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.05 * peaks[0] + 1e5


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"preset": "martians"}, "preset: must be one of adults"),
        ({"where": {"length": 3.0}}, "where.length: no such quantity"),
        ({"where": {"age_years": 5}}, "where.age_years: nobody"),
        ({"where": {"age_years": (40, 30)}}, "where.age_years: the first number"),
        ({"replace": {"ipd_mm": {"kind": "gamma"}}}, "replace.ipd_mm: kind must be"),
        ({"replace": {"age_years": {"kind": "regression", "mean": 3.0, "residual_sd": 1.0}}}, "must be a marginal"),
    ],
)
def test_wrong_populations_name_the_key(fields, message):
    with pytest.raises(er.InputError, match=message):
        er.Population(**fields)


def test_conditions_that_hardly_anybody_meets_are_refused():
    with pytest.raises(er.InputError, match="meets the conditions"):
        er.Population("adults", where={"axial_length_mm": (35.0, 36.0)}).draw(1)


def test_pupils_shift_with_their_size_in_all_directions():
    """Yang, Thompson and Burns 2002: 0.060 +- 0.032 mm per mm; most pupils move temporally as they dilate, not all."""
    people = er.Population("adults").draw(20_000, 8)
    nasal, up = people["pupil_shift_nasal_mm_per_mm"], people["pupil_shift_up_mm_per_mm"]
    size = np.hypot(nasal, up)
    assert size.mean() == pytest.approx(0.060, abs=0.002)
    assert size.std() == pytest.approx(0.032, abs=0.003)
    assert np.mean(nasal > 0) == pytest.approx(0.16, abs=0.01)
    # Eyes are mirror images, so the pair converges or diverges by the sum.
    assert 0.05 < np.mean(nasal.sum(axis=1) > 0) < 0.25


def test_children_become_more_myopic_as_their_eyes_grow():
    """Gopalakrishnan et al. 2022: 22.50, 22.88, 23.30 and 23.58 mm, and -0.05 D a year, from grade 1 to grade 10."""
    people = er.Population("children").draw(20_000, 3)
    age, length, refraction = people["age_years"], people["axial_length_mm"][:, 0], people["refraction_d"][:, 0]
    assert -0.07 < np.polyfit(age, refraction, 1)[0] < -0.04
    for first, last, mean in ((6, 8, 22.50), (8, 11, 22.88), (11, 15, 23.30), (15, 17, 23.58)):
        assert length[(age >= first) & (age < last)].mean() == pytest.approx(mean, abs=0.25)


def test_lengths_radii_and_refractions_correlate_as_in_samples():
    """95 % intervals: Iyamu et al. 2011 (70 young adults), and 723 people from 55 years on (Olsen et al. 2007).

    That of children follows from the regression line of 402 (Wang et al. 2019) and the spread of drawn refractions.
    """
    for preset, pairs in {
        "adults": {"ratio": (-0.86, -0.67)},
        "children": {"ratio": (-0.69, -0.60)},
        "elderly": {"length": (-0.636, -0.540), "radius": (0.088, 0.230)},
    }.items():
        people = er.Population(preset).draw(20_000, 3)
        length, radius, refraction = (
            people[name][:, 0] for name in ("axial_length_mm", "corneal_radius_mm", "refraction_d")
        )
        values = {"ratio": length / radius, "length": length, "radius": radius}
        for name, (low, high) in pairs.items():
            assert low < np.asarray(np.corrcoef(values[name], refraction))[0, 1] < high, (preset, name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("survey") / "people"
    assert run(["population", "myopes", "-o", str(out), "--count", "600", "--check", "3", "--faces", "0"]) == 0
    return out


def test_the_table_holds_the_people_of_the_draw(folder):
    with (folder / "people.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    people = er.Population("myopes").draw(600)
    assert [int(row["subject"]) for row in rows] == list(range(600))
    for name, column in people.columns().items():
        np.testing.assert_allclose([float(row[name]) for row in rows], column, rtol=1e-5, atol=1e-12, err_msg=name)


def test_the_summary_agrees_with_the_draw(folder):
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    people = er.Population("myopes").draw(600)
    for name, told in summary["quantities"].items():
        x = people[name] if people[name].ndim == 1 else people[name][:, 0]
        assert told["mean"] == pytest.approx(x.mean(), rel=1e-9, abs=1e-9), name
        assert told["sd"] == pytest.approx(x.std(), rel=1e-9), name
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Atchison" in page
    assert "chosen" in page


@pytest.mark.slow
def test_errors_are_standard_errors():
    """Over many seeds, mean and spread in units of their errors have a variance of 1."""
    population = er.Population("adults")
    errors: list[float] = []
    for seed in range(12):
        for m in survey(population, 500, seed).moments:
            if np.isfinite(m.expected_mean):
                errors += m.errors
    # Some 1600 numbers, of which those of both eyes' and correlated quantities count less.
    assert np.std(errors) == pytest.approx(1.0, abs=0.1)


def test_refusals_move_the_mean():
    deep = {"chamber_depth_mm": {"kind": "uniform", "low": 0.3, "high": 3.6}}
    found = refusals(er.Population("adults", replace=deep), 12, 1)
    assert 0 < found.people < 12
    assert sum(found.reasons.values()) >= found.people
    assert found.shifts["chamber_depth_mm"] > 0.05


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["nobody"], "PRESET: must be one of adults"),
        (["adults", "--count", "1"], "--count: must be 2 to"),
        (["adults", "--faces", "-1"], "--faces: must be 0 to"),
        (["adults", "--seed", "-1"], "--seed: must be 0 to"),
    ],
)
def test_bad_input_ends_with_one_line(arguments, line, tmp_path, capsys):
    assert run(["population", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert line in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_of_a_population(tmp_path, capsys):
    file = tmp_path / "p.yaml"
    file.write_text("population:\n  preset: adults\n  where: {age_years: [30, 31], colour: 3}\n", encoding="utf-8")
    assert run(["population", str(file), "-o", str(tmp_path / "out")]) == 2
    assert "where.colour: no such quantity" in capsys.readouterr().err


def test_every_number_is_marked():
    table = default_table()
    for name, quantity in table.quantities.items():
        told = ", ".join(source.what for source in quantity.sources)
        assert all(source.text.strip() for source in quantity.sources), name
        if "all" not in told and quantity.slopes:
            assert "slopes" in told, name
    assert all(pair.text.strip() for pair in table.correlations)
    assert all(constant.text.strip() for constant in table.constants.values())


def test_correlations_of_the_table_hold_together():
    reference = default_reference()
    model = Model(reference, reference.distributions)
    assert reference.distance < 1e-9, "the table's correlations need no nearest matrix"
    for pair in reference.table.correlations:
        if pair.of == "values":
            assert model.expected_correlation(*pair.pair) == pytest.approx(pair.r, abs=1e-6), pair.pair
        i, j = (model.places(name)[0] for name in pair.pair)
        if pair.of == "residuals":
            assert reference.latent[i, j] == pytest.approx(pair.r, abs=1e-6), pair.pair


def test_nearest_correlation_of_highams_example():
    """Higham 2002, section 4: the tridiagonal matrix of 2 and -1, whose nearest correlation matrix he prints."""
    given = 2 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1)
    found = nearest_correlation(given, smallest=0.0)
    printed = [[1, -0.8084, 0.1916, 0.1068], [-0.8084, 1, -0.6562, 0.1916]]
    np.testing.assert_allclose(found[:2], printed, atol=1e-4)
    assert np.linalg.eigvalsh(found)[0] > -1e-9


def test_nearest_correlation_leaves_a_valid_matrix():
    a = np.random.default_rng(3).normal(size=(6, 20))
    valid = np.asarray(np.corrcoef(a))
    np.testing.assert_allclose(nearest_correlation(valid), valid, atol=1e-12)


def test_completed_matrix_has_independent_pairs():
    wanted = np.eye(4)
    pairs = [(0, 1), (1, 2), (0, 2), (2, 3)]
    for (i, j), r in zip(pairs, (0.5, 0.6, 0.4, -0.7), strict=True):
        wanted[i, j] = wanted[j, i] = r
    found = completed(wanted, pairs)
    for i, j in pairs:
        assert found[i, j] == pytest.approx(wanted[i, j], abs=1e-12)
    inverse = np.linalg.inv(found)
    assert abs(inverse[0, 3]) < 1e-9
    assert abs(inverse[1, 3]) < 1e-9


def mean_of(marginal):
    return getattr(marginal, "mean", 0.0)


@pytest.mark.parametrize(
    "marginal",
    [
        Normal(kind="normal", mean=1.0, sd=2.0),
        Normal(kind="normal", mean=1.0, sd=2.0, low=0.5, high=3.0),
        Normal(kind="normal", mean=-9.0, sd=1.0, low=-4.0),
        Lognormal(kind="lognormal", median=0.06, sigma=0.4),
        Uniform(kind="uniform", low=18.0, high=70.0),
        Mixture(kind="mixture", parts=(Part(weight=7, mean=0.1, sd=0.8), Part(weight=3, mean=-2.2, sd=2.2))),
    ],
)
def test_marginals_map_there_and_back(marginal):
    z = np.linspace(-5, 5, 201)
    # Where the whole distribution lies in a tail, its lower end keeps fewer digits.
    np.testing.assert_allclose(marginal.latent(marginal.at(z)), z, atol=5e-4 if mean_of(marginal) < -5 else 2e-6)
    u = (np.arange(200_000) + 0.5) / 200_000
    x = marginal.at(ndtri(u))
    mean, sd = marginal.moments
    assert mean == pytest.approx(x.mean(), abs=2e-3 * sd)
    assert sd == pytest.approx(x.std(), rel=2e-3)


def changed(**parts):
    data = default_table().to_mapping()
    for path, value in parts.items():
        keys = path.split("__")
        node = data
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value
    return PopulationTable.from_mapping(data)


def test_a_spread_below_what_is_explained_is_refused():
    with pytest.raises(InputError, match=r"quantities\.axial_length_mm\.sd"):
        Reference.of(changed(quantities__axial_length_mm__sd=0.3))


def test_wrong_tables_name_the_key():
    with pytest.raises(InputError, match=r"correlations\.0\.pair"):
        changed(
            correlations=[{"pair": ["age_years", "ipd_mm"], "r": 0.5, "of": "values", "mark": "chosen", "text": "x"}]
        )
    with pytest.raises(InputError, match="unknown quantity"):
        changed(presets__adults2={"description": "x", "replace": {"no": {"kind": "fixed", "value": 1.0}}})


def test_the_history_of_skin_has_random_numbers_of_its_own():
    aged, bare = (PopulationSpec(preset="adults", skin_history=h).numbers(400, 3) for h in (1.0, 0.0))
    own = {"skin.folds", "skin.mottling", "skin.relief_mm", "skin.liner", "skin.shadow"}
    assert all(np.array_equal(aged[name], bare[name]) for name in set(aged) - own)
    assert not any(bare[name].any() for name in ("skin.folds", "skin.liner", "skin.shadow"))
    skin = Skin()
    assert np.all(bare["skin.mottling"] == skin.mottling)
    assert np.all(bare["skin.relief_mm"] == skin.relief_mm)
    assert np.corrcoef(aged["age_years"], aged["skin.folds"])[0, 1] > 0.5
    made_up = aged["skin.liner"] > 0
    assert not np.any(made_up & (aged["male"] > 0.5))
    assert np.mean(made_up[aged["male"] < 0.5]) == pytest.approx(1 / 3, abs=0.09)
    # A person's numbers depend on neither the number of people nor the first of them.
    part = PopulationSpec(preset="adults").numbers(3, 3, first=7)
    assert all(np.array_equal(part[name], aged[name][7:10]) for name in own)
