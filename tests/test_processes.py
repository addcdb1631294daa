import multiprocessing
import time

import pytest

from eyerender.base.processes import mapper, process_pool


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
    # The pool's own thread may have waited for a child first; then this one learns of its end a moment later.
    end = time.perf_counter() + 10
    while (left := set(multiprocessing.active_children()) - set(before)) and time.perf_counter() < end:
        time.sleep(0.05)
    assert not left
