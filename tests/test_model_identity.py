"""A model's name and file, under what is attached to it and what wraps it."""

import npdr_ppl as npdr
from npdr_ppl.cli.model_files import load_function
from npdr_ppl.model_identity import model_name, unwrapped
from npdr_ppl.models.effects import Bias, CoulombFriction
from npdr_ppl.models.pendulum import pendulum


def test_a_model_has_the_same_name_in_every_process():
    # A handler of Pyro's is printed with its address in memory.
    noisy = npdr.with_noise(npdr.add_effect(pendulum, CoulombFriction("hinge")), 0.1)
    assert model_name(noisy) == "pendulum + hinge.coulomb_friction"
    assert model_name(pendulum) == "pendulum"


def test_a_model_is_found_under_what_wraps_it():
    noisy = npdr.with_noise(npdr.add_effect(pendulum, CoulombFriction("hinge")), 0.1)
    base, effects = unwrapped(noisy)
    assert base is pendulum and [effect.name for effect in effects] == ["hinge.coulomb_friction"]


def test_a_function_called_model_has_the_name_of_its_file(tmp_path):
    (tmp_path / "arm.py").write_text("def model(inputs):\n    pass\n")
    model = load_function(tmp_path / "arm.py", "model")
    assert model_name(model) == "arm"
    rubbed = npdr.add_effect(npdr.add_effect(model, CoulombFriction("hinge")), Bias("hinge"))
    assert model_name(rubbed) == "arm + hinge.coulomb_friction + hinge.bias"
