"""Every test runs torch on one thread: repeatable, and fastest with parallel workers."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    torch.set_num_threads(1)
