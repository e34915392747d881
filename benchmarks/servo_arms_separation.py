"""How well recordings of an arm tell a hidden effect from everything else.

The separation d of an effect is the distance between the rig's two recordings with and without
it, in standard deviations of the encoders' noise. What other parameters of the model under test
could imitate is projected out, whatever their priors, and so is the other hidden effect. In each
segment of 0.5 s, so is what another initial state could imitate: to first order, of each joint's
servo by itself.
"""

import importlib
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from discovery import meet_separation
from servo_arms_links import TIME_STEP, Arm, Array, Link, Values, mjcf
from servo_arms_rigs import FIT, Hidden, simulate

__all__ = ["LATE", "NOISE", "Twin", "alternatives", "sized"]

mujoco: Any = importlib.import_module("mujoco")

NOISE = 2e-4
"""Standard deviation of the encoders' noise, rad."""

LATE = ("servo_delay", "bus_delay")
"""Kinds of late commands."""

COARSE, MEDIUM = 2, 5
"""Steps of the rig per sample for derivatives with respect to parameters, and for separations."""

LEAST = 10.0
"""Least separation of every hidden effect."""

STRONGEST = 30.0
"""Multiple of an arm's typical size beyond which no arm is."""

TELLABLE = 3.0
"""Separation from another cause below which that cause counts as right, too."""

SEGMENT = 250
"""Samples in whose beginning the initial state is unknown."""


class Twin:
    """A rig without noise, and what its recordings to fit tell apart.

    Args:
        arm: The arm.
        true: The rig's values.
        commands: Commands of each rollout, ``(steps, n)``, in rad.
    """

    def __init__(self, arm: Arm, true: Values, commands: Sequence[Array]) -> None:
        self.arm = arm
        self.true = true
        self.commands = commands
        self._modes = _modes(arm, true)
        self._without: dict[int, Array] = {}

    def readings(
        self, hidden: Sequence[Hidden], *, true: Values | None = None, substeps: int = MEDIUM
    ) -> Array:
        """Returns readings of the rollouts to fit without noise, ``(rollouts, steps + 1, n)``."""
        values = true or self.true
        return np.stack(
            [simulate(self.arm, values, self.commands[i], hidden, substeps=substeps) for i in FIT]
        )

    def without(self, substeps: int = MEDIUM) -> Array:
        """Returns the readings if nothing is hidden."""
        if substeps not in self._without:
            self._without[substeps] = self.readings((), substeps=substeps)
        return self._without[substeps]

    def change(self, hidden: Sequence[Hidden]) -> Array:
        """Returns the change of the readings because of hidden effects."""
        return self.readings(hidden) - self.without()

    def derivatives(self, addresses: Mapping[str, str]) -> Sequence[Array]:
        """Returns the change of the readings for a change of each parameter by 5 %."""
        fields = {"damping": "dampings", "armature": "armatures", "mass": "masses"}
        changes = []
        for name in addresses:
            what, joint = name.split("_", 1)
            values = {f: np.array(getattr(self.true, f)) for f in fields.values()}
            values[fields[what]][self.arm.joints.index(joint)] *= 1.05
            other = self.readings((), true=Values(**values), substeps=COARSE)
            changes.append(other - self.without(COARSE))
        return changes

    def distance(self, change: Array, beside: Sequence[Array] = ()) -> float:
        """Returns the norm of a change in standard deviations, beyond other changes."""
        target = self._beyond_states(change)
        if beside:
            columns = np.stack([self._beyond_states(other) for other in beside], axis=1)
            columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
            target = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
        return float(np.linalg.norm(target))

    def _beyond_states(self, change: Array) -> Array:
        """Returns a change in standard deviations beyond what initial states explain, flat."""
        rollouts, samples, number = change.shape
        count = (samples - 1) // SEGMENT
        cut = change[:, 1 : 1 + count * SEGMENT] / NOISE
        cut = cut.reshape(rollouts * count, SEGMENT, number)
        found = np.einsum("jtm,stj->sjm", self._modes, cut)
        return (cut - np.einsum("jtm,sjm->stj", self._modes, found)).ravel()


def _modes(arm: Arm, true: Values) -> Array:
    """Returns each joint's free motions in a segment, orthonormal, ``(n, SEGMENT, 2)``."""
    model = mujoco.MjModel.from_xml_string(mjcf(arm, true))
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = [link.home for link in arm.links]
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    times = TIME_STEP * np.arange(1, SEGMENT + 1)
    result = []
    for i, link in enumerate(arm.links):
        stiffness, damping = link.gains[0], link.gains[1] + true.dampings[i]
        one, other = np.roots([inertia[i, i], damping, stiffness])
        if np.isreal(one):
            motions = np.exp(one.real * times), np.exp(other.real * times)
        else:
            motions = np.exp(one * times).real, np.exp(one * times).imag
        result.append(np.linalg.qr(np.stack(motions, axis=1))[0])
    return np.stack(result)


def sized(
    twin: Twin, hidden: tuple[Hidden, ...], nuisance: Sequence[Array], separation: float
) -> tuple[tuple[Hidden, ...], tuple[float, ...]]:
    """Returns effects with sizes that have the separation, and what each one has.

    Raises:
        ValueError: No size has it.
    """
    found = []
    for effect in hidden:

        def measure(strength: float, effect: Hidden = effect) -> float:
            return twin.distance(twin.change([effect.scaled(strength)]), nuisance)

        strength = 1.0
        if separation or measure(1.0) < LEAST:
            wanted = separation or LEAST
            strength, _ = meet_separation(measure, wanted, strongest=STRONGEST)
        found.append(effect.scaled(strength))
    separations = _beyond_each_other(twin, found, nuisance)
    weakest = min(separations)
    if weakest < LEAST:  # one of them alone could explain most of both
        found = [effect.scaled(1.2 * LEAST / weakest) for effect in found]
        separations = _beyond_each_other(twin, found, nuisance)
    if min(separations) < LEAST:
        raise ValueError(f"the effects separate by {min(separations):.1f} only")
    return tuple(found), separations


def _beyond_each_other(
    twin: Twin, hidden: Sequence[Hidden], nuisance: Sequence[Array]
) -> tuple[float, ...]:
    changes = [twin.change([effect]) for effect in hidden]
    return tuple(
        twin.distance(own, [*nuisance, *(c for c in changes if c is not own)]) for own in changes
    )


def alternatives(
    twin: Twin, hidden: Sequence[Hidden], truth: tuple[str, ...], nuisance: Sequence[Array]
) -> tuple[tuple[str, ...], ...]:
    """Returns sets of names that the recordings cannot tell from the truth."""
    choices = []
    for effect, name in zip(hidden, truth, strict=True):
        own: list[tuple[str, ...]] = [(name,)]
        if effect.kind == "bus_delay":
            own.append(tuple(f"{link.servo}.input_delay" for link in twin.arm.links))
        change = twin.change([effect])
        for names, other in _look_alikes(twin, effect):
            if twin.distance(change, [*nuisance, other]) < TELLABLE:
                own.append(names)
        choices.append(own)
    found = [
        tuple(name for names in chosen for name in names) for chosen in itertools.product(*choices)
    ]
    return tuple(found[1:])  # the first is the truth


def _look_alikes(twin: Twin, effect: Hidden) -> list[tuple[tuple[str, ...], Array]]:
    """Returns causes that may look like an effect, with the change of the readings by each."""
    arm, size = twin.arm, effect.size[0]
    before = twin.without()
    if effect.joint is None:
        own = slice(None)
        links: tuple[Link, ...] = arm.links
    else:
        own = slice(effect.joint, effect.joint + 1)
        links = (arm.links[effect.joint],)
    sensor = ",".join(link.joint for link in links)
    here = np.zeros_like(before)
    if effect.kind in LATE:
        slower = np.array(before)
        kept = math.exp(-TIME_STEP / size)
        for k in range(1, before.shape[1]):
            slower[:, k] += kept * (slower[:, k - 1] - slower[:, k])
        late, filtered = np.array(here), np.array(here)
        late[..., own] = (_shifted(before, size) - before)[..., own]
        filtered[..., own] = (slower - before)[..., own]
        lag = twin.change([Hidden("lag", effect.joint, (size,))])
        return [
            (tuple(f"{link.servo}.actuator_lag" for link in links), lag),
            ((f"{sensor}.sensor_delay",), late),
            ((f"{sensor}.sensor_low_pass",), filtered),
        ]
    if effect.kind == "payload":  # one with a place of its own contains it
        return [(("payload.offset_payload",), twin.change([effect]))]
    if effect.kind == "tool":
        return [(("payload.payload",), twin.change([Hidden("payload", None, (size,))]))]
    if effect.kind == "constant_torque":
        here[..., own] = 1.0
        return [((f"{sensor}.encoder_bias",), here)]
    if effect.kind == "sensor_offset":
        torque = Hidden("constant_torque", effect.joint, (links[0].gains[0] * size,))
        return [((f"{links[0].force_port}.bias",), twin.change([torque]))]
    return []


def _shifted(readings: Array, delay: float) -> Array:
    """Returns readings a time earlier; at the start the first."""
    times = TIME_STEP * np.arange(readings.shape[1])
    return np.apply_along_axis(lambda own: np.interp(times - delay, times, own), 1, readings)
