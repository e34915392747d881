"""The figures of a run of the NPDR loop: returns, rollouts and domain parameters by iteration."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from npdr_ppl.display.plots.marginals import MAX_COLUMNS, Samples, add_legend
from npdr_ppl.drawing.theme import COLORS, save_figure, theme
from npdr_ppl.loop.control_task import ControlTask
from npdr_ppl.loop.domains import prior_of, simulator_of
from npdr_ppl.loop.loop_folder import LoopFolder
from npdr_ppl.loop.npdr_loop import Training
from npdr_ppl.posterior.parameter_units import parameter_units
from npdr_ppl.randomness import seeded
from npdr_ppl.rollouts import Rollouts
from npdr_ppl.targets.base import TargetDomain

__all__ = [
    "last_rollout",
    "plot_learning_curve",
    "plot_parameters_by_iteration",
    "plot_rollouts",
    "write_training_figures",
]

Records = Sequence[Mapping[str, Any]]
"""Records of the iterations, as in ``train.json``."""

NUM_PRIOR_DRAWS = 2_000
"""Number of draws from which a prior's range and standard deviation are computed."""

RANGE = (0.005, 0.995)
"""Quantiles that are drawn as a prior's range; for a uniform prior, almost the whole range."""


def write_training_figures(
    training: Training, target: TargetDomain, task: ControlTask, out: Path
) -> list[Path]:
    """Draws the results of a run of the loop.

    Args:
        training: The run's result.
        target: Its target domain.
        task: Its task.
        out: Its folder; gets ``learning_curve.png``, ``rollouts.png`` and ``parameters.png``.
    """
    records = training.iterations
    first = LoopFolder(out).policy(0)
    figure = plot_learning_curve(
        records,
        first_sim_return=None if first is None else first[1]["sim_return"],
        success=task.success,
    )
    paths = [save_figure(figure, out / "learning_curve.png")]
    shown = {0: 1, last_rollout(records): len(records)}
    figure = plot_rollouts(
        {
            f"iteration {number}: return {_return(training.rollouts, row):.0f}": (
                training.rollouts[[row]]
            )
            for row, number in shown.items()
        }
    )
    paths.append(save_figure(figure, out / "rollouts.png"))
    figure = _parameters_figure(training, target, seed=0)
    paths.append(save_figure(figure, out / "parameters.png"))
    return paths


def last_rollout(records: Records) -> int:
    """Returns the position of the last rollout that an iteration recorded at its start.

    Rollouts that a diagnosis requested come later and may use another controller.
    """
    last = records[-1]
    before = records[-2]["num_rollouts"] if len(records) > 1 else 0
    return before + len(last["real_returns"]) - 1


def plot_learning_curve(
    records: Records, *, first_sim_return: float | None = None, success: float | None = None
) -> Figure:
    """Draws the returns of each iteration's policy, on the target and in simulation.

    The policy that the last iteration trained has not run on the target.

    Args:
        records: Records of the iterations, as in ``train.json``.
        first_sim_return: Return in simulation of the policy of the first iteration.
        success: Return above which an episode counts as a success.
    """
    numbers = np.arange(1, len(records) + 1)
    # The policy that an iteration trains runs in the next iteration.
    simulated = [first_sim_return, *(record.get("sim_return") for record in records)]
    with theme():
        size = (max(5.5, 0.85 * len(records) + 2.0), 3.2)
        figure = Figure(figsize=size, layout="constrained")
        axis = figure.subplots()
        if success is not None:
            axis.axhline(success, color="0.6", lw=0.8, ls=":", label="success")
        values = np.array([np.nan if value is None else value for value in simulated], float)
        axis.plot(
            np.arange(1, len(values) + 1), values, "s--", color=COLORS["posterior"], ms=4,
            mfc="w", label="in simulation, mean over domains",
        )  # fmt: skip
        for number, record in zip(numbers, records, strict=True):
            returns = record["real_returns"]
            if len(returns) > 1:
                axis.plot([number] * len(returns), returns, "o", color=COLORS["nominal"], ms=4,
                          alpha=0.5, mew=0, label="on the target, single rollouts")  # fmt: skip
        axis.plot(numbers, [record["real_return"] for record in records], "o-",
                  color=COLORS["nominal"], ms=6, label="on the target, mean")  # fmt: skip
        labels = [f"{n}\n{_decisions(record)}" for n, record in enumerate(records, start=1)]
        ticks = numbers.tolist()
        if np.isfinite(values[-1]):
            ticks.append(len(values))
            labels.append("trained\nlast")
        axis.set_xticks(ticks, labels)
        axis.set_xlim(0.5, ticks[-1] + 0.5)
        axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
        axis.set_xlabel("iteration, and the decision after its rollouts")
        axis.set_ylabel("return")
        add_legend(figure, loc="outside upper center", ncols=2)
    return figure


def plot_rollouts(rollouts: Mapping[str, Rollouts]) -> Figure:
    """Draws measurements and applied commands over time; a cross marks an early end.

    Args:
        rollouts: One rollout by legend entry; all have the same channels.
    """
    some = next(iter(rollouts.values()))
    names = [*some.channel_names, *some.action_names]
    units = [*some.channel_units, *some.action_units]
    longest = max(float(rollout.time[0][-1]) for rollout in rollouts.values())
    colors = [COLORS["nominal"], COLORS["posterior"]][-len(rollouts) :]
    with theme():
        figure = Figure(figsize=(7.5, 1.3 * len(names) + 0.6), layout="constrained")
        axes = figure.subplots(len(names), 1, sharex=True, squeeze=False).ravel()
        for (label, rollout), color in zip(rollouts.items(), colors, strict=True):
            time = rollout.time[0]
            # The last command is held until the last measurement.
            commands = np.concatenate([rollout.actions[0], rollout.actions[0][-1:]])
            series = np.concatenate([rollout.readings[0], commands], axis=1)
            count = len(rollout.channel_names)
            for column, axis in enumerate(axes):
                is_command = column >= count
                axis.plot(
                    time, series[:, column], color=color, lw=0.6 if is_command else 1.1,
                    drawstyle="steps-post" if is_command else "default", label=label, alpha=0.85,
                )  # fmt: skip
                if time[-1] < longest:
                    axis.plot(time[-1], series[-1, column], "x", color=color, ms=5)
        for axis, name, unit in zip(axes, names, units, strict=True):
            axis.set_ylabel(f"{name}\n[{unit}]" if unit else name)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(0.0, longest)
        figure.align_ylabels(list(axes))
        add_legend(figure, loc="outside upper center", ncols=2)
    return figure


def plot_parameters_by_iteration(
    mean: Samples,
    sd: Samples,
    prior: Samples,
    *,
    nominal: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Draws how domain parameters change from iteration to iteration, against their prior.

    Args:
        mean: Posterior means by parameter, one per iteration, ``(I,)``; NaN if an iteration has
            none.
        sd: Posterior standard deviations, in the same format.
        prior: Draws ``(m,)`` by parameter; their range is shaded.
        nominal: Values to mark.
        units: Units by parameter.
    """
    names = list(mean)
    columns = min(MAX_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    with theme():
        figure = Figure(figsize=(2.6 * columns, 1.9 * rows + 0.4), layout="constrained")
        axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for axis, name in zip(axes, names, strict=False):
            numbers = np.arange(1, len(mean[name]) + 1)
            low, high = np.quantile(prior[name], RANGE)
            axis.axhspan(low, high, color=COLORS["prior"], alpha=0.25, lw=0, label="prior, 99 %")
            if nominal and name in nominal:
                axis.axhline(nominal[name], color=COLORS["nominal"], lw=1, ls=":", label="nominal")
            axis.errorbar(
                numbers, mean[name], sd[name], color=COLORS["posterior"], fmt="o-", ms=4,
                lw=1, capsize=3, label="posterior mean ± sd",
            )  # fmt: skip
            # Error bars may leave the prior's range; the axis does not include them.
            margin = 0.04 * (high - low)
            bottom, top = (
                np.nanmin([low, *mean[name]]),
                np.nanmax([high, *mean[name]]),
            )
            axis.set_ylim(bottom - margin, top + margin)
            _name_parameter(axis, name, (units or {}).get(name, ""))
            axis.set_xlim(0.5, len(numbers) + 0.5)
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        for position, axis in enumerate(axes):
            axis.set_visible(position < len(names))
            if position + columns >= len(names):
                axis.tick_params(labelbottom=True)
                axis.set_xlabel("iteration")
        add_legend(figure, loc="outside upper center", ncols=3)
    return figure


def _parameters_figure(training: Training, target: TargetDomain, *, seed: int) -> Figure:
    prior = prior_of(training.model, target.sensors, target.actions, target.time_step)
    with seeded(seed, "figures"):
        draws = prior.to_parameters(prior.sample(NUM_PRIOR_DRAWS))
    moments = [record["parameters"] for record in training.iterations]
    return plot_parameters_by_iteration(
        {name: _by_iteration(moments, name, "mean") for name in draws},
        {name: _by_iteration(moments, name, "sd") for name in draws},
        {name: values.double().numpy() for name, values in draws.items()},
        nominal={n: float(v) for n, v in simulator_of(prior).nominal().items()},
        units=parameter_units(prior),
    )


def _by_iteration(
    moments: Sequence[Mapping[str, Mapping[str, float]]], name: str, moment: str
) -> NDArray[np.float64]:
    """Returns a parameter's moment in every iteration, NaN before its effect was added."""
    none = {moment: np.nan}
    return np.array([found.get(name, none)[moment] for found in moments], dtype=np.float64)


def _decisions(record: Mapping[str, Any]) -> str:
    """Returns the decisions of an iteration, one per line."""
    return "\n".join(str(decision["decision"]) for decision in record["decisions"])


def _return(rollouts: Rollouts, row: int) -> float:
    """Returns the sum of a rollout's rewards; NaN if it has none."""
    return float("nan") if rollouts.rewards is None else float(rollouts.rewards[row].sum())


def _name_parameter(axis: Axes, name: str, unit: str) -> None:
    """Writes a parameter's name above its panel; names of effects take two lines."""
    port, separator, rest = name.partition(".")
    label = f"{port}\n{rest}" if separator else name
    axis.set_title(f"{label} [{unit}]" if unit and unit != "1" else label, fontsize=8, pad=10)
    axis.ticklabel_format(axis="y", scilimits=(-2, 3))
