"""Effects with memory in compiled time loops."""

import pytest
import torch

from npdr_ppl.engines.common.compilation import has_compiler
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.models.effects import (
    ActuatorLag,
    Backlash,
    InputDelay,
    ParameterDrift,
    Payload,
    SensorDelay,
)
from npdr_ppl.models.pendulum import Pendulum


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore:The .grad attribute:UserWarning"
)  # torch's compiler, of itself
@pytest.mark.skipif(not has_compiler("cpu"), reason="needs a C++ compiler")
@pytest.mark.usefixtures("short_kernels")
def test_effects_with_memory_compile():
    attached = (
        SensorDelay("velocity"),
        Backlash("hinge"),
        ParameterDrift("mass"),
        Payload("payload"),
        ActuatorLag("torque"),
        InputDelay("torque"),
    )
    inputs = Inputs.single(
        3.0 * torch.sin(torch.arange(30.0, dtype=torch.float64))[:, None],
        torch.tensor([0.5, 1.0], dtype=torch.float64),
        action_names=("torque",),
        state_names=("angle", "velocity"),
        time_step=Pendulum.time_step,
    )
    given = {"length": torch.tensor([0.8, 1.1]).double()}
    for effect in attached:
        given |= {
            f"{effect.name}.{name}": torch.tensor(value).double()
            for name, value in effect.probe(Pendulum().port(effect.port)).items()
        }
    eager, fast = (
        Pendulum(compile=mode).with_effects(*attached).simulate(given, inputs)
        for mode in ("never", "always")
    )
    torch.testing.assert_close(fast, eager, rtol=1e-8, atol=1e-9)
