"""What was done to a recording before inference, in one line and for a run's JSON."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.rollouts import Rollouts

__all__ = ["PreparationSummary"]


@dataclass(frozen=True)
class PreparationSummary:
    """What ``fit``, ``compare``, ``train`` and ``discover`` did to a recording.

    Attributes:
        rollouts: The recording that is fitted; its ``notes`` say what was repaired.
        options: How it is cut into segments.
        noise: Estimated standard deviation by channel, in its unit; ``None`` if the model keeps
            its own.
        are_steps_coarse: Whether the model's own integration steps were refined.
        independent_share: Effective number of independent measurements, as a share of all;
            ``None`` if it was not estimated.
        narrow_priors: The priors that end too early, a sentence each.
        jumps: A sentence about jumps of the simulation; empty if they do not matter.
    """

    rollouts: Rollouts
    options: DataOptions
    noise: Mapping[str, float] | None
    are_steps_coarse: bool
    independent_share: float | None
    narrow_priors: tuple[str, ...] = ()
    jumps: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Returns JSON-serialisable values, the sentence included."""
        length = self.options.steps(self.rollouts)
        embedding = self.options.embedding
        used, every = self.options.num_segments(self.rollouts)
        return {
            "sentence": self.sentence(),
            "recording": [str(note) for note in self.rollouts.notes],
            "segment_length": length,
            "segments": {"used": used, "recorded": every},
            "segment_seconds": None if length is None else length * self.rollouts.time_step,
            "initial_states": self.options.initial_state,
            "embedding": (
                embedding if embedding is None or isinstance(embedding, str) else repr(embedding)
            ),
            "noise": None if self.noise is None else dict(self.noise),
            "steps": "refined" if self.are_steps_coarse else "as the model has them",
            "independent_share": self.independent_share,
            "priors_too_narrow": list(self.narrow_priors),
            "jumps": self.jumps,
        }

    def sentence(self) -> str:
        """Returns a line that says how the recording was prepared, and what to beware of."""
        length = self.options.steps(self.rollouts)
        cut = (
            "whole rollouts"
            if length is None
            else f"segments of {length} steps ({length * self.rollouts.time_step:.3g} s)"
        )
        used, every = self.options.num_segments(self.rollouts)
        if used < every:
            cut = (
                f"{used} of {every} {cut}, one from each of {used} equal parts of the recording, "
                "moving ones preferred"
            )
        starts = {
            "uncertain": "initial states estimated with their errors",
            "estimated": "estimated initial states taken as true",
            "recorded": "recorded initial states taken as true",
        }[self.options.initial_state]
        noise = "the model's own noise" if self.noise is None else "noise estimated"
        steps = ", integration steps refined" if self.are_steps_coarse else ""
        held = self.options.commands_before == "first"
        before = ", first commands held before each rollout" if held else ""
        jumps = f" {self.jumps}" if self.jumps else ""
        return f"Prepared: {cut}, {starts}, {noise}{before}{steps}.{jumps}"
