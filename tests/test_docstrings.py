"""The examples in the docstrings of the main functions run as printed."""

import doctest
import importlib

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["posterior.infer", "posterior.comparison.compare"])
def test_examples_run(name):
    found = doctest.testmod(importlib.import_module(f"npdr_ppl.{name}"))
    assert found.attempted > 0
    assert found.failed == 0
