"""The model of one run of the loop, and what it has been given since the run began."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from npdr_ppl.loop.domains import prior_of
from npdr_ppl.loop.loop_discovery import LoopDiscovery
from npdr_ppl.loop.loop_options import Model, Revise
from npdr_ppl.loop.next_excitation import proposed_excitation
from npdr_ppl.policies.playback import Playback
from npdr_ppl.progress import Reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import TargetDomain

__all__ = ["LoopModel"]


class LoopModel:
    """A model that missing effects are added to.

    All attributes change together, where something is found; a resumed run, which repeats such
    looks only, has the same.

    Args:
        model: The Pyro model that the run begins with.
        target: The target domain.
        discovery: Looks for missing effects.
        revise: What does so in its place, if the caller has such a way of their own.

    Attributes:
        model: The model now.
        prior: Its prior.
        near: Parameters near which it is known to fit best; empty if nothing is known.
        proposal: What to run the device with so that the causes can be separated, if discovery
            proposes something.
    """

    def __init__(
        self, model: Model, target: TargetDomain, discovery: LoopDiscovery, revise: Revise | None
    ) -> None:
        self.target = target
        self.discovery = discovery
        self.revise = revise
        self.model = model
        self.prior = prior_of(model, target.sensors, target.actions, target.time_step)
        self.near: Mapping[str, Tensor] = {}
        self.proposal: Playback | None = None

    def look(self, rollouts: Rollouts, folder: Path, report: Reporter) -> tuple[bool, str]:
        """Looks for effects that the model lacks, and gives it what is found.

        Args:
            rollouts: All real rollouts so far.
            folder: Where what is found goes, or is read from if it has been looked for already.
            report: Where to report progress.

        Returns:
            Whether the model has effects now that were found, and what was found in a sentence.
        """
        target = self.target
        near: Mapping[str, Tensor] = {}
        proposal = None
        if self.revise is not None:
            found, finding = self.revise(self.model, rollouts, folder), ""
        else:
            step = report.stage("look for a missing effect")
            revision = self.discovery.look(rollouts, folder, step)
            found, finding, near = revision.model, revision.reason, revision.parameters
            proposal = proposed_excitation(revision.experiment, target.actions, target.time_step)
        if found is None:
            return False, finding
        self.model, self.near, self.proposal = found, near, proposal
        self.prior = prior_of(found, target.sensors, target.actions, target.time_step)
        return True, finding
