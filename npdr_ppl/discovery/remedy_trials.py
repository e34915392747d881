"""Fits of a recording with remedies, and how much each of them explains."""

import copy
import math
from collections.abc import Mapping

import torch
from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, fit_segment_model, with_effects
from npdr_ppl.discovery.remedies import Remedy, Shift
from npdr_ppl.discovery.screening.encoder_resolution import count_of
from npdr_ppl.discovery.search.prior_ends import with_widest_priors
from npdr_ppl.discovery.settings import REPAIR
from npdr_ppl.errors import DataError, NpdrError
from npdr_ppl.language.effects import Effect
from npdr_ppl.language.model import Model
from npdr_ppl.language.only_simulator import only_simulator
from npdr_ppl.models.effects import ActuatorLag
from npdr_ppl.models.effects.candidates import attached
from npdr_ppl.preparation.data_options import DataOptions, one_of_each_part
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.rollouts.segments import layout_of, motion_by_channel

__all__ = ["RemedyTrials", "Windows", "misfits_of", "relative_misfit", "root_mean_square"]

_LEAST_MOTION = 0.5
"""Motion of a channel in one of the first segments, as a share of its largest in any. A channel
that moves half as far shows a unit or a sign as clearly."""


class Windows:
    """The segments along which remedies are tried: the same with each of them, where possible.

    Attributes:
        options: How a recording is cut into segments.
        few: A part of them, which shows the remedies that help little; ``None`` if they are few.
    """

    def __init__(self, rollouts: Rollouts, options: DataOptions) -> None:
        """Chooses segments of a recording; those that move are preferred."""
        self.options = options
        self.few: Windows | None = None
        self._places: list[tuple[int, int]] | None = None
        used, length = options.used_segments(rollouts), options.steps(rollouts)
        layout, moving = layout_of(rollouts, length), motion_by_channel(rollouts, length)

        def some(num: int) -> Tensor:
            return used[one_of_each_part(num, len(used), seed=0, weights=moving[used].sum(-1))]

        if len(used) > REPAIR.most_segments:
            used = some(REPAIR.most_segments)
            self._places = [layout[k][:2] for k in used.tolist()]
        if len(used) >= 2 * REPAIR.first_segments:
            self.few = copy.copy(self)
            few = set(some(REPAIR.first_segments).tolist())
            for own in moving.T:
                # A channel that hardly moves in them would show neither a unit nor a sign.
                largest = int(used[own[used].argmax()])
                if own[[*few]].max() < _LEAST_MOTION * own[largest]:
                    few.add(largest)
            self.few._places = [layout[k][:2] for k in sorted(few)]

    def fitted(
        self, model: Model, rollouts: Rollouts, start: Mapping[str, Tensor] | None = None
    ) -> Hypothesis | None:
        """Returns a rough fit from the smoother's initial states.

        Args:
            model: The model.
            rollouts: The recording, as it was or with a remedy.
            start: Parameters from which the fit begins; by default the middle of the priors.

        Returns:
            ``None`` if simulations fail.
        """
        try:
            segments = self._along(SegmentModel(model, rollouts, self.options))
            return fit_segment_model(segments, start=start, max_steps=6, is_rough=True)
        except DataError:
            return None

    def _along(self, segments: SegmentModel) -> SegmentModel:
        """Returns a model along the segments that begin closest to the chosen ones."""
        return segments if self._places is None else segments.along(self.index(segments))

    def index(self, segments: SegmentModel) -> Tensor:
        """Returns the indices of the segments that begin closest to the chosen ones."""
        assert self._places is not None
        rollout, start = segments.inputs.rollout, segments.inputs.start
        found = set()
        for own, place in self._places:
            distance = (start - place).abs().double().masked_fill(rollout != own, math.inf)
            if bool(distance.isfinite().any()):
                found.add(int(distance.argmin()))
        if not found:
            raise DataError("No segment is left close to those that were chosen.")
        return torch.tensor(sorted(found))


class RemedyTrials:
    """Fits of a recording with remedies."""

    def __init__(
        self, model: Model, rollouts: Rollouts, windows: Windows, as_read: Hypothesis | None
    ) -> None:
        """Keeps the recording and its fit as it was read, ``None`` if simulations fail."""
        self._model, self._rollouts, self._windows = model, rollouts, windows
        self._as_read = None if as_read is None else as_read.parameters
        self.present = {} if as_read is None else misfits_of(as_read)
        """Misfit of the recording as it was read, by channel."""
        self._few: Windows | None = None
        self._present_in_few: dict[str, float] = {}
        if as_read is not None and windows.few is not None:
            self._few = windows.few
            part = as_read.along(windows.few.index(as_read.segments))
            self._present_in_few = misfits_of(part)
        self._shifted: dict[str | None, dict[float, Mapping[str, Tensor]]] = {}
        """Fitted parameters by channel and number of steps."""
        self._parameters: dict[str, Mapping[str, Tensor]] = {}
        """Fitted parameters by the sentence of a remedy."""

    def ratio(self, remedy: Remedy) -> float:
        """Returns the misfit with a remedy, relative to that of the same channels without it."""
        start, shift = None, remedy.apply
        known: dict[float, Mapping[str, Tensor]] = {}
        if isinstance(shift, Shift):
            # A step more moves the closest parameters a little. A fit that begins elsewhere can
            # end in another minimum.
            known = self._shifted.setdefault(shift.channel, {})
            if not known and self._as_read is not None:
                known[0.0] = self._as_read
            if known:
                start = known[min(known, key=lambda steps: abs(steps - shift.steps))]
        try:
            changed = remedy.apply(self._rollouts)
            # Where all rests in the few segments, they tell nothing.
            if self._few is not None and root_mean_square(self._present_in_few) > 0.0:
                first = self._few.fitted(self._model, changed, start)
                if first is None:
                    return math.inf
                ratio = relative_misfit(misfits_of(first), self._present_in_few)
                if ratio >= REPAIR.hopeless_ratio:
                    return ratio
                start = first.parameters
            tried = self._windows.fitted(self._model, changed, start)
        except NpdrError:
            return math.inf
        if tried is None:
            return math.inf
        if isinstance(shift, Shift):
            known[shift.steps] = tried.parameters
        self._parameters[remedy.sentence] = tried.parameters
        return relative_misfit(misfits_of(tried), self.present)

    def ratio_without(self, remedy: Remedy) -> float:
        """Returns the relative misfit without a remedy, fitted from where it was fitted with it.

        It is at most 1. If it is about as small as with the remedy, the parameters explain the
        recording and not the remedy: a servo that hardly acts predicts slow motions from their
        speed alone, whatever the commands.
        """
        start = self._parameters[remedy.sentence]
        again = self._windows.fitted(self._model, self._rollouts, start)
        return 1.0 if again is None else min(1.0, relative_misfit(misfits_of(again), self.present))

    def ratio_with_lag(self) -> float:
        """Returns the relative misfit of the recording as it was read, with a lag of the device.

        The lag is of first order, one for all commands of each kind. It looks like time stamps of
        commands that are too early.
        """
        simulator = only_simulator(self._model)[0].simulator
        widest: dict[str, Effect] = {}
        for lag in attached(simulator, ActuatorLag):
            kind = simulator.port(lag.port).kind
            if kind not in widest or len(lag.channels) > len(widest[kind].channels):
                widest[kind] = lag
        try:
            model = with_effects(self._model, tuple(widest.values()))
            tried = self._windows.fitted(model, self._rollouts, self._as_read) if widest else None
        except NpdrError:
            return math.inf
        return math.inf if tried is None else relative_misfit(misfits_of(tried), self.present)

    def ratio_with_wider_priors(self, as_read: Hypothesis) -> float:
        """Returns the relative misfit of the recording as it was read, with wider priors.

        Args:
            as_read: Its fit with the model's own priors.
        """
        widest, _ = with_widest_priors(as_read, is_rough=True)
        return relative_misfit(misfits_of(widest), self.present)


def misfits_of(hypothesis: Hypothesis) -> dict[str, float]:
    """Returns the residual relative to the measurements' change in windows, by channel.

    A share of the motion, in the windows with the largest residuals, does not count. A window that
    begins at an impact has a wrong initial state in any recording. A wrong unit, sign or time
    stamp shows in all windows in which the device moves.

    Rounding changes the difference of two measurements by up to the encoder's resolution.
    Residuals up to it are no misfit, and a channel that changes by less shows no unit and no sign:
    its ratio is 0. An idle gripper would otherwise make every recording of its arm look wrong.
    """
    segments = hypothesis.segments
    names = segments.inputs.channel_names
    columns = [names.index(name) for name in segments.channel_names]
    residual = hypothesis.difference
    change = segments.observed - segments.inputs.initial_values[:, None, columns]
    measured = segments.is_measured.expand(residual.shape)
    resolution = residual.new_tensor(
        [
            count_of(segments.observed[..., c][measured[..., c]].numpy()) or 0.0
            for c in range(residual.shape[-1])
        ]
    )
    residual = (residual.abs() - resolution).clamp_min(0.0)
    residuals, changes = (
        (values * measured).double().square().sum(1) for values in (residual, change)
    )  # (S, C)
    is_still = (resolution > 0.0) & (changes.sum(0) <= measured.sum((0, 1)) * resolution**2)
    order = residuals.argsort(0, descending=True)
    residuals, changes = residuals.gather(0, order), changes.gather(0, order)
    # All windows count if nothing was measured to move.
    is_counted = changes.cumsum(0) >= REPAIR.disregarded_share * changes.sum(0)
    left, moved = ((values * is_counted).sum(0) for values in (residuals, changes))
    ratio = (left / moved.clamp_min(1e-24)).sqrt().clamp_max(10.0).nan_to_num(10.0)
    ratio = ratio.masked_fill(is_still, 0.0)
    return dict(zip(segments.channel_names, ratio.tolist(), strict=True))


def relative_misfit(found: Mapping[str, float], present: Mapping[str, float]) -> float:
    """Returns misfits relative to those of the same channels in the recording as it was read."""
    before = {name: present[name] for name in found if name in present}
    after = root_mean_square(found)
    reference = root_mean_square(before) if before else 1.0
    if reference > 0.0:
        return after / reference
    # Channels that rest within their resolution cannot be explained better.
    return 1.0 if after == 0.0 else math.inf


def root_mean_square(misfits: Mapping[str, float]) -> float:
    """Returns the root of the mean square over the channels.

    A fault is often in one of many channels, and well explained channels must not hide it, as they
    would in a geometric mean.
    """
    return math.sqrt(sum(value**2 for value in misfits.values()) / len(misfits))
