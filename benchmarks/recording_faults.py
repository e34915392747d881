"""Twenty kinds of faults in recordings with a hidden effect: is the fault said, the effect named?

    python benchmarks/recording_faults.py --out rows.jsonl                # all kinds, test seeds
    python benchmarks/recording_faults.py --part tune --kinds lost,swapped --out tried.jsonl
    python benchmarks/recording_faults.py --out rows.jsonl --summary

Each recording is made by another integrator than the model's, with one hidden effect. It is
written as a CSV file with a fault, read again, and discovered with the whole catalogue. A fault is
*said* if a note of the recording names its kind. An effect is *kept* if discovery still names it,
or a class that holds it, as it does without the fault; late or early stamps of the commands absorb
a hidden delay, which nothing can tell from them, so there the shift counts as its name. Rows that
the file holds are not run again.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from discovery_rows import found_names, has_all_classes
from hidden_rigs.cases import Case, make_case
from hidden_rigs.rigs import RIGS
from scipy.interpolate import CubicSpline

import npdr_ppl as npdr
from npdr_ppl.randomness import derived_seed
from npdr_ppl.rollouts import Rollouts

CASES = (
    ("pendulum", ("hinge", "coulomb_friction")),
    ("pendulum", ("torque", "input_delay")),
    ("cart_pole", ("rail", "coulomb_friction")),
    ("emps", ("carriage", "coulomb_friction")),
    ("furuta", ("pole", "coulomb_friction")),
)
"""Rigs and effects; each is recorded with two seeds."""

SEEDS = {"tune": (900, 901), "test": (910, 911)}
"""Settings were chosen with the first ones."""

STRENGTH = 3.0
"""Multiple of an effect's typical size."""


@dataclass
class Table:
    """One rollout as a file has it: the action of the last row is not known.

    Attributes:
        time: Time stamps in s, ``(T + 1,)``.
        channels: Measurements by name, ``(T + 1,)``.
        actions: Commands by name, ``(T + 1,)``, NaN in the last row.
    """

    time: np.ndarray
    channels: dict[str, np.ndarray]
    actions: dict[str, np.ndarray]

    @property
    def columns(self) -> list[dict[str, np.ndarray]]:
        """All columns but the time."""
        return [self.channels, self.actions]

    def rows(self, index: Any) -> "Table":
        """Returns some of the rows, at regular times."""
        own = {n: v[index] for n, v in self.channels.items()}
        commands = {n: v[index] for n, v in self.actions.items()}
        for values in commands.values():
            values[-1] = np.nan
        step = self.time[1] - self.time[0]
        return Table(step * np.arange(len(self.time[index])), own, commands)


Fault = Callable[[list[Table], np.random.Generator, str], None]
"""Changes tables in place; ``str`` is the channel that is to be spoilt."""


def _places(table: Table, generator: np.random.Generator, num: int, length: int) -> list[int]:
    """Returns first rows of separate stretches in which the device moves."""
    last = len(table.time) - 2 * length - 20
    speed = sum(np.abs(np.gradient(v)) / (np.ptp(v) + 1e-12) for v in table.channels.values())
    speed = np.convolve(speed, np.ones(9) / 9, "same")
    candidates = np.arange(20, last)
    candidates = candidates[speed[20:last] > np.median(speed)]
    chosen: list[int] = []
    for row in generator.permutation(candidates).tolist():
        if all(abs(row - other) > 2 * length + 20 for other in chosen):
            chosen.append(row)
        if len(chosen) == num:
            break
    return chosen


def _lost(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for k, table in enumerate(tables):
        keep = np.ones(len(table.time), dtype=bool)
        for row in _places(table, generator, 3, 4):
            keep[row : row + int(generator.integers(1, 4))] = False
        tables[k] = table.rows(np.flatnonzero(keep))


def _duplicated(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for k, table in enumerate(tables):
        rows = np.arange(len(table.time))
        tables[k] = table.rows(np.sort(np.concatenate((rows, _places(table, generator, 3, 4)))))


def _swapped(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        for row in _places(table, generator, 3, 4):
            for values in table.channels.values():
                values[[row, row + 1]] = values[[row + 1, row]]


def _frozen(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        length = max(15, round(0.3 / (table.time[1] - table.time[0])))
        for row in _places(table, generator, 2, length):
            table.channels[channel][row : row + length] = table.channels[channel][row]


def _spiked(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        values = table.channels[channel]
        size = 0.5 * np.ptp(values)
        for row in _places(table, generator, 5, 4):
            values[row] += size * (1 if generator.random() < 0.5 else -1)


def _missing(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        length = max(5, round(0.2 / (table.time[1] - table.time[0])))
        for row in _places(table, generator, 2, length):
            table.channels[channel][row : row + length] = np.nan


def _moved(table: Table, time: np.ndarray) -> None:
    """Measures at other times."""
    for name, values in table.channels.items():
        table.channels[name] = CubicSpline(table.time, values)(time)


def _jitter(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        size = min(0.005, 0.45 * (table.time[1] - table.time[0]))
        time = table.time + generator.uniform(-size, size, len(table.time))
        time[[0, -1]] = table.time[[0, -1]]
        _moved(table, time)
        _separate_commands(table, time)


def _separate_commands(table: Table, time: np.ndarray) -> None:
    """Puts measurements at other times than the commands, on rows of their own."""
    every = np.unique(np.concatenate((table.time, time)))
    at = np.searchsorted(every, time)
    held = np.clip(np.searchsorted(table.time, every, side="right") - 1, 0, None)
    for name, values in table.channels.items():
        column = np.full(len(every), np.nan)
        column[at] = values
        table.channels[name] = column
    for name, values in table.actions.items():
        table.actions[name] = values[held]
    table.time = every


def _drift(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        time = table.time * (1.0 + 1e-4)
        time[-1] = table.time[-1]
        _separate_commands(table, np.minimum(time, table.time[-1]))


def _rate_change(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        half = len(table.time) // 2
        drop = np.arange(half, len(table.time) - 2, 2)
        for columns in (table.channels, table.actions):
            for name, values in columns.items():
                columns[name] = np.delete(values, drop)
        table.time = np.delete(table.time, drop)


def _glitch_at_end(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    values = tables[0].channels[channel]
    values[-1] += 0.7 * np.ptp(values)


def _unit(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        # The carts and the carriage move along a line, everything else turns.
        is_linear = channel.startswith("cart") or "position" in table.channels
        factor = 1000.0 if is_linear else 180.0 / np.pi
        table.channels[channel] = table.channels[channel] * factor


def _sign(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        table.channels[channel] = -table.channels[channel]


def _shift_commands(tables: list[Table], steps: int) -> None:
    for table in tables:
        for name, values in table.actions.items():
            moved = np.roll(values[:-1], steps)
            moved[:steps] = values[0] if steps > 0 else moved[:steps]
            if steps < 0:
                moved[steps:] = values[-2]
            table.actions[name] = np.append(moved, np.nan)


def _late(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    _shift_commands(tables, int(generator.integers(8, 20)))


def _early(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    step = tables[0].time[1] - tables[0].time[0]
    _shift_commands(tables, -max(int(generator.integers(8, 20)), round(0.05 / step)))


def _unsigned(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        table.channels[channel] = np.abs(table.channels[channel])


def _clipped(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    limit = 0.6 * max(np.abs(table.channels[channel]).max() for table in tables)
    for table in tables:
        table.channels[channel] = np.clip(table.channels[channel], -limit, limit)


def _shifted_column(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    steps = int(generator.integers(8, 20))
    for table in tables:
        values = table.channels[channel]
        table.channels[channel] = np.concatenate((np.repeat(values[:1], steps), values[:-steps]))


def _mixed_rates(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        values = table.channels[channel]
        values[np.arange(len(values)) % 4 != 0] = np.nan


def _restart(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    table = tables[0]
    half = len(table.time) // 2
    table.time[half:] -= table.time[half]


def _constant(tables: list[Table], generator: np.random.Generator, channel: str) -> None:
    for table in tables:
        table.channels[channel][:] = table.channels[channel][0]


KINDS: dict[str, tuple[Fault, str]] = {
    "lost": (_lost, "lost or repeated"),
    "duplicated": (_duplicated, "lost or repeated"),
    "swapped": (_swapped, "swapped"),
    "frozen": (_frozen, "frozen"),
    "spiked": (_spiked, "spike"),
    "missing": (_missing, "Gaps"),
    "jitter": (_jitter, "uneven"),
    "drift": (_drift, "clock"),
    "rate_change": (_rate_change, "every step"),
    "glitch_at_end": (_glitch_at_end, "last sample"),
    "unit": (_unit, "in degrees|in millimetres"),
    "sign": (_sign, "sign"),
    "late": (_late, "commands look|too late"),
    "early": (_early, "commands look|too early"),
    "unsigned": (_unsigned, "without its sign"),
    "clipped": (_clipped, "clipped"),
    "shifted_column": (_shifted_column, "too late|sensor_delay"),
    "mixed_rates": (_mixed_rates, "every step"),
    "restart": (_restart, "restarted"),
    "constant": (_constant, "not used|frozen"),
}
"""Faults, and what their note says."""


def written(rollouts: Rollouts, kind: str, channel: str, seed: int, file: Path) -> None:
    """Writes rollouts as CSV with a fault; ``"none"`` writes them as they are."""
    tables = [
        Table(
            np.array(time),
            {n: np.array(readings[:, i]) for i, n in enumerate(rollouts.channel_names)},
            {n: np.append(actions[:, i], np.nan) for i, n in enumerate(rollouts.action_names)},
        )
        for time, readings, actions in zip(
            rollouts.time, rollouts.readings, rollouts.actions, strict=True
        )
    ]
    if kind != "none":
        KINDS[kind][0](tables, np.random.default_rng(seed), channel)
    names = (*rollouts.channel_names, *rollouts.action_names)
    lines = [",".join(("rollout", "time", *names))]
    for index, table in enumerate(tables):
        columns = [(table.channels | table.actions)[name] for name in names]
        for row, time_ in enumerate(table.time):
            cells = ["" if np.isnan(c[row]) else repr(float(c[row])) for c in columns]
            lines.append(",".join((str(index), repr(float(time_)), *cells)))
    file.write_text("\n".join([*lines, ""]))


def run(case: Case, kind: str, channel: str, seed: int) -> dict[str, Any]:
    """Discovers in one spoilt recording and returns its row."""
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "data.csv"
        written(case.fit, kind, channel, seed, file)
        try:
            rollouts = Rollouts.load(file)
            found = npdr.discover(case.model, rollouts, seed=0, progress=False)
        except npdr.NpdrError as error:
            is_said = any(word in str(error) for word in KINDS.get(kind, (None, ""))[1].split("|"))
            spent = time.process_time() - begun
            return {"error": str(error), "is_said": is_said, "cpu": spent}
    effects = [e.effect.name for e in found.effects]
    judged = {
        "truth": list(case.names),
        "alternatives": [list(names) for names in case.alternatives],
        "effects": [finding.to_dict() for finding in found.effects],
    }
    is_absorbed = kind in ("late", "early") and "torque.input_delay" in case.names
    # Uneven times and different rates are no faults, but are said, too.
    text = " ".join((*found.problems, *found.remarks, *effects))
    expected = KINDS[kind][1].split("|") if kind != "none" else []
    return {
        **judged,
        "verdict": found.verdict,
        "notes": [*found.problems, *found.remarks],
        "is_said": any(word in text for word in expected) if expected else not found.problems,
        "is_found": has_all_classes(judged) or (is_absorbed and "commands look" in text),
        "cpu": time.process_time() - begun,
    }


def summary(rows: list[dict]) -> str:
    """Returns the table: faults said and effects kept, by kind."""
    clean = {tuple(row["key"][:3]): row for row in rows if row["kind"] == "none"}
    lines = []
    totals = np.zeros(4, dtype=int)
    for kind in ("none", *KINDS):
        of_kind = [row for row in rows if row["kind"] == kind]
        known = [r for r in of_kind if clean.get(tuple(r["key"][:3]), {}).get("is_found")]
        said = sum(bool(row.get("is_said")) for row in of_kind)
        kept = sum(bool(row.get("is_found")) for row in known)
        lines.append(
            f"{kind:16} said {said:2} of {len(of_kind):2}   kept {kept:2} of {len(known):2}"
        )
        if kind != "none":
            totals += (said, len(of_kind), kept, len(known))
    lines.append(f"{'all':16} said {totals[0]} of {totals[1]}   kept {totals[2]} of {totals[3]}")
    return "\n".join(lines)


def main() -> None:
    """Runs what the file does not hold, or summarises."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=sorted(SEEDS), default="test")
    parser.add_argument("--kinds", default=",".join(("none", *KINDS)))
    parser.add_argument("--rigs", default=",".join(dict.fromkeys(rig for rig, _ in CASES)))
    parser.add_argument("--summary", action="store_true", help="run nothing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    if options.out.exists():
        rows = [json.loads(line) for line in options.out.read_text().splitlines()]
    done = {tuple(row["key"]) for row in rows}
    for seed in () if options.summary else SEEDS[options.part]:
        for rig, place in CASES:
            if rig not in options.rigs.split(","):
                continue
            case = make_case(rig, "one", (place,), strength=STRENGTH, seed=seed)
            sensors = [n for n in RIGS[rig].layout.sensors if n in case.fit.channel_names]
            for kind in options.kinds.split(","):
                key = (rig, place[1], seed, kind)
                if key in done:
                    continue
                own = derived_seed(seed, rig, kind)
                channel = sensors[own % len(sensors)]
                row = {"key": key, "kind": kind, "channel": channel}
                row |= run(case, kind, channel, own)
                with options.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                rows.append(row)
                print(
                    key,
                    channel,
                    row.get("is_said"),
                    found_names(row),
                    row.get("notes", row.get("error")),
                    f"{row['cpu']:.0f} s",
                    flush=True,
                )
    print(summary(rows))


if __name__ == "__main__":
    main()
