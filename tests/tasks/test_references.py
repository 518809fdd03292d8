import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import torch

from datasets.quadrotor_references import SPLINE_DEGREE, Settings, basis, main, make, read
from tests.flying import asked_by, fly_blind, states_on
from visadapt.interpolation import cubic
from visadapt.recordings import RecordingError
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import rotation
from visadapt.tasks.differential_flatness import commands, demanded
from visadapt.tasks.references import Reference, read_reference

SMALL = Settings(train=60, test=20)


@pytest.fixture(scope="module")
def drawn():
    return make(SMALL)


@pytest.fixture(scope="module")
def fine():
    """The same kind of references, 5 ms between rows."""
    return make(Settings(train=8, test=0, period=0.005))[0]


def test_what_a_reference_asks_for_flies_it_in_the_simulator(fine):
    # Open loop for 10 s: an attitude off by a milliradian throughout would end half a metre off.
    assert fly_blind(Reference.of(fine.motion[:, :, ::2], 2 * fine.period)).max() < 0.01


def test_the_demand_of_a_motion_is_the_thrust_that_makes_it_with_yaw_zero():
    generator = torch.Generator().manual_seed(0)
    acceleration, jerk = 3 * torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    demand = demanded(acceleration, jerk)
    axes = rotation(demand.attitude)
    lifted = demand.thrust[:, None] * axes[..., 2] - torch.tensor([0, 0, 9.81], dtype=torch.float64)
    torch.testing.assert_close(lifted, acceleration)
    torch.testing.assert_close(axes[:, 0, 1], torch.zeros(50, dtype=torch.float64))  # y_body is at right angles to e_x
    assert (axes[:, 0, 0] > 0).all()
    # R' = R [omega]x, by a difference.
    h = 1e-5
    later, sooner = (rotation(demanded(acceleration + s * jerk, jerk).attitude) for s in (h, -h))
    turned = axes.mT @ (later - sooner) / (2 * h)
    seen = torch.stack((turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]), 1)
    torch.testing.assert_close(demand.rates, seen, rtol=1e-6, atol=1e-8)


def test_hovering_asks_for_the_command_that_hovers():
    still = torch.zeros(1, 3)
    asked = commands(still, still, still, Quadrotor())
    assert asked.tolist()[0] == pytest.approx([Quadrotor().hover(), 0, 0, 0])
    assert asked.dtype == torch.float32
    assert demanded(still, still).attitude.tolist() == [[1, 0, 0, 0]]


def test_rows_and_the_origin(drawn):
    train, test = drawn
    assert train.positions.shape == (60, 101, 3)
    assert test.jerks.shape == (20, 101, 3)
    assert train.positions.dtype == torch.float32
    assert (train.positions[:, 0] == 0).all()
    assert states_on(train).shape == (60, 101, 13)


def test_all_are_feasible_with_the_margin_and_within_the_bounds_on_speed(drawn):
    for references in drawn:
        speed = references.velocities.norm(dim=-1)
        assert (speed <= SMALL.max_speed).all()
        # The mean is taken at twice as many instants.
        assert speed.mean(1).min() > 0.98
        assert speed.mean(1).max() <= 2.02
        asked = asked_by(references)
        # Differences of the jerk over 0.1 s are no more than nearly the snap.
        assert asked.abs().max() < SMALL.margin + 0.05
        demand = demanded(references.accelerations, references.jerks)
        assert demand.rates.abs().max() < 0.5
        assert demand.thrust.min() > 2.21
        assert demand.thrust.max() < 17.31


def test_the_references_use_what_is_allowed(drawn):
    train, _ = drawn
    peak = demanded(train.accelerations, train.jerks).rates.abs().amax((1, 2))
    assert peak.max() > 0.4
    assert peak.median() > 0.2
    assert train.velocities.norm(dim=-1).amax(1).median() > 2.5
    still = train.velocities[:, 0].norm(dim=1) == 0
    assert 0.3 < still.float().mean() < 0.7


def test_derivatives_are_those_of_the_positions(fine):
    for value, slope in pairwise(fine.motion):
        seen = torch.gradient(value.double(), spacing=fine.period, dim=1)[0]
        # float32 rounds metres to 1e-6, over 4 ms.
        torch.testing.assert_close(seen[:, 1:-1], slope[:, 1:-1].double(), rtol=1e-3, atol=5e-3)


def test_splines_add_up_to_one_and_are_smooth_across_knots():
    time = torch.linspace(0, 10, 41, dtype=torch.float64)
    value = basis(time, 2.0, 5, 0)
    torch.testing.assert_close(value.sum(1), torch.ones_like(time))
    assert value.shape == (41, 5 + SPLINE_DEGREE)
    for order in range(5):
        about_a_knot = torch.tensor([4 - 1e-6, 4 + 1e-6], dtype=torch.float64)
        assert basis(about_a_knot, 2.0, 5, order).diff(dim=0).abs().max() < 1e-5


def test_the_same_seed_draws_the_same_and_no_reference_twice(drawn):
    train, test = drawn
    again, _ = make(SMALL)
    torch.testing.assert_close(again.positions, train.positions, rtol=0, atol=0)
    other, _ = make(dataclasses.replace(SMALL, seed=1))
    assert not torch.equal(other.positions, train.positions)
    ends = torch.cat((train.positions[:, -1], test.positions[:, -1]))
    assert len(ends.unique(dim=0)) == 80


def test_the_file_gives_back_what_was_drawn_and_with_which_settings(drawn, tmp_path, capsys):
    path = tmp_path / "data" / "references.npz"
    settings = dataclasses.replace(SMALL, out=path)
    main(settings)
    assert "60 references to train on, 20 to test on" in capsys.readouterr().out
    for got, expected in zip(read(path), drawn, strict=True):
        assert got.period == 0.1
        for field in ("positions", "velocities", "accelerations", "jerks"):
            assert torch.equal(getattr(got, field), getattr(expected, field))
    assert '"seed": 0' in str(np.load(path)["settings"])
    main(settings)
    assert [entry.name for entry in path.parent.iterdir()] == ["references.npz"]


def test_a_file_that_is_missing_or_torn_is_one_line(tmp_path):
    with pytest.raises(ValueError, match="there is no such data set; make it with python -m"):
        read(tmp_path / "none.npz")
    torn = tmp_path / "torn.npz"
    main(dataclasses.replace(SMALL, train=2, test=0, out=torn))
    torn.write_bytes(torn.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"torn\.npz: not a complete data set of references"):
        read(torn)
    np.savez(torn, positions=np.zeros((1, 2, 3)))
    with pytest.raises(ValueError, match="not a complete data set"):
        read(torn)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train": 0}, "train and test are 0 and 20"),
        ({"period": 0.0}, "period is 0.0 s"),
        ({"period": 20.0}, "period is 20.0 s"),
        ({"max_mean_speed": 0.5}, "speeds are 1.0 and 0.5"),
        ({"max_speed": 1.5}, "speeds are"),
        ({"min_segments": 0}, "segments are 0 to 15"),
        ({"margin": 0.0}, "margin and at_rest are 0.0 and 0.5"),
    ],
)
def test_impossible_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        make(dataclasses.replace(SMALL, **change))


def test_between_rows_cubics_are_the_reference_itself(fine):
    time = 0.1 * torch.arange(fine.positions[:, ::20].shape[1])
    at = time[-1] * torch.linspace(0, 1, 10 * (len(time) - 1) + 1)
    between = cubic(time, fine.positions[:, ::20], fine.velocities[:, ::20], at)
    torch.testing.assert_close(between, fine.positions[:, : 20 * (len(time) - 1) + 1 : 2], atol=2e-5, rtol=0)


def written(path, text):
    path.write_text(text)
    return path


def table_of(time, places, speeds=None, names="time,x,y,z"):
    rows = np.column_stack([time, places] if speeds is None else [time, places, speeds])
    header = names if speeds is None else f"{names},x_dot,y_dot,z_dot"
    return "\n".join([header, *(",".join(f"{value:.9g}" for value in row) for row in rows)])


def circle(time):
    """2 m around, 1.6 m/s."""
    t = 0.8 * np.asarray(time)[:, None]
    return np.hstack([2 * np.sin(t), 2 - 2 * np.cos(t), 0 * t]), 1.6 * np.hstack([np.cos(t), np.sin(t), 0 * t])


@pytest.mark.parametrize("spacing", [0.01, 0.07, 0.25])
@pytest.mark.parametrize("with_speeds", [True, False])
def test_a_reference_of_ones_own_is_resampled_to_the_period(tmp_path, spacing, with_speeds):
    time = np.arange(0, 6.0001, spacing)
    places, speeds = circle(time)
    text = table_of(time + 17.0, places, speeds if with_speeds else None)
    own = read_reference(written(tmp_path / "own.csv", text), period=0.1)
    at = np.arange(len(own.positions)) * 0.1
    assert at[-1] == pytest.approx(6.0, abs=0.1)
    expected, fast = circle(at)
    np.testing.assert_allclose(own.positions, expected, atol=0.01)
    np.testing.assert_allclose(own.velocities, fast, atol=0.05)
    np.testing.assert_allclose(own.accelerations[1:-1].norm(dim=1), 1.28, atol=0.15)
    assert own.positions.dtype == torch.float32
    assert torch.isfinite(states_on(own)).all()


GOOD = table_of(np.arange(0, 1.05, 0.1), circle(np.arange(0, 1.05, 0.1))[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("time,", "t,"), r"has no column 'time'; its columns are t, x, y, z"),
        (lambda text: text.replace("z\n", "height\n"), "has no column 'z'"),
        (lambda text: text.replace("z\n", "x_dot\n"), "has no column 'z'"),
        (
            lambda text: text.replace("\n0.3,", "\nnan,"),
            r"row 4 \(line 5\), column 'time' is empty or nan",
        ),
        (
            lambda text: text.replace("\n0.3,", "\n0.1,"),
            r"row 4 \(line 5\), column 'time': the clock runs backward \(from 0.2",
        ),
        (lambda text: "\n".join(text.split("\n")[:3]), r"2 rows over 0.1 s; at least 3 rows over 0.5 s"),
        (lambda text: text.replace("\n0.5,", "\n0.5,9"), r"it moves at .* m/s; at most 5 m/s is right"),
        (lambda text: text.replace("\n0.5,", "\n0.5,x"), r"row 6 \(line 7\), column 'x' is"),
        (lambda text: "", "is empty"),
    ],
)
def test_a_reference_that_cannot_be_used_is_one_line(tmp_path, change, message):
    path = written(tmp_path / "own.csv", change(GOOD))
    with pytest.raises(RecordingError, match=message) as caught:
        read_reference(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.csv: cannot be read"):
        read_reference(tmp_path / "none.csv")


def test_a_cubic_is_interpolated_exactly():
    time = torch.tensor([0.0, 0.3, 1.0, 1.1], dtype=torch.float64)
    at = torch.linspace(-0.1, 1.2, 20, dtype=torch.float64)

    def value(t):
        return torch.stack((t**3 - t, 2 * t**2), -1)

    slope = torch.stack((3 * time**2 - 1, 4 * time), -1)
    torch.testing.assert_close(cubic(time, value(time), slope, at), value(at))
