"""The loop of policy and simulator in one process, with reward and termination."""

import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.chain_state import State, Tables
from npdr_ppl.engines.common.compilation import (
    compiled,
    mark_sizes_dynamic,
    signature,
)
from npdr_ppl.engines.common.effect_chain import EffectChain
from npdr_ppl.engines.common.episodes import Episodes, FeedbackPolicy, Reward
from npdr_ppl.engines.common.integrators import Components

__all__ = ["LoopBody", "PolicyLoop", "begin", "run_compiled", "run_eagerly"]

# Number of simulations in a block. A compiled kernel runs one block through the whole episode
# before the next block, which limits memory. Measurements show that larger blocks are faster up to
# this size, because each call costs 50 µs.
_BLOCK = 1 << 16


class PolicyLoop(NamedTuple):
    """State of the loop between two steps."""

    state: State
    readings: Components
    policy_memory: Any
    is_running: Tensor
    total: Tensor
    length: Tensor


class LoopBody:
    """The loop's body, which does not change after the first step.

    Args:
        stepper: Advances the state.
        policy: The policy.
        reward: Reward of a step, if any.
        steps_per_call: Number of steps per call of :meth:`run`.
    """

    def __init__(
        self,
        stepper: EffectChain,
        policy: FeedbackPolicy,
        reward: Reward | None,
        steps_per_call: int = 1,
    ) -> None:
        simulator = stepper.simulator
        self.stepper, self.steps_per_call = stepper, steps_per_call
        # Parameters and their defaults are removed, so a compiled body cannot keep old ones by
        # mistake.
        self.policy = copy.copy(policy)
        del self.policy.parameters
        vars(self.policy).pop("parameter_info", None)
        self.reward = reward
        sensors = [sensor.name for sensor in simulator.sensors]
        self.observed = tuple(sensors.index(name) for name in policy.observations)
        self.order = tuple(policy.actions.index(action.name) for action in simulator.actions)
        self.limits = tuple((action.lower, action.upper) for action in simulator.actions)
        self.bounds = tuple((state.lower, state.upper) for state in simulator.states)

    @property
    def signature(self) -> Any:
        """Equal for bodies that compile to the same code."""
        parts = signature(self.policy), signature(self.reward), self.steps_per_call
        return "roll_out", self.stepper.signature, *parts

    def step(
        self, loop: PolicyLoop, tables: Tables, policy_constants: Any, time: Tensor | float
    ) -> tuple[PolicyLoop, Components]:
        """Advances the loop by one step; also returns the commands before any limit."""
        state, stepper = loop.state, self.stepper
        observation = tuple(loop.readings[i] for i in self.observed)
        chosen, memory = self.policy.act(observation, time, loop.policy_memory, policy_constants)
        commands = tuple(chosen[i] for i in self.order)
        limited = tuple(
            command.clamp(*limit) for command, limit in zip(commands, self.limits, strict=True)
        )
        total = loop.total
        if self.reward is not None:
            reward = self.reward(state.positions, state.velocities, commands)
            total = torch.where(loop.is_running, total + reward, total)
        length = torch.where(loop.is_running, loop.length + 1.0, loop.length)
        state = stepper.advance(state, limited, tables)
        state, readings = stepper.read(state, tables)
        is_running = loop.is_running
        for value, (lower, upper) in zip(
            (*state.positions, *state.velocities), self.bounds, strict=True
        ):
            # These comparisons are false for NaN, so NaN counts as outside the bounds.
            if lower == -upper:
                is_running = is_running & (value.abs() <= upper)
            else:
                is_running = is_running & (value >= lower) & (value <= upper)
        return PolicyLoop(state, readings, memory, is_running, total, length), commands

    def run(
        self, loop: PolicyLoop, tables: Tables, policy_constants: Any, start: Tensor
    ) -> PolicyLoop:
        """Advances the loop by ``steps_per_call`` steps from a time in seconds."""
        for step in range(self.steps_per_call):
            time = start + step * self.stepper.time_step
            loop, _ = self.step(loop, tables, policy_constants, time)
        return loop


def begin(body: LoopBody, states: Components, tables: Tables, constants: Any) -> PolicyLoop:
    """Returns the loop before its first step.

    Commands in the past are zero, but servos hold their first goals, as in recordings.

    Args:
        body: The loop's body.
        states: Initial states, ``(N,)`` each.
        tables: Constants of the simulation.
        constants: Constants of the policy.
    """
    zero = torch.zeros_like(states[0])
    simulator, num_positions = body.stepper.simulator, body.stepper.num_positions
    positions, velocities = states[:num_positions], states[num_positions:]
    no_readings = (None,) * len(simulator.sensors)
    readings = body.stepper.true_readings(positions, velocities, tables)
    observed = tuple(readings[i] for i in body.observed)
    memory = body.policy.initial_memory(observed)
    before = [zero] * len(simulator.actions)
    goals = [k for k, action in enumerate(simulator.actions) if simulator.is_goal(action.name)]
    if goals:
        chosen, _ = body.policy.act(observed, 0.0, memory, constants)
        for k in goals:
            lower, upper = body.limits[k]
            before[k] = chosen[body.order[k]].clamp(lower, upper).expand_as(zero)
    is_held = zero == 0.0
    for velocity in velocities:
        is_held = is_held & (velocity == 0.0)
    state = body.stepper.start(
        positions, velocities, tables, tuple(before), no_readings, zero, is_held=is_held
    )
    return PolicyLoop(state, readings, memory, torch.ones_like(zero, dtype=torch.bool), zero, zero)


def run_eagerly(
    body: LoopBody,
    loop: PolicyLoop,
    tables: Tables,
    constants: Any,
    num_steps: int,
    shape: torch.Size,
    record: bool,
) -> Episodes:
    """Runs all steps one by one, and records them if ``record`` is true."""
    readings, commands = [loop.readings], []
    for k in range(num_steps):
        loop, chosen = body.step(loop, tables, constants, k * body.stepper.time_step)
        if record:
            readings.append(loop.readings)
            commands.append(tuple(c.expand_as(loop.length) for c in chosen))
    if not record:
        return _episodes(loop, shape, body.reward)
    return _episodes(loop, shape, body.reward, readings, commands)


def run_compiled(
    body: LoopBody,
    loop: PolicyLoop,
    tables: Tables,
    constants: Any,
    num_steps: int,
    shape: torch.Size,
) -> Episodes:
    """Runs all steps block by block; remaining steps that do not fill a call run eagerly."""
    loop = flatten(loop, loop.total.shape, expand=True)
    key = body.signature, loop.total.dtype, loop.total.device.type
    run, at_once = compiled(key, body.run), body.steps_per_call
    num_simulations = loop.total.shape[0]
    num_blocks = -(-num_simulations // _BLOCK)
    edges = [i * num_simulations // num_blocks for i in range(num_blocks + 1)]
    num_calls = num_steps // at_once
    time_step = body.stepper.time_step
    starts = torch.arange(num_calls, dtype=loop.total.dtype, device=loop.total.device)
    starts = (starts * (at_once * time_step)).unbind()
    done = []
    for first, last in zip(edges, edges[1:], strict=False):

        def block(x: Tensor, first: int = first, last: int = last) -> Tensor:
            return x[first:last]

        part, block_tables, block_constants = pytree.tree_map_only(
            Tensor, block, (loop, tables, constants)
        )
        # The first call is eager. After it, a tensor may occur twice among the arguments, e.g. as
        # a rate and as a filter's memory of it. Torch would compile both cases separately.
        for start in starts[:1]:
            part = body.run(part, block_tables, block_constants, start)
        mark_sizes_dynamic((part, block_tables, block_constants))
        for start in starts[1:]:
            part = run(part, block_tables, block_constants, start)
        for k in range(num_calls * at_once, num_steps):
            part, _ = body.step(part, block_tables, block_constants, k * time_step)
        done.append(part)
    loop = loop._replace(
        total=torch.cat([part.total for part in done]),
        length=torch.cat([part.length for part in done]),
    )
    return _episodes(loop, shape, body.reward)


def _episodes(
    loop: PolicyLoop,
    shape: torch.Size,
    reward: Reward | None,
    readings: list[Components] | None = None,
    commands: list[Components] | None = None,
) -> Episodes:
    """Returns the loop's results in the batch's shape."""
    returns = None if reward is None else loop.total.reshape(shape)
    lengths = loop.length.long().reshape(shape)
    if readings is None or commands is None:
        return Episodes(returns, lengths)

    def stacked(steps: list[Components], last: Tensor) -> Tensor:
        table = torch.stack([torch.stack(step, dim=-1) for step in steps], dim=-2)
        exists = torch.arange(len(steps), device=table.device) <= last[:, None]
        table = torch.where(exists[..., None], table, torch.zeros_like(table))
        return table.reshape(*shape, *table.shape[-2:])

    return Episodes(
        returns, lengths, stacked(readings, loop.length), stacked(commands, loop.length - 1.0)
    )
