import multiprocessing
import time

import pytest

from eyerender.processes import mapper, process_pool


def test_results_come_in_the_order_of_the_arguments_in_this_process_and_in_a_pool():
    for processes in (1, 2):
        with mapper(processes, chunksize=3) as mapped:
            assert list(mapped(pow, range(8), [2] * 8)) == [k * k for k in range(8)]


def _work_and_interrupt():
    with process_pool(2) as pool:
        pool.submit(int).result()  # a child is up
        for _ in range(8):
            pool.submit(time.sleep, 60)
        raise KeyboardInterrupt


def test_an_interrupted_pool_ends_its_children_in_the_middle_of_their_work():
    before, start = multiprocessing.active_children(), time.perf_counter()  # children of other tests
    with pytest.raises(KeyboardInterrupt):
        _work_and_interrupt()
    assert time.perf_counter() - start < 30  # the first task alone would take 60 s
    assert [child for child in multiprocessing.active_children() if child not in before] == []
