"""Mechanical systems whose accelerations are written in torch.

May import: engines.common, language. Start reading at ``mechanical_system.py`` (what an author
declares), then ``stepping.py`` (one step) and ``recorded_actions.py`` (a whole replay).
"""
