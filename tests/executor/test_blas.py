"""BLAS in one thread, for as long as anybody needs it."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from en4dvar.executor import one_blas_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().info() if library["user_api"] == "blas"}


@pytest.fixture
def several() -> Iterator[set[int]]:
    with threadpool_limits(2, user_api="blas"):
        if (before := threads()) == {1}:
            pytest.skip("BLAS has one thread here, whatever is asked")
        yield before


def test_contexts_nest(several: set[int]):
    with one_blas_thread():
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == several


def test_a_thread_that_leaves_does_not_lift_the_limit_of_another(several: set[int]):
    def visit() -> None:
        with one_blas_thread():
            assert threads() == {1}

    with one_blas_thread():
        with ThreadPoolExecutor(1) as pool:
            pool.submit(visit).result()
        assert threads() == {1}
    assert threads() == several
