"""Writes a mapping to start from: what the names of a log's signals tell, in TOML."""

from collections.abc import Sequence

from npdr_ppl.rollouts.logs.inspection import Description, SignalSummary
from npdr_ppl.rollouts.logs.log_settings import LogSettings
from npdr_ppl.rollouts.logs.mapping import settings_lines, toml_key, toml_text
from npdr_ppl.rollouts.logs.matching import Column, can_be_left_out, matched
from npdr_ppl.rollouts.logs.signal_names import plain_names

__all__ = ["mapping_to_start_from", "possible_actions", "proposed_actions", "without_signal"]

_HEAD = """\
# Which signals of the log {source} are channels and actions of the rollouts.
# {what}
# A value is sign * scale * (signal in SI units) + offset, the offset in SI units.
"""

_TO_RENAME = (
    "Rename the tables as your model names its sensors and actions, state the units, and delete\n"
    "# what you do not need."
)

_TO_CHECK = "The tables are named as in {model}. Check the signals, their units and their signs."

_UNCLEAR = {
    "other": "meaning not clear from its name",
    "effort": "a command or a measurement; remove the # if it is the command",
}
"""Why a signal is commented out, by role."""

_SECTIONS = {"command": "actions", "effort": "actions"}
"""Tables of a mapping by role; all others are channels."""

_UNIT_HINTS = {
    "position": '"rad", "deg", "m", "mm", ...',
    "velocity": '"rad/s", "deg/s", "rpm", "m/s", ...',
    "command": '"V", "A", "N m", "rad", "percent", ...',
    "effort": '"N m", "N", "A", "percent", ...',
}


def mapping_to_start_from(
    description: Description,
    settings: LogSettings | None = None,
    *,
    model: str = "",
    columns: Sequence[Column] = (),
) -> str:
    """Returns a mapping in TOML; what is not clear is commented out.

    Args:
        description: The log.
        settings: How the log was read; the mapping states the same.
        model: Name of the model that the mapping is for.
        columns: The columns that the model reads, each of which gets a table. Without columns,
            each signal whose meaning is clear from its name gets one.
    """
    what = _TO_CHECK.format(model=_printable(model)) if columns else _TO_RENAME
    head = _HEAD.format(source=toml_text(description.source), what=what)
    lines = [*head.splitlines(), "", *(_comment(note) for note in description.notes)]
    lines += [*_log_lines(description, settings or LogSettings()), ""]
    signals = _signals(description)
    if columns:
        lines += _tables_of_columns(columns, signals)
    else:
        lines += _tables_of_signals(signals)
    return "\n".join(lines).rstrip() + "\n"


def _log_lines(description: Description, settings: LogSettings) -> list[str]:
    """Returns the table that says how the log is read."""
    stated = settings_lines(settings)
    lines = ["[log]", *stated.values()]
    if "episodes" not in stated:
        lines.append(
            f"episodes = {toml_text(description.episodes)}"
            if description.episodes
            else '# episodes = "..."      # a signal whose every change begins a new rollout'
        )
    if "time_step" not in stated:
        lines.append("# time_step = 0.01      # s between the steps of the rollouts")
    return lines


def _tables_of_signals(signals: Sequence[SignalSummary]) -> list[str]:
    """Returns a table for each signal; those whose meaning is not clear are commented out."""
    lines, unclear = [], []
    if not any(s.role == "command" and not s.is_constant for s in signals):
        lines += ["# There are no actions yet, so the motion is taken as free.", ""]
    names = plain_names([s.name for s in signals])
    for signal, name in zip(signals, names, strict=True):
        entry = _entry(signal, name)
        if signal.role in _UNCLEAR or signal.is_constant:
            why = "does not change" if signal.is_constant else _UNCLEAR[signal.role]
            unclear += [f"# {why}:", *(_comment(line) for line in entry), ""]
        else:
            lines += [*entry, ""]
    return [*lines, *unclear]


def _tables_of_columns(columns: Sequence[Column], signals: Sequence[SignalSummary]) -> list[str]:
    """Returns a table for each column of a model; those without a signal are commented out."""
    found = matched(columns, signals)
    lines = []
    for column in columns:
        section = "actions" if column.role == "command" else "channels"
        entry = [f"[{section}.{toml_key(column.name)}]"]
        if column.name not in found:
            is_needed = not can_be_left_out(column, columns, found)
            hint = "name it" if is_needed else "may be left out"
            entry.append('signal = "..."')
            lines += [f"# No signal has a matching name; {hint}:", *map(_comment, entry), ""]
            continue
        signal, doubt = found[column.name]
        entry.append(f"signal = {toml_text(signal.name)}{f'  # {doubt}' if doubt else ''}")
        if signal.unit:
            entry.append(f"unit = {toml_text(signal.unit)}")
        elif column.unit:
            entry.append(f"# unit = {toml_text(column.unit)}  # the model's; the log states none")
        lines += [*entry, ""]
    used = {match.signal.name for match in found.values()}
    rest = [signal.name for signal in signals if signal.name not in used]
    if rest:
        lines += ["# Signals that are not used:", *(_comment(f"  {name}") for name in rest)]
    return lines


def without_signal(description: Description, columns: Sequence[Column]) -> list[str]:
    """Returns the names of a model's positions and commands that a log lacks but has to have."""
    found = matched(columns, _signals(description))
    return [
        c.name
        for c in columns
        if c.name not in found and c.rate_of is None and not can_be_left_out(c, columns, found)
    ]


def _signals(description: Description) -> list[SignalSummary]:
    """Returns the signals in the order of the log, without the one that marks episodes."""
    signals = [s for timing in description.timings for s in timing.signals]
    signals = [s for s in signals if s.name != description.episodes]
    return sorted(signals, key=lambda signal: signal.place)


def proposed_actions(description: Description) -> list[str]:
    """Returns the names of the signals that a mapping to start from has as actions."""
    return [s.name for s in _signals(description) if s.role == "command" and not s.is_constant]


def possible_actions(description: Description) -> list[str]:
    """Returns the names of the signals that are either actions or measurements."""
    return [s.name for s in _signals(description) if s.role == "effort" and not s.is_constant]


def _entry(signal: SignalSummary, name: str) -> list[str]:
    """Returns the lines of a channel or an action."""
    lines = [f"[{_SECTIONS.get(signal.role, 'channels')}.{name}]"]
    lines.append(f"signal = {toml_text(signal.name)}")
    if signal.unit:
        lines.append(f"unit = {toml_text(signal.unit)}")
    else:
        lines.append(f"# unit = {_UNIT_HINTS.get(signal.role, '...')}")
    return lines


def _comment(text: str) -> str:
    return f"# {_printable(text)}"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)
