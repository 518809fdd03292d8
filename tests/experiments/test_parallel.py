"""Jobs give the same numbers in processes, and on a cluster of which a node is lost."""

import threading
import time

import pytest

from experiments.parallel import in_processes
from tests.short_training import Settings, tuned

SEEDS = [(seed,) for seed in range(6)]


def attempts(folder):
    return len([*folder.iterdir()])


def test_a_cluster_that_loses_a_node_gives_the_numbers_of_processes(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    alone, together = tmp_path / "alone", tmp_path / "together"
    alone.mkdir()
    together.mkdir()
    expected = in_processes(tuned, Settings(alone), SEEDS)
    assert list(expected) == SEEDS
    assert attempts(alone) == len(SEEDS)

    small = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=small)
    lost = cluster.add_node(num_cpus=2, object_store_memory=80_000_000)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)

    def lose_it() -> None:
        while attempts(together) < 2:
            time.sleep(0.05)
        cluster.remove_node(lost, allow_graceful=False)

    killer = threading.Thread(target=lose_it)
    killer.start()
    try:
        assert in_processes(tuned, Settings(together, "ray"), SEEDS) == expected
        assert attempts(together) > len(SEEDS)  # jobs of the lost node ran again
    finally:
        killer.join()
        ray.shutdown()
        cluster.shutdown()
