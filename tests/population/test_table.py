"""The table of people: what it says about itself, and what its correlations become."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtri

from eyerender.base.errors import InputError
from eyerender.population.marginals import Lognormal, Mixture, Normal, Part, Uniform
from eyerender.population.model import Model, Reference, completed, default_reference, nearest_correlation
from eyerender.population.table import PopulationTable, default_table


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
