"""Finding backends by name."""

from importlib.metadata import EntryPoint

import pytest

from npdr_ppl.errors import BackendError
from npdr_ppl.inference import registry
from npdr_ppl.inference.base import Backend
from npdr_ppl.inference.snpe_c import SNPEC


def test_makes_backends_with_options():
    method = registry.backend("snpe-c", members=3)
    assert isinstance(method, SNPEC) and method.members == 3


def test_lists_names_and_summaries():
    for name, summary in registry.backends().items():
        cls = registry.backend_class(name)
        assert issubclass(cls, Backend) and cls.name == name
        assert summary and "\n" not in summary


def test_suggests_a_name():
    with pytest.raises(BackendError, match="did you mean 'snpe-c'"):
        registry.backend("SNPE_C")
    with pytest.raises(BackendError, match="known are"):
        registry.backend("zzz")


def test_suggests_an_option():
    with pytest.raises(BackendError, match="did you mean 'members'"):
        registry.backend("snpe-c", member=3)


def test_finds_backends_of_other_packages(monkeypatch):
    points = [
        EntryPoint("mine", "npdr_ppl.inference.snpe_c:SNPEC", registry.GROUP),
        EntryPoint("broken", "no_such_package.module:Class", registry.GROUP),
        EntryPoint("wrong", "npdr_ppl.errors:NpdrError", registry.GROUP),
        EntryPoint("snpe-c", "npdr_ppl.errors:NpdrError", registry.GROUP),
    ]
    monkeypatch.setattr("npdr_ppl.registry.entry_points", lambda group: points)
    assert isinstance(registry.backend("mine"), SNPEC)
    assert isinstance(registry.backend("snpe-c"), SNPEC)
    with pytest.raises(BackendError, match="cannot be loaded"):
        registry.backend("broken")
    with pytest.raises(BackendError, match="not a subclass"):
        registry.backend("wrong")
