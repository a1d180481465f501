"""Workers for tests."""

import concurrent.futures

import pytest
from documents import WRITTEN

from jaxgray.fleets.store import Store

# What workers of their own have written is seen when it is read.
Store.read = WRITTEN.watch(Store.read)


@pytest.fixture
def executor():
    """One thread of this process, which shares what is compiled."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        yield pool
