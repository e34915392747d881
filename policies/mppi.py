"""Model-predictive path integral control: plans from weighted random rollouts of a model."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npdr_ppl.engines.common.episodes import Reward
from npdr_ppl.errors import ModelError, ShapeError
from npdr_ppl.language.inputs import Inputs
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.policies.base import Policy
from npdr_ppl.randomness import derived_seed

__all__ = ["MPPI", "Plan"]


@dataclass(frozen=True)
class Plan:
    """Memory of :class:`MPPI` for N episodes, H steps of the plan and A actions.

    Attributes:
        commands: Planned commands, ``(N, H, A)``.
        time: Time of the first of them, in seconds.
        past: Commands of the previous H steps, oldest first, zero before the start, ``(N, H, A)``.
        num_replans: Number of plans so far; it selects the random stream.
    """

    commands: Tensor
    time: float
    past: Tensor
    num_replans: int


class MPPI(Policy):
    """Plans a sequence of commands, executes its first steps and plans again.

    From the current measurements, K candidate sequences V_k = clip(U + ε_k) around the previous
    plan U are simulated under M domains ξ_m at once. The next plan is their mean with weights

        w_k ∝ exp(R̄_k / λ),   R̄_k = (1/M) Σ_m Σ_h r(x_{m,k,h+1}, V_{k,h}).

    ε interpolates linearly between Gaussian knots at equal distances over the horizon, and is
    scaled to the same standard deviation at every step. White noise would shake a device instead
    of moving it. ε_0 is zero, so that the previous plan is always a candidate. Commands have no
    cost apart from the reward, as in the paper with base distribution U (α = 1). From the step at
    which a candidate leaves the states' bounds, it gets the least reward of any step, whatever the
    reward's sign.

    Averaging returns over posterior draws (M > 1) makes the plan robust to the uncertainty of the
    posterior. M = 1 with the most likely sample is the usual controller.

    Use it on devices and for batches of a few episodes. Loops cannot compile it, because its
    memory is a plan and not a number per simulation. For speed, pass a simulator made with
    ``compile="always"`` instead. Episodes of a batch share the random numbers, so that each is
    planned as if alone. It has no parameters to search over; the floating type of its empty
    parameters is that of the plan on devices.

    Args:
        simulator: The internal model. Its effects are simulated, with the past commands known. It
            must report its full state and start from a given state. A batched engine plans in
            milliseconds; an engine on workers takes K M H single steps per plan.
        reward: Reward of a step, from the measurements at its end and the limited command.
        horizon: Number of steps of the plan H.
        num_samples: Number of candidate sequences K.
        temperature: λ, in units of the return over the horizon.
        noise: Standard deviation of ε per action in its unit, A numbers.
        domains: Parameters of the internal model, scalars or M draws ``(M,)``; missing ones are
            the episode's own, as in :class:`~npdr_ppl.policies.furuta_swing_up.FurutaSwingUp`.
        num_knots: Number of knots of the noise over the horizon, 2 … H; ``None`` for white noise.
        replan_every: Number of steps of the plan that are executed before the next plan.
        time_step: Seconds per step of the plan, a multiple of the loop's step; ``None`` for the
            simulator's. Commands are held within a step.
        seed: Seed of ε.

    References: Williams et al., Information Theoretic MPC for Model-Based Reinforcement Learning,
    ICRA 2017, algorithm 2; Barcelos et al., DISCO: Double Likelihood-free Inference Stochastic
    Control, ICRA 2020 (averages over posterior draws).
    """

    def __init__(
        self,
        simulator: Simulator,
        reward: Reward,
        *,
        horizon: int,
        num_samples: int,
        temperature: float,
        noise: Sequence[float],
        domains: Mapping[str, Tensor] | None = None,
        num_knots: int | None = None,
        replan_every: int = 1,
        time_step: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.simulator = simulator
        self.reward = reward
        self.domains = {name: torch.as_tensor(x) for name, x in (domains or {}).items()}
        simulator.check_parameters(self.domains)
        self.observations = tuple(state.name for state in simulator.states)
        self.actions = tuple(action.name for action in simulator.actions)
        if not self.observations or not self.actions:
            raise ModelError(
                f"MPPI needs a simulator that starts from a state and takes actions, but "
                f"{simulator.name} has {len(self.observations)} states and "
                f"{len(self.actions)} actions."
            )
        sensors = [sensor.name for sensor in simulator.sensors]
        if missing := [name for name in self.observations if name not in sensors]:
            raise ModelError(
                f"MPPI needs the full state, but {simulator.name} has no sensor of "
                f"{', '.join(missing)}."
            )
        if not 1 <= replan_every <= horizon or num_samples < 1 or temperature <= 0.0:
            raise ModelError(
                "MPPI needs 1 <= replan_every <= horizon, a sample and a positive temperature, "
                f"got {replan_every=}, {horizon=}, {num_samples=}, {temperature=}."
            )
        if len(noise) != len(self.actions):
            raise ShapeError(
                f"Each of {', '.join(self.actions)} needs one noise, but got {len(noise)} numbers."
            )
        if any(value.ndim > 1 for value in self.domains.values()):
            raise ShapeError("Domains of MPPI are scalars or draws (M,), not further batches.")
        self.horizon = horizon
        self.num_samples = num_samples
        self.temperature = temperature
        self.noise = torch.tensor(noise, dtype=torch.float64)
        self.blend = _blend(horizon, num_knots or horizon)
        self.replan_every = replan_every
        self.time_step = time_step or simulator.time_step
        self.seed = seed
        self._columns = [sensors.index(name) for name in self.observations]

    def constants(self, domain: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Returns the parameters of the internal model; missing ones are the episode's own."""
        known = {parameter.name for parameter in self.simulator.parameters}
        known |= {name for effect in self.simulator.effects for name in effect.parameter_names}
        known -= set(self.domains)
        return {name: value for name, value in domain.items() if name in known}

    def initial_memory(self, observation: tuple[Tensor, ...]) -> Plan:
        """Returns a plan of zero commands that the first step replaces."""
        nothing = observation[0].new_zeros(observation[0].numel(), self.horizon, len(self.actions))
        return Plan(nothing, 0.0, nothing, 0)

    def act(
        self,
        observation: tuple[Tensor, ...],
        time: Tensor | float,
        memory: Plan,
        constants: dict[str, Tensor],
    ) -> tuple[tuple[Tensor, ...], Plan]:
        """Returns the planned commands of the current time, after replanning if necessary.

        Raises:
            ModelError: The loop is being compiled; torch's own error quotes it.
        """
        if torch.compiler.is_compiling():
            raise ModelError("MPPI cannot be compiled into a loop; use compile='never'.")
        step = self._step(memory, float(time))
        if memory.num_replans == 0 or step >= self.replan_every:
            states = torch.stack(observation, dim=-1).reshape(-1, len(observation))
            with torch.no_grad():
                memory = self._replan(memory, states, step, constants)
            step = 0
        present = memory.commands[:, step].reshape(*observation[0].shape, len(self.actions))
        return present.unbind(-1), memory

    def _step(self, plan: Plan, time: float) -> int:
        """Returns the step of the plan that is being executed."""
        # Times are rounded products of steps, so that a step may begin a little early.
        return math.floor((time - plan.time) / self.time_step + 1e-3)

    def _replan(self, plan: Plan, states: Tensor, step: int, constants: dict[str, Tensor]) -> Plan:
        """Returns the next plan, which begins at a step of the previous one.

        Args:
            plan: The previous plan.
            states: Current measurements of the state, ``(N, states)``.
            step: Number of steps since the previous plan began.
            constants: What :meth:`constants` returned.
        """
        held = plan.commands[:, -1:].expand(-1, step, -1)
        whole = torch.cat((plan.past, plan.commands, held), dim=1)
        first = self.horizon + step
        past, former = whole[:, step:first], whole[:, first:]
        candidates = self._candidates(former, plan.num_replans)
        returns = self._returns(candidates, past, states, constants)
        weights = torch.softmax(returns / self.temperature, dim=-1)
        commands = torch.einsum("nk,nkha->nha", weights, candidates)
        time = plan.time + step * self.time_step
        return Plan(commands, time, past, plan.num_replans + 1)

    def _candidates(self, former: Tensor, number: int) -> Tensor:
        """Returns sequences around the previous plan, ``(N, K, H, A)``, within the limits."""
        generator = torch.Generator().manual_seed(derived_seed(self.seed, "mppi", number))
        # Drawn in the same way for all floating types and devices.
        shape = self.num_samples, self.blend.shape[-1], len(self.actions)
        knots = torch.randn(*shape, generator=generator, dtype=torch.float64)
        noise = self.noise * torch.einsum("hj,kja->kha", self.blend, knots)
        noise[0] = 0.0
        candidates = former[:, None] + noise.to(former)
        lower = candidates.new_tensor([action.lower for action in self.simulator.actions])
        upper = candidates.new_tensor([action.upper for action in self.simulator.actions])
        return candidates.clamp(lower, upper)

    def _returns(
        self, candidates: Tensor, past: Tensor, states: Tensor, constants: dict[str, Tensor]
    ) -> Tensor:
        """Returns the candidates' returns, averaged over domains, ``(N, K)``."""
        count = self.num_samples
        readings = states[:, None].expand(-1, count, -1)
        like = {"dtype": states.dtype, "device": states.device}
        inputs = Inputs(
            actions=candidates,
            action_names=self.actions,
            initial_readings=readings,
            initial_values=readings,
            initial_rates=None,
            channel_names=self.observations,
            past_actions=past[:, None].expand(-1, count, -1, -1),
            time_step=self.time_step,
            mask=torch.ones(count, self.horizon, dtype=torch.bool, device=states.device),
            rollout=torch.zeros(count, dtype=torch.long, device=states.device),
            start=torch.zeros(count, dtype=torch.long, device=states.device),
        )
        # The axis of draws precedes that of episodes.
        domains = {name: x.to(**like)[..., None] for name, x in self.domains.items()}
        domains |= {name: x.to(**like) for name, x in constants.items()}
        trajectories = self.simulator.simulate(domains, inputs).to(**like)
        values = trajectories[..., self._columns].unbind(-1)
        kinds = list(zip(values, self.simulator.is_rate, strict=True))
        positions = tuple(value for value, is_rate in kinds if not is_rate)
        velocities = tuple(value for value, is_rate in kinds if is_rate)
        rewards = self.reward(positions, velocities, candidates.unbind(-1))
        outside = torch.zeros_like(rewards, dtype=torch.bool)
        for value, state in zip(values, self.simulator.states, strict=True):
            # Written so that a NaN counts as outside.
            outside |= ~((value >= state.lower) & (value <= state.upper))
        shape = -1, *candidates.shape[:3]  # domains, episodes, candidates, steps
        rewards, outside = rewards.reshape(shape), outside.cummax(dim=-1).values.reshape(shape)
        least = torch.where(outside, math.inf, rewards).amin(dim=(0, 2, 3), keepdim=True)
        # Where all is outside, all is equal.
        least = torch.where(least.isinf(), 0.0, least)
        return torch.where(outside, least, rewards).sum(dim=-1).mean(dim=0)


def _blend(horizon: int, num_knots: int) -> Tensor:
    """Returns the weight of each knot at each step of the horizon, ``(horizon, num_knots)``.

    Rows have unit norm, so that independent knots of unit variance give steps of unit variance.
    """
    if num_knots == horizon:
        return torch.eye(horizon, dtype=torch.float64)
    if not 2 <= num_knots < horizon:
        raise ModelError(f"MPPI needs 2 … {horizon} knots, got {num_knots=}.")
    place = torch.linspace(0.0, num_knots - 1.0, horizon, dtype=torch.float64)
    distance = (place[:, None] - torch.arange(num_knots, dtype=torch.float64)).abs()
    share = (1.0 - distance).clamp_min(0.0)
    return share / share.norm(dim=-1, keepdim=True)
