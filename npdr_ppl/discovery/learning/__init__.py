"""Learns the law of what no effect of the catalogue explains, and writes it as an effect.

Begin with :func:`~npdr_ppl.discovery.learning.result.learn`. ``recorded_motion`` records what a
law may depend on, ``terms`` lists what it may consist of, ``regression`` chooses terms,
``formulas`` does so at every port, ``learn`` fits laws by simulation, ``proof`` checks them on
other measurements, and ``law`` writes them as source.
"""
