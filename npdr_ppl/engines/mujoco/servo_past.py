"""States of servos at the start of segments: what they summed up in the recorded past."""

from collections.abc import Sequence

import torch
from torch import Tensor

from npdr_ppl.engines.common.chain_state import Tables
from npdr_ppl.engines.mujoco.fields import actuated_joint
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.language.inputs import Inputs

__all__ = ["with_recorded_past"]


def with_recorded_past(
    simulator: MujocoMechanism,
    inputs: Inputs,
    shape: Sequence[int],
    chunk: slice,
    tables: Tables,
    memory: tuple[Tensor | None, ...],
) -> tuple[Tensor | None, ...]:
    """Returns the own states of servo effects at the start of segments.

    The first effect of a servo gets its error in every step since the rollout began: the recorded
    goal minus the mean of the measured positions before and after the step. A later effect gets
    the error that the one before it gives. Without a record, or if the joint's position was not
    measured, states stay those of a rollout's beginning.

    Args:
        simulator: The simulator with its effects.
        inputs: The segments.
        shape: Shape of the batch and the segments, of numel N.
        chunk: The simulations of these N that are computed, n.
        tables: Parameters of the effects, ``(n,)`` or numbers.
        memory: Own state of each servo effect as a rollout begins, ``(n,)``; ``None`` for effects
            without a state.
    """
    effects = simulator.servo_effects
    if inputs.recorded_actions is None or all(own is None for own in memory):
        return memory
    rollout, start = (
        value.expand(*shape).reshape(-1)[chunk] for value in (inputs.rollout, inputs.start)
    )
    with_state = {a for (*_, a), own in zip(effects, memory, strict=True) if own is not None}
    found = {actuator: _errors(simulator, inputs, actuator) for actuator in with_state}
    known = {actuator: errors for actuator, errors in found.items() if errors is not None}
    states = list(memory)
    for step in range(int(start.max()) if known else 0):
        present = {actuator: errors[step][rollout] for actuator, errors in known.items()}
        for number, (place, effect, actuator) in enumerate(effects):
            if actuator not in known:
                continue
            error, values, own = present[actuator], tables.effects[place], states[number]
            middle = effect.next_memory(error, values, own, 0.5 * inputs.time_step)
            present[actuator] = effect.act(error, values, middle)
            later = effect.next_memory(error, values, own, inputs.time_step)
            if own is not None and later is not None:
                states[number] = torch.where(step < start, later, own)
    return tuple(states)


def _errors(simulator: MujocoMechanism, inputs: Inputs, actuator: int) -> Tensor | None:
    """Returns a position servo's recorded errors, ``(T, R)``, zero where nothing was measured."""
    joint = actuated_joint(simulator.model, actuator)
    address = None if joint is None else int(simulator.model.jnt_qposadr[joint])
    names = [
        component.channel.name
        for component in simulator.components
        if not component.is_velocity and component.address == address
    ]
    action = simulator.actions[actuator]
    known = [name for name in names if name in inputs.channel_names]
    if inputs.recorded_actions is None or inputs.recorded_readings is None or not known:
        return None
    position = inputs.recorded_readings[..., inputs.channel_names.index(known[0])]
    goal = inputs.recorded_actions[..., inputs.action_names.index(action.name)]
    later = torch.cat((position[:, 1:], position[:, -1:]), dim=1)
    errors = goal.clamp(action.lower, action.upper) - 0.5 * (position + later)
    return errors.nan_to_num(0.0).T.contiguous()
