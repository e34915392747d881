"""A Gymnasium environment of MuJoCo that becomes another robot at every reset."""

# pyright: reportAttributeAccessIssue=false
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

__all__ = ["Field", "RandomisedEnv"]

Field = tuple[str, str, str | int, int]
"""A number of a model: array, kind and name of an element, and the number's place within the
element's row of the array. The kind of options is ``"option"``."""


class RandomisedEnv(gymnasium.Wrapper):
    """Gives a MuJoCo environment another draw of the robot's parameters at every reset.

    Args:
        env: The environment. Its unwrapped one has ``model`` and ``data``, as a ``MujocoEnv`` has.
        fields: The numbers of the model that the draws set.
        draws: An ``.npz`` file: ``fields``, the values of the fields, shape (draws, fields);
            ``parameters``, the parameters, shape (draws, parameters); ``names``, their names.
        hard_friction: Joints whose dry friction is made as hard as the engine allows.
        make_effects: Makes what takes the steps, from a model and one draw of the parameters;
            ``None`` for the engine itself.

    Attributes:
        draw: Number of the present draw.
        parameters: Its parameters by name.
        measured: What the robot's sensors report, with their errors, by channel; empty without
            effects.
    """

    def __init__(
        self,
        env: Any,
        fields: Sequence[Field],
        draws: str | Path,
        hard_friction: Sequence[str | int] = (),
        make_effects: Callable[[Any, Mapping[str, float]], Any] | None = None,
    ) -> None:
        super().__init__(env)
        with np.load(draws, allow_pickle=False) as file:
            self._values, self._parameters = file["fields"], file["parameters"]
            self._names = [str(name) for name in file["names"]]
        self._robot: Any = env.unwrapped
        model = self._robot.model
        self._places = [self._place(model, *number) for number in fields]
        for name in hard_friction:
            dof = int(_element(model, "joint", name).dofadr[0])
            model.dof_solref[dof] = 2.0 * model.opt.timestep, 1.0
            model.dof_solimp[dof] = 0.9999, 0.9999, 0.001, 0.5, 2.0
        for array, kind, name, _ in fields:
            if array in ("actuator_forcerange", "actuator_ctrlrange"):
                limited = getattr(model, array.replace("range", "limited"))
                limited[_element(model, kind, name).id] = 1
        self._make_effects, self._effects = make_effects, None
        self._random = np.random.default_rng()
        self._scratch = mujoco.MjData(model)
        if make_effects is not None:
            if not hasattr(self._robot, "_step_mujoco_simulation"):
                raise TypeError("The environment is no MujocoEnv, so effects cannot act in it.")
            self._robot._step_mujoco_simulation = self._advance
        self.draw, self.parameters, self.measured = 0, {}, {}
        self.use(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Takes another draw, then resets the environment.

        Args:
            seed: Seed of the environment and of the choice of draws.
            options: ``{"draw": 3}`` chooses a draw; the rest is for the environment.
        """
        if seed is not None:
            self._random = np.random.default_rng(seed)
        options = dict(options or {})
        self.use(int(options.pop("draw", self._random.integers(len(self._values)))))
        observation, info = self.env.reset(seed=seed, options=options or None)
        if self._effects is not None:
            self.measured = self._effects.reset(self._robot.data)
        told = {"draw": self.draw, "parameters": self.parameters, "measured": self.measured}
        return observation, info | told

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advances the environment; ``info["measured"]`` is what the robot's sensors report."""
        observation, reward, ends, is_cut, info = self.env.step(action)
        return observation, reward, ends, is_cut, info | {"measured": self.measured}

    def use(self, draw: int) -> None:
        """Writes a draw into the model; the next reset of the environment begins with it."""
        model = self._robot.model
        for (owner, name, place), value in zip(self._places, self._values[draw], strict=True):
            if place is None:
                setattr(owner, name, value)
            else:
                getattr(owner, name).reshape(-1)[place] = value
        # Inverse inertias and lengths follow from the numbers above.
        mujoco.mj_setConst(model, self._scratch)
        self.draw = draw
        row = self._parameters[draw]
        self.parameters = {n: float(v) for n, v in zip(self._names, row, strict=True)}
        if self._make_effects is not None:
            self._effects = self._make_effects(model, self.parameters)
            self._effects.reset(self._robot.data)

    def _advance(self, ctrl: Any, n_frames: int) -> None:
        """Takes the steps of one action."""
        assert self._effects is not None
        self.measured = self._effects.step(self._robot.data, ctrl, n_frames)
        mujoco.mj_rnePostConstraint(self._robot.model, self._robot.data)

    @staticmethod
    def _place(
        model: Any, array: str, kind: str, name: str | int, place: int
    ) -> tuple[Any, str, int | None]:
        """Returns what has a field, its name in it, and its place; ``None`` for a number."""
        if kind == "option":
            is_number = np.ndim(getattr(model.opt, array)) == 0
            return model.opt, array, None if is_number else place
        element = _element(model, kind, name)
        row = element.id
        if array.startswith("dof_"):
            row = int(element.dofadr[0])
        elif array.startswith("qpos"):
            row = int(element.qposadr[0])
        return model, array, row * int(getattr(model, array)[0].size) + place


def _element(model: Any, kind: str, name: str | int) -> Any:
    """Returns an element of a model."""
    try:
        return getattr(model, kind)(name)
    except (KeyError, IndexError):
        raise ValueError(
            f"The environment's model has no {kind} {name!r}; it needs the robot's file with "
            "which the parameters were identified."
        ) from None
