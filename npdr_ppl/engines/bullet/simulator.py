"""A PyBullet scene as a simulator."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from os import PathLike
from typing import Any, Self

import numpy as np
import torch

from npdr_ppl.engines.bullet.channels import JOINT_FIELDS, Command, Sensor
from npdr_ppl.engines.bullet.client import connect, connected
from npdr_ppl.engines.bullet.forces import JointForces, is_dry
from npdr_ppl.engines.bullet.parameters import BoundParameter
from npdr_ppl.engines.bullet.scene import Builder, Scene, Urdf
from npdr_ppl.engines.bullet.settings import BulletSettings
from npdr_ppl.engines.bullet.stepping import BulletSimulation, stepping
from npdr_ppl.engines.common.robot_files import located
from npdr_ppl.engines.common.source_files import recorded_files
from npdr_ppl.engines.pooled.pool_simulator import Segment
from npdr_ppl.engines.pooled.stepped_simulator import SteppedSimulator
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Channel, Parameter, Port
from npdr_ppl.language.effects import Effect, EnvironmentEffect, ForceEffect

__all__ = ["BulletSimulator"]


class BulletSimulator(SteppedSimulator):
    """A scene of PyBullet, simulated on workers in DIRECT mode.

    The scene is rebuilt for each simulation; otherwise, contacts and solver caches of the previous
    simulation would influence it. Every joint that moves is a force port, commands and sensors are
    ports, and ``gravity`` is an environment port.

    A subclass can override :meth:`start` and :meth:`drive` for actions that channels cannot
    express, e.g. a body that is moved along a path.

    Args:
        scene: A builder, or a URDF file of one robot with a fixed base.
        parameters: Domain parameters by name: a place in the scene such as ``"link lower mass"``,
            ``"joint elbow damping"``, ``"body ball restitution"``, ``"body wall x_offset"`` or
            ``"world gravity"``, whose value in the scene is the nominal one; or the declaration
            of a parameter that the builder uses.
        actions: Commands of joints; channels without a command must be handled by :meth:`drive`.
        sensors: Sensors that are measured after each step.
        states: Sensors whose values at a segment's start are set in the scene; ``None`` for all
            sensors of joints and bodies. Other states begin as the builder set them.
        settings: Settings of the engine.

    Raises:
        ModelError: The scene cannot be built, or something in it cannot be found.

    Attributes:
        settings: Settings of the engine.
    """

    is_deterministic = True

    def __init__(
        self,
        scene: Builder | str | PathLike[str],
        *,
        parameters: Mapping[str, str | Parameter] | None = None,
        actions: Sequence[Command | Channel] = (),
        sensors: Sequence[Sensor],
        states: Sequence[str] | None = None,
        settings: BulletSettings | None = None,
    ) -> None:
        self.settings = settings or BulletSettings()
        self.time_step = self.settings.time_step
        self._build: Builder = scene if callable(scene) else Urdf(located(scene))
        self._commands = tuple(
            (column, action)
            for column, action in enumerate(actions)
            if isinstance(action, Command)
        )
        self._sensors = tuple(sensors)
        self.actions = tuple(a.channel if isinstance(a, Command) else a for a in actions)
        self.sensors = tuple(sensor.channel for sensor in sensors)
        self._states = self._chosen_states(states)
        self.states = tuple(sensor.channel for sensor in self._states)
        declared = dict(parameters or {})
        self._bound = tuple(
            BoundParameter(name, text) for name, text in declared.items() if isinstance(text, str)
        )
        given = [value for value in declared.values() if isinstance(value, Parameter)]
        for name, value in declared.items():
            if isinstance(value, Parameter) and value.name != name:
                raise ModelError(f"The parameter {value.name!r} is given as {name!r}.")
        nominal = {parameter.name: parameter.nominal for parameter in given}
        with connected() as client:
            built = Scene(client, self._build, nominal, self.settings, self.time_step)
            found = {bound.name: bound.declaration(built) for bound in self._bound}
            by_name = {p.name: p for p in given} | found
            self.parameters = tuple(by_name[name] for name in declared)
            self.ports = self._find_ports(built)
            built.reader(self._sensors)  # raises an error if something does not exist

    @property
    def name(self) -> str:
        """Name for messages: name of the class, with the name of the URDF file if there is one."""
        file = f"({str(self._build.path)!r})" if isinstance(self._build, Urdf) else ""
        return f"{type(self).__name__}{file}"

    def recorded_settings(self) -> dict[str, Any]:
        """Returns the settings of the engine and the text of the URDF file, if there is one."""
        settings = {"engine": "bullet", **asdict(self.settings)}
        if isinstance(self._build, Urdf):
            settings["urdf"] = recorded_files(self._build.path)
        return settings

    def with_effects(self, *effects: Effect) -> Self:
        """Returns a copy with effects attached; see :meth:`Simulator.with_effects`.

        Raises:
            ModelError: Dry friction is attached to a joint whose motor follows a velocity or a
                position, but Bullet has one motor per joint. Or an effect needs acceleration and
                inertia of its joint before each step.
        """
        changed = super().with_effects(*effects)
        driven = {
            command.place.name: command.place.field
            for _, command in self._commands
            if command.place.field != "torque"
        }
        for effect in effects:
            if isinstance(effect, ForceEffect) and effect.needs_joint:
                raise ModelError(
                    f"{effect.id} cannot attach to {effect.port!r} of {self.name}: it needs "
                    "acceleration and inertia before each step, which Bullet does not give."
                )
            follows = driven.get(self._joint_of.get(effect.port, ""))
            if isinstance(effect, ForceEffect) and is_dry(effect) and follows:
                raise ModelError(
                    f"{effect.id} cannot attach to {effect.port!r} of {self.name}: the joint's "
                    f"motor follows a {follows}, and it would have to be the friction."
                )
        return changed

    def set_up(self) -> Any:
        """Connects to a physics server in the worker's process."""
        torch.set_num_threads(1)
        return connect()

    def begin(
        self, workspace: Any, parameters: Mapping[str, float], segment: Segment, seed: int
    ) -> BulletSimulation:
        """Begins a simulation; see :meth:`SteppedSimulator.begin`."""
        client = workspace
        scene = Scene(client, self._build, parameters, self.settings, segment.time_step)
        for bound in self._bound:
            bound.apply(scene, parameters[bound.name])
        self._change_environment(scene, parameters)
        self.start(scene, parameters, segment)
        forces = self._forces(scene, parameters, segment)
        drive = None if type(self).drive is BulletSimulator.drive else self.drive
        return BulletSimulation(
            stepping(scene, segment, self._commands, self.settings.substeps, forces, drive),
            scene.reader(self._sensors),
        )

    def start(self, scene: Scene, parameters: Mapping[str, float], segment: Segment) -> None:
        """Sets the scene to a segment's initial state.

        Args:
            scene: The scene, with its parameters.
            parameters: All parameters.
            segment: The segment; its initial state is in the order of ``states``.
        """
        joints: dict[tuple[int, int], dict[str, float]] = {}
        bodies: dict[int, dict[str, float]] = {}
        for sensor, value in zip(self._states, segment.initial_state.tolist(), strict=True):
            body, index = scene.find(sensor.place)
            if sensor.place.kind == "joint":
                joints.setdefault((body, index), {})[sensor.place.field] = value
            else:
                bodies.setdefault(body, {})[sensor.place.field] = value
        for joint, values in joints.items():
            present = dict(zip(JOINT_FIELDS, scene.client.getJointState(*joint)[:2], strict=True))
            values = {**present, **values}
            scene.place_joint(joint, values["position"], values["velocity"])
        for body, values in bodies.items():
            scene.place_body(body, values)

    def drive(self, scene: Scene, segment: Segment, step: int, substep: int) -> None:
        """Moves bodies in a way that joint commands cannot, before a substep.

        By default it does nothing.

        Args:
            scene: The scene.
            segment: The segment; ``segment.actions[step]`` is the present command.
            step: Number of the step, from 0.
            substep: Number of the substep within it, from 0.
        """

    def _forces(
        self, scene: Scene, parameters: Mapping[str, float], segment: Segment
    ) -> JointForces | None:
        """Returns the forces of effects at joints, if there are any."""
        effects = [e for e in self.effects if isinstance(e, ForceEffect)]
        if not effects:
            return None
        pairs = [(effect, scene.joints[self._joint_of[effect.port]]) for effect in effects]
        step = segment.time_step / self.settings.substeps
        return JointForces(scene, pairs, parameters, step, segment.start_time)

    def _change_environment(self, scene: Scene, parameters: Mapping[str, float]) -> None:
        """Applies environment effects to gravity."""
        gravity: Any = scene.gravity
        effects = [e for e in self.effects if isinstance(e, EnvironmentEffect)]
        for effect in effects:
            values = {n: torch.tensor(parameters[n]).double() for n in effect.parameter_names}
            gravity = effect.environment(gravity, effect.own_parameters(values))
        if effects:
            x, y, z = (float(component) for component in gravity)
            scene.gravity = (x, y, z)
            scene.client.setGravity(*scene.gravity)

    def _chosen_states(self, names: Sequence[str] | None) -> tuple[Sensor, ...]:
        """Returns the sensors that are states."""
        possible = {s.channel.name: s for s in self._sensors if s.place.kind != "link"}
        if names is None:
            return tuple(possible.values())
        unknown = [name for name in names if name not in possible]
        if unknown:
            raise ModelError(
                f"{', '.join(unknown)} cannot be a state: sensors of joints and bodies can, "
                f"here {', '.join(possible) or 'none'}."
            )
        return tuple(possible[name] for name in names)

    def _find_ports(self, scene: Scene) -> tuple[Port, ...]:
        """Returns the ports of a scene, and notes the joint of each force port.

        A force port has the name of its joint, or ``<joint>_torque`` (``_force`` if it slides) if
        a channel has that name.
        """
        rated = {c.place.name: c.rated for _, c in self._commands if c.place.field == "torque"}
        commands = {command.channel.name: command for _, command in self._commands}
        ports = [
            Port(a.name, "action", a.unit, commands[a.name].rated if a.name in commands else 1.0)
            for a in self.actions
        ]
        driven = {scene.find(command.place) for _, command in self._commands}
        of_joint: dict[tuple[int, int], str] = {}
        for name, joint in scene.joints.items():
            if joint not in of_joint or "/" not in name:
                of_joint[joint] = name
        channels = {channel.name for channel in (*self.actions, *self.sensors)}
        self._joint_of: dict[str, str] = {}
        for joint, name in of_joint.items():
            info = scene.client.getJointInfo(*joint)
            turns = info[2] == scene.client.JOINT_REVOLUTE
            unit, coordinate = ("N m", "rad") if turns else ("N", "m")
            # Unspecified limits are zero in a URDF, and sometimes a thousand in Bullet.
            effort = rated.get(name, info[10] if 0.0 < info[10] < 1000.0 else 1.0)
            speed = info[11] if 0.0 < info[11] < 1000.0 else 1.0
            called = f"{name}_{'torque' if turns else 'force'}" if name in channels else name
            self._joint_of[called] = name
            port = Port(called, "force", unit, effort, speed, 1.0, coordinate, joint in driven)
            ports.append(port)
        ports += [Port(s.channel.name, "sensor", s.channel.unit, s.rated) for s in self._sensors]
        strength = float(np.linalg.norm(scene.gravity)) or 9.81
        ports.append(Port("gravity", "environment", "m/s²", strength))
        names = [port.name for port in ports]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ModelError(
                f"{', '.join(twice)} names two ports of {self.name}; call the channel otherwise."
            )
        return tuple(ports)
