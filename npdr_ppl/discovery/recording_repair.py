"""Repairs a recording before it is fitted, so that faults in it are not taken for the device's.

Faults that are visible without a model are left out (``rollouts/faults.py``). A recording in
degrees, with an inverted sign or with late time stamps of its commands looks like a device with a
missing effect, and a large catalogue would offer one. Each such fault has a remedy that can be
tried: the recording is corrected and the model is fitted again. A remedy is applied if it explains
the recording and the recording as it is cannot be explained. What was done is said in
``Recording.notes``.
"""

import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_hypothesis, fit_segment_model
from npdr_ppl.discovery.search.base_fit import fit_base
from npdr_ppl.discovery.settings import REPAIR
from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel, has_closest_fit
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.arrays import Array
from npdr_ppl.rollouts.collection import with_commands, without_duplicates
from npdr_ppl.rollouts.faults import without_faults
from npdr_ppl.rollouts.sampling import Sampling, spans_without_gaps
from npdr_ppl.rollouts.simulator_checks import OTHER_UNITS

__all__ = ["Remedy", "Repair", "repair"]

SIGN_WINDOW = 4
"""Steps on each side of a zero crossing over which an absolute value falls and rises."""


@dataclass(frozen=True)
class Remedy:
    """A change of a recording that cures a fault.

    Attributes:
        sentence: What the fault looks like.
        apply: Changes rollouts.
    """

    sentence: str
    apply: Callable[[Rollouts], Rollouts]


@dataclass(frozen=True)
class Repair:
    """A repaired recording.

    Attributes:
        rollouts: The recording to be fitted; its ``notes`` say what was changed.
        simulator: The model's simulator; ``None`` if the model has none or several, and the
            recording is as it was.
        remedies: The remedies that were applied; other recordings of the same device need them,
            too.
    """

    rollouts: Rollouts
    simulator: Simulator | None
    remedies: tuple[Remedy, ...] = ()

    def applied_to(self, other: Rollouts) -> Rollouts:
        """Returns another recording of the device with the same remedies, without its own faults.

        Args:
            other: The recording, such as held-out rollouts.

        Raises:
            DataError: It does not fit the model, or nothing usable is left.
        """
        if self.simulator is None:
            return other
        other = _without_visible_faults(other, self.simulator)
        for remedy in self.remedies:
            other = remedy.apply(other)
        return other


def repair(model: Model, rollouts: Rollouts, options: DataOptions) -> Repair:
    """Returns a recording that is ready to be fitted.

    Args:
        model: A Pyro model with one simulator.
        rollouts: The recording.
        options: How it is cut into segments.

    Raises:
        DataError: The recording does not fit the model, or nothing usable is left of it.
    """
    if not _takes_inputs(model):
        raise DataError(
            "The model takes no inputs, so its simulator cannot replay rollouts; write "
            "model(inputs) with a simulator that takes initial states and actions, such as an "
            "npdr.FunctionSimulator."
        )
    prior = Prior(with_noise(model, None), (rollouts.inputs(None, "recorded"),))
    boxes = [*prior.black_boxes.values()]
    simulators = [box.simulator for box in boxes if isinstance(box, SimulatorBlackBox)]
    if len(boxes) != 1 or not simulators:
        return Repair(rollouts, None)
    (simulator,) = simulators
    if options.strict:
        rollouts.check(simulator.sensors, simulator.actions, allow_extra=True)
    told = rollouts.notes
    rollouts = _without_visible_faults(rollouts, simulator)
    _refuse_if_strict(rollouts, options, told)
    applied: list[Remedy] = []
    if options.initial_state != "uncertain" or not has_closest_fit(prior):
        return Repair(rollouts, simulator)
    length = options.steps(rollouts) or max(rollouts.lengths)
    options = replace(options, embedding=None, segment_length=length)
    with seeded(0, "try out"):
        # Run as inference will run it, so that the model's own mistakes are reported first.
        tried = Prior(model, (options.with_certain_start().inputs(rollouts),))
        tried.execute(tried.sample(2))
    while len(applied) < REPAIR.most_remedies:
        remedy = _remedy_for(model, rollouts, options)
        if remedy is None:
            break
        applied.append(remedy)
        rollouts = remedy.apply(rollouts)
        rollouts = replace(rollouts, notes=(*rollouts.notes, remedy.sentence))
        _refuse_if_strict(rollouts, options, told)
    return Repair(rollouts, simulator, tuple(applied))


def _takes_inputs(model: Model) -> bool:
    """Returns whether a model can be called with inputs, as far as its signature tells."""
    try:
        inspect.signature(model).bind(None)
    except TypeError:
        return False
    except ValueError:  # Pyro's handlers wrap a model in a callable without a signature.
        return True
    return True


def _refuse_if_strict(rollouts: Rollouts, options: DataOptions, told: Sequence[str]) -> None:
    """Raises a DataError with the first fault, if faults are to be refused.

    Args:
        rollouts: The repaired recording.
        options: Its options.
        told: Notes that the recording had before, about times, which are no faults.
    """
    if options.strict and len(rollouts.notes) > len(told):
        raise DataError(rollouts.notes[len(told)])


def _without_visible_faults(rollouts: Rollouts, simulator: Simulator) -> Rollouts:
    """Returns a recording without faults that are visible without a simulation."""
    rollouts = without_duplicates(with_commands(rollouts, simulator.actions))
    rollouts.check(simulator.sensors, simulator.actions, allow_extra=True, strict=False)
    measured = [s for s in simulator.sensors if s.name in rollouts.channel_names]
    if not measured:
        names = ", ".join(sensor.name for sensor in simulator.sensors)
        raise DataError(
            f"None of the recording's columns {', '.join(rollouts.channel_names)} is a sensor of "
            f"the model, {names}; rename them."
        )
    rollouts = without_faults(rollouts, measured)
    try:
        rollouts.check(simulator.sensors, simulator.actions, allow_extra=True, strict=False)
    except DataError as error:
        raise DataError(" ".join((*rollouts.notes[-1:], str(error)))) from None
    return rollouts


def _remedy_for(model: Model, rollouts: Rollouts, options: DataOptions) -> Remedy | None:
    """Returns the remedy that explains a recording best, if the recording is not explained."""
    as_read = _fitted(model, rollouts, options)
    if as_read is not None and _mean(_misfits(as_read)) >= REPAIR.large_residual:
        # Before data are blamed, the parameters are searched for as thoroughly as for a fit.
        searched = _searched(as_read.segments)
        if searched is not None and _mean(_misfits(searched)) < _mean(_misfits(as_read)):
            as_read = searched
    if as_read is not None and _mean(_misfits(as_read)) < REPAIR.large_residual:
        return None
    present = {} if as_read is None else _misfits(as_read)

    def ratio(remedy: Remedy) -> float:
        """Returns the misfit with a remedy, relative to that of the same channels without it."""
        try:
            tried = _fitted(model, remedy.apply(rollouts), options)
        except NpdrError:
            return math.inf
        if tried is None:
            return math.inf
        found = _misfits(tried)
        before = {name: present[name] for name in found if name in present}
        return _mean(found) / (_mean(before) if before else 1.0)

    best, least = _best(_remedies(model, rollouts, options), ratio)
    if best is not None and isinstance(best.apply, _Shift):
        near = [best.apply.by(steps) for steps in range(-2, 3)]
        best, least = _best([best, *near], ratio)
    if least < REPAIR.remedy_factor:
        return best
    # A channel is given up only if nothing else helps.
    best, least = _best(_without_one(model, rollouts, options), ratio)
    return best if least < REPAIR.remedy_factor else None


def _best(
    remedies: Iterable[Remedy], ratio: Callable[[Remedy], float]
) -> tuple[Remedy | None, float]:
    """Returns the remedy with the least ratio, and the ratio."""
    best, least = None, math.inf
    for remedy in remedies:
        found = ratio(remedy)
        if found < least:
            best, least = remedy, found
    return best, least


def _fitted(model: Model, rollouts: Rollouts, options: DataOptions) -> Hypothesis | None:
    """Returns a rough fit from the smoother's initial states; ``None`` if simulations fail."""
    try:
        return fit_hypothesis(model, rollouts, options, max_steps=6, is_rough=True)
    except DataError:
        return None


def _searched(segments: SegmentModel) -> Hypothesis | None:
    """Returns a rough fit that begins at the result of a search; ``None`` if simulations fail."""
    try:
        found = fit_base(segments)
        return fit_segment_model(segments, start=found.parameters, max_steps=6, is_rough=True)
    except DataError:
        return None


def _misfits(hypothesis: Hypothesis) -> dict[str, float]:
    """Returns the residual relative to the measurements' change in windows, by channel."""
    segments = hypothesis.segments
    names = segments.inputs.channel_names
    columns = [names.index(name) for name in segments.channel_names]
    change = segments.observed - segments.inputs.initial_values[:, None, columns]
    count = segments.num_measured.sum(0).clamp_min(1)
    square = (change * segments.is_measured).square().sum((0, 1))
    spread = (square / count).sqrt().double()
    ratio = (hypothesis.fit.scale / spread.clamp_min(1e-12)).clamp_max(10.0)
    return dict(zip(segments.channel_names, ratio.tolist(), strict=True))


def _mean(misfits: Mapping[str, float]) -> float:
    """Returns the geometric mean over the channels."""
    return math.exp(sum(math.log(max(value, 1e-12)) for value in misfits.values()) / len(misfits))


def _remedies(model: Model, rollouts: Rollouts, options: DataOptions) -> Iterator[Remedy]:
    segments = SegmentModel(model, rollouts, options)
    sensors = segments.measured
    units = {sensor.name: sensor.unit.removesuffix("/s") for sensor in sensors}
    pairs = [[s.rate_of, s.name] for s in sensors if s.rate_of in units]
    for group in [[name] for name in units] + pairs:
        text = f"The sign of {' and '.join(group)} looks inverted; it was changed."
        yield Remedy(text, _Scaled(group, -1.0))
    for si, (other, factor) in OTHER_UNITS.items():
        chosen = [name for name, unit in units.items() if unit == si]
        for group in [[name] for name in chosen] + ([chosen] if len(chosen) > 1 else []):
            looks = "look" if len(group) > 1 else "looks"
            names = " and ".join(group)
            text = f"{names} {looks} recorded in {other}, not in SI units; converted."
            yield Remedy(text, _Scaled(group, 1.0 / factor))
    for name in rollouts.action_names:
        text = f"The sign of {name} looks inverted; it was changed."
        yield Remedy(text, _ScaledAction(name, -1.0))
    shifts = [steps for steps in REPAIR.shifts if 4 * steps < min(rollouts.lengths)]
    long = [steps for steps in shifts if steps * rollouts.time_step > REPAIR.longest_delay]
    for steps in (*shifts, *(-steps for steps in long)):
        yield _Shift(None, steps).remedy
    for sensor in sensors:
        column = rollouts.channel_names.index(sensor.name)
        values = np.concatenate(rollouts.measurements(column))
        if len(values) and values.min() >= 0.0 and values.max() > 0.0:
            text = f"{sensor.name} looks recorded without its sign, which was restored."
            rates = [other.name for other in sensors if other.rate_of == sensor.name]
            position = sensor.rate_of if sensor.rate_of in units else None
            yield Remedy(text, _Signed(sensor.name, position, rates[0] if rates else None))
        limits = _plateaus(rollouts, column)
        if limits:
            text = f"{sensor.name} looks clipped; measurements at its limit are left out."
            yield Remedy(text, _WithoutLimits(sensor.name, limits))
        if len(sensors) > 1:
            for steps in (*(-steps for steps in shifts[2:]), *long):
                yield _Shift(sensor.name, steps).remedy


def _without_one(model: Model, rollouts: Rollouts, options: DataOptions) -> Iterator[Remedy]:
    sensors = SegmentModel(model, rollouts, options).measured
    for sensor in sensors if len(sensors) > 1 else ():
        text = f"{sensor.name} does not fit the other channels; it is not used."
        yield Remedy(text, _Without(sensor.name))


@dataclass(frozen=True)
class _Scaled:
    """Multiplies channels by a factor."""

    channels: Sequence[str]
    factor: float

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        names = rollouts.channel_names
        factors = np.where([name in self.channels for name in names], self.factor, 1.0)
        return _changed(rollouts, lambda values, _: values * factors)


@dataclass(frozen=True)
class _ScaledAction:
    """Multiplies an action by a factor."""

    name: str
    factor: float

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        factors = np.where([n == self.name for n in rollouts.action_names], self.factor, 1.0)
        return replace(rollouts, actions=tuple(values * factors for values in rollouts.actions))


@dataclass(frozen=True)
class _Shift:
    """Moves a channel, or all commands, some steps earlier, or later if negative.

    Attributes:
        channel: Name of the channel; ``None`` for the commands.
        steps: Number of steps.
    """

    channel: str | None
    steps: int

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        if self.channel is None:
            moved = tuple(_shifted(actions, self.steps) for actions in rollouts.actions)
            return replace(rollouts, actions=moved)
        column = rollouts.channel_names.index(self.channel)

        def change(values: Array, _: int) -> Array:
            result = values.copy()
            result[:, column] = _shifted(values[:, column], self.steps)
            return result

        return _changed(rollouts, change)

    @property
    def remedy(self) -> Remedy:
        """The remedy, with its sentence."""
        name = f"{self.channel} looks"
        if self.channel is None:
            name = "The time stamps of the commands look"
        when = "late" if self.steps > 0 else "early"
        return Remedy(f"{name} about {abs(self.steps)} steps too {when}; shifted.", self)

    def by(self, steps: int) -> Remedy:
        """Returns the remedy that moves some steps more."""
        return _Shift(self.channel, self.steps + steps).remedy


@dataclass(frozen=True)
class _Signed:
    """Gives a channel of absolute values its sign.

    Attributes:
        name: The channel.
        position: The channel whose rate it is, if that was recorded.
        rate: Its own rate, if that was recorded.
    """

    name: str
    position: str | None
    rate: str | None

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        names = rollouts.channel_names
        column = names.index(self.name)

        def change(values: Array, _: int) -> Array:
            result = values.copy()
            size = values[:, column]
            evidence = None
            if self.position is not None:
                evidence = np.gradient(values[:, names.index(self.position)])
            elif self.rate is not None:
                evidence = np.gradient(size) * values[:, names.index(self.rate)]
            result[:, column] = _with_signs(size, evidence)
            return result

        return _changed(rollouts, change)


@dataclass(frozen=True)
class _WithoutLimits:
    """Leaves out a channel's measurements at the limits of its range."""

    name: str
    limits: Sequence[float]

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        column = rollouts.channel_names.index(self.name)
        samplings, spans = [], []
        for index, readings in enumerate(rollouts.readings):
            at_limit = np.isin(readings[:, column], self.limits)
            known = _sampling(rollouts, index)
            is_read = known.is_read.copy()
            is_read[at_limit, column] = False
            samplings.append(Sampling(known.values.copy(), known.lateness.copy(), is_read))
            spans.append(spans_without_gaps(is_read[:, [column]]))
        return replace(rollouts, samplings=tuple(samplings), stretches=tuple(spans))


@dataclass(frozen=True)
class _Without:
    """Leaves out a channel."""

    name: str

    def __call__(self, rollouts: Rollouts) -> Rollouts:
        return rollouts.select([name for name in rollouts.channel_names if name != self.name])


def _sampling(rollouts: Rollouts, index: int) -> Sampling:
    if rollouts.samplings:
        return rollouts.samplings[index]
    values = rollouts.readings[index]
    return Sampling(values.copy(), np.zeros(values.shape), np.ones(values.shape, dtype=bool))


def _changed(rollouts: Rollouts, change: Callable[[Array, int], Array]) -> Rollouts:
    """Returns rollouts with other readings; called with readings ``(T + 1, C)`` and rollout."""
    return replace(
        rollouts,
        readings=tuple(change(values, k) for k, values in enumerate(rollouts.readings)),
        samplings=tuple(
            Sampling(change(s.values, k), s.lateness.copy(), s.is_read.copy())
            for k, s in enumerate(rollouts.samplings)
        ),
    )


def _shifted(values: Array, steps: int) -> Array:
    """Returns values some rows earlier, or later if negative; the ends are repeated."""
    size = abs(steps)
    if steps > 0:
        return np.concatenate((values[size:], np.repeat(values[-1:], size, 0)))
    return np.concatenate((np.repeat(values[:1], size, 0), values[:-size]))


def _with_signs(size: Array, evidence: Array | None) -> Array:
    """Returns absolute values ``(N,)`` with signs that change only where they turn near zero.

    Args:
        size: The absolute values.
        evidence: A curve that has the sign on average; ``None`` if there is none, and the sign
            alternates.
    """
    reach = SIGN_WINDOW
    turns = [0]
    for k in range(reach, len(size) - reach):
        falls, rises = size[k - reach] - size[k], size[k + reach] - size[k]
        is_least = size[k] <= size[k - reach : k + reach + 1].min()
        if is_least and size[k] < 0.5 * min(falls, rises) and k - turns[-1] >= reach:
            # The sign changes on the side on which the value is already rising.
            turns.append(k + int(size[k + 1] > size[k - 1]))
    result = size.copy()
    for number, (begin, end) in enumerate(itertools.pairwise((*turns, len(size)))):
        sign = (-1.0) ** number
        if evidence is not None:
            sign = float(np.sign(size[begin:end] @ evidence[begin:end])) or 1.0
        result[begin:end] *= sign
    return result


def _plateaus(rollouts: Rollouts, column: int) -> list[float]:
    """Returns the ends of a channel's range at which it stays for several measurements."""
    values = np.concatenate(rollouts.measurements(column))
    ends = [float(values.min()), float(values.max())]
    changes = np.diff(values)
    limits = []
    for end in ends:
        at_end = values == end
        stays = at_end[1:] & at_end[:-1]
        # Other values are hardly ever repeated, unless the encoder is coarse.
        usual = (changes[~at_end[1:]] == 0).mean() if (~at_end[1:]).any() else 1.0
        if stays.sum() >= REPAIR.fewest_clipped and stays.sum() > 2 * usual * at_end.sum():
            limits.append(end)
    return limits if ends[0] < ends[1] else []
