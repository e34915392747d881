"""What the JSON files in a run's folder contain: the types that are checked when they are read.

A key that is missing or of another type is an error in one sentence. Further keys are kept as they
are: they are written for other programs.
"""

from typing import Any, NotRequired, TypedDict

__all__ = [
    "CheckRecord",
    "ComparisonRecord",
    "DemoRecord",
    "Description",
    "DiscoveryRecord",
    "FitRecord",
    "IterationRecord",
    "MemoryRecord",
    "OutcomeRecord",
    "OverlayRecord",
    "PolicyRecord",
    "PreparationRecord",
    "ReproductionRecord",
    "RoundRecord",
    "RunDescription",
    "SurvivingCausesRecord",
    "TrainingRecord",
]

Number = float | None
"""A number; ``None`` if it is not finite or not known."""

Numbers = float | list[Any] | None
"""A number, or nested lists of numbers for a parameter that is a vector."""


class Description(TypedDict, total=False):
    """``run.json`` and ``loop.json``: what is run."""

    model: str | dict[str, Any] | None
    versions: dict[str, str] | None
    seed: int
    rounds: int | None


class RunDescription(TypedDict):
    """``run.json`` of a run of inference."""

    backend: str
    options: dict[str, Any]
    binding: dict[str, Any]
    seed: int
    num_simulations: int
    model: NotRequired[dict[str, Any]]


class Interval(TypedDict):
    """A parameter's posterior."""

    mean: Numbers
    sd: Numbers
    hdi_94: list[Any]


class DiagnosisRecord(TypedDict, total=False):
    """What ArviZ says of a posterior, and what follows."""

    decision: str
    reason: str
    contraction: dict[str, Number] | None
    edge_mass: dict[str, Number] | None
    elpd_loo: list[Number] | None
    r_hat: Number
    ess: Number
    coverage_90: Number
    segment_p_value: Number
    pit_deviation: Number
    pareto_k: Number
    model_p_value: Number
    estimator_k: Number


class Metrics(TypedDict, total=False):
    """Errors of the most likely draw."""

    rmse: Number
    dtw: Number
    evaluated_on: str


class FitRecord(TypedDict):
    """``fit.json``."""

    backend: str
    parameters: dict[str, Interval]
    diagnosis: NotRequired[DiagnosisRecord | None]
    metrics: NotRequired[Metrics | None]
    most_likely: NotRequired[dict[str, Numbers] | None]
    seconds: NotRequired[dict[str, Number] | None]
    units: NotRequired[dict[str, str] | None]
    faults: NotRequired[dict[str, int] | None]
    finer_steps: NotRequired[int]
    preparation: NotRequired[dict[str, Any] | None]


class BackendRow(TypedDict, total=False):
    """A backend in ``comparison.json``."""

    backend: str
    error: str | None
    elpd: Number
    elpd_difference: Number
    elpd_difference_se: Number
    weight: Number
    rmse: Number
    dtw: Number
    crps: Number
    r_hat: Number
    coverage: dict[str, Number] | None
    decision: str
    diagnosis: DiagnosisRecord | None
    parameters: dict[str, Interval] | None
    seconds: dict[str, Number] | None


class ComparisonSettings(TypedDict, total=False):
    """Settings that all backends share."""

    rounds: int | None
    num_simulations: int | None
    evaluated_on: str
    elpd: str


class ComparisonRecord(TypedDict):
    """``comparison.json``."""

    backends: dict[str, BackendRow]
    ranking: list[str]
    weights: NotRequired[dict[str, Number] | None]
    settings: NotRequired[ComparisonSettings | None]


class Alarm(TypedDict, total=False):
    """Whether something is missing."""

    p_value: Number
    fired: bool | None


class EffectInterval(TypedDict, total=False):
    """A parameter's posterior in a revised model."""

    mean: Numbers
    sd: Numbers
    hdi_94: list[Any] | None
    unit: str


class EffectStrength(TypedDict):
    """A strength in a part of a recording."""

    mean: Number
    sd: Number


class EffectPart(TypedDict):
    """An effect's strengths in a part of a recording."""

    part: str
    strengths: dict[str, EffectStrength]


class PartRecord(TypedDict):
    """Whether a part of a recording shows an effect."""

    part: str
    is_found: bool
    probability: Number
    instead: str
    contradicts: NotRequired[bool]


class EffectRecord(TypedDict):
    """An effect that was missing."""

    effect: str
    port: str
    probability: NotRequired[Number]
    equivalent_to: NotRequired[list[str] | None]
    constants: NotRequired[dict[str, Number]]
    parameters: NotRequired[dict[str, EffectInterval] | None]
    share: NotRequired[Number]
    is_minor: NotRequired[bool]
    corrects: NotRequired[str]
    parts: NotRequired[list[EffectPart]]
    in_halves: NotRequired[dict[str, bool]]
    found_in: NotRequired[list[PartRecord]]
    doubt: NotRequired[str]


class GapRecord(TypedDict, total=False):
    """The error on held-out rollouts, before and after."""

    before: Number
    after: Number
    noise_floor: Number
    closed: Number


class CauseEffectRecord(TypedDict):
    """An effect of a cause, with the priors that differ from the effect's own."""

    effect: str
    port: str
    constants: dict[str, float]
    priors: dict[str, dict[str, Any] | None]


class CauseRecord(TypedDict):
    """A fitted cause that a recording leaves possible."""

    effects: list[CauseEffectRecord]
    probability: Number
    parameters: dict[str, Any]
    coordinates: list[float]
    precision: list[list[float]]


class SurvivingCausesRecord(TypedDict):
    """The causes that a recording leaves possible, and the ranges of the recording."""

    version: int
    causes: list[CauseRecord]
    separations: list[list[float]]
    noise: dict[str, float]
    independent_share: float
    segment_length: int
    time_step: float
    seconds: float
    actions: dict[str, dict[str, float]]
    channels: dict[str, dict[str, float]]


class DiscoveryRecord(TypedDict, total=False):
    """``discovery.json``; what it has depends on the stage that was reached."""

    stage: str
    verdict: str
    reason: str
    has_stopped: bool
    preparation: dict[str, Any] | None
    data_problems: list[str]
    remarks: list[str]
    alarm: Alarm | None
    remainder: Alarm | None
    effects: list[EffectRecord] | None
    learned: dict[str, Any] | None
    ranking: list[dict[str, Any]] | None
    where: list[dict[str, Any]] | None
    gap: dict[str, GapRecord] | None
    estimated_anew: dict[str, dict[str, Number]]
    parameters: dict[str, EffectInterval]
    counts: dict[str, dict[str, Number]]
    finer_steps: int
    wider_priors: list[list[str]]
    surviving_causes: SurvivingCausesRecord | None
    seed: int
    versions: dict[str, str] | None
    model: str | dict[str, Any] | None


class OverlaidRollout(TypedDict):
    """A rollout in ``overlays.json``: points by channel and series, errors by model."""

    rollout: int
    time: list[float]
    channels: dict[str, dict[str, list[Number]]]
    misfit: dict[str, dict[str, Number]]


class ResidualMapRecord(TypedDict):
    """Residuals of a rollout in ``overlays.json``, a row of cells per channel."""

    rollout: int
    seconds: float
    before: list[list[Number]]
    after: list[list[Number]]


class OverlayRecord(TypedDict):
    """``overlays.json``."""

    is_held_out: bool
    restart_seconds: float
    channels: list[str]
    units: dict[str, str]
    rollouts: list[OverlaidRollout]
    maps: list[ResidualMapRecord]


class ExcitationRecord(TypedDict):
    """The excitation of another rollout, and the information in nats that each would give."""

    name: str
    information: dict[str, Number]


class DecisionRecord(TypedDict):
    """A decision of the loop; those of a check have no action."""

    decision: str
    reason: str
    action: NotRequired[str]
    diagnosis: NotRequired[DiagnosisRecord | None]
    excitation: NotRequired[ExcitationRecord | None]


class IterationRecord(TypedDict):
    """``iteration_<i>.json``, and an entry of ``train.json``."""

    real_return: Number
    decisions: list[DecisionRecord]
    internal_model: dict[str, float]
    parameters: dict[str, Interval]
    real_returns: NotRequired[list[Number]]
    decision: NotRequired[str]
    reason: NotRequired[str]
    num_rollouts: NotRequired[int]
    effects: NotRequired[list[str] | None]
    checks: NotRequired[list[DecisionRecord] | None]
    sim_return: NotRequired[Number]
    simulated_success: NotRequired[Number]


class TrainingRecord(TypedDict):
    """``train.json``."""

    iterations: list[IterationRecord]
    policy: NotRequired[dict[str, Number] | None]
    deployed: NotRequired[int | None]


class CheckRecord(TypedDict):
    """A check of a policy in simulation."""

    success: Number
    reliable_share: Number
    mean_return: Number
    tail_return: Number
    num_draws: int


class PolicyRecord(TypedDict):
    """``policy_<k>.json``: figures of a search; only drafts have a check."""

    check: NotRequired[CheckRecord]


class DemoTruth(TypedDict):
    """The rig of the demonstration."""

    parameters: dict[str, float]


class DemoRecord(TypedDict):
    """``demo.json``."""

    returns: dict[str, float]
    success: float
    effects: list[EffectRecord]
    truth: DemoTruth


class PreparationRecord(TypedDict):
    """``preparation.json``."""

    noise: dict[str, float] | None
    num_finer_steps: int


class RoundFigures(TypedDict):
    """Figures of one round of inference."""

    num_simulations: int
    num_failed: int
    seconds: float
    losses: dict[str, Any]
    faults: dict[str, int]


class RoundRecord(TypedDict):
    """``round_<r>.json``."""

    values: dict[str, Any]
    infos: list[RoundFigures]
    seconds: dict[str, float]


class MemoryRecord(TypedDict):
    """``memory.json``."""

    peak_memory_mib: float


class OutcomeRecord(TypedDict):
    """``outcome.json`` of a study."""

    returns: list[float]
    sim_return: float
    iterations: NotRequired[list[dict[str, Any]]]


class ReproductionRecord(TypedDict):
    """``missing-effect.json``."""

    rows: dict[str, dict[str, Any]]
    paper: dict[str, dict[str, Any]]
    skipped: dict[str, str]
