import pytest
import torch

from visadapt.history import LENGTH, History


def frames(value, batch=2):
    return torch.full((batch, 3, 4), float(value))


def acts(value, batch=2):
    return torch.full((batch, 1), float(value))


def test_it_starts_with_the_first_observation_repeated_and_no_actions():
    first = torch.arange(24.0).reshape(2, 3, 4)
    history = History.start(first, 1)
    assert history.observations.shape == (2, LENGTH, 3, 4)
    assert history.actions.shape == (2, LENGTH, 1)
    for k in range(LENGTH):
        assert torch.equal(history.observations[:, k], first)
    assert not history.actions.any()


def test_the_latest_comes_last_and_the_oldest_is_forgotten():
    history = History.start(frames(0), 1)
    for k in range(1, LENGTH + 3):
        history = history.acting(acts(k / 10)).observing(frames(k))
    latest = list(range(3, LENGTH + 3))
    assert history.observations[1, :, 0, 0].tolist() == latest
    assert history.actions[1, :, 0].tolist() == pytest.approx([k / 10 for k in latest])


def test_acting_and_observing_leave_the_old_history_as_it_was():
    history = History.start(frames(0), 1)
    history.acting(acts(1)).observing(frames(1))
    assert not history.actions.any()
    assert not history.observations.any()


@pytest.mark.parametrize("shape", [(2, 4), (2, 3, 4)])
def test_rows_can_be_taken_from_either_of_two_histories(shape):
    one, other = History.start(torch.ones(shape), 1).acting(acts(0.5)), History.start(torch.zeros(shape), 1)
    mixed = one.where(torch.tensor([True, False]), other)
    for b, source in enumerate((one, other)):
        assert torch.equal(mixed.observations[b], source.observations[b])
        assert torch.equal(mixed.actions[b], source.actions[b])
    assert torch.equal(mixed[1:].observations, other[1:].observations)
