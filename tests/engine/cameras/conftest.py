from __future__ import annotations

from collections.abc import Iterator

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    """Solve as the pipeline does: many tiny matrices are far slower on several threads."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield
