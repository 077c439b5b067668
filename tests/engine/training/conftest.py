"""Tests of the networks need PyTorch, which only the extra `train` brings."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("torch") else ["test_networks.py"]
