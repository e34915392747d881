"""A baseline: sparse regression of the force that the refitted model lacks.

What one would do without a catalogue of effects (Brunton, Proctor and Kutz 2016): a library of
candidate terms in each joint's position, velocity and command, of which sequentially thresholded
least squares keeps few, as many as BIC likes best. A term is read as the effect that has this
law; one that no effect has stands for an effect outside the catalogue. What has no term, such as
an effect of the sensors, cannot be found.

Reference: S. L. Brunton, J. L. Proctor, J. N. Kutz, Discovering governing equations from data by
sparse identification of nonlinear dynamical systems, 2016; the optimizer is pysindy's.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
from hidden_rigs.sizes import COGGING_ORDERS
from residual_forces import Array, ResidualForces, residual_forces

from npdr_ppl.discovery.hypothesis import Hypothesis
from npdr_ppl.errors import NpdrError
from npdr_ppl.rollouts import Rollouts

__all__ = [
    "SparseChoice",
    "Term",
    "least_squares",
    "name_first",
    "select",
    "sparse_choice",
    "terms",
]

NUM_THRESHOLDS = 40
"""Thresholds tried, from a thousandth of the largest coefficient to the one that keeps none."""

RIDGE = 1e-6
"""Weight of the squared coefficients of columns of unit length: keeps collinear ones solvable."""

STRIBECK_SPEED = 0.1
"""Velocity within which static friction fades, in the joint's root-mean-square velocity."""

Laws = dict[tuple[str, str], Array]
"""Values of terms by label and effect id, the latter empty where no effect has this law."""


@dataclass(frozen=True)
class SparseChoice:
    """Result of sparse regression.

    Attributes:
        first: Name of the effect whose term explains most, ``None`` if no term was kept. A term
            that is no effect's has a name like ``"hinge: v³"``.
        terms: Coefficients of all terms kept, in the port's unit per unit of the term.
        left_out: Why there is no result, empty if there is.
    """

    first: str | None = None
    terms: dict[str, float] = field(default_factory=dict)
    left_out: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values."""
        return asdict(self)


@dataclass(frozen=True)
class Term:
    """One column of a joint's library.

    Attributes:
        label: What it is, e.g. ``"hinge: v|v|"``.
        name: The effect that has this law, or the label.
        values: Values along the recording, filtered, ``(n,)``.
    """

    label: str
    name: str
    values: Array


def sparse_choice(hypothesis: Hypothesis, rollouts: Rollouts) -> SparseChoice:
    """Returns what sparse regression would name first.

    Args:
        hypothesis: The model in question, its parameters refitted.
        rollouts: The recording.
    """
    if find_spec("pysindy") is None:
        return SparseChoice(left_out="not installed")
    try:
        found = residual_forces(hypothesis, rollouts)
    except (NpdrError, np.linalg.LinAlgError) as error:
        return SparseChoice(left_out=str(error))
    return name_first(found, rollouts.action_names)


def name_first(found: ResidualForces, actions: Sequence[str]) -> SparseChoice:
    """Regresses each joint's force and returns what explains most of any.

    Args:
        found: The missing forces.
        actions: Names of the commands.
    """
    best, first = 0.0, None
    kept: dict[str, float] = {}
    forces = found.filtered(found.forces)
    for joint in range(len(found.ports)):
        library = terms(found, joint, actions)
        columns = np.stack([term.values for term in library], axis=1)
        chosen = select(columns, forces[:, joint])
        fit = least_squares(columns[:, chosen], forces[:, joint])
        for place, k in enumerate(chosen):
            kept[library[k].label] = float(fit.coefficients[place])
            others = [j for j in chosen if j != k]
            without = least_squares(columns[:, others], forces[:, joint])
            gain = len(columns) * math.log(without.misfit / fit.misfit)
            if gain > best:
                best, first = gain, library[k].name
    return SparseChoice(first, kept)


def terms(found: ResidualForces, joint: int, actions: Sequence[str]) -> list[Term]:
    """Returns the library of one joint.

    Commands count where a joint is driven, each at one joint, in their order.

    Args:
        found: The missing forces and the motion.
        joint: Index of the joint.
        actions: Names of the commands.
    """
    port = found.ports[joint]
    driven = [j for j, other in enumerate(found.ports) if other.is_driven]
    command = driven.index(joint) if joint in driven else len(actions)
    speed = np.concatenate([motion.velocities[:, joint] for motion in found.motions])
    static = STRIBECK_SPEED * float(np.sqrt(np.mean(speed**2)))
    by_rollout: list[dict[tuple[str, str], Array]] = []
    for motion in found.motions:
        q, v = motion.positions[:, joint], motion.velocities[:, joint]
        laws = _force_laws(q, v, static)
        if port.coordinate == "rad":
            laws |= _turning_laws(q)
        named = {(label, port.name, effect): x for (label, effect), x in laws.items()}
        if command < len(actions):
            u, rate = motion.actions[:, command], motion.action_rates[:, command]
            named[("|u| sign v", port.name, "load_dependent_friction")] = np.abs(u) * np.sign(v)
            for (label, effect), x in _command_laws(u, rate).items():
                named[(label, actions[command], effect)] = x
        by_rollout.append(named)
    result = []
    for label, place, effect in by_rollout[0]:
        values = found.filtered([laws[label, place, effect][:, None] for laws in by_rollout])
        full = f"{port.name}: {label}"
        result.append(Term(full, f"{place}.{effect}" if effect else full, values[:, 0]))
    return result


def select(columns: Array, force: Array) -> list[int]:
    """Returns the columns that sequentially thresholded least squares keeps, maybe none.

    Args:
        columns: Candidate terms, ``(n, k)``; rows are independent.
        force: What they are to explain, ``(n,)``.
    """
    from pysindy import STLSQ

    lengths = np.linalg.norm(columns, axis=0)
    usable = np.flatnonzero(lengths > 0.0)
    if not usable.size:
        return []
    unit = columns[:, usable] / lengths[usable]
    start = np.linalg.solve(unit.T @ unit + RIDGE * np.eye(len(usable)), unit.T @ force)
    supports: set[tuple[int, ...]] = {()}
    for threshold in np.abs(start).max() * np.geomspace(1e-3, 1.0, NUM_THRESHOLDS):
        optimizer = STLSQ(threshold=threshold, alpha=RIDGE, max_iter=len(usable) + 1)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparsity parameter is too big")
            optimizer.fit(unit, force[:, None])
        support = tuple(int(k) for k in usable[np.flatnonzero(optimizer.coef_[0])])
        if not support:
            break
        supports.add(support)
    num = len(force)

    def criterion(support: tuple[int, ...]) -> float:
        misfit = least_squares(columns[:, list(support)], force).misfit
        return num * math.log(misfit / num) + len(support) * math.log(num)

    return list(min(sorted(supports), key=criterion))


@dataclass(frozen=True)
class LeastSquares:
    """Coefficients, ``(k,)``, and the sum of squares that they leave."""

    coefficients: Array
    misfit: float


def least_squares(columns: Array, force: Array) -> LeastSquares:
    """Fits a force by columns, maybe none."""
    coefficients = np.linalg.lstsq(columns, force, rcond=None)[0]
    misfit = float(np.square(force - columns @ coefficients).sum())
    return LeastSquares(coefficients, max(misfit, 1e-300))


def _force_laws(q: Array, v: Array, static: float) -> Laws:
    """Returns what a joint's force may be a function of; static friction fades at a velocity."""
    return {
        ("1", "bias"): np.ones_like(q),
        ("v", "viscous_friction"): v,
        ("sign v", "coulomb_friction"): np.sign(v),
        ("exp(−|v|/v_s) sign v", "stribeck_friction"): np.exp(-np.abs(v) / static) * np.sign(v),
        ("v|v|", "quadratic_drag"): v * np.abs(v),
        ("v³", ""): v**3,
        ("q", "spring"): q,
        ("q³", "hardening_spring"): q**3,
        ("q²", ""): q**2,
        ("q v", ""): q * v,
    }


def _turning_laws(q: Array) -> Laws:
    """Returns waves over the angle of a joint that turns."""
    return {
        ("sin q", "unbalance"): np.sin(q),
        ("cos q", "unbalance"): np.cos(q),
    } | {
        (f"{name} {order} q", "cogging"): wave(order * q)
        for order in COGGING_ORDERS
        for name, wave in (("sin", np.sin), ("cos", np.cos))
    }


def _command_laws(u: Array, rate: Array) -> Laws:
    """Returns what a command may lack: u(t − d) ≈ u − d u̇, gain, sag, limit and dead zone."""
    return {
        ("u", "actuator_gain"): u,
        ("u̇", "input_delay"): rate,
        ("u|u|", "supply_sag"): u * np.abs(u),
        ("u³", "saturation"): u**3,
        ("sign u", "dead_zone"): np.sign(u),
        ("u²", ""): u**2,
    }
