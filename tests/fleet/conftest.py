"""Workers for tests."""

import concurrent.futures

import pytest


@pytest.fixture
def executor():
    """One thread of this process, which shares what is compiled."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        yield pool
