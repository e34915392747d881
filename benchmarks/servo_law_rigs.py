"""One-joint arms behind a servo with one hidden law, simulated by equations of their own.

The arm is a link under gravity with a rotor, J q̈ = f − b q̇ + m g l cos q, where q is the angle
below the horizontal. The servo's force is f = K (e + w) − D q̇ within ±f_max, with the error
e = g − q of the goal g that its own laws make of the command, and the integral part w.

What carries the joint may turn by φ, which the encoder does not see. The rotor's inertia R and the
link's L, whose sum is J, then accelerate differently, as the carrier with its inertia A, stiffness
k and damping d does:

    R q̈ + L (q̈ + φ̈) = f − b q̇ + m g l cos(q + φ)
    A φ̈ + L (q̈ + φ̈) = −k φ − d φ̇ + m g l cos(q + φ)

Everything is integrated by the Runge-Kutta method in steps of 0.5 ms; laws of goals run in the
same steps. None of it is the package's.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import npdr_ppl as npdr
from npdr_ppl.randomness import derived_seed

__all__ = ["KINDS", "Case", "Kind", "make_case", "mjcf"]

Array = NDArray[np.float64]

SAMPLE, SUBSTEPS = 0.01, 20
"""Seconds between samples, and steps of the rig in each."""

SECONDS, ROLLOUTS = 10.0, 3
"""Duration and number of rollouts; the last one is held out."""

NOISE = 2e-4
"""Standard deviation of the encoder's noise in rad, that of 12 bits per turn behind a filter."""

SPREAD = 0.2
"""Greatest relative difference between the rig's values and those in the file."""

GAIN, SERVO_DAMPING, DAMPING, ROTOR = 20.0, 1.0, 0.1, 0.02
"""Values in the file: N m/rad, N m s/rad, N m s/rad, kg m²."""

MASS, LENGTH, GRAVITY = 0.5, 0.3, 9.81
"""Values of the link in kg and m, which the user knows, and m/s²."""

OWN_INERTIA = 1e-3
"""Inertia of the link about its centre of mass, kg m²."""


State = tuple[float, float, float, float, float]
"""Position, speed, integral part, turn of the carrier and its rate; or the rates of these."""


@dataclass(frozen=True)
class Kind:
    """A kind of law.

    Attributes:
        name: Name that a finder should give.
        ranges: Range of each of its parameters, by short name.
        is_signed: Whether the sign is drawn, too.
    """

    name: str
    ranges: dict[str, tuple[float, float]]
    is_signed: bool = False


KINDS: dict[str, Kind] = {
    "none": Kind("", {}),
    "dead_band": Kind("servo.servo_dead_band", {"width": (5e-3, 0.015)}),
    "force_limit": Kind("servo.servo_force_limit", {"limit": (2.5, 4.5)}),
    "speed_limit": Kind("servo.goal_speed_limit", {"limit": (0.7, 1.5)}),
    "acceleration_limit": Kind("servo.goal_acceleration_limit", {"limit": (5.0, 15.0)}),
    "coarse_goal": Kind("servo.goal_resolution", {"step": (6e-3, 0.015)}),
    "dead_time": Kind("servo.input_delay", {"delay": (0.01, 0.03)}),
    "offset": Kind("hinge.encoder_bias", {"offset": (5e-3, 0.02)}, is_signed=True),
    "carrier": Kind(
        "hinge_torque.base_compliance",
        {"compliance": (2e-3, 6e-3), "time_constant": (5e-3, 0.015), "damping_ratio": (0.05, 0.2)},
    ),
    "integral": Kind("servo.servo_integral_action", {"rate": (1.0, 4.0), "limit": (0.02, 0.06)}),
}
"""What may be hidden. Sizes are typical of small servos: 0.3° to 0.9° of dead band or resolution,
limits that steps of 0.5 rad reach, dead times of one to three samples, carriers that the weight
turns by 0.2° to 0.5° and that swing at 7 to 15 Hz with the link."""


@dataclass(frozen=True)
class Case:
    """A case.

    Attributes:
        truth: Name of the hidden effect; empty if nothing is hidden.
        values: Its parameters by short name.
        rollouts: The recording.
    """

    truth: str
    values: dict[str, float]
    rollouts: npdr.Rollouts


def mjcf() -> str:
    """Returns the user's file."""
    return f"""<mujoco><compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="link">
    <joint name="hinge" axis="0 1 0" damping="{DAMPING}" armature="{ROTOR}" range="-2 2"/>
    <inertial pos="{LENGTH} 0 0" mass="{MASS}"
      diaginertia="{OWN_INERTIA} {OWN_INERTIA} {OWN_INERTIA}"/>
  </body></worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="{GAIN}" kv="{SERVO_DAMPING}" ctrlrange="-1.5 1.5"/>
  </actuator>
</mujoco>
"""


def make_case(kind: str, seed: int) -> Case:
    """Makes a case: commands, the rig's values, the hidden law's, and readings with noise.

    Args:
        kind: One of ``KINDS``.
        seed: Seed of all of it.
    """
    rng = np.random.default_rng(derived_seed(seed, kind))
    about = KINDS[kind]
    sign = float(rng.choice([-1.0, 1.0])) if about.is_signed else 1.0
    values = {name: sign * float(rng.uniform(*ends)) for name, ends in about.ranges.items()}
    gain, servo_damping, damping, rotor = (
        value * rng.uniform(1.0 - SPREAD, 1.0 + SPREAD)
        for value in (GAIN, SERVO_DAMPING, DAMPING, ROTOR)
    )
    rig = _Rig(gain, servo_damping, damping, rotor, kind, values)
    commands = [_commands(rng) for _ in range(ROLLOUTS)]
    readings = [rig.run(own) for own in commands]
    return Case(
        about.name,
        values,
        npdr.Rollouts.from_arrays(
            readings=[r + NOISE * rng.standard_normal(r.shape) for r in readings],
            actions=[own[:, None] for own in commands],
            channel_names=["hinge"],
            action_names=["servo"],
            time_step=SAMPLE,
        ),
    )


def _commands(rng: np.random.Generator) -> Array:
    """Returns steps of up to 0.5 rad for half the time, then a sum of three sines."""
    number = round(SECONDS / SAMPLE)
    half, steps = number // 2, []
    while len(steps) < half:
        steps += [float(rng.uniform(-0.5, 0.5))] * int(rng.integers(60, 140))
    times = SAMPLE * np.arange(number - half)
    frequency, phase = rng.uniform(0.1, 0.8, (3, 1)), rng.uniform(0.0, 2.0 * math.pi, (3, 1))
    waves = 0.25 * np.sin(2.0 * math.pi * frequency * times + phase).sum(0)
    return np.concatenate((steps[:half], waves))


class _Rig:
    """The arm with its servo.

    Args:
        gain: K in N m/rad.
        servo_damping: D in N m s/rad.
        damping: b in N m s/rad.
        rotor: Inertia of the rotor behind the gear in kg m².
        kind: What is hidden.
        values: Its parameters.
    """

    def __init__(
        self,
        gain: float,
        servo_damping: float,
        damping: float,
        rotor: float,
        kind: str,
        values: dict[str, float],
    ) -> None:
        self.gain, self.servo_damping, self.damping = gain, servo_damping, damping
        self.rotor, self.link = rotor, OWN_INERTIA + MASS * LENGTH**2
        self.kind, self.values = kind, values

    def run(self, commands: Array) -> Array:
        """Returns positions before the first and after each sample, ``(steps + 1, 1)``, in rad.

        The arm rests under its first command before, without an integral part.
        """
        h = SAMPLE / SUBSTEPS
        goals = GOALS.get(self.kind, _as_commanded)(np.repeat(commands, SUBSTEPS), h, self.values)
        first = float(goals[0])
        position, turn = self._equilibrium(first)
        state: State = (position, 0.0, 0.0, turn, 0.0)
        readings = [state[0]]
        for number, goal in enumerate(goals, 1):
            state = self._stepped(state, float(goal), h)
            if number % SUBSTEPS == 0:
                readings.append(state[0])
        offset = self.values["offset"] if self.kind == "offset" else 0.0
        return np.array(readings)[:, None] + offset

    def _equilibrium(self, goal: float) -> tuple[float, float]:
        """Returns where the joint and its carrier rest."""
        position, turn = goal, 0.0
        for _ in range(100):
            load = MASS * GRAVITY * LENGTH * math.cos(position + turn)
            position = goal + load / self.gain
            position += self.values["width"] if self.kind == "dead_band" else 0.0
            turn = load * self.values["compliance"] if self.kind == "carrier" else 0.0
        return position, turn

    def _stepped(self, state: State, goal: float, h: float) -> State:
        """Returns the state after a step of the Runge-Kutta method."""

        def moved(rate: State, time: float) -> State:
            p, s, i, t, r = rate
            return (
                state[0] + time * p,
                state[1] + time * s,
                state[2] + time * i,
                state[3] + time * t,
                state[4] + time * r,
            )

        a = self._rates(state, goal)
        b = self._rates(moved(a, 0.5 * h), goal)
        c = self._rates(moved(b, 0.5 * h), goal)
        d = self._rates(moved(c, h), goal)
        p, s, i, t, r = (
            (p + 2 * q + 2 * r + s) / 6 for p, q, r, s in zip(a, b, c, d, strict=True)
        )
        position, speed, integral, turn, turning = moved((p, s, i, t, r), h)
        if self.kind == "integral":
            integral = min(max(integral, -self.values["limit"]), self.values["limit"])
        return position, speed, integral, turn, turning

    def _rates(self, state: State, goal: float) -> State:
        position, speed, integral, turn, turning = state
        error, rate = goal - position, 0.0
        if self.kind == "integral":
            rate = self.values["rate"] * error
            error += integral
        elif self.kind == "dead_band":
            error = math.copysign(max(abs(error) - self.values["width"], 0.0), error)
        force = self.gain * error - self.servo_damping * speed
        if self.kind == "force_limit":
            force = min(max(force, -self.values["limit"]), self.values["limit"])
        force -= self.damping * speed
        load = MASS * GRAVITY * LENGTH * math.cos(position + turn)
        if self.kind != "carrier":
            return speed, (force + load) / (self.rotor + self.link), rate, 0.0, 0.0
        v, time = self.values, self.values["time_constant"]
        spring = -(turn + 2.0 * v["damping_ratio"] * time * turning) / v["compliance"]
        # Both equations, solved for both accelerations.
        own = time**2 / v["compliance"] + self.link
        both = (self.rotor + self.link) * own - self.link**2
        fast = (own * (force + load) - self.link * (spring + load)) / both
        turns = ((self.rotor + self.link) * (spring + load) - self.link * (force + load)) / both
        return speed, fast, rate, turning, turns


def _as_commanded(commands: Array, h: float, values: dict[str, float]) -> Array:
    return commands


def _slowly(commands: Array, h: float, values: dict[str, float]) -> Array:
    """A goal of limited speed."""
    goals, goal = [], commands[0]
    for command in commands:
        goal += min(max(command - goal, -values["limit"] * h), values["limit"] * h)
        goals.append(goal)
    return np.array(goals)


def _gently(commands: Array, h: float, values: dict[str, float]) -> Array:
    """A goal of limited acceleration that brakes in time.

    At the distance d its speed is v with v²/(2 a) + v h/2 = d, to stop there in steps of h.
    """
    most, goals, goal, speed = values["limit"], [], commands[0], 0.0
    for command in commands:
        distance = command - goal
        own = 0.5 * most * h
        wanted = math.sqrt(own * own + 2.0 * most * abs(distance)) - own
        wanted = math.copysign(wanted, distance)
        if abs(distance) <= most * h * h and abs(speed) <= most * h:
            goal, speed = command, 0.0
        else:
            speed += min(max(wanted - speed, -most * h), most * h)
            goal += h * speed
        goals.append(goal)
    return np.array(goals)


def _coarsely(commands: Array, h: float, values: dict[str, float]) -> Array:
    """A goal in steps."""
    return values["step"] * np.floor(commands / values["step"] + 0.5)


def _late(commands: Array, h: float, values: dict[str, float]) -> Array:
    """A goal that comes later, by linear interpolation of the delay between two steps."""
    whole = math.floor(values["delay"] / h)
    share = values["delay"] / h - whole
    index = np.arange(len(commands))
    near = commands[np.maximum(index - whole, 0)]
    return near + share * (commands[np.maximum(index - whole - 1, 0)] - near)


GOALS: dict[str, Callable[[Array, float, dict[str, float]], Array]] = {
    "speed_limit": _slowly,
    "acceleration_limit": _gently,
    "coarse_goal": _coarsely,
    "dead_time": _late,
}
"""The goal in every step of the rig, from the commands."""
