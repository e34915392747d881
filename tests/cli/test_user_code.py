"""Models and simulators that are wrong get one sentence and exit code 2."""

import sys

import numpy as np
import pytest

from npdr_ppl.cli import main
from npdr_ppl.rollouts import Rollouts
from tests.helpers.command_line import run

MODELS = """
import sys
import pyro
import pyro.distributions as dist
import torch
import npdr_ppl as npdr
from npdr_ppl.models.pendulum import Pendulum


class Exits(Pendulum):
    def simulate(self, *arguments):
        sys.exit(3)


class Complex(Pendulum):
    def simulate(self, *arguments):
        return super().simulate(*arguments).to(torch.complex128)


def model_of(simulator, prior):
    def model(inputs):
        mass = pyro.sample("mass", prior())
        return npdr.simulate("trajectory", simulator, {"mass": mass}, inputs)
    return model


ends = model_of(Exits(), lambda: dist.Uniform(1.0, 2.0))
complex_numbers = model_of(Complex(), lambda: dist.Uniform(1.0, 2.0))
empty = model_of(Pendulum(), lambda: dist.Uniform(2.0, 1.0))
negative = model_of(Pendulum(), lambda: dist.Normal(0.0, -1.0))
unknown = model_of(Pendulum(), lambda: dist.LogNormal(0.0, float("nan")))
"""

SENTENCES = {
    "ends": "ended the program by sys.exit(3).",
    "complex_numbers": "Complex returned complex numbers.",
    "empty": "Site 'mass' has no valid Uniform",
    "negative": "Site 'mass' has no valid Normal",
    "unknown": "Site 'mass' has no valid Normal",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SENTENCES)
def test_a_wrong_model_gets_one_sentence(name, tmp_path, monkeypatch, capsys):
    (tmp_path / "models.py").write_text(MODELS)
    angle = 0.3 * np.cos(0.06 * np.arange(61))
    Rollouts.from_arrays(
        [np.stack([angle, np.gradient(angle, 0.02)], 1)],
        [np.zeros((60, 1))],
        channel_names=("angle", "velocity"),
        action_names=("torque",),
        time_step=0.02,
    ).to_csv(tmp_path / "data.csv")
    model, out = f"{tmp_path}/models.py:{name}", tmp_path / "out"
    code, _, err = run(
        monkeypatch, capsys, "fit", model, "--data", tmp_path / "data.csv", "--out", out, "--quiet"
    )
    assert code == 2
    assert err.startswith("npdr: ") and err.count("\n") == 1
    assert SENTENCES[name] in err


def test_an_error_of_several_lines_in_a_model_file_is_one_sentence(tmp_path, monkeypatch, capsys):
    file = tmp_path / "models.py"
    file.write_text("import torch\ntorch.distributions.Normal(0.0, -1.0, validate_args=True)")
    (tmp_path / "data.csv").write_text("rollout,time,angle\n0,0,1\n0,0.1,1\n")
    data, out = tmp_path / "data.csv", tmp_path / "out"
    code, _, err = run(monkeypatch, capsys, "fit", f"{file}:m", "--data", data, "--out", out)
    assert code == 2
    assert err.startswith("npdr: ") and err.count("\n") == 1 and "GreaterThan" in err


def test_a_pipe_that_is_closed_early_is_no_fault_of_the_model(monkeypatch, capsys):
    def printing(**_):
        try:
            raise BrokenPipeError
        except BrokenPipeError:
            sys.exit(1)  # as click does

    monkeypatch.setattr(main, "app", printing)
    monkeypatch.setattr(sys, "argv", ["npdr", "effects"])
    with pytest.raises(SystemExit) as stopped:
        main._run()
    assert stopped.value.code == 1
    assert capsys.readouterr().err == ""
