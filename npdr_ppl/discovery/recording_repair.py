"""Repairs a recording before it is fitted, so that faults in it are not taken for the device's.

Faults that are visible without a model are left out (``rollouts/faults.py``). A recording in
degrees, with an inverted sign or with late time stamps of its commands looks like a device with a
missing effect, and a large catalogue would offer one. Each such fault has a remedy that can be
tried: the recording is corrected and the model is fitted again. A remedy is applied if it explains
the recording and the recording as it is cannot be explained. What was done is said in
``Recording.notes``.
"""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model
from npdr_ppl.discovery.remedies import Remedy, Shift, remedies, without_one
from npdr_ppl.discovery.remedy_trials import RemedyTrials, Windows, misfits_of, root_mean_square
from npdr_ppl.discovery.search.base_fit import searched_fit
from npdr_ppl.discovery.settings import REPAIR
from npdr_ppl.errors import DataError
from npdr_ppl.language.handlers import with_noise
from npdr_ppl.language.model import Model
from npdr_ppl.language.prior import Prior
from npdr_ppl.language.simulator import Simulator
from npdr_ppl.language.sites import SimulatorBlackBox
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel, has_closest_fit
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.collection import with_commands, with_followers, without_duplicates
from npdr_ppl.rollouts.faults import without_faults
from npdr_ppl.rollouts.notes import faults_among
from npdr_ppl.rollouts.quaternion_signs import continuous
from npdr_ppl.rollouts.simulator_checks import limited_commands
from npdr_ppl.rollouts.wrapped_angles import unwrapped

__all__ = ["Repair", "repair"]


@dataclass(frozen=True)
class Repair:
    """A repaired recording.

    Attributes:
        rollouts: The recording to be fitted; its ``notes`` say what was changed.
        simulator: The model's simulator; ``None`` if the model has none or several, and the
            recording is as it was.
        remedies: The remedies that were applied; other recordings of the same device need them,
            too.
        parameters: Parameters that are close to the recording, ``None`` if they were not searched
            for. A fit may begin there.
    """

    rollouts: Rollouts
    simulator: Simulator | None
    remedies: tuple[Remedy, ...] = ()
    parameters: Mapping[str, Tensor] | None = None

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


def repair(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    *,
    seed: int = 0,
    report: Callable[[str], None] = lambda status: None,
) -> Repair:
    """Returns a recording that is ready to be fitted.

    Args:
        model: A Pyro model with one simulator.
        rollouts: The recording.
        options: How it is cut into segments.
        seed: Seed of a search of the priors.
        report: Called with a short status before each long step.

    Raises:
        DataError: The recording does not fit the model, or nothing usable is left of it.
    """
    if not _takes_inputs(model):
        raise DataError(
            "The model takes no inputs, so its simulator cannot replay rollouts; write "
            "model(inputs) with a simulator that takes initial states and actions, such as an "
            "npdr.FunctionSimulator."
        )
    _refuse_if_strict(rollouts, options)
    prior = Prior(with_noise(model, None), (rollouts.inputs(None, "recorded"),))
    boxes = [*prior.black_boxes.values()]
    simulators = [box.simulator for box in boxes if isinstance(box, SimulatorBlackBox)]
    if len(boxes) != 1 or not simulators:
        return Repair(rollouts, None)
    (simulator,) = simulators
    if options.strict:
        rollouts.check(simulator.sensors, simulator.actions, allow_extra=True)
    rollouts = _without_visible_faults(rollouts, simulator)
    _refuse_if_strict(rollouts, options)
    applied: list[Remedy] = []
    if options.initial_state != "uncertain" or not has_closest_fit(prior):
        return Repair(rollouts, simulator)
    length = options.steps(rollouts) or max(rollouts.lengths)
    options = replace(options, embedding=None, segment_length=length)
    with seeded(0, "try out"):
        # Run as inference will run it, so that the model's own mistakes are reported first.
        tried = Prior(model, (options.with_certain_start().inputs(rollouts),))
        tried.execute(tried.sample(2))
    parameters = None
    while len(applied) < REPAIR.most_remedies:
        remedy, parameters = _remedy_for(model, rollouts, options, report, seed)
        if remedy is None:
            break
        parameters = None
        applied.append(remedy)
        rollouts = remedy.apply(rollouts)
        rollouts = replace(rollouts, notes=(*rollouts.notes, remedy.sentence))
        _refuse_if_strict(rollouts, options)
    return Repair(rollouts, simulator, tuple(applied), parameters)


def _takes_inputs(model: Model) -> bool:
    """Returns whether a model can be called with inputs, as far as its signature tells."""
    try:
        inspect.signature(model).bind(None)
    except TypeError:
        return False
    except ValueError:  # Pyro's handlers wrap a model in a callable without a signature.
        return True
    return True


def _refuse_if_strict(rollouts: Rollouts, options: DataOptions) -> None:
    """Raises a DataError with the first fault of a recording, if faults are to be refused."""
    faults = faults_among(rollouts.notes)
    if options.strict and faults:
        raise DataError(faults[0])


def _without_visible_faults(rollouts: Rollouts, simulator: Simulator) -> Rollouts:
    """Returns a recording without faults that are visible without a simulation."""
    rollouts = without_duplicates(with_commands(rollouts, simulator.actions))
    rollouts = with_followers(rollouts, simulator.followers)
    rollouts.check(simulator.sensors, simulator.actions, allow_extra=True, strict=False)
    measured = [s for s in simulator.sensors if s.name in rollouts.measured_names]
    if not measured:
        names = ", ".join(sensor.name for sensor in simulator.sensors)
        raise DataError(
            f"None of the recording's columns {', '.join(rollouts.channel_names)} is a sensor of "
            f"the model, {names}; rename them."
        )
    rollouts = continuous(unwrapped(rollouts, measured), measured)
    rollouts = without_faults(rollouts, measured)
    try:
        rollouts.check(simulator.sensors, simulator.actions, allow_extra=True, strict=False)
    except DataError as error:
        faults = [fault.rstrip(".") for fault in faults_among(rollouts.notes)[-1:]]
        raise DataError("; ".join((*faults, str(error)))) from None
    limited = limited_commands(rollouts, simulator.actions)
    return replace(rollouts, notes=(*rollouts.notes, *limited)) if limited else rollouts


def _remedy_for(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    report: Callable[[str], None],
    seed: int = 0,
) -> tuple[Remedy | None, Mapping[str, Tensor] | None]:
    """Returns the remedy that explains a recording best, if the recording is not explained.

    The second result is the closest parameters to the recording as it was read, if they were
    searched for.
    """
    windows, found = Windows(rollouts, options), None
    report("checking the recording: a rough fit of it as it was read")
    as_read = windows.fitted(model, rollouts)
    if as_read is not None and root_mean_square(misfits_of(as_read)) >= REPAIR.large_residual:
        # Before data are blamed, the parameters are searched for as thoroughly as for a fit.
        report("checking the recording: a thorough fit, because the rough one leaves much")
        searched = _searched(as_read.segments, seed)
        if searched is not None:
            as_read = min(as_read, searched, key=lambda each: root_mean_square(misfits_of(each)))
            found = as_read.parameters
    if as_read is not None and root_mean_square(misfits_of(as_read)) < REPAIR.large_residual:
        return None, found
    return _trusted_remedy(model, rollouts, options, windows, as_read, report), found


def _trusted_remedy(
    model: Model,
    rollouts: Rollouts,
    options: DataOptions,
    windows: Windows,
    as_read: Hypothesis | None,
    report: Callable[[str], None],
) -> Remedy | None:
    """Returns the remedy that explains a recording best; ``None`` if none explains enough.

    Args:
        model: The model.
        rollouts: The recording.
        options: How it is cut into segments.
        windows: The segments along which remedies are tried.
        as_read: The fit of the recording as it was read; ``None`` if simulations fail.
        report: Called with a short status.
    """
    trials = RemedyTrials(model, rollouts, windows, as_read)
    present, ratio = trials.present, trials.ratio
    segments = SegmentModel(model, rollouts, options) if as_read is None else as_read.segments
    sensors = segments.measured
    # A channel that the simulation explains has no fault.
    suspects = {s.name for s in sensors if present.get(s.name, math.inf) >= REPAIR.large_residual}
    joints = {s.rate_of or s.name for s in sensors if s.name in suspects}
    singly = len(joints) <= REPAIR.most_suspects
    best, least = _best(remedies(sensors, rollouts, suspects, singly=singly), ratio, report)
    if best is not None and isinstance(best.apply, Shift):
        best, least = _refined(best.apply, ratio)
    if best is not None and least < REPAIR.remedy_factor:
        if _is_early(best) and least >= REPAIR.remedy_factor * trials.ratio_with_lag():
            # It may be the device that answers late, which is for discovery to name.
            return None
        without = trials.ratio_without(best)
    else:
        # A channel is given up only if nothing else helps.
        best, least = _best(without_one(sensors) if singly else (), ratio, report)
        without = 1.0
    if best is None or least >= REPAIR.remedy_factor * without:
        return None
    if as_read is None or least * root_mean_square(present) < REPAIR.large_residual:
        return best
    # What a remedy does not explain, either, may be a matter of priors that are too narrow.
    return best if least < REPAIR.remedy_factor * trials.ratio_with_wider_priors(as_read) else None


def _is_early(remedy: Remedy) -> bool:
    """Returns whether a remedy treats the commands' time stamps as too early."""
    shift = remedy.apply
    return isinstance(shift, Shift) and shift.channel is None and shift.steps < 0.0


def _best(
    remedies: Iterable[Remedy], ratio: Callable[[Remedy], float], report: Callable[[str], None]
) -> tuple[Remedy | None, float]:
    """Returns the remedy with the least ratio, and the ratio; says how many are tried."""
    best, least = None, math.inf
    waiting = list(remedies)
    for number, remedy in enumerate(waiting):
        report(
            f"checking the recording: {number} of {len(waiting)} other units, signs and time "
            "stamps tried"
        )
        found = ratio(remedy)
        if found < least:
            best, least = remedy, found
    return best, least


def _refined(shift: Shift, ratio: Callable[[Remedy], float]) -> tuple[Remedy, float]:
    """Returns the shift near another one that explains a recording best, and its ratio.

    A shift to half a step would leave a delay that discovery could name. The square of the misfit
    is a parabola near its least value.
    """
    whole = {steps: ratio(shift.by(steps)) for steps in range(-2, 3)}
    best = min(whole, key=whole.__getitem__)
    early, late = (ratio(shift.by(best + part)) ** 2 for part in (-0.5, 0.5))
    curvature = early + late - 2.0 * whole[best] ** 2
    remedy, least = shift.by(best), whole[best]
    if 0.0 < curvature < math.inf:
        part = round(min(max(0.25 * (early - late) / curvature, -0.5), 0.5), 2)
        moved = shift.by(best + part)
        if (found := ratio(moved)) < least:
            return moved, found
    return remedy, least


def _searched(segments: SegmentModel, seed: int) -> Hypothesis | None:
    """Returns a rough fit that begins at the result of a search; ``None`` if simulations fail."""
    try:
        found, _ = searched_fit(segments, seed=seed)
        return fit_segment_model(segments, start=found.parameters, max_steps=6, is_rough=True)
    except DataError:
        return None
