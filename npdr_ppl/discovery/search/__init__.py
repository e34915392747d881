"""The search: add the effect that explains most, refit, compare with its alternatives, repeat.

May import: discovery.screening, preparation. Start reading at ``effect_search.py``.
"""
