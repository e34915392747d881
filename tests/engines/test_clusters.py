"""The pool on real clusters of two workers, started and ended here: Dask's and Ray's."""

from contextlib import contextmanager

import numpy as np
import pytest

from npdr_ppl.engines.workers import Pool, WorkerOptions
from npdr_ppl.errors import SimulationError
from npdr_ppl.randomness import derived_seed
from tests.helpers.faulty import FaultRates, Faulty
from tests.helpers.pool_tasks import Noise

RATES = FaultRates(crash=0.05, hang=0.06, nan=0.05)

NUM_DRAWS = 20
"""Of which three hang, one crashes and one is NaN."""


@contextmanager
def dask_cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=40
    ) as cluster:
        yield cluster.scheduler_address


@contextmanager
def ray_cluster():
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    try:
        yield cluster.address
    finally:
        cluster.shutdown()


@pytest.fixture(autouse=True)
def no_telemetry(monkeypatch):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


CLUSTERS = {"dask": dask_cluster, "ray": ray_cluster}


@pytest.mark.slow
@pytest.mark.parametrize("executor", CLUSTERS)
def test_a_cluster_returns_what_one_process_does_and_outlives_the_pool(executor):
    expected = np.array(
        [
            np.random.default_rng(derived_seed(7, "draw", i)).normal(i, size=3)
            for i in range(NUM_DRAWS)
        ]
    )
    with CLUSTERS[executor]() as address:
        for options in (
            WorkerOptions(executor, address=address, time_limit=2.0, chunk_size=4),
            WorkerOptions(executor, address=address, time_limit=2.0),
        ):
            with Pool(options) as pool:
                outcome = pool.run(Faulty(Noise(), RATES), range(NUM_DRAWS), seed=7)
                again = pool.run(Noise(), range(NUM_DRAWS), seed=7)
            np.testing.assert_array_equal(np.array(outcome.values), expected)
            np.testing.assert_array_equal(np.array(again.values), expected)
            counts = outcome.faults.counts()
            assert counts["crashed"] and counts["hung"] and counts["nan"]
            assert counts["lost"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("executor", CLUSTERS)
def test_without_an_address_a_cluster_of_its_own_is_started(executor):
    pytest.importorskip({"dask": "distributed"}.get(executor, executor))
    with Pool(WorkerOptions(executor, num_workers=2)) as pool:
        outcome = pool.run(Noise(), range(10), seed=7)
    assert len(outcome.values) == 10
    assert not outcome.faults


def test_an_address_without_a_cluster_is_one_sentence():
    pytest.importorskip("distributed")
    import dask

    with dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}):
        with Pool(WorkerOptions("dask", address="tcp://127.0.0.1:9")) as pool:
            with pytest.raises(SimulationError, match="no dask cluster at tcp://127.0.0.1:9"):
                pool.run(Noise(), range(2))
