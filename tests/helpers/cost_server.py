"""Reads files in children of one process that has imported everything, and measures the cost.

    python cost_server.py

Each line of the input is a JSON list: the kind of file, and its path. The answer is a JSON object:
``outcome`` ("read", "refused" or what else happened), ``message``, ``seconds`` of processor time,
and ``megabytes`` above the start.
"""

import gc
import json
import os
import signal
import sys
from pathlib import Path

from file_outcomes import outcome

PAGE = os.sysconf("SC_PAGE_SIZE")
TIME_LIMIT = 20
"""Processor time in seconds after which a child is ended."""


def measured(kind, path):
    """Reads a file in a child of this process; returns the answer."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT, TIME_LIMIT))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(6 * TIME_LIMIT)
        before = int(open("/proc/self/statm").read().split()[1]) * PAGE
        found, message = outcome(kind, Path(path))
        os.write(writing, json.dumps([before, found, message[-3000:]]).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        text = pipe.read()
    _, status, usage = os.wait4(child, 0)
    answer = {"seconds": usage.ru_utime + usage.ru_stime}
    if not text:
        return answer | {"outcome": f"died ({status})", "message": "", "megabytes": 0.0}
    before, found, message = json.loads(text)
    megabytes = max(0.0, usage.ru_maxrss * 1024 - before) / 1e6
    return answer | {"outcome": found, "message": message, "megabytes": megabytes}


def main():
    # Imports that a file's reader makes count for the start.
    import h5netcdf  # noqa: F401
    import mujoco  # noqa: F401
    import pyarrow.parquet  # noqa: F401
    import pybullet  # noqa: F401
    import xarray  # noqa: F401
    from rosbags.typesys import Stores, get_typestore

    get_typestore(Stores.ROS2_HUMBLE)

    import npdr_ppl
    import npdr_ppl.cli.main
    import npdr_ppl.display.reports  # noqa: F401
    from npdr_ppl.engines import bullet  # noqa: F401

    _ = npdr_ppl.MujocoSimulator
    # Without this, the first collection of garbage in each child copies the memory of all modules.
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
    for line in sys.stdin:
        print(json.dumps(measured(*json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
