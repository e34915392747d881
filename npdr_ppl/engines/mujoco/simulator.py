"""Simulation of any MJCF file in MuJoCo, many parameter sets and segments at a time."""

import copy
import importlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Self

from torch import Tensor

from npdr_ppl.engines.common.episodes import EpisodeRequest, Episodes
from npdr_ppl.engines.mujoco.closed_loop import roll_out
from npdr_ppl.engines.mujoco.mechanism import MujocoMechanism
from npdr_ppl.engines.mujoco.mujoco_linear_dynamics import bound_inverse_dynamics
from npdr_ppl.engines.mujoco.open_loop import replay
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.linear_dynamics import InverseDynamics

__all__ = ["MujocoSimulator"]

_FINER = 2
"""Engine steps of :meth:`MujocoSimulator.with_finer_steps`, of order four, for each of the
simulator's own. Forces of effects are constant over an engine step whatever its order, so only
shorter ones bring those closer to the truth."""


class MujocoSimulator(MujocoMechanism):
    """Any MJCF file as a simulator; channels, nominal values and ports are read from it.

    States are by default the position and the velocity of every hinge and slide, ``elbow`` and
    ``elbow_velocity``; see :func:`~npdr_ppl.engines.mujoco.channels.state_components` for other
    joints. Actions are the actuators with their control ranges, in the file's order. Forces of
    effects are constant over an engine step; dry friction is the engine's own friction loss, the
    set-valued law solved with all other constraints, made as hard as the engine admits where the
    file has none of its own. A simulation that diverges is NaN from there on.

    Args:
        source: Path of an MJCF file, or a ``mujoco.MjModel``, which is not changed.
        parameters: What each domain parameter sets, by its name: a field such as
            ``"body hand mass"``, several fields of one value, a
            :class:`~npdr_ppl.engines.mujoco.parameters.Scale`, or a
            :class:`~npdr_ppl.language.channels.Parameter` that sets nothing by itself.
        derived: Fields that are functions of all parameters, by the field's name.
        states: Names of the states to keep, or new names mapped to the default ones. Components
            that are left out start where the file, or ``keyframe``, has them.
        sensors: Names of states or of the file's sensor elements to report, or new names mapped
            to those; ``None`` for the states. Sensors of accelerations and forces report what
            acted during the last engine step.
        units: Units of channels where the file does not tell them, by channel.
        bounds: Least and greatest values of states, by channel; episodes end beyond them.
        time_step: Seconds per step; ``None`` for ``substeps`` times the file's.
        substeps: Engine steps per step; ``None`` for as many as the file's time step suggests.
        num_threads: Threads; ``None`` for as many as torch uses.
        keyframe: The file's keyframe that holds the pose of components that are no states.

    Attributes:
        model: The ``mujoco.MjModel``.
        components: Where each state is kept.
        readings: Where each sensor's value is kept.
        force_ports: The force ports with the coordinates they act on.

    Raises:
        ModelError: The file is not MJCF, or a name in it does not exist; the message names the
            nearest.

    Example:
        >>> MujocoSimulator("models/furuta.xml", {"payload": "body pole mass"}).parameters
        (Parameter(name='payload', unit='kg', nominal=0.024, description='body pole mass'),)
    """

    @cached_property
    def inverse_dynamics(self) -> InverseDynamics | None:
        """The inverse dynamics as a linear form, or ``None`` where there is none."""
        return bound_inverse_dynamics(self)

    def with_finer_steps(self) -> Self | None:
        """Returns a copy with twice the engine steps, of order four; ``None`` if it is one."""
        if self.refinement > 1:
            return None
        mujoco: Any = importlib.import_module("mujoco")
        changed = copy.copy(self)
        changed.refinement = _FINER
        changed.model, changed.prepared_models = copy.copy(self.model), {}
        changed.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        return changed

    def simulate(self, parameters: Mapping[str, Tensor], inputs: Inputs) -> Tensor:
        """Replays the inputs' actions in float64; see :meth:`Simulator.simulate`."""
        return replay(self, parameters, inputs)

    def run_episodes(self, request: EpisodeRequest) -> Episodes:
        """Simulates closed-loop episodes; see :meth:`ClosedLoopSimulator.roll_out`.

        The arguments for compilation change nothing: the engine is compiled.
        """
        return roll_out(self, request)
