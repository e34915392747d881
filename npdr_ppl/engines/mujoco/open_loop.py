"""Open loop in MuJoCo: recorded commands are replayed, in one native call if possible.

Action effects depend on commands only and sensor effects on measurements only. Commands can
therefore pass the action effects before the engine runs all steps in one call, and measurements
the sensor effects after it. Only force effects have to be evaluated between engine steps.
"""

import logging
import math
from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npdr_ppl.engines.common.alike import SameLaws, alike, same_laws
from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.commands import CommandRecord, command_records, commands_at
from npdr_ppl.engines.common.past_motion import PastMotion, past_motion
from npdr_ppl.engines.common.segment_start import after_past_commands, recorded_start, true_start
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.carrier_past import carrier_past
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.native import run_all_steps
from npdr_ppl.engines.mujoco.servo_past import with_recorded_past
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.language.inputs import Inputs

__all__ = ["CHUNK_BYTES", "replay"]

logger = logging.getLogger(__name__)

_DIVERGED: set[int] = set()
"""Hashes of robots' files of which a simulation has diverged in this process."""

CHUNK_BYTES = 1 << 28
"""Bound, in bytes, on the memory for commands and records of simulations that run together."""


def replay(simulator: MujocoMechanism, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
    """Simulates all parameters, segments and steps; see :meth:`Simulator.simulate`."""
    simulator.check_parameters(parameters)
    simulator.check_inputs(inputs)
    device, mask = inputs.actions.device, inputs.mask
    inputs = inputs.to(dtype=torch.float64, device="cpu")
    given = {
        name: torch.as_tensor(value).detach().to(dtype=torch.float64, device="cpu")
        for name, value in parameters.items()
    }
    batch_shape = torch.broadcast_shapes(
        inputs.batch_shape, *(value.shape for value in given.values())
    )
    shape = torch.Size((*batch_shape, inputs.num_segments))
    # The axis of the segments follows the axes of the batch.
    given = flatten({name: value[..., None] for name, value in given.items()}, shape)
    run = _Replay(simulator, given, inputs, shape)
    size, step = shape.numel(), run.chunk_size
    output = torch.empty(size, inputs.num_steps, len(simulator.sensors), dtype=torch.float64)
    for first in range(0, size, step):
        last = min(first + step, size)
        output[first:last] = run.chunk(first, last)
    output = output.reshape(*shape, *output.shape[1:]).to(device)
    if not bool(mask.all()):
        output = torch.where(mask[..., None], output, torch.zeros_like(output))
    num_lost = int(output.isnan().flatten(-2).any(-1).sum())
    if num_lost:
        # A search tries many parameters that do, and one warning says it.
        source = hash(str(simulator._source))
        is_said = source in _DIVERGED
        _DIVERGED.add(source)
        logger.log(
            logging.DEBUG if is_said else logging.WARNING,
            "%d of %d simulations of %s diverged; they are NaN from there on.%s",
            num_lost,
            size,
            simulator.name,
            "" if is_said else " Those that follow are not reported.",
        )
    return output


class _Replay:
    """Data that all chunks of a replay share.

    Args:
        simulator: The simulator.
        given: Given parameters, ``(N,)`` or numbers.
        inputs: The segments.
        shape: Shape of the batch and the segments, of numel N.
    """

    def __init__(
        self,
        simulator: MujocoMechanism,
        given: dict[str, Tensor],
        inputs: Inputs,
        shape: torch.Size,
    ) -> None:
        self.simulator, self.given = simulator, given
        self.inputs, self.shape = inputs, shape
        self.columns = [inputs.action_names.index(a.name) for a in simulator.actions]
        self.limits = [(a.lower, a.upper) for a in simulator.actions]
        self.start = recorded_start(simulator, inputs, shape)
        self.carriers = carrier_past(simulator, inputs, shape, self.start.states)
        self.commands, self.rows = self._commands(shape)
        self.histories = simulator.histories(given, inputs.time_step)

    @property
    def chunk_size(self) -> int:
        """Number of simulations that run together."""
        model = self.simulator.model
        num_steps = self.inputs.num_steps + self.carriers.num_steps
        num_steps *= self.simulator.num_substeps(self.inputs.time_step)
        width = 1 + model.nq + model.nv + model.nu + model.nsensordata
        return max(1, CHUNK_BYTES // (8 * width * (num_steps + 1)))

    def chunk(self, first: int, last: int) -> Tensor:
        """Returns the measurements of some of the simulations, ``(n, steps, sensors)``."""

        def part(value: Tensor) -> Tensor:
            return value[first:last] if value.ndim else value

        given = {name: part(value) for name, value in self.given.items()}
        recorded = self.start.part(first, last)
        step = self.inputs.time_step
        with quiet():
            middle = recorded.time + 0.5 * self.inputs.num_steps * step
            batch, tables = self.simulator.make_batch(given, last - first, step, middle)
            chain = MujocoStepper(self.simulator, batch, step, self.histories)
            records = self._records(chain, first, last)
            components, earlier = true_start(chain, tables, recorded, records)
            past = self._num_past(chain)
            chain.place(components)
            chain.begin()
            state = chain.start(
                components[: chain.num_positions],
                components[chain.num_positions :],
                tables,
                commands_at(records, -1 - past),
                recorded.readings,
                recorded.time,
                commands_before=partial(commands_at, records),
                num_past=past,
                past_motion=self._past_motion(chain).part(first, last),
                is_held=recorded.is_held,
                earlier=earlier,
            )
            servo_memory = with_recorded_past(
                self.simulator,
                self.inputs,
                self.shape,
                slice(first, last),
                tables,
                state.servo_memory,
            )
            state = state._replace(servo_memory=servo_memory)
            controls = self._controls(chain, state, tables, records, first, last)
            if self.simulator.second_joints:
                carriers = self.carriers.part(first, last)
                until = torch.from_numpy(controls[:, : carriers.num_steps + 1])
                carriers.replay(chain, state, tables, until, components, recorded.time)
                controls = controls[:, carriers.num_steps :]
                chain.begin()
            if chain.has_forces:
                return self._step_by_step(chain, state, tables, controls)
            true = run_all_steps(batch, controls, chain.substeps, self.simulator.readings)
        readings = torch.from_numpy(true)
        if not chain.sensors.effects:
            return readings
        # Written to a separate table, because effects keep references to true values.
        reported = torch.empty_like(readings)
        for k in range(self.inputs.num_steps):
            state, values = chain.sensors.report(state, readings[:, k].unbind(-1), tables)
            reported[:, k] = torch.stack(values, dim=-1)
        return reported

    def _commands(self, shape: torch.Size) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Returns limited commands, ``(rows, steps, actions)``, and the row of each simulation.

        There is one row per segment, which many simulations share. The steps begin with the past
        ones that carriers need.
        """
        actions = self.inputs.actions[..., self.columns]
        if num_past := self.carriers.num_steps:
            past = self.inputs.past_actions[..., -num_past:, self.columns]
            axes = torch.broadcast_shapes(past.shape[:-2], actions.shape[:-2])
            both = (value.expand(*axes, *value.shape[-2:]) for value in (past, actions))
            actions = torch.cat(tuple(both), dim=-2)
        lower, upper = torch.tensor(self.limits, dtype=torch.float64).reshape(-1, 2).unbind(-1)
        commands = actions.clamp(lower, upper).numpy()
        segments, num_rows = commands.shape[:-2], math.prod(commands.shape[:-2])
        rows = np.broadcast_to(np.arange(num_rows).reshape(segments), shape).reshape(-1)
        return commands.reshape(num_rows, *commands.shape[-2:]), rows

    def _num_past(self, chain: MujocoStepper) -> int:
        """Returns from how many past commands the action effects' states are computed."""
        recorded = self.inputs.past_actions.shape[-2]
        return max(chain.actions.num_past_steps(recorded), self.carriers.num_steps)

    def _records(self, chain: MujocoStepper, first: int, last: int) -> tuple[CommandRecord, ...]:
        """Returns the commands of each action channel, if an effect needs them."""
        if not (chain.actions.effects or chain.sensors.effects):
            return ()
        kept = chain.actions.num_kept_steps(self.inputs.past_actions.shape[-2])
        kept = max(kept, self.carriers.num_steps)
        records = command_records(self.simulator, self.inputs, self.shape, torch.float64, kept)
        return tuple(record.part(first, last) for record in records)

    def _past_motion(self, chain: MujocoStepper) -> PastMotion:
        """Returns the motion of the joints at which a force needs it."""
        channels = chain.channels_with_past
        return past_motion(self.inputs, channels, self.shape, torch.float64)

    def _controls(
        self,
        chain: MujocoStepper,
        state: State,
        tables: Tables,
        records: tuple[CommandRecord, ...],
        first: int,
        last: int,
    ) -> NDArray[np.float64]:
        """Returns actions after all effects, ``(n, steps, engine steps per step, actions)``.

        Without action effects, the third axis has size 1. The steps begin with the past ones that
        carriers need.
        """
        controls = self.commands[self.rows[first:last], :, None]
        if not chain.actions.effects:
            return controls
        controls = np.repeat(controls, chain.substeps, axis=2)
        past = self._num_past(chain)
        for same in same_laws(chain.actions, state, tables, records):
            acted = self._acted(same, chain.substeps, past, controls.shape[1])
            for channel, own in zip(same.channels, acted, strict=True):
                controls[..., channel] = own
        return controls

    def _acted(
        self, same: SameLaws, substeps: int, past: int, num_steps: int
    ) -> NDArray[np.float64]:
        """Returns the actions of channels with the same laws, ``(channels, n, steps, parts)``.

        Args:
            same: The channels.
            substeps: Engine steps per step, the parts.
            past: Number of past commands from which the effects' states are computed.
            num_steps: Number of steps.
        """
        few = alike(same.actions, same.state, same.tables, same.records)
        num_before = self.carriers.num_steps
        state = after_past_commands(
            same.actions, few.state, few.tables, few.records, past, until=-num_before
        )
        acted = np.empty((len(few.first), num_steps, substeps))
        for k in range(num_steps):
            state, reached, moments = same.actions.act_on_record(
                state, few.records, k - num_before, few.tables
            )
            means, _ = same.actions.by_substep((reached[0],), (moments.get(0),), substeps)
            for part, (mean,) in enumerate(means):
                acted[:, k, part] = mean.numpy()
        return acted[few.kind.numpy()].reshape(len(same.channels), -1, num_steps, substeps)

    def _step_by_step(
        self,
        chain: MujocoStepper,
        state: State,
        tables: Tables,
        controls: NDArray[np.float64],
    ) -> Tensor:
        """Runs the steps one by one."""
        steps = []
        for k in range(self.inputs.num_steps):
            actions = [part.unbind(-1) for part in torch.from_numpy(controls[:, k]).unbind(1)]
            state = chain.follow(state, actions, tables)
            state, readings = chain.read(state, tables)
            steps.append(torch.stack(readings, dim=-1))
        return torch.stack(steps, dim=1)
