"""The command on workers of dask: Ctrl-C, a scheduler that dies and comes back, or does not."""

import os
import signal
import time

import pytest
from cluster import Cluster
from test_faults import at as at
from test_faults import begin, end, fresh, kept, require_same, resume, wait_for, working

__all__ = ["fresh"]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="signals")]


@pytest.fixture
def cluster(tmp_path):
    with Cluster(tmp_path, 1, "--no-nanny") as cluster:
        yield cluster


def remaining(session):
    """Whether a process of the session is still there after some seconds."""
    for _ in range(100):
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return False
        time.sleep(0.1)
    return True


@pytest.mark.parametrize("to_all", [False, True])
def test_ctrl_c_keeps_what_is_finished_and_leaves_no_process(fresh, to_all):
    process = begin(fresh, "--backend", "dask", "--jobs", "1")
    wait_for(working(fresh), process)
    (os.killpg if to_all else os.kill)(process.pid, signal.SIGINT)  # in a terminal all processes get it
    status, error = end(process)
    assert status == 130, error
    assert "Traceback" not in error
    assert not remaining(process.pid)
    assert "finished runs are kept where there are any: the same command continues, 'run' with --resume" in error
    resume(fresh)


def test_a_killed_client_leaves_no_process(fresh):
    process = begin(fresh, "--backend", "dask", "--jobs", "1")
    wait_for(working(fresh), process)
    process.kill()
    process.communicate()
    assert kept(fresh) > 0
    assert not remaining(process.pid)
    resume(fresh)


def test_a_scheduler_that_ends(fresh, cluster, monkeypatch):
    monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "3s")
    process = begin(fresh, "--backend", "dask", "--jobs", "-1", "--scheduler", cluster.address)
    wait_for(working(fresh), process)
    cluster.kill()
    status, error = end(process)
    assert status == 2, error
    assert "Traceback" not in error
    assert "the executor has ended" in error
    assert f"; {kept(fresh)} finished runs are kept, and the same command with --resume continues" in error
    resume(fresh)


def test_workers_that_come_back(fresh, cluster):
    process = begin(fresh, "--backend", "dask", "--jobs", "-1", "--scheduler", cluster.address)
    wait_for(working(fresh), process)
    cluster.kill_workers()
    cluster.add_worker()
    status, error = end(process)
    assert status == 0, error
    require_same(fresh)
