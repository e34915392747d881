"""The model of one run of the loop, and the effects that the run has added to it."""

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from npdr_ppl.language.model import Model
from npdr_ppl.loop.domains import prior_of
from npdr_ppl.loop.loop_discovery import LoopDiscovery
from npdr_ppl.loop.loop_options import Revise
from npdr_ppl.loop.next_excitation import proposed_excitation
from npdr_ppl.policies.playback import Playback
from npdr_ppl.progress import Reporter
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import TargetDomain

__all__ = ["LoopModel"]


class LoopModel:
    """A model to which missing effects are added.

    All attributes change together when an effect is found. A resumed run repeats the successful
    searches only, and so reaches the same attributes.

    Args:
        model: The Pyro model that the run begins with.
        target: The target domain.
        discovery: Searches for missing effects.
        revise: The caller's own function that replaces discovery, if there is one.

    Attributes:
        model: The current model.
        prior: Its prior.
        near: Parameters near which it is known to fit best; empty if nothing is known.
        proposal: Commands for the device that separate the possible causes, if discovery proposes
            any.
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
        """Searches for effects that the model lacks, and adds those that are found.

        Args:
            rollouts: All real rollouts so far.
            folder: Folder for the result; an earlier result there is used instead of a new search.
            report: Where to report progress.

        Returns:
            Whether the model was revised, and a sentence that says what was found.
        """
        target = self.target
        near: Mapping[str, Tensor] = {}
        proposal = None
        if self.revise is not None:
            found, finding = self.revise(self.model, rollouts, folder), ""
        else:
            revision = self.discovery.look(rollouts, folder, report)
            found, finding, near = revision.model, revision.reason, revision.parameters
            proposal = proposed_excitation(revision.experiment, target.actions, target.time_step)
        if found is None:
            return False, finding
        self.model, self.near, self.proposal = found, near, proposal
        self.prior = prior_of(found, target.sensors, target.actions, target.time_step)
        return True, finding
