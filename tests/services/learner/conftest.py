"""Torch computes on one thread here: two that share a busy core are ten times slower."""

import pytest


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    """Limit torch's threads, and give them back."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
