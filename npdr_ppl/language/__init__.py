"""Declare a model: simulators, black-box sample sites, effects, priors and the handlers on them.

May import: errors, randomness, registry. Start reading at ``sites.py`` (``npdr.simulate``), then
``simulator.py`` (what a simulator is) and ``effects`` (what an effect is).
"""
