"""The paper's experiments and the demonstration, as functions that the command line calls.

May import: loop, posterior, discovery. Start reading at ``table2.py`` or ``demo.py``.
"""
