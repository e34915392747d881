"""One step of a scene: commands, forces of effects, and motions that a subclass drives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from npdr_ppl.engines.bullet.channels import Command
from npdr_ppl.engines.bullet.forces import JointForces
from npdr_ppl.engines.bullet.scene import Scene
from npdr_ppl.engines.pooled.pool_simulator import Segment

__all__ = ["BulletSimulation", "Drive", "stepping"]

Joint = tuple[int, int]

Drive = Callable[[Scene, Segment, int, int], None]
"""Moves bodies of a scene before a substep; see :meth:`BulletSimulator.drive`."""

# Greatest force of Bullet's motors that is practically no limit.
_NO_LIMIT = 1e9


@dataclass(frozen=True)
class BulletSimulation:
    """A running simulation; see :class:`~npdr_ppl.engines.pooled.stepped_simulator.Simulation`.

    Attributes:
        advance: Performs all substeps of a step.
        read: Reads the sensors.
    """

    advance: Callable[[int], None]
    read: Callable[[], Sequence[float]]


def stepping(
    scene: Scene,
    segment: Segment,
    commands: Sequence[tuple[int, Command]],
    substeps: int,
    forces: JointForces | None,
    drive: Drive | None,
) -> Callable[[int], None]:
    """Returns a function that performs all substeps of a step.

    Args:
        scene: The scene, in its initial state.
        segment: The segment; the actions of a step must be set before the step.
        commands: Commands of joints, with their columns in the actions.
        substeps: Integration steps per step.
        forces: Forces of effects at joints.
        drive: Moves other bodies before each substep, if given.
    """
    motors, torques = [], []
    for column, command in commands:
        joint = scene.find(command.place)
        if command.place.field == "torque":
            torques.append((column, joint))
        else:
            motors.append((column, _motor(scene.client, command, joint)))
    actions, substep_range = segment.actions, range(substeps)
    client = scene.client
    step_simulation, torque_control = client.stepSimulation, client.TORQUE_CONTROL
    control = client.setJointMotorControl2

    def advance(step: int) -> None:
        present = actions[step].tolist()
        for column, follow in motors:
            follow(present[column])
        for substep in substep_range:
            total = {} if forces is None else forces()
            for column, joint in torques:
                total[joint] = present[column] + total.get(joint, 0.0)
            for (body, index), torque in total.items():
                # Bullet forgets torques after each substep.
                control(body, index, torque_control, force=torque)
            if drive is not None:
                drive(scene, segment, step, substep)
            step_simulation()

    def advance_simply(step: int) -> None:
        present = actions[step].tolist()
        for column, follow in motors:
            follow(present[column])
        for _ in substep_range:
            for column, (body, index) in torques:
                control(body, index, torque_control, force=present[column])
            step_simulation()

    # Most scenes have no forces to sum, and the sum would take a noticeable part of a step.
    is_simple = len({joint for _, joint in torques}) == len(torques)
    return advance_simply if is_simple and forces is None and drive is None else advance


def _motor(client: Any, command: Command, joint: tuple[int, int]) -> Any:
    """Returns a function that lets a joint's motor follow a velocity or a position."""
    control = client.setJointMotorControl2
    force = _NO_LIMIT if command.max_force is None else command.max_force
    if command.place.field == "velocity":

        def follow(value: float) -> None:
            control(
                *joint,
                client.VELOCITY_CONTROL,
                targetVelocity=value,
                velocityGain=command.velocity_gain,
                force=force,
            )

    else:

        def follow(value: float) -> None:
            control(
                *joint,
                client.POSITION_CONTROL,
                targetPosition=value,
                positionGain=command.position_gain,
                velocityGain=command.velocity_gain,
                force=force,
            )

    return follow
