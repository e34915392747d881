"""Policies and policy search, one file each.

May import: engines.common, language. Start reading at ``base.py``, then ``power.py``.
"""
