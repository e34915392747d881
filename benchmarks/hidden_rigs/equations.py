"""Equations of motion of the five rigs, by Lagrange, in the form M(q) q̈ = f(q, q̇) + τ.

Angles are zero where a pole or an arm hangs. Positions in the x-z plane of a mass at distance r
along a pole are (r sin θ, −r cos θ).
"""

from collections.abc import Sequence

import numpy as np

from hidden_rigs.mechanics import Array, Mechanics

__all__ = ["CartPoleMechanics", "DriveMechanics", "FurutaMechanics", "PendulumMechanics",
           "TwoLinkMechanics"]  # fmt: skip


class PendulumMechanics(Mechanics):
    """A rod on a hinge, with a payload as a point at its end."""

    num_joints = 1

    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns the moment of inertia about the hinge."""
        p, payload = self.parameters, self.surroundings.payload
        return ((p["mass"] / 3.0 + payload) * p["length"] ** 2,)

    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns gravity's torque and the damping."""
        p, payload = self.parameters, self.surroundings.payload
        x, _, z = self.surroundings.gravity(p["gravity"])
        first_moment = (0.5 * p["mass"] + payload) * p["length"]
        swing = first_moment * (x * np.cos(q[0]) + z * np.sin(q[0]))
        return [swing - p["damping"] * v[0]]

    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns the torque."""
        return [commands[0]]


class CartPoleMechanics(Mechanics):
    """A cart at x with a rod hinged to it; L = ½(M+m)ẋ² + μ ẋ θ̇ cos θ + ½ I θ̇² + gravity's."""

    num_joints = 2

    def _moments(self) -> tuple[float, float, float]:
        """Returns the whole mass, and first and second moment of the pole about its hinge."""
        p, payload = self.parameters, self.surroundings.payload
        pole, length = p["pole_mass"], p["pole_length"]
        return (
            p["cart_mass"] + pole + payload,
            (0.5 * pole + payload) * length,
            (pole / 3.0 + payload) * length**2,
        )

    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns M₁₁, M₂₂, M₁₂."""
        total, first, second = self._moments()
        return total, second, first * np.cos(q[1])

    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns the centrifugal force, gravity and damping."""
        total, first, _ = self._moments()
        p = self.parameters
        x, _, z = self.surroundings.gravity(p["gravity"])
        sin, cos = np.sin(q[1]), np.cos(q[1])
        return [
            first * sin * v[1] ** 2 + total * x - p["cart_damping"] * v[0],
            first * (x * cos + z * sin) - p["pole_damping"] * v[1],
        ]

    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns the force on the cart."""
        return [commands[0], np.zeros_like(commands[0])]


class DriveMechanics(Mechanics):
    """A carriage on a screw: the EMPS drive."""

    num_joints = 1

    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns the moving mass."""
        return (self.parameters["mass"] + self.surroundings.payload,)

    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns the viscous friction."""
        return [-self.parameters["viscous_friction"] * v[0]]

    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns gain times voltage."""
        return [self.parameters["drive_gain"] * commands[0]]


class FurutaMechanics(Mechanics):
    """An arm at angle θ that carries a pole at angle α, driven by a DC motor.

    Kinetic energy ½ (c₀ + c₁ sin² α) θ̇² + c₂ cos α θ̇ α̇ + ½ c₃ α̇², as the paper's equations
    imply it: with c₁ = M_p L_p²/4 and not c₃ = M_p L_p²/3 beside sin² α.
    """

    num_joints = 2

    def _coefficients(self) -> tuple[float, float, float, float, float, float]:
        """Returns c₀, c₁, c₂, c₃, and the first moments of pole and arm end."""
        p, payload = self.parameters, self.surroundings.payload
        arm, pole, length = p["arm_length"], p["pole_mass"], p["pole_length"]
        carried = pole + payload
        first = (0.5 * pole + payload) * length
        return (
            p["arm_mass"] * arm**2 / 12.0 + carried * arm**2,
            (0.25 * pole + payload) * length**2,
            first * arm,
            (pole / 3.0 + payload) * length**2,
            first,
            carried * arm,
        )

    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns M₁₁, M₂₂, M₁₂."""
        c0, c1, c2, c3, _, _ = self._coefficients()
        return c0 + c1 * np.sin(q[1]) ** 2, c3, c2 * np.cos(q[1])

    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns velocity products, gravity, back-EMF and damping."""
        _, c1, c2, _, first, end = self._coefficients()
        p = self.parameters
        x, y, z = self.surroundings.gravity(p["gravity"])
        sin, cos = np.sin(q[1]), np.cos(q[1])
        product = 2.0 * c1 * sin * cos
        back_emf = p["motor_constant"] ** 2 / p["motor_resistance"]
        arm = -product * v[0] * v[1] + c2 * sin * v[1] ** 2
        pole = 0.5 * product * v[0] ** 2 + first * z * sin
        if x != 0.0 or y != 0.0:
            outward = x * np.cos(q[0]) + y * np.sin(q[0])
            sideways = y * np.cos(q[0]) - x * np.sin(q[0])
            arm = arm + end * sideways - first * sin * outward
            pole = pole + first * cos * sideways
        return [
            arm - (back_emf + p["arm_damping"]) * v[0],
            pole - p["pole_damping"] * v[1],
        ]

    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns the motor's torque at standstill."""
        gain = self.parameters["motor_constant"] / self.parameters["motor_resistance"]
        return [gain * commands[0], np.zeros_like(commands[0])]


class TwoLinkMechanics(Mechanics):
    """Two rods in the x-z plane, the second angle relative to the first.

    A payload sits at the second rod's centre. The rods' lengths are parameters here.
    """

    num_joints = 2

    def _moments(self) -> tuple[float, float, float, float, float]:
        """Returns I₁ and I₂ about shoulder and elbow, l₁, and first moments about both."""
        p, payload = self.parameters, self.surroundings.payload
        upper, lower = p["upper_length"], p["lower_length"]
        carried = p["lower_mass"] + payload
        return (
            p["upper_mass"] * upper**2 / 3.0 + carried * upper**2,
            (p["lower_mass"] / 3.0 + 0.25 * payload) * lower**2,
            upper,
            0.5 * p["upper_mass"] * upper + carried * upper,
            0.5 * carried * lower,
        )

    def inertia(self, q: Array) -> tuple[Array | float, ...]:
        """Returns M₁₁, M₂₂, M₁₂."""
        outer, inner, upper, _, first = self._moments()
        cross = upper * first * np.cos(q[1])
        return outer + inner + 2.0 * cross, inner, inner + cross

    def forces(self, q: Array, v: Array) -> list[Array]:
        """Returns velocity products, gravity and damping."""
        _, _, upper, outer_first, first = self._moments()
        p = self.parameters
        x, _, z = self.surroundings.gravity(p["gravity"])
        product = upper * first * np.sin(q[1])
        both = q[0] + q[1]
        inner = first * (x * np.cos(both) + z * np.sin(both))
        outer = outer_first * (x * np.cos(q[0]) + z * np.sin(q[0]))
        return [
            product * (2.0 * v[0] + v[1]) * v[1] + outer + inner - p["shoulder_damping"] * v[0],
            -product * v[0] ** 2 + inner - p["elbow_damping"] * v[1],
        ]

    def drives(self, commands: Sequence[Array]) -> list[Array]:
        """Returns the torques."""
        return [commands[0], commands[1]]
