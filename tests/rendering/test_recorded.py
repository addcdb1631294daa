"""Recordings: a call with other plain values, or other sizes, is never answered by the wrong one."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

pytestmark = pytest.mark.render


@dataclass(frozen=True)
class Structure:
    """What a frame holds."""

    region: bool
    matte: bool


@pytest.mark.parametrize("structure", [Structure(True, False), Structure(False, True), (True, False)])
def test_plain_values_choose_the_recording(renderer, structure):
    import mitsuba as mi

    from eyerender.rendering.recorded import recorded

    @recorded
    def doubled(structure, x: mi.Float, twice: bool, count: int) -> list[mi.Float]:
        return [x * 2] * (count if twice else 1)

    for size in (3, 7):
        x = mi.Float([1.0] * size)
        for twice, count in ((True, 2), (False, 2), (True, 1), (True, 2), (False, 1)):
            found = doubled(structure, x, twice, count)
            assert len(found) == (count if twice else 1)
            assert found[0].numpy().tolist() == [2.0] * size


def test_a_flag_inside_an_argument_chooses_the_recording(renderer):
    import mitsuba as mi

    from eyerender.rendering.recorded import recorded

    @recorded
    def scaled(structure: Structure, x: mi.Float) -> mi.Float:
        return x * ((2 if structure.region else 3) * (5 if structure.matte else 7))

    x = mi.Float([1.0, 2.0])
    for region in (True, False):
        for matte in (True, False):
            expected = (2 if region else 3) * (5 if matte else 7)
            assert scaled(Structure(region, matte), x).numpy().tolist() == [expected, 2 * expected]
