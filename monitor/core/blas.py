"""Number of threads of the linear algebra."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
"""Environment variables that the libraries read when they are loaded."""


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Limit the linear algebra of this process and of its children to one thread.

    The matrices are small, so that several threads only wait for one another.  Libraries that are loaded later read the
    limit from the environment.  Libraries that are loaded already are limited by ``threadpoolctl``, which is imported only
    for these.

    Examples
    --------
    >>> with single_blas_thread():
    ...     os.environ["OPENBLAS_NUM_THREADS"]
    '1'
    """
    before = {name: os.environ.get(name) for name in _VARIABLES}
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    try:
        if "numpy" not in sys.modules:
            yield
            return
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
