"""The original model along a recording: its fit, with steps and priors that suffice for it."""

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import Self

from torch import Tensor

from npdr_ppl.discovery.hypothesis import Hypothesis, extended
from npdr_ppl.discovery.search.base_fit import (
    fit_base,
    in_finer_steps,
    is_clearly_likelier,
    polished,
)
from npdr_ppl.discovery.search.prior_ends import own_priors_suffice, widen_where_it_helps
from npdr_ppl.discovery.search.trials import Trials
from npdr_ppl.language.effects import ActionEffect
from npdr_ppl.language.handlers import num_finer_steps, with_finer_steps
from npdr_ppl.language.model import Model
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.preparation.segment_model import SegmentModel
from npdr_ppl.progress import Step
from npdr_ppl.rollouts import Rollouts

__all__ = ["OriginalModel"]


class OriginalModel:
    """A model along a recording, without any added effect.

    Args:
        model: The model.
        rollouts: The recording.
        data_options: How the recording is cut into segments.
        seed: Seed of all random numbers.
        report: Called with a sentence at each step.

    Attributes:
        rollouts: The recording.
        data_options: How the recording is cut into segments.
        seed: Seed of all random numbers.
        are_steps_coarse: Whether the model's own integration steps are too coarse.
        are_priors_widened: Whether some of the model's priors were too narrow and were widened.
    """

    def __init__(
        self,
        model: Model,
        rollouts: Rollouts,
        data_options: DataOptions,
        *,
        seed: int = 0,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._model = model
        self.rollouts = rollouts
        self.data_options = data_options
        self.seed = seed
        self.are_steps_coarse = False
        self.are_priors_widened = False
        # Whether the last fit is rough, and where one in finer steps begins.
        self._is_rough = False
        self._finer_parameters: Mapping[str, Tensor] | None = None
        self._report = report

    @cached_property
    def base(self) -> SegmentModel:
        """The original model along the recording, to which every hypothesis adds effects.

        It has finer steps once its own were found to be too coarse, and wider priors once its own
        were found to be too narrow.

        Raises:
            DataError: The recording does not fit the model.
        """
        return SegmentModel(self._model, self.rollouts, self.data_options)

    @property
    def trials(self) -> Trials:
        """Fits of the model with its current integration steps and priors."""
        return Trials(self.base)

    def fit_base(
        self,
        *,
        near: Mapping[str, Tensor] | None = None,
        may_be_rough: bool = False,
        progress: Step | None = None,
    ) -> Hypothesis:
        """Fits the original model; see :func:`~npdr_ppl.discovery.search.base_fit.fit_base`.

        A rough fit must be followed by :meth:`settled`, or by :meth:`with_finer_steps` and
        :meth:`converged`.
        """
        self._report("fitting the original model")
        fitted, self._finer_parameters = fit_base(
            self.base, near=near, seed=self.seed, may_be_rough=may_be_rough, progress=progress
        )
        self._is_rough = self._finer_parameters is not None
        return fitted

    def settled(self, given: Hypothesis) -> Hypothesis:
        """Returns the fit with steps and priors that suffice; the given one if its own do.

        All later hypotheses use the steps and priors of the returned one.

        Args:
            given: The fitted original model.
        """
        # Where a prior is too narrow, a precise fit takes many steps towards its end.
        finer = self.with_finer_steps(given, is_rough=True)
        wider = self.with_wider_priors(finer)
        found = self.converged(finer) if wider is finer else wider
        return self.with_likelier_commands_before(found)

    def converged(self, current: Hypothesis) -> Hypothesis:
        """Returns the last fit of the original model, after precise steps if it is rough."""
        if not self._is_rough:
            return current
        self._is_rough = False
        return polished(current)

    def with_finer_steps(self, current: Hypothesis, *, is_rough: bool = False) -> Hypothesis:
        """Returns a hypothesis with finer steps if its own are too coarse; else unchanged.

        All later hypotheses use the steps of the returned one.

        Args:
            current: A fitted hypothesis.
            is_rough: Whether a rough fit is enough.
        """
        near, self._finer_parameters = self._finer_parameters, None
        found = in_finer_steps(
            current, self.base, near=near, is_rough=is_rough, report=self._report
        )
        self.base = found.segments
        is_new = found.hypothesis is not current
        self._is_rough = is_rough and not found.is_polished and (self._is_rough or is_new)
        self.are_steps_coarse = self.are_steps_coarse or found.are_steps_coarse
        return found.hypothesis

    def with_wider_priors(self, current: Hypothesis) -> Hypothesis:
        """Returns a hypothesis with wider priors if its own are too narrow; else unchanged.

        All later hypotheses use the priors of the returned one. So no effect is named if a wider
        prior explains the same misfit.

        Args:
            current: A fitted hypothesis.
        """
        found = widen_where_it_helps(self.base, current)
        if found is None:
            return current
        self._report(f"{found.ends[0]}")
        self.base, self.are_priors_widened = found.segments, True
        # The misfit caused by the narrow prior can hide that the steps are too coarse.
        return self.with_finer_steps(found.hypothesis)

    @property
    def found_options(self) -> DataOptions:
        """How recordings are prepared, with the commands before them that were found."""
        began = self.base.inputs.began_in_operation
        return replace(self.data_options, commands_before="first" if began else "zero")

    def with_likelier_commands_before(
        self, current: Hypothesis, *, compared: Hypothesis | None = None
    ) -> Hypothesis:
        """Returns a hypothesis with other commands before the recording, if they are likelier.

        Only delays and lags depend on them. If others are not likelier, the hypothesis is
        unchanged. All later hypotheses use the commands of the returned one. They are changed once
        at most.

        Args:
            current: A fitted hypothesis.
            compared: The hypothesis than which it must be likelier; itself by default.
        """
        base = self.base.with_other_commands_before()
        has_memory = any(isinstance(e, ActionEffect) for e in current.simulator.effects)
        if base is None or not has_memory or not current.can_be_linearised:
            return current
        segments, z = extended(base, current.effects, current.segments.starts), current.fit.z[None]
        likelihood = current.likelihood
        gain = replace(likelihood, segments=segments).log_prob(z) - likelihood.log_prob(z)
        if not float(gain) > 0.0:
            return current
        trials = Trials(base)
        found = trials.refitted_along(segments, current, current.effects)
        found = None if found is None else trials.with_own_starts(found)
        if found is None or not is_clearly_likelier(found, compared or current):
            return current
        self._report(
            "the first commands had been acting before the recording, so delays and lags begin "
            "with them"
            if base.inputs.began_in_operation
            else "there were no commands before the recording, so delays and lags begin from zero"
        )
        self.base = base
        return found

    def under_commands_found(self, given: Hypothesis) -> Hypothesis:
        """Returns a hypothesis refitted with the commands before the recording that were found.

        Args:
            given: A hypothesis with these or the other commands before it.
        """
        if given.segments.inputs.began_in_operation == self.base.inputs.began_in_operation:
            return given
        segments = given.segments.with_other_commands_before()
        if segments is None:
            return given
        found = Trials(segments).refitted_along(segments, given, given.effects)
        return given if found is None else found

    def take_own_priors(
        self, current: Hypothesis, alternatives: Iterable[Hypothesis] = ()
    ) -> bool:
        """Takes the model's own priors again if they suffice with the effects that were added.

        A missing effect can move parameters beyond their priors. Once it is added, wider priors
        would only let these parameters imitate a part of it.

        Args:
            current: The best model with effects and wider priors.
            alternatives: Models with other effects in place of the last one that are possible,
                too. With one of all these, the own priors must fit as well as wider ones do with
                the best.

        Returns:
            Whether it has its own priors again.
        """
        if not self.are_priors_widened:
            return False
        given = self._model
        for _ in range(num_finer_steps(self.base.model) - num_finer_steps(given)):
            given = with_finer_steps(given)
        own = self.base.with_model(given)
        models = chain((current,), alternatives)
        if not any(own_priors_suffice(own, model, current) for model in models):
            return False
        self._report("with the added effects, the model's own priors suffice")
        self.base, self.are_priors_widened = own, False
        return True

    def along(self, index: Tensor) -> Self:
        """Returns the same along some of the segments, with the current steps and priors.

        Args:
            index: Indices of the segments.
        """
        part = copy.copy(self)
        part.base = self.base.along(index)
        part._finer_parameters = None
        return part
