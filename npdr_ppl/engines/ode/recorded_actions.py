"""Open loop: recorded commands are replayed from the initial states of the segments."""

from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.commands import (
    CommandRecord,
    RecordedCommands,
    command_records,
    commands_at,
)
from npdr_ppl.engines.common.compilation import (
    compiled,
    is_worthwhile,
    mark_sizes_dynamic,
    steps_per_call,
    with_fallback,
)
from npdr_ppl.engines.common.integrators import Components
from npdr_ppl.engines.common.past_motion import past_motion
from npdr_ppl.engines.common.segment_start import recorded_start, true_start, with_past_commands
from npdr_ppl.engines.ode.mechanical_system import MechanicalSystem
from npdr_ppl.engines.ode.stepping import Stepper
from npdr_ppl.errors import ShapeError
from npdr_ppl.language.inputs import Inputs

__all__ = ["replay"]


def replay(
    simulator: MechanicalSystem, parameters: Mapping[str, Tensor], inputs: Inputs
) -> Tensor:
    """Simulates all parameters, segments and steps; see :meth:`Simulator.simulate`."""
    simulator.check_parameters(parameters)
    simulator.check_inputs(inputs)
    device = inputs.actions.device
    dtype = simulator.common_dtype(parameters, inputs.actions)
    inputs = inputs.to(dtype=dtype)
    domain = simulator.complete(parameters, dtype, device)
    batch_shape = torch.broadcast_shapes(
        inputs.batch_shape, *(value.shape for value in domain.values())
    )
    shape = torch.Size((*batch_shape, inputs.num_segments))
    # The axis of the segments follows the axes of the batch.
    domain = {name: value[..., None] for name, value in domain.items()}
    begin = inputs.start.to(device=device, dtype=dtype) * inputs.time_step
    domain = simulator.changed(domain, begin + 0.5 * inputs.num_steps * inputs.time_step)
    is_compiled = is_worthwhile(
        simulator.compile, device, num_steps=inputs.num_steps, batch_size=shape.numel()
    )

    def run(is_compiled: bool) -> Tensor:
        return _replay(simulator, domain, inputs, shape, dtype, is_compiled)

    trajectory = with_fallback(simulator.compile, is_compiled, run)
    if bool(inputs.mask.all()):
        return trajectory
    return torch.where(inputs.mask[..., None], trajectory, torch.zeros_like(trajectory))


def _replay(
    simulator: MechanicalSystem,
    domain: Mapping[str, Tensor],
    inputs: Inputs,
    shape: torch.Size,
    dtype: torch.dtype,
    is_compiled: bool,
) -> Tensor:
    """Returns all trajectories, ``shape + (steps, sensors)``, including padded steps."""
    tables, histories = simulator.tables(domain, shape, inputs.time_step, expand=is_compiled)
    body = _Body(Stepper(simulator, inputs.time_step, histories))
    kept = body.stepper.actions.num_kept_steps(inputs.past_actions.shape[-2])
    records = command_records(simulator, inputs, shape, dtype, kept)
    readings: list[Tensor] = []
    given = tables, [vars(part) for part in (inputs, *records)]
    has_gradient = any(
        isinstance(leaf, Tensor) and leaf.requires_grad for leaf in pytree.tree_leaves(given)
    )

    def run_eagerly(state: State, first: int, last: int) -> State:
        for step in range(first, last):
            commands = commands_at(records, step)
            state, values = body.step(state, tables, commands, _views(records, step))
            readings.extend(values)
        return state

    if not is_compiled:
        # If no gradients are needed, not recording them saves a seventh of the time of a step.
        with torch.inference_mode(not has_gradient):
            run_eagerly(_start(body, tables, inputs, records, shape), 0, inputs.num_steps)
        return _joined(readings, shape, inputs.num_steps)
    state = _start(body, tables, inputs, records, shape)
    at_once = steps_per_call(num_steps=inputs.num_steps, batch_size=shape.numel())
    # The first state would need its own kernel. In later states, a filter's memory is the same
    # tensor as the last measurement, and tensors may have gradients.
    first = min(at_once, inputs.num_steps)
    last = inputs.num_steps - (inputs.num_steps - first) % at_once
    state = run_eagerly(state, 0, first)
    state = _run_compiled(body, state, tables, records, range(first, last, at_once), readings)
    run_eagerly(state, last, inputs.num_steps)
    return _joined(readings, shape, inputs.num_steps)


def _joined(readings: list[Tensor], shape: torch.Size, num_steps: int) -> Tensor:
    """Stacks measurements listed by step, then sensor, into ``shape + (steps, sensors)``."""
    return torch.stack(readings, dim=-1).reshape(*shape, num_steps, -1)


_View = tuple[Tensor, Tensor, Tensor | int, Tensor | int]
"""Table, rows, time and stride of a record; see :class:`RecordedCommands`."""


class _Body:
    """The loop's body, which does not change after the first step."""

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper

    def step(
        self, state: State, tables: Tables, commands: Components, views: tuple[_View, ...]
    ) -> tuple[State, Components]:
        """Advances the state by one step and reads the sensors."""
        records = tuple(
            RecordedCommands(command, *view)
            for command, view in zip(commands, views, strict=bool(views))
        )
        state = self.stepper.advance(state, commands, tables, records)
        return self.stepper.read(state, tables)

    def run(
        self,
        state: State,
        tables: Tables,
        commands: tuple[Components, ...],
        views: tuple[_View, ...],
    ) -> tuple[State, Components]:
        """Advances the state by as many steps as there are commands."""
        readings: list[Tensor] = []
        for k, present in enumerate(commands):
            later = tuple((table, rows, time + k, stride) for table, rows, time, stride in views)
            state, values = self.step(state, tables, present, later)
            readings.extend(values)
        return state, tuple(readings)


def _views(records: tuple[CommandRecord, ...], step: int) -> tuple[_View, ...]:
    return tuple((r.table, r.rows, r.first + step, r.stride) for r in records)


def _run_compiled(
    body: _Body,
    state: State,
    tables: Tables,
    records: tuple[CommandRecord, ...],
    steps: range,
    readings: list[Tensor],
) -> State:
    """Runs the compiled body, ``steps.step`` steps per call, and appends the measurements."""
    position = state.positions[0]
    key = "replay", body.stepper.signature, position.dtype, position.device.type
    run = compiled(key, body.run)
    state = flatten(state, position.shape, expand=True)

    for step in steps:
        commands = tuple(
            tuple(record.at(k).contiguous() for record in records)
            for k in range(step, step + steps.step)
        )
        # Tensors, because numbers would become constants of the compiled code. They are needed
        # for action effects only.
        views = tuple(
            (table, rows, torch.as_tensor(time), torch.as_tensor(stride))
            for table, rows, time, stride in _views(records, step)
            if body.stepper.actions.effects
        )
        mark_sizes_dynamic((state, tables, commands, views))
        state, values = run(state, tables, commands, views)
        readings.extend(values)
    return state


def _start(
    body: _Body,
    tables: Tables,
    inputs: Inputs,
    records: tuple[CommandRecord, ...],
    shape: torch.Size,
) -> State:
    """Returns the state at the start of the segments, including the effects' memory."""
    stepper = body.stepper
    simulator = stepper.simulator
    recorded = recorded_start(simulator, inputs, shape)
    num_joints = len(simulator.joints)
    if len(recorded.states) != 2 * num_joints:
        raise ShapeError(
            f"{simulator.name} has {num_joints} joints, so it should declare {2 * num_joints} "
            f"states, got {len(recorded.states)}."
        )
    past = stepper.actions.num_past_steps(inputs.past_actions.shape[-2])
    true = true_start(stepper, tables, recorded, records)
    state = stepper.start(
        true.states[:num_joints],
        true.states[num_joints:],
        tables,
        commands_at(records, -1 - past),
        recorded.readings,
        recorded.time,
        commands_before=partial(commands_at, records),
        num_past=past,
        past_motion=past_motion(inputs, stepper.channels_with_past, shape, recorded.time.dtype),
        is_held=recorded.is_held,
        earlier=true.earlier,
    )
    return with_past_commands(stepper, state, tables, records, past)
