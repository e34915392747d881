"""The names of Isaac Lab that a configuration of events uses, with the arguments they take.

The arguments are those of ``isaaclab/envs/mdp/events.py`` of the versions 2.3.2 and 3.0.0, which
are the same. ``benchmarks/isaac_lab.py`` compares an exported file with the wheel of any version.
Isaac Lab itself needs Isaac Sim and a GPU.
"""

import inspect
import sys
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

REQUIRED = inspect.Parameter.empty

TERMS = {
    "randomize_rigid_body_mass": {
        "asset_cfg": REQUIRED,
        "mass_distribution_params": REQUIRED,
        "operation": REQUIRED,
        "distribution": "uniform",
        "recompute_inertia": True,
        "min_mass": 1e-6,
    },
    "randomize_rigid_body_material": {
        "static_friction_range": REQUIRED,
        "dynamic_friction_range": REQUIRED,
        "restitution_range": REQUIRED,
        "num_buckets": REQUIRED,
        "asset_cfg": REQUIRED,
        "make_consistent": False,
    },
    "randomize_rigid_body_com": {"com_range": REQUIRED, "asset_cfg": REQUIRED},
    "randomize_joint_parameters": {
        "asset_cfg": REQUIRED,
        "friction_distribution_params": None,
        "armature_distribution_params": None,
        "lower_limit_distribution_params": None,
        "upper_limit_distribution_params": None,
        "operation": REQUIRED,
        "distribution": "uniform",
    },
    "randomize_actuator_gains": {
        "asset_cfg": REQUIRED,
        "stiffness_distribution_params": None,
        "damping_distribution_params": None,
        "operation": REQUIRED,
        "distribution": "uniform",
    },
    "randomize_physics_scene_gravity": {
        "gravity_distribution_params": REQUIRED,
        "operation": REQUIRED,
        "distribution": "uniform",
    },
}
"""The arguments of each term, behind the environment and its numbers, with their defaults. The
terms of joints and gains read ``operation`` when they are made, before their default applies."""


@dataclass
class SceneEntityCfg:
    """An asset of the scene and some of its parts."""

    name: str
    joint_names: str | list[str] | None = None
    body_names: str | list[str] | None = None


@dataclass
class EventTermCfg:
    """A term; its arguments are checked as the event manager checks them."""

    func: Any
    mode: str
    params: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises an error if a term is not one that Isaac Lab would accept."""
        taken = TERMS[self.func]
        assert self.mode in ("prestartup", "startup", "reset", "interval")
        assert set(self.params) <= set(taken), self.params
        missing = {name for name, default in taken.items() if default is REQUIRED}
        assert missing <= set(self.params), self.params
        assert self.params.get("operation", "abs") in ("abs", "add", "scale")
        for name, value in self.params.items():
            if name.endswith("_params") and name != "gravity_distribution_params":
                low, high = value
                assert low <= high
            elif name == "com_range":
                assert set(value) <= set("xyz") and all(
                    low <= high for low, high in value.values()
                )


def install(monkeypatch):
    """Makes ``import isaaclab`` find these names."""
    modules = ("isaaclab", "isaaclab.envs", "isaaclab.envs.mdp", "isaaclab.managers")
    made = {name: ModuleType(name) for name in (*modules, "isaaclab.utils")}
    for name in TERMS:
        setattr(made["isaaclab.envs.mdp"], name, name)
    made["isaaclab"].envs = made["isaaclab.envs"]
    made["isaaclab.envs"].mdp = made["isaaclab.envs.mdp"]
    made["isaaclab.managers"].EventTermCfg = EventTermCfg
    made["isaaclab.managers"].SceneEntityCfg = SceneEntityCfg
    made["isaaclab.utils"].configclass = lambda cls: cls
    for name, module in made.items():
        monkeypatch.setitem(sys.modules, name, module)
