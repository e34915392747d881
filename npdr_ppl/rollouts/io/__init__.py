"""File formats of rollouts: each reader returns a recording, each writer takes one.

May import: the arrays and checks of :mod:`npdr_ppl.rollouts`. Start reading at
``file_formats.py``.
"""
