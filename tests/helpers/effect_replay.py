"""Commands replayed on simple systems, for comparing effects with closed forms."""

from dataclasses import replace

import torch

from npdr_ppl.language.inputs import Inputs

# A mass of 1 kg on a frictionless rail, pushed by 1 N per volt.
FREE = {"mass": 1.0, "viscous_friction": 0.0, "drive_gain": 1.0}


def replay(simulator, parameters, actions, start=None, step=0, past_actions=None, time_step=None):
    """Readings of one segment, (steps, sensors), from a state at a step of its rollout."""
    actions = torch.as_tensor(actions, dtype=torch.float64)
    names = tuple(state.name for state in simulator.states)
    inputs = Inputs.single(
        actions[:, None],
        torch.tensor(start or [0.0] * len(names), dtype=torch.float64),
        action_names=tuple(action.name for action in simulator.actions),
        state_names=names,
        time_step=time_step or simulator.time_step,
    )
    inputs = replace(inputs, start=torch.tensor([step]))
    if past_actions is not None:
        inputs = replace(inputs, past_actions=past_actions)
    given = {
        name: torch.as_tensor(value, dtype=torch.float64) for name, value in parameters.items()
    }
    return simulator.simulate(given, inputs)[0]
