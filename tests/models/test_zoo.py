"""The registry of the zoo and of the effects."""

import subprocess
import sys

import pytest

from npdr_ppl.language.effects import Effect
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.models import zoo
from npdr_ppl.models.effects import effects


@pytest.mark.parametrize("name", zoo())
def test_entries_resolve(name):
    entry = zoo()[name]
    assert entry.name == name
    assert callable(entry.model)
    assert issubclass(entry.simulator, Simulator)
    assert entry.summary


@pytest.mark.parametrize("name", zoo())
def test_declarations_are_complete(name):
    simulator = zoo()[name].simulator()
    names = [channel.name for channel in simulator.states]
    for channel in simulator.states:
        assert channel.unit
        assert channel.rate_of is None or channel.rate_of in names
    assert all(port.rated > 0.0 and port.unit for port in simulator.ports)
    assert {a.name for a in simulator.actions} <= {p.name for p in simulator.ports}


@pytest.mark.parametrize("name", effects())
def test_effects_declare_units_and_a_priors_for_every_parameter(name):
    effect = effects()[name]
    assert issubclass(effect, Effect)
    assert effect.id == name
    assert effect.__doc__
    assert all(parameter.unit and parameter.description for parameter in effect.parameters)


@pytest.mark.slow
def test_importing_the_zoo_imports_no_engine():
    code = "import sys, npdr_ppl.models; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
