"""Work shared out among processes gives what one process gives, in its order; errors come back."""

import os
import signal
import subprocess
import sys

import pytest
import torch

from tests.own_systems import Pendulum
from visadapt.effects.catalogue import catalogue
from visadapt.processes import shared_out
from visadapt.systems import CartPole


@pytest.mark.parametrize("jobs", [1, 2, 3, 9])
def test_results_are_in_order(jobs):
    table = torch.arange(14.0).reshape(7, 2)
    with torch.inference_mode():
        found = shared_out(lambda indices: [table[k] ** 2 for k in indices], 7, jobs)
    torch.testing.assert_close(torch.stack(found), table**2)


@pytest.mark.parametrize(("jobs", "processes"), [(1, 1), (2, 2), (8, 5)])
def test_each_share_has_a_process_of_its_own(jobs, processes):
    assert len(set(shared_out(lambda indices: [os.getpid()] * len(indices), 5, jobs))) == processes


@pytest.mark.parametrize("bad", [0, 1])
def test_an_error_in_any_process_is_raised(bad):
    def work(indices):
        if bad in indices:
            raise ValueError(f"index {bad}")
        return list(indices)

    with pytest.raises(ValueError, match=f"index {bad}"):
        shared_out(work, 4, 2)


def test_nothing_to_do():
    assert shared_out(lambda indices: [], 0, 4) == []


def test_an_interrupt_is_told_by_one_process_alone():
    code = """
import os, signal, time
from visadapt.processes import shared_out
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore interrupts
def work(indices):
    os.write(1, b"at work\\n")
    for _ in range(600):  # one long sleep would not see a signal that comes just before it
        time.sleep(0.1)
    return list(indices)
try:
    shared_out(work, 2, 2)
except KeyboardInterrupt:
    raise SystemExit(130)
"""
    begun = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert begun.stdout is not None
    assert [begun.stdout.readline() for _ in range(2)] == ["at work\n"] * 2
    os.killpg(begun.pid, signal.SIGINT)
    _, told = begun.communicate(timeout=30)
    assert (begun.returncode, told) == (130, "")


def test_effects_of_a_system_of_ones_own_come_back_from_another_process():
    effects = catalogue(Pendulum())
    assert shared_out(lambda indices: [effects[k] for k in indices], len(effects), 2) == effects


def test_so_do_effects_that_are_searched_in_wider_ranges():
    effects = catalogue(CartPole(cart_mass=10.0, pole_mass=5.0))
    assert shared_out(lambda indices: [effects[k] for k in indices], len(effects), 2) == effects
