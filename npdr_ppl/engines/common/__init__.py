"""What engines share: the chain of effects, commands, integrators, episodes and compilation.

May import: language. Start reading at ``effect_chain.py``, which carries effects through a step.
"""
