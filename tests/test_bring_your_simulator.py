"""The page on simulators: its snippets run as printed, one after the other, and simulate."""

import re
from pathlib import Path

import pyro
import pytest
import torch

import npdr_ppl as npdr
from npdr_ppl.language.inputs import Inputs

PAGE = Path(__file__).parents[1] / "docs" / "bring_your_simulator.md"

pytest.importorskip("gymnasium", reason="needs the extra `gymnasium`")


@pytest.fixture(scope="module")
def scope(tmp_path_factory):
    """The names that the page's snippets define, next to the files that it shows."""
    folder = tmp_path_factory.mktemp("page")
    text = PAGE.read_text()
    for name, content in re.findall(r"```xml\n<!-- (\S+) -->\n(.*?)```", text, re.DOTALL):
        (folder / name).write_text(content)
    names: dict[str, object] = {"__name__": "page"}
    with pytest.MonkeyPatch.context() as patch, npdr.workers("serial"):
        patch.chdir(folder)
        for snippet in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(snippet, str(PAGE), "exec"), names)
        yield names


def inputs(simulator, num_steps=5):
    # Different ones, because equal thrusts do not turn a quadrotor.
    actions = 0.4 + 0.1 * torch.arange(len(simulator.actions), dtype=torch.float64)
    return Inputs.single(
        actions.expand(num_steps, -1),
        torch.full((len(simulator.states),), 0.3, dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=tuple(state.name for state in simulator.states),
        time_step=simulator.time_step,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["arm", "lever", "falling", "pendulum", "quadrotor", "cart_pole", "swinging"]
)
def test_every_simulator_of_the_page_depends_on_its_parameters(scope, name):
    simulator = scope[name]
    given = inputs(simulator, num_steps=60)
    for parameter in simulator.parameters:
        values = parameter.nominal + torch.tensor([0.0, 0.1], dtype=torch.float64)
        found = simulator.simulate({parameter.name: values}, given)
        assert bool(found.isfinite().all())
        assert not torch.equal(found[0], found[1]), parameter


def test_the_model_is_a_pyro_model(scope):
    trace = pyro.poutine.trace(scope["model"]).get_trace(inputs(scope["arm"]))
    assert trace.nodes["trajectory"]["value"].shape == (1, 5, 4)
    assert scope["arm"].parameters[0].unit == "kg"


def test_the_throw_is_found(scope):
    draws = scope["posterior"].sample(500, seed=0)
    landing = scope["throw"](draws["speed"], draws["angle"]).mean(0)
    torch.testing.assert_close(landing, torch.tensor([4.1, 1.2]).to(landing), rtol=0.1, atol=0.1)


def test_the_tank_is_filled_and_held(scope):
    assert scope["levels"].shape == (3, 1, 20, 1)
    # Inflow 0.2 (1 − h) and outflow 0.03 √h balance where h = 0.867.
    assert float(scope["episodes"].readings[-1]) == pytest.approx(0.867, abs=0.01)


def test_lines_of_the_page_are_short():
    for line in PAGE.read_text().splitlines():
        assert len(line) <= 100, line
