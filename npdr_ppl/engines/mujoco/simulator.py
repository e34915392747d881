"""Simulation of any MJCF file in MuJoCo, many parameter sets and segments at a time."""

import copy
import importlib
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor

from npdr_ppl.engines.common.batching import flatten
from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.common.policy_loop import LoopBody, begin, run_eagerly
from npdr_ppl.engines.mujoco.batches import quiet
from npdr_ppl.engines.mujoco.damping import fastest_damping
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mujoco_linear_dynamics import bound_inverse_dynamics
from npdr_ppl.engines.mujoco.open_loop import replay
from npdr_ppl.engines.mujoco.stepper import MujocoStepper
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_dynamics import InverseDynamics

__all__ = ["MujocoSimulator"]

_FINER = 2
"""How many times as many steps :meth:`MujocoSimulator.with_finer_steps` takes once the order is
four. Forces of effects are constant over an engine step of any order, so only shorter steps make
them more accurate."""

_FINER_IF_STIFF = 4
"""Greatest factor on the number of steps with which the order becomes four, and the factor where
even these steps would be unstable."""

_MOST_DAMPED = 2.5
"""Rate of the fastest damping, per engine step, up to which steps of order four are used. They are
stable up to 2.8; an arm's inertia changes as it moves."""


_COARSER = 2
"""How many times fewer steps :meth:`MujocoSimulator.with_coarser_steps` takes where the file's own
are several per sample. In 20 s of the SO-101's ``friction_gravity`` at 50 Hz, steps of 4 ms in
place of 2 ms change derivatives of positions by 0.8 % (median of 29 parameters; 10 % at most), and
steps of order four change them as much."""

_MANY_STEPS = 4
"""Number of engine steps per sample from which half of them are enough for derivatives."""


class MujocoSimulator(MujocoMechanism):
    """Any MJCF file as a simulator; channels, nominal values and ports are read from it.

    States are by default the position and the velocity of every hinge and slide, ``elbow`` and
    ``elbow_velocity``; see :func:`~npdr_ppl.engines.mujoco.channels.state_components` for other
    joints. Actions are the actuators with their control ranges, in the file's order. Forces of
    effects are constant over an engine step. Dry friction is the engine's own friction loss, the
    set-valued law solved with all other constraints. If the file has no friction loss, it is made
    as hard as the engine allows. A simulation that diverges is NaN from then on.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel``, which is not changed.
        parameters: The target of each domain parameter, by its name: a field such as
            ``"body hand mass"``, several fields of equal value, a
            :class:`~npdr_ppl.engines.mujoco.parameters.Scale`, or a
            :class:`~npdr_ppl.language.channels.Parameter` that sets nothing by itself.
        derived: Fields that are functions of all parameters, by the field's name.
        states: Names of the states to keep, or new names mapped to the default ones. Other
            components have the initial values of the file, or of ``keyframe``.
        sensors: Names of states or of the file's sensor elements to report, or new names mapped
            to those; ``None`` for the states. Sensors of accelerations and forces report the
            values of the last engine step.
        units: Units of channels that the file does not specify, by channel.
        bounds: Least and greatest values of states, by channel; episodes end beyond them.
        time_step: Seconds per step; ``None`` for ``substeps`` times the file's time step.
        substeps: Engine steps per step; ``None`` to compute it from the file's time step.
        num_threads: Threads; ``None`` for as many as torch uses.
        keyframe: The file's keyframe with the pose of components that are not states.
        held: Fields whose value is uncertain, but which positions do not determine beside the
            parameters. An added effect can make the damping of a joint determinable. Discovery
            then corrects it, and does not call this a missing effect.

    Attributes:
        model: The ``mujoco.MjModel``.
        components: Where MuJoCo stores each state.
        readings: Where MuJoCo stores each sensor's value.
        force_ports: The force ports with the coordinates they act on.

    Raises:
        ModelError: The file is not MJCF, or it does not contain a given name; the message suggests
            the nearest name.

    Example:
        >>> MujocoSimulator("models/furuta.xml", {"payload": "body pole mass"}).parameters
        (Parameter(name='payload', unit='kg', nominal=0.024, description='body pole mass'),)
    """

    # The simulator with the file's own steps, once finer ones are taken.
    unrefined: Self | None = None
    # Whether the steps cannot be refined further.
    is_finest = False
    # Whether the steps are those of ``with_coarser_steps``, which cannot be made coarser again.
    is_coarsest = False

    @cached_property
    def inverse_dynamics(self) -> InverseDynamics | None:
        """The inverse dynamics in linear form, or ``None`` if the model has no such form."""
        return bound_inverse_dynamics(self)

    def with_finer_steps(self) -> Self | None:
        """Returns a copy with finer steps; ``None`` if there are none.

        The first call raises the order to four, the second doubles the number of steps. With stiff
        servos, steps of order four are stable only if they are shorter, so that the first call
        takes up to four times as many. Where these would be unstable, too, it takes four times as
        many of the file's own integrator, and the second call returns ``None``.
        """
        if self.rigid is not None:
            finer = self.rigid.with_finer_steps()
            return finer and finer.carrying(self.effects)
        mujoco: Any = importlib.import_module("mujoco")
        rk4 = mujoco.mjtIntegrator.mjINT_RK4
        is_fourth = self.model.opt.integrator == rk4
        if self.is_finest or (self.unrefined is not None and not is_fourth):
            return None
        changed = copy.copy(self)
        changed.prepared_models = {}
        changed.unrefined = self.unrefined or self
        changed.coarsening, changed.is_coarsest = 1, False
        if is_fourth:
            changed.refinement, changed.is_finest = _FINER * self.refinement, True
            return changed
        engine_step = self.time_step / self.num_substeps(self.time_step)
        rate = fastest_damping(self.model, self.initial_positions) * engine_step
        while rate > _MOST_DAMPED * changed.refinement <= _MOST_DAMPED * _FINER_IF_STIFF:
            changed.refinement *= 2
        if changed.refinement > _FINER_IF_STIFF:
            changed.refinement = _FINER_IF_STIFF
        else:
            changed.model = copy.copy(self.model)
            changed.model.opt.integrator = rk4
        return changed

    def with_coarser_steps(
        self, num_simulations: float = math.inf, time_step: float | None = None
    ) -> Self | None:
        """Returns a copy with the file's own steps, or with half as many if these are its steps.

        ``None`` if there are few steps per sample already. Half as many steps are those of
        ``implicitfast`` if the file's integrator is Euler. They save time from four simulations of
        each segment on, which nearly every use takes, so ``num_simulations`` is not looked at.
        """
        if self.rigid is not None:
            coarser = self.rigid.with_coarser_steps(num_simulations, time_step)
            return coarser and coarser.carrying(self.effects)
        if self.unrefined is not None:
            changed = copy.copy(self.unrefined)
            changed.effects, changed.is_coarsest = self.effects, True
            return changed
        if self.is_coarsest or self.num_substeps(time_step or self.time_step) < _MANY_STEPS:
            return None
        changed = copy.copy(self)
        changed.coarsening, changed.is_coarsest = _COARSER, True
        return changed

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions in float64; see :meth:`Simulator.simulate`."""
        return replay(self, parameters, inputs)

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`roll_out`.

        The arguments for compilation have no effect, because the engine is compiled already.
        """
        num_steps, step = request.num_steps, request.time_step
        given = {n: torch.as_tensor(x).detach().double() for n, x in request.parameters.items()}
        request = replace(request, parameters=given)
        policy, domain, shape = request.batch(self, torch.float64, torch.device("cpu"))
        flat = flatten(given, shape)
        constants = flatten(policy.constants(request.believed(domain)), shape)
        states = flatten(request.initial_states.double().unbind(-1), shape, expand=True)
        with quiet():
            middle = torch.tensor(0.5 * num_steps * step, dtype=torch.float64)
            batch, tables = self.make_batch(flat, shape.numel(), step, middle)
            stepper = MujocoStepper(self, batch, step, self.histories(flat, step))
            stepper.place(states)
            stepper.settle()
            stepper.begin()
            body = LoopBody(stepper, policy, request.reward)
            loop = begin(body, states, tables, constants)
            return run_eagerly(body, loop, tables, constants, num_steps, shape, request.record)
