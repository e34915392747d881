"""Names for shell completion: models, backends, effects and more, without importing them.

The registries import torch, which is too slow for tab completion. The names are therefore repeated
here, and a test compares them with the registries. Names that other packages add are read from
their entry points, which is fast, and those of the user's effects from their files.
"""

from collections.abc import Iterable
from importlib.metadata import entry_points

from npdr_ppl.added_files import added_files, declared_ids

__all__ = [
    "BACKENDS",
    "EFFECTS",
    "MODELS",
    "SEARCHES",
    "TARGETS",
    "TASKS",
    "complete_backend",
    "complete_backends",
    "complete_effect",
    "complete_embedding",
    "complete_model",
    "complete_search",
    "complete_target",
    "complete_task",
]

MODELS = (
    "pendulum",
    "furuta",
    "furuta_paper",
    "cart_pole",
    "emps",
    "two_link_arm",
    "mini_golf",
    "mini_golf_two_restitutions",
)

TARGETS = ("furuta-easy", "furuta-medium", "furuta-hard", "furuta-random-0")

TASKS = ("furuta-swing-up",)

BACKENDS = (
    "abc",
    "bayesian-linear-regression",
    "bayessim",
    "fmpe",
    "nle",
    "nre",
    "nuts",
    "online-bayessim",
    "snpe-a",
    "snpe-c",
)

SEARCHES = ("cma-es", "power", "random")

EFFECTS = (
    "viscous_friction",
    "coulomb_friction",
    "asymmetric_coulomb_friction",
    "stribeck_friction",
    "presliding_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "friction_drift",
    "input_delay",
    "sensor_delay",
    "actuator_lag",
    "sensor_low_pass",
    "saturation",
    "supply_sag",
    "dead_zone",
    "actuator_gain",
    "servo_gain",
    "servo_force_limit",
    "servo_dead_band",
    "servo_integral_action",
    "goal_speed_limit",
    "goal_acceleration_limit",
    "goal_resolution",
    "bias",
    "cogging",
    "spring",
    "hardening_spring",
    "joint_elasticity",
    "backlash",
    "base_compliance",
    "payload",
    "offset_payload",
    "unbalance",
    "tilt",
    "encoder_bias",
    "encoder_scale",
    "quantisation",
    "clock_skew",
    "contact",
    "wind",
    "periodic_disturbance",
    "parameter_drift",
)

EMBEDDINGS = ("bayessim", "score", "all/", "gru/")
"""Names of trajectory features, or their beginnings."""


def complete_model(incomplete: str) -> list[str]:
    """Completes MODEL; if no name fits, the shell completes file names."""
    return _beginning_with(incomplete, MODELS)


def complete_target(incomplete: str) -> list[str]:
    """Completes a target domain."""
    return _beginning_with(incomplete, (*TARGETS, "gym:"))


def complete_task(incomplete: str) -> list[str]:
    """Completes a control task."""
    return _beginning_with(incomplete, TASKS)


def complete_backend(incomplete: str) -> list[str]:
    """Completes an inference backend."""
    return _beginning_with(incomplete, (*BACKENDS, *_added("npdr_ppl.backends")))


def complete_backends(incomplete: str) -> list[str]:
    """Completes the last backend of a comma-separated list."""
    done, comma, last = incomplete.rpartition(",")
    before = done + comma + " " * (len(last) - len(last.lstrip()))
    return [before + name for name in complete_backend(last.lstrip())]


def complete_search(incomplete: str) -> list[str]:
    """Completes a policy search."""
    return _beginning_with(incomplete, (*SEARCHES, *_added("npdr_ppl.policy_searches")))


def complete_effect(incomplete: str) -> list[str]:
    """Completes the effect in ``port.effect``, the last one of a comma-separated list.

    Ports are not completed, because the simulator would have to be loaded.
    """
    port, dot, last = incomplete.rpartition(".")
    if not dot:
        return []
    own = [name for file in added_files() for name in declared_ids(file)]
    names = _beginning_with(last, (*EFFECTS, *_added("npdr_ppl.effects"), *own))
    return [f"{port}.{name}" for name in names]


def complete_embedding(incomplete: str) -> list[str]:
    """Completes trajectory features."""
    return _beginning_with(incomplete, EMBEDDINGS)


def _added(group: str) -> list[str]:
    """Returns the names that installed packages add to a registry."""
    return [entry.name for entry in entry_points(group=group)]


def _beginning_with(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
