"""Effects that MuJoCo does not have itself, as Python that needs only mujoco and numpy.

``npdr export`` copies the source of the classes in ``joint_laws.py``, ``command_laws.py``,
``sensor_laws.py`` and ``runner.py`` into one file; see ``python_file.py``. These modules may
therefore import the standard library, mujoco, numpy and each other only. Effects of a user and
learned laws become classes by ``traced_laws.py``.
"""
