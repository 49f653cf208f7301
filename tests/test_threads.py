from __future__ import annotations

import numpy as np
from threadpoolctl import ThreadpoolController

from handeye_tri.threads import one_thread


def threads():
    """Of each linear algebra library that is loaded."""
    blas = ThreadpoolController().select(user_api="blas")
    return [library["num_threads"] for library in blas.info()]


def test_one_thread_inside_and_as_many_as_before_after_it():
    # Numpy's is one of them.
    assert np.linalg.det(np.eye(2)) == 1.0
    with ThreadpoolController().limit(limits=2, user_api="blas"):
        before = threads()
        assert before
        with one_thread():
            assert set(threads()) == {1}
        assert threads() == before
