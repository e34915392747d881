"""A flag means the same in every command, and an argument the same in every function."""

import inspect
import typing
from collections import defaultdict
from dataclasses import dataclass

import pytest
from typer.models import ArgumentInfo

import npdr_ppl as npdr
from npdr_ppl.cli import fit as fit_command
from npdr_ppl.cli import train as train_command
from npdr_ppl.cli.main import app
from npdr_ppl.cli.options import InitialState, Noise, Precision, data_options
from npdr_ppl.discovery import Investigation
from npdr_ppl.errors import DataError
from npdr_ppl.loop.loop_options import LOOP_DATA
from npdr_ppl.models.pendulum import pendulum
from npdr_ppl.posterior.fit import fit
from npdr_ppl.preparation.data_options import DataOptions
from npdr_ppl.progress import Reporter
from tests.helpers.discovery_recording import pendulum_recording

FUNCTIONS = {
    "infer": npdr.infer,
    "fit": fit,
    "compare": npdr.compare,
    "discover": npdr.discover,
    "Investigation": Investigation.__init__,
    "train": npdr.train,
    "calibrate": npdr.calibrate,
}


@dataclass(frozen=True)
class Declared:
    """An option or argument of a command, as it is declared."""

    command: str
    parameter: inspect.Parameter

    @property
    def kind(self):
        """The type of a value, without ``None`` for a flag that may be left out."""
        annotated, _ = typing.get_args(self.parameter.annotation)
        kinds = [k for k in typing.get_args(annotated) or (annotated,) if k is not type(None)]
        return annotated if typing.get_origin(annotated) is list else kinds[0]

    @property
    def option(self):
        return typing.get_args(self.parameter.annotation)[1]

    @property
    def flags(self):
        """What is typed; an argument's name."""
        if isinstance(self.option, ArgumentInfo):
            return (self.parameter.name,)
        return self.option.param_decls or (f"--{self.parameter.name.replace('_', '-')}",)

    @property
    def meaning(self):
        """What a user sees, apart from the default."""
        option = self.option
        complete = option.autocompletion
        return self.flags, self.kind, option.help, option.min, option.max, complete


def declared():
    """Returns the options and arguments of all commands."""
    return [
        Declared(info.name or info.callback.__name__, parameter)
        for info in app.registered_commands
        for parameter in inspect.signature(info.callback).parameters.values()
    ]


def by_flag():
    """Returns what is declared by flag."""
    found = defaultdict(list)
    for one in declared():
        for flag in one.flags:
            found[flag].append(one)
    return found


def test_a_flag_has_one_type_and_one_help_in_all_commands():
    found = by_flag()
    # The listings' argument completes a name of its own kind in each.
    del found["name"]
    differing = {f: {d.meaning for d in several} for f, several in found.items()}
    assert not {flag: kinds for flag, kinds in differing.items() if len(kinds) > 1}
    # The walk saw what it was to compare.
    for flag in ("--segment-length", "--effect", "--out", "--seed"):
        assert {"fit", "compare", "discover", "train"} <= {d.command for d in found[flag]}


def test_defaults_of_a_flag_are_of_one_kind():
    for flag, several in by_flag().items():
        # A command may require what another one has a default for, or leave it open.
        defaults = {d.command: d.parameter.default for d in several}
        kinds = {
            type(default)
            for default in defaults.values()
            if default is not None and default is not inspect.Parameter.empty
        }
        assert len(kinds) <= 1, (flag, defaults)


@pytest.mark.parametrize("name", ["fit", "compare", "discover", "train"])
def test_commands_that_take_rollouts_prepare_them_by_the_same_flags(name):
    own = {flag for one in declared() if one.command == name for flag in one.flags}
    assert {"--effect", "--segment-length", "--initial-state", "--precision", "--noise"} <= own
    assert ("--embedding" in own) == (name != "discover")


def test_everything_that_can_be_typed_has_help():
    for one in declared():
        assert one.option.help, (one.command, one.flags)


def test_commands_have_the_defaults_of_the_functions():
    for command, default in ((fit_command.fit, DataOptions()), (train_command.train, LOOP_DATA)):
        given = {n: p.default for n, p in inspect.signature(command).parameters.items()}
        names = ("embedding", "segment_length", "initial_state", "precision", "noise")
        assert data_options(*(given[name] for name in names)) == default


def test_words_become_options():
    made = data_options("all/5", "0", InitialState.RECORDED, Precision.FLOAT32, Noise.MODEL)
    assert made == DataOptions("all/5", None, "recorded", "float32", "model")
    for word in ("-1", "2.5", "whole"):
        with pytest.raises(DataError, match="a number of steps, auto or 0"):
            data_options(None, word, InitialState.RECORDED, Precision.FLOAT32, Noise.MODEL)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_share_options_progress_and_seed(name):
    parameters = inspect.signature(FUNCTIONS[name]).parameters
    hints = typing.get_type_hints(FUNCTIONS[name])
    shared = {"progress": (bool | Reporter | None, None), "seed": (int, 0)}
    if name != "calibrate":  # a posterior knows how its data were prepared
        shared["options"] = (DataOptions | None, None)
    for argument, (kind, default) in shared.items():
        assert hints[argument] == kind, argument
        assert parameters[argument].default == default, argument
        assert parameters[argument].kind is inspect.Parameter.KEYWORD_ONLY, argument


@pytest.mark.parametrize("wrong", [npdr.DiscoveryOptions(), npdr.LoopOptions(), {"noise": "auto"}])
def test_options_of_another_kind_are_refused(wrong):
    rollouts = pendulum_recording(num_rollouts=1, num_steps=50)
    for function in (npdr.infer, fit, npdr.discover):
        with pytest.raises(DataError, match="options takes a DataOptions"):
            function(pendulum, rollouts, options=wrong)


class Noting(Reporter):
    """Keeps the stages and the fractions that it is told."""

    def __init__(self):
        self.told = defaultdict(list)

    def stage(self, label, *, may_end_early=False):
        return lambda fraction, status: self.told[label].append(fraction)


def test_a_search_reports_its_progress_to_a_larger_workflow():
    told = Noting()
    rollouts = pendulum_recording(num_rollouts=1)
    search = npdr.DiscoveryOptions(max_effects=0)
    Investigation(pendulum, rollouts, search=search, progress=told).first  # noqa: B018
    fractions = [f for f in told.told["screen candidates"] if f is not None]
    assert fractions == sorted(fractions) and fractions[0] == 0.0 < fractions[-1] < 1.0
    # The check of the recording, which comes first, says what it does without a fraction.
    assert next(f for f in told.told["fit the original model"] if f is not None) == 0.0


def test_what_a_model_or_a_training_needs_is_exported():
    needed = {
        "BulletSimulator", "Channel", "ControlTask", "DataOptions", "DiscoveryOptions", "Effect",
        "LoopOptions", "MujocoSimulator", "ODESimulator", "Parameter", "Policy", "Port",
        "Rollouts", "TargetDomain", "calibrate", "compare", "discover", "infer", "train",
    }  # fmt: skip
    assert needed <= set(npdr.__all__)
    for name in npdr.__all__:
        assert getattr(npdr, name) is not None
