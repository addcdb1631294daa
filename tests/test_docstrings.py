"""The examples in the docstrings of public names run and print what they say; those that render are skipped."""

from __future__ import annotations

import doctest
from types import ModuleType

import numpy as np
import pytest

import eyerender as er

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
