"""The numbers of the search, one validated object per stage."""

import math
from dataclasses import dataclass

from npdr_ppl.settings import check_range

__all__ = [
    "BASE_FIT",
    "EVIDENCE",
    "PARSIMONY",
    "PRIOR_ENDS",
    "REPEATABILITY",
    "SEARCH",
    "TRIALS",
    "BaseFitSettings",
    "EvidenceSettings",
    "ParsimonySettings",
    "PriorEndSettings",
    "RepeatabilitySettings",
    "SearchSettings",
    "TrialSettings",
]


@dataclass(frozen=True)
class BaseFitSettings:
    """The fit of the original model, and its integration steps.

    Attributes:
        noticeable_change: Change of all simulated measurements together by the finest steps, in
            standard deviations of the residuals. Above it, finer steps are used unless the
            recording contradicts them, because parameters or false effects would compensate for
            it. It is half of what an effect must change to be detected.
        clear_probability: Probability above which a recording is clearly likelier with other
            steps, or with other commands before it.
        most_refits: Greatest number of refits from inside the priors, each from the result of the
            previous one.
        least_gain: Least gain of such a refit in log density, a tenth of what makes one model ten
            times as likely as another.
        num_linear_draws: Number of draws of the prior along which simulations must be nearly
            linear, so that no better fit is searched for. If they are along 32 draws, they are
            along more than nine tenths of the prior with a probability of 0.97.
        largest_linear_error: Greatest error of a linear prediction along them, as a share of the
            predicted change. In the recordings of ``benchmarks/sysid.py`` it is up to 0.19, on the
            rigs of ``benchmarks/discovery.py`` 0.45 and more.
    """

    noticeable_change: float = 2.5
    clear_probability: float = 0.9
    most_refits: int = 4
    least_gain: float = 0.23
    num_linear_draws: int = 32
    largest_linear_error: float = 0.25

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 100.0, "noticeable_change", "least_gain")
        check_range(self, 0.5, 1.0, "clear_probability")
        check_range(self, 1, 100, "most_refits")
        check_range(self, 1, 10_000, "num_linear_draws")
        check_range(self, 0.0, 0.5, "largest_linear_error")


@dataclass(frozen=True)
class SearchSettings:
    """The rounds of the search.

    Attributes:
        hopeless: Probability in coarse steps, or with wider priors, below which a candidate is not
            fitted again in finer steps or own priors: a log evidence of −230. An error of the
            steps of 10 standard deviations, of which the parameters absorb most, changes it by up
            to 10 √(2 · 230), less than itself.
        least_unexplained: Stop when the unexplained misfit is below this fraction of the explained
            misfit, over all channels and in those in which it is. If a large effect was missing,
            differences between integrators and in details of the laws are this large.
        num_leading: Number of best candidates whose pairwise distances are computed.
        num_paired: Number of best candidates whose pairs are screened.
        prior_of_any: Prior probability that any effect of the catalogue is missing.
        most_revisions: Greatest number of times that the effects are simplified and compared with
            their alternatives. A second time is needed if an alternative is not found again in
            parts of the recording.
    """

    hopeless: float = 1e-100
    least_unexplained: float = 1e-4
    num_leading: int = 10
    num_paired: int = 20
    prior_of_any: float = 0.5
    most_revisions: int = 2

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "hopeless", "least_unexplained", "prior_of_any")
        check_range(self, 2, 1000, "num_leading", "num_paired")
        check_range(self, 1, 100, "most_revisions")


@dataclass(frozen=True)
class EvidenceSettings:
    """Probabilities of the alternatives.

    Attributes:
        num_resamplings: Number of bootstrap resamplings of the segments.
        least_probability: Probability from which an alternative remains possible.
        indistinct_loss: Loss of log density up to which a recording cannot distinguish two laws,
            or a law from its limit: two standard deviations of a likelihood ratio of one
            parameter.
    """

    num_resamplings: int = 1000
    least_probability: float = 0.05
    indistinct_loss: float = 2.0

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 1, math.inf, "num_resamplings")
        check_range(self, 0.0, 1.0, "least_probability")
        check_range(self, 0.0, 100.0, "indistinct_loss")


@dataclass(frozen=True)
class PriorEndSettings:
    """Fits at the end of a prior.

    Attributes:
        near_coordinate: Absolute reference coordinate above which a parameter is near an end of
            its prior: in the outermost 5 % on either side. Only the priors of these are widened,
            which costs one fit.
        false_alarm_rate: Probability that the likelihood-ratio test reports a prior with the true
            value as too narrow.
        outside_probability: A value is outside its prior if the prior probability beyond it is at
            most this.
        outside_coordinate: An effect's strength is near an end from this absolute reference
            coordinate on. It is greater than that of parameters: a strong effect often is in the
            outermost 5 % of its prior, and each fit with wider priors costs time.
        most_widenings: Greatest number of times that priors are widened, each time threefold, or
            twofold if they begin at zero and have bounds.
    """

    near_coordinate: float = 1.64
    false_alarm_rate: float = 1e-3
    outside_probability: float = 1e-3
    outside_coordinate: float = 3.0
    most_widenings: int = 3

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 10.0, "near_coordinate", "outside_coordinate")
        check_range(self, 0.0, 1.0, "false_alarm_rate", "outside_probability")
        check_range(self, 0, 100, "most_widenings")


@dataclass(frozen=True)
class TrialSettings:
    """Fits of candidates in a round.

    Attributes:
        shortlist: Greatest number of candidates that are fitted in full in each round.
        pairs: Greatest number of pairs of candidates that are fitted in full in each round.
        most_steps: Greatest number of linearisations of a fit.
        first_steps: The same of a first fit, which shows whether a longer fit is worth it.
        most_converged: Greatest number of candidates that are fitted until convergence.
        converged_share: Excess of a candidate's loss over the least one, as a share of it, up to
            which it is fitted until convergence.
        converged_loss: The same in log density. Either condition is enough.
        candidates_per_decision: Number of candidates that are tried before each decision whether
            to try more.
        largest_growth: Greatest factor by which a full fit may explain more than a candidate's
            linear gain predicts, relative to the best candidate. On the tuning rigs it is at most
            3.4 for candidates that explain a tenth or more.
        certain_evidence: Difference of log evidence above which one of two hypotheses is taken as
            certain. If finer steps change it by less, candidates are not screened again.
        enough_evidence: Log evidence for the best candidate, to first order, beyond which first
            fits need no more segments: ten times what is certain. The model without it is then far
            off, and alternatives are compared along the best candidate's motion.
        fewest_segments: Least number of segments of these fits, in which all kinds of motion
            should occur.
    """

    shortlist: int = 6
    pairs: int = 3
    most_steps: int = 12
    first_steps: int = 6
    most_converged: int = 3
    converged_share: float = 0.3
    converged_loss: float = 20.0
    candidates_per_decision: int = 2
    largest_growth: float = 4.0
    certain_evidence: float = 30.0
    enough_evidence: float = 300.0
    fewest_segments: int = 24

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(
            self,
            1,
            100,
            "shortlist",
            "pairs",
            "most_steps",
            "first_steps",
            "most_converged",
            "candidates_per_decision",
            "fewest_segments",
        )
        check_range(self, 0.0, 1.0, "converged_share")
        check_range(self, 0.0, 1000.0, "converged_loss", "largest_growth", "certain_evidence")
        check_range(self, 0.0, math.inf, "enough_evidence")


@dataclass(frozen=True)
class ParsimonySettings:
    """Laws that explain too little, where something remains that no law explains.

    Attributes:
        largest_linear_share: Share of the explained misfit that is lost without an effect, to
            first order, above which its removal is not tried. The other effects are fitted again
            and can take over, so the estimate is too high.
        most_by_shape: Share of the explained misfit that may be lost by simplifying a law with an
            implausible shape. ``VerdictSettings.minor_share`` is the limit for all other changes.
            Both were chosen on joint 2 of a UR10e and on the swing-up of the DFKI pendulum.
    """

    largest_linear_share: float = 0.5
    most_by_shape: float = 0.5

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 0.0, 1.0, "largest_linear_share", "most_by_shape")


@dataclass(frozen=True)
class RepeatabilitySettings:
    """Comparison of an effect's strengths in disjoint parts of a recording.

    Attributes:
        fewest_segments: Fewest segments of a recording that is compared in parts, four for each
            half.
        false_alarm_rate: Upper bound of the probability that a real effect is reported as not
            found again, if its law is right.
        least_probability: Probability of an effect, against the model without it, from which a
            part shows it. The whole recording has found it before, so the part need not overcome
            the number of candidates.
        certain_probability: Least probability of an effect in a part, after one Gauss-Newton step,
            from which fits of the part need not confirm it.
    """

    fewest_segments: int = 8
    false_alarm_rate: float = 1e-3
    least_probability: float = 0.5
    certain_probability: float = 0.99

    def __post_init__(self) -> None:
        """Checks the values; raises ``ValueError``."""
        check_range(self, 2, 1000, "fewest_segments")
        check_range(self, 0.0, 1.0, "false_alarm_rate", "least_probability", "certain_probability")


BASE_FIT = BaseFitSettings()
EVIDENCE = EvidenceSettings()
PRIOR_ENDS = PriorEndSettings()
PARSIMONY = ParsimonySettings()
REPEATABILITY = RepeatabilitySettings()
SEARCH = SearchSettings()
TRIALS = TrialSettings()
