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

    from eyerender.rendering.records.recording import recorded

    @recorded
    def doubled(structure, x: mi.Float, twice: bool, count: int) -> list[mi.Float]:
        return [x * 2] * (count if twice else 1)

    for size in (3, 7):
        x = mi.Float([1.0] * size)
        for twice, count in 2 * ((True, 2), (False, 2), (True, 1), (True, 2), (False, 1)):
            found = doubled(structure, x, twice, count)
            assert len(found) == (count if twice else 1)
            assert found[0].numpy().tolist() == [2.0] * size


def test_a_flag_inside_an_argument_chooses_the_recording(renderer):
    import mitsuba as mi

    from eyerender.rendering.records.recording import recorded

    @recorded
    def scaled(structure: Structure, x: mi.Float) -> mi.Float:
        return x * ((2 if structure.region else 3) * (5 if structure.matte else 7))

    x = mi.Float([1.0, 2.0])
    for region, matte in 2 * ((True, True), (True, False), (False, True), (False, False)):
        expected = (2 if region else 3) * (5 if matte else 7)
        assert scaled(Structure(region, matte), x).numpy().tolist() == [expected, 2 * expected]


def test_the_second_call_is_recorded_and_new_subjects_forget_it(renderer):
    import mitsuba as mi

    from eyerender.rendering.records.recording import forget, recorded

    class Counter:
        runs = 0

    counter = Counter()

    @recorded
    def doubled(x: mi.Float) -> mi.Float:
        counter.runs += 1
        return x * 2

    times = []
    for k in range(6):
        if k == 4:
            forget()
        assert doubled(mi.Float([float(k), 1.0])).numpy().tolist() == [2.0 * k, 2.0]
        times.append(counter.runs)
    assert times == [1, 2, 2, 2, 3, 4]
