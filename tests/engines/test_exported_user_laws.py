"""Effects of a user's file and learned laws in the Python beside an exported robot."""

import pyro.distributions as dist
import pytest
import torch

from npdr_ppl.discovery.learning.formulas import effects_of
from npdr_ppl.discovery.learning.law import Law
from npdr_ppl.discovery.learning.memory import DELAY
from npdr_ppl.discovery.learning.recorded_motion import PortMotion
from npdr_ppl.discovery.learning.terms import terms_at
from npdr_ppl.discovery.learning.terms_with_memory import series_at
from npdr_ppl.engines.mujoco import MujocoSimulator
from npdr_ppl.engines.mujoco.callbacks import python_file
from npdr_ppl.engines.mujoco.callbacks.traced_laws import trace
from npdr_ppl.engines.mujoco.export import export_mjcf
from npdr_ppl.errors import ModelError
from npdr_ppl.language.channels import Parameter
from npdr_ppl.language.effects import ActionEffect, ForceEffect, SensorEffect, ServoEffect
from npdr_ppl.models.effects import InputDelay, effects
from tests.helpers.exported_robots import ARM, attachable, difference, probed, refusals

MOST = 1e-4
"""Greatest difference over 1 s, in rad and rad/s, that users are promised."""

NEED_THE_PAST = {"input_delay", "sensor_delay", "clock_skew", "sensor_low_pass"}
"""Effects of the catalogue whose state is more than numbers of one law; they have Python of
their own."""


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    """The engine writes its own warnings to a file in the present folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(integrator="Euler", friction=0.0, spring=""))
    return MujocoSimulator(path, time_step=0.01)


def motion(simulator, name):
    """A motion at a port, from which learning would choose terms."""
    port = simulator.port(name)
    time = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)[None]
    swing = {"q": 0.8 * torch.sin(6.0 * time), "v": 4.8 * torch.cos(6.0 * time)}
    values = {
        "force": {**swing, "tau": 2.0 * torch.sin(9.0 * time)},
        "sensor": {"y": swing["q"]},
    }.get(port.kind, {"u": swing["q"]})
    units = {"q": "rad", "v": "rad/s", "tau": "N m", "u": port.unit, "y": port.unit, "t": "s"}
    edges, past = torch.tensor([0, 100]), torch.zeros(1, 0, dtype=torch.float64)
    return PortMotion(port, {**values, "t": time}, units, None, edges, 0.01, past, 0.01)


def learned(simulator, name, terms):
    """The learned effect with some terms, and values of its parameters."""
    recorded = motion(simulator, name)
    size = 0.05 * simulator.port(name).rated
    coefficients = []
    for term in terms:
        scale = term.values(recorded).square().mean((0, 1)).sqrt().clamp_min(1e-3)
        # Friction is positive; other forces are negative, so that they take energy.
        sign = 1.0 if term.is_dry else -1.0
        coefficients += (sign * size / len(terms) / scale).tolist()
    ranges = {symbol: (-1.0, 1.0) for symbol in recorded.values}
    law = Law(
        simulator.port(name),
        tuple(terms),
        tuple(coefficients),
        (1.0,) * len(coefficients),
        ranges,
        recorded.units,
    )
    (effect,), start = effects_of([law])
    return effect, {site: float(value) for site, value in start.items()}


def kinds_of_terms(simulator, name):
    """One term of every form, whatever the constants inside of it."""
    found = {}
    recorded = motion(simulator, name)
    for term in (*terms_at(recorded), *series_at(recorded)):
        if term.memory == DELAY:
            continue  # refused by name: it needs earlier commands
        found[term.columns[:2], term.is_dry, term.is_spline] = term
    # Waves with other numbers of periods have the same form.
    forms = {}
    for (columns, *flags), term in found.items():
        form = ("".join(c for c in columns[0] if not c.isdigit()), *flags)
        forms[form] = term
    return list(forms.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shoulder_torque", "elbow_torque", "motor", "servo"])
def test_every_form_of_a_learned_law_moves_the_exported_robot_as_ours(arm, tmp_path, name):
    terms = kinds_of_terms(arm, name)
    assert len(terms) >= 10
    few = [terms[k : k + 4] for k in range(0, len(terms), 4)]
    for some in few:
        effect, values = learned(arm, name, some)
        error, matters, where = difference(arm.with_effects(effect), values, tmp_path)
        assert where == "Python"
        assert error <= MOST, [t.key for t in some]
        assert matters > 1e-4, [t.key for t in some]


def test_every_form_of_a_learned_error_is_the_same_at_every_value(arm):
    # Simulations begin at a measurement, from which a learned error is removed only nearly.
    for term in kinds_of_terms(arm, "elbow"):
        effect, start = learned(arm, "elbow", [term])
        simulator = arm.with_effects(effect)
        given = {n: torch.tensor(v, dtype=torch.float64) for n, v in start.items()}
        space = {"__name__": "exported"}
        exec(export_mjcf(simulator, given).callbacks.text, space)
        (law,) = space["laws"](start)
        values = torch.linspace(-1.2, 1.2, 25, dtype=torch.float64)
        own = {name.rpartition(".")[2]: value for name, value in given.items()}
        wanted, _ = effect.read(values, own, None, 0.01)
        found = [law.read(float(value), 0.0, 0.0, 0.01) for value in values]
        assert found == pytest.approx(wanted.tolist(), abs=1e-12), term.key


def test_a_learned_law_of_time_load_and_friction_is_reproduced(arm, tmp_path):
    chosen = {"v³", "τ", "spline(q)", "exp(−t/T) · sign v 1"}
    terms = [t for t in terms_at(motion(arm, "shoulder_torque")) if t.key in chosen]
    assert len(terms) == len(chosen)
    effect, values = learned(arm, "shoulder_torque", terms)
    error, matters, where = difference(arm.with_effects(effect), values, tmp_path)
    assert where == "Python" and error <= MOST and matters > 1e-3


def test_laws_at_two_ports_act_together(arm, tmp_path):
    ports = {"shoulder_torque": "v|v|", "elbow_torque": "v³", "motor": "u³"}
    found = [
        learned(arm, name, [t for t in terms_at(motion(arm, name)) if t.key == key])
        for name, key in ports.items()
    ]
    simulator = arm.with_effects(*(effect for effect, _ in found))
    values = {site: value for _, own in found for site, value in own.items()}
    error, matters, where = difference(simulator, values, tmp_path)
    assert where == "Python" and error <= MOST and matters > 1e-3


@pytest.mark.parametrize("name", sorted(effects()))
def test_tracing_the_catalogue_gives_what_its_own_python_gives(arm, tmp_path, monkeypatch, name):
    effect = attachable(arm, effects()[name])
    if effect is None:
        pytest.skip("the arm has no place for it")
    simulator = arm.with_effects(effect)
    values = probed(simulator, effect)
    monkeypatch.setattr(python_file, "law_of", trace)
    monkeypatch.setattr("npdr_ppl.engines.mujoco.effects_in_file.law_of", trace)
    if name in NEED_THE_PAST:
        assert refusals(simulator, values)
        return
    error, *_ = difference(simulator, values, tmp_path)
    assert error <= MOST


class Warming(ForceEffect):
    """Friction that falls as the joint warms, with the heat as a state."""

    id = "warming"
    parameters = (Parameter("damping", "{port}", 0.0), Parameter("rate", "1/s", 1.0))
    strength = ("damping",)
    law = "−b v exp(−E)"

    def default_priors(self, port):
        """Wide."""
        return {"damping": dist.Normal(0.0, 1.0), "rate": dist.LogNormal(0.0, 1.0)}

    def initial_memory(self, position, velocity, start):
        """Cold."""
        return (torch.zeros_like(position),)

    def force(self, position, velocity, parameters, memory):
        """Viscous friction."""
        return -parameters["damping"] * velocity * torch.exp(-memory[0])

    def next_memory(self, position, velocity, parameters, memory, time_step):
        """Warms with the speed."""
        return (memory[0] + time_step * parameters["rate"] * velocity.abs(),)


class Creeping(ActionEffect):
    """A command that the output approaches, by a rule of its own."""

    id = "creeping"
    parameters = (Parameter("share", "1", 0.0),)

    def default_priors(self, port):
        """Wide."""
        return {"share": dist.Uniform(0.0, 0.9)}

    def initial_memory(self, command, start):
        """The command itself."""
        return command

    def act(self, commands, parameters, memory, time_step):
        """Keeps a share of the last output."""
        kept = parameters["share"]
        output = kept * memory + (1.0 - kept) * commands.now()
        return output, output


class Sticky(SensorEffect):
    """A measurement that keeps a share of the last one."""

    id = "sticky"
    parameters = (Parameter("share", "1", 0.0),)

    def default_priors(self, port):
        """Wide."""
        return {"share": dist.Uniform(0.0, 0.9)}

    def initial_memory(self, value, reading, start):
        """The value itself."""
        return {"last": value}["last"]

    def read(self, value, parameters, memory, time_step):
        """Mixes it with the last."""
        output = torch.lerp(value, memory, parameters["share"])
        return output, output


class SoftServo(ServoEffect):
    """A servo that is soft near its goal."""

    id = "soft_servo"
    parameters = (Parameter("width", "{coordinate}", 0.0),)

    def default_priors(self, port):
        """Wide."""
        return {"width": dist.Uniform(0.0, 1.0)}

    def act(self, error, parameters, memory):
        """Weakens small errors."""
        return error * error.abs() / (error.abs() + parameters["width"])


class FilteredServo(ServoEffect):
    """A servo that acts on the error after a low-pass, which begins at the first error."""

    id = "filtered_servo"
    parameters = (Parameter("time_constant", "s", 0.0),)

    def default_priors(self, port):
        """Wide."""
        return {"time_constant": dist.Uniform(0.0, 1.0)}

    def initial_memory(self, error):
        """The error itself."""
        return error

    def act(self, error, parameters, memory):
        """Takes half of the filtered error."""
        return 0.5 * memory

    def next_memory(self, error, parameters, memory, time_step):
        """Approaches the error; at once if the time constant is zero."""
        return error + (memory - error) * torch.exp(-time_step / parameters["time_constant"])


class WithTheLoad(ForceEffect):
    """Friction that is greater where the joint moves away from zero."""

    id = "with_the_load"
    parameters = (Parameter("damping", "{port}", 0.0),)

    def default_priors(self, port):
        """Wide."""
        return {"damping": dist.Normal(0.0, 1.0)}

    def force(self, position, velocity, parameters, memory):
        """Compares two comparisons, as Python would not with `a > b == c > d`."""
        leaves = (velocity > 0.0) == (position > 0.0)
        return -parameters["damping"] * velocity * torch.where(leaves, 1.0, 0.5)


OWN = {
    "a state of a force": (Warming("shoulder_torque"), {"damping": 0.8, "rate": 0.5}),
    "a state of a command": (Creeping("motor"), {"share": 0.6}),
    "a state of a measurement": (Sticky("elbow"), {"share": 0.6}),
    "a servo": (SoftServo("servo"), {"width": 0.1}),
    "a state of a servo": (FilteredServo("servo"), {"time_constant": 0.05}),
    "a time constant of zero": (FilteredServo("servo"), {"time_constant": 0.0}),
    "a comparison of comparisons": (WithTheLoad("shoulder_torque"), {"damping": 0.8}),
}


@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
@pytest.mark.parametrize("kind", OWN)
def test_an_effect_of_ones_own_is_reproduced_with_its_state(arm, tmp_path, kind):
    effect, values = OWN[kind]
    given = {f"{effect.name}.{name}": value for name, value in values.items()}
    error, matters, where = difference(arm.with_effects(effect), given, tmp_path)
    assert where == "Python" and error <= MOST and matters > 1e-3


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_two_laws_of_one_servo_are_reproduced(tmp_path, integrator):
    (tmp_path / "arm.xml").write_text(ARM.format(integrator=integrator, friction=0.0, spring=""))
    laws = SoftServo("servo"), FilteredServo("servo")
    given = {"servo.soft_servo.width": 0.1, "servo.filtered_servo.time_constant": 0.05}
    arm = MujocoSimulator(tmp_path / "arm.xml", time_step=0.01)
    error, matters, where = difference(arm.with_effects(*laws), given, tmp_path)
    assert where == "Python" and error <= MOST and matters > 1e-3


class Branching(Creeping):
    """A law that cannot be followed, because it branches on a number."""

    def act(self, commands, parameters, memory, time_step):
        """Branches."""
        if commands.now() > 0.0:
            return commands.now(), memory
        return parameters["share"] * commands.now(), memory


class Delayed(Creeping):
    """A law that needs earlier commands."""

    def history(self, parameters, time_step):
        """Returns one command."""
        return 1

    def act(self, commands, parameters, memory, time_step):
        """Takes the last command."""
        return commands.delayed(torch.ones((), dtype=torch.int64)), memory


class Tabulated(Creeping):
    """A law with a table."""

    def act(self, commands, parameters, memory, time_step):
        """Weighs a table."""
        table = torch.linspace(0.0, 1.0, 5)
        return (table * commands.now()).sum() * parameters["share"], memory


class Noisy(Creeping):
    """A law with a random number."""

    def act(self, commands, parameters, memory, time_step):
        """Scatters the command."""
        return commands.now() + parameters["share"] * torch.randn(()), memory


class Reserved(Creeping):
    """A parameter that has the name of something in the file."""

    parameters = (Parameter("memory", "1", 0.0),)


class Coarse(Creeping):
    """A law that cuts off decimals."""

    def act(self, commands, parameters, memory, time_step):
        """Makes a whole number."""
        return parameters["share"] * commands.now().to(torch.int64), memory


@pytest.mark.parametrize(
    ("effect_class", "sentence"),
    [
        (Branching, "branches on a number; torch.where instead of `if`"),
        (Delayed, "needs earlier commands"),
        (Tabulated, "it uses sum"),
        (Coarse, "it makes whole numbers of numbers"),
        (Noisy, "it draws random numbers"),
        (Reserved, 'parameter "memory" has a name that the file needs itself'),
    ],
)
def test_what_cannot_be_followed_is_refused_by_name(arm, effect_class, sentence):
    effect = effect_class("motor")
    simulator = arm.with_effects(effect)
    values = {site: torch.tensor(0.5) for site in effect.parameter_names}
    found = export_mjcf(simulator, values)
    assert sentence in found.refused[effect.name]
    with pytest.raises(ModelError):
        trace(effect)


def test_a_law_of_several_joints_is_refused_by_name(arm):
    class Coupled(Warming):
        needs_joint = True

        def begin_step(self, joint, parameters, memory, time_step):
            return (joint.others["elbow_torque"][0],)

    effect = Coupled("shoulder_torque")
    values = {site: torch.tensor(0.5) for site in effect.parameter_names}
    found = export_mjcf(arm.with_effects(effect), values)
    assert found.refused[effect.name] == "it depends on another joint, elbow_torque"


@pytest.mark.parametrize("name", ["Effects", "VALUES", "field", "np"])
def test_a_class_with_a_name_in_the_file_gets_another_one(arm, name):
    class Own(Warming):
        pass

    Own.__name__ = name
    assert python_file._class_names([Own("shoulder_torque")]).popitem()[1] == f"{name}2"


def test_a_class_with_a_name_of_ours_gets_another_one(arm):
    class Spring(Warming):
        id = "own_spring"

    class Other(Warming):
        id = "own_other"

    Other.__name__ = "Warming"
    own = [Spring("shoulder_torque"), Warming("shoulder_torque"), Other("elbow_torque")]
    names = python_file._class_names(own)
    assert names["shoulder_torque.own_spring"] == "Spring2"
    assert names["shoulder_torque.warming"] == names["elbow_torque.own_other"] == "Warming"
    simulator = arm.with_effects(*own)
    values = {site: torch.tensor(0.5) for e in own for site in e.parameter_names}
    found = export_mjcf(simulator, values).callbacks
    assert found is not None
    assert found.text.count("class Warming(JointLaw):") == 1
    assert "class Spring2(JointLaw):" in found.text


def test_a_copy_of_an_effect_of_the_catalogue_in_a_revised_model_is_that_effect():
    copied = type("InputDelay", (InputDelay,), {"__module__": "revised_model"})
    assert python_file.law_of(copied("motor")) is python_file.LAWS["input_delay"]
