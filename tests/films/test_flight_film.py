import dataclasses
import resource
import subprocess
import sys
from pathlib import Path
from typing import cast

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from visadapt.films.canvas import Canvas
from visadapt.films.colours import RED, VIOLET
from visadapt.films.drawing3d import Pen, PinholeCamera
from visadapt.films.flight_film import FlightFilm
from visadapt.films.flight_panel import FlightPanel
from visadapt.films.flight_views import FOLLOWING_VIEW, FlightScales, draw_close_up
from visadapt.films.vehicle_shapes import draw_vehicle, outline
from visadapt.recordings import Episode
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import from_angles, rotation
from visadapt.targets.rollout import Run
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference

SPEED = 1.5
"""m/s of the reference, along x"""


def along(seconds: float = 1.0) -> Follow:
    """A straight reference at a steady speed."""
    time = torch.arange(round(seconds / 0.1) + 1) * 0.1
    motion = torch.zeros(4, 1, len(time), 3)
    motion[0, 0, :, 0], motion[1, 0, :, 0] = SPEED * time, SPEED
    return Follow(Reference.of(motion, 0.1))


def following(
    aside: tuple[float, float, float] = (0.0, 0.0, 0.0), rows: int = 11, survived: bool = True, **other
) -> FlightPanel:
    """A quadrotor that flies beside its reference all the way."""
    task = along()
    time = np.arange(rows) * 0.1
    state = np.zeros((rows, 13))
    state[:, 0], state[:, 3], state[:, 6] = SPEED * time, SPEED, 1.0
    state[:, :3] += aside
    run = Run(
        Episode(time, np.zeros((rows, 4)), state), survived, np.tile(other.pop("force", (0.0, 0.0, 0.0)), (rows, 1))
    )
    return FlightPanel("a flight", run, Quadrotor(), task, torch.tensor([0, 0]), **other)


def reaching(miss: float) -> FlightPanel:
    """A fixed wing that passes its target at a distance, to the left."""
    time = np.arange(140) * 0.05
    state = np.zeros((140, 13))
    state[:, 0], state[:, 1], state[:, 3], state[:, 6] = 11.5 * time, miss, 11.5, 1.0
    run = Run(Episode(time, np.zeros((140, 4)), state), True, np.zeros(140))
    return FlightPanel("a flight", run, FixedWing(), Reach(), torch.tensor([50.0, 0.0, 0.0]))


def count(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - colour).max(-1) < 30).sum())


def test_positions_between_rows_go_through_the_rows_and_errors_are_the_course_s():
    panel = following((0.0, 0.03, 0.04))
    np.testing.assert_allclose(panel.position[::5], panel.states[:, :3], atol=1e-6)
    np.testing.assert_allclose(panel.position[:, 0], SPEED * panel.times, atol=1e-6)
    states = torch.from_numpy(panel.states)[None]
    assert panel.score[-1] == pytest.approx(float(panel.task.misses(states, panel.task_state[None]).mean()), abs=1e-6)
    assert panel.score[-1] == pytest.approx(0.05)
    wing = reaching(0.2)
    flown = torch.from_numpy(np.array(wing.run.episode.state))[None]
    assert wing.worst == pytest.approx(float(wing.task.misses(flown, wing.task_state[None])))
    assert wing.passed == pytest.approx(50 / 11.5, abs=0.051)
    np.testing.assert_allclose(wing.nearest, (50, 0.2, 0), atol=1e-6)
    assert wing.end == pytest.approx(wing.passed + 0.5, abs=0.051)


def test_attitudes_between_rows_do_not_care_about_the_sign_of_a_quaternion():
    panel = following()
    turned = from_angles(torch.tensor([[0.1 * k, -0.3, 0.2] for k in range(11)]))
    state = np.array(panel.run.episode.state)
    state[:, 6:10] = turned * torch.tensor([1.0, -1.0]).repeat(6)[:11, None]
    run = Run(dataclasses.replace(panel.run.episode, state=state), True, panel.run.force)
    attitude = dataclasses.replace(panel, run=run).attitude
    np.testing.assert_allclose(attitude[::5], rotation(turned), atol=1e-5)
    middle = rotation(from_angles(torch.tensor([[0.05, -0.3, 0.2]])))[0]
    np.testing.assert_allclose((attitude[2] + attitude[3]) / 2, middle, atol=0.02)


@pytest.mark.parametrize("vehicle", [Quadrotor(), FixedWing()])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.8, -0.4, 2.0)])
def test_a_vehicle_is_drawn_where_it_is_as_it_is_turned(vehicle, angles: tuple[float, float, float]):
    canvas, place = Canvas(480, 360), np.array([0.4, 1.0, -0.2])
    camera = PinholeCamera.towards(np.array([-2.0, -4.0, 1.5]), np.zeros(3), 500.0, (480, 360))
    turned = rotation(from_angles(torch.tensor([angles])))[0].double().numpy()
    draw_vehicle(Pen(canvas, camera), vehicle, place, turned)
    drawn = np.argwhere((canvas.pixels < 250).any(-1))[:, ::-1]
    expected = camera.project(place + outline(vehicle) @ turned.T)[0]
    np.testing.assert_allclose(drawn.min(0), expected.min(0), atol=4)
    np.testing.assert_allclose(drawn.max(0), expected.max(0), atol=4)


@pytest.mark.parametrize("aside", [(0.3, 0.0, 0.0), (-0.3, 0.0, 0.2), (0.0, 0.3, -0.3)])
def test_the_error_is_drawn_from_the_reference_to_the_vehicle(aside: tuple[float, float, float]):
    panel, canvas = following(aside), Canvas(480, 360)
    draw_close_up(canvas, panel, 1, FlightScales.of([panel, following()]))
    goal = panel.goal[1]
    camera = FOLLOWING_VIEW.camera(goal, (480, 360))
    ends = camera.project(np.stack([goal, goal + np.array(aside)]))[0]
    np.testing.assert_allclose(ends[0], (240, 180), atol=1e-6)
    between = ends[0] + np.linspace(0.2, 0.8, 9)[:, None] * (ends[1] - ends[0])
    near = [canvas.pixels[round(y) - 2 : round(y) + 2, round(x) - 2 : round(x) + 2] for x, y in between]
    assert sum(count(part, RED) > 0 for part in near) >= 7  # the thrust's arrow may cover some


def test_a_hidden_force_is_drawn_towards_where_it_pushes():
    columns = []
    for newtons in (2.0, -2.0):
        panel = following(force=(newtons, 0.0, 0.0))
        scene = FlightFilm([panel]).still(0.5)[60:420, 28:508].astype(int)
        violet = np.abs(scene - VIOLET).max(-1) < 30
        assert violet.sum() > 150
        columns.append(np.nonzero(violet)[1].mean())
    assert columns[0] > 260
    assert columns[1] < 220
    assert count(FlightFilm([following()]).still(0.5)[60:420], VIOLET) == 0


def test_outlines_have_the_vehicles_sizes():
    assert np.ptp(outline(FixedWing())[:, 1]) == pytest.approx(1.54)
    rotors = outline(Quadrotor()).reshape(4, 24, 3).mean(1)
    np.testing.assert_allclose(np.linalg.norm(rotors[:, :2], axis=1), 0.2, atol=1e-9)


def test_a_film_is_decoded_as_it_was_drawn(tmp_path: Path):
    panels = [following((0.0, 0.05, 0.0), rows=4)]
    path = tmp_path / "new folder" / "film.mp4"
    done: list[tuple[int, int]] = []
    FlightFilm(panels).write(path, lambda now, total, _: done.append((now, total)))
    reader = imageio_ffmpeg.read_frames(path)
    meta = next(reader)
    reader.close()
    assert meta["codec"] == "h264"
    assert meta["pix_fmt"].startswith("yuv420p")
    assert meta["fps"] == 25
    frames = imageio.imread(path, plugin="FFMPEG")
    assert len(frames) == round((0.3 + 1.5) * 25) + 1
    assert done[-1] == (len(frames), len(frames))
    for i in (0, 20, len(frames) - 1):
        drawn = FlightFilm(panels).still(i * 0.04)
        assert frames[i].shape == drawn.shape
        assert drawn.shape[0] % 2 == drawn.shape[1] % 2 == 0
        assert np.abs(frames[i].astype(float) - drawn).mean() < 2
    assert [entry.name for entry in path.parent.iterdir()] == ["film.mp4"]


def test_a_still_is_a_picture_and_its_end_stands_still(tmp_path: Path):
    panels = [following(), following((0.0, 0.05, 0.0))]
    FlightFilm(panels).write_still(tmp_path / "still.png", 0.6)
    with Image.open(tmp_path / "still.png") as picture:
        assert np.array_equal(np.asarray(picture), FlightFilm(panels).still(0.6))
    assert np.array_equal(FlightFilm(panels).still(1.0), FlightFilm(panels).still(9.0))


def test_flights_that_failed_are_marked_as_such_from_then_on():
    state = np.array(following().run.episode.state)
    state[6:, 1] = 2.0
    strays = following()
    strays = dataclasses.replace(
        strays, run=Run(dataclasses.replace(strays.run.episode, state=state), True, np.zeros(11))
    )
    assert strays.failed == pytest.approx(0.56, abs=0.04)
    lost = following(rows=7, survived=False)
    assert lost.failed == pytest.approx(0.6)
    for panel, before, after in ((strays, 0.4, 0.8), (lost, 0.5, 0.7)):
        banner = slice(60, 120), slice(28, 508)
        assert count(FlightFilm([following(), panel]).still(before)[:, 544:][banner], RED) == 0
        assert count(FlightFilm([following(), panel]).still(after)[:, 544:][banner], RED) > 2000
        assert count(FlightFilm([following(), panel]).still(after)[banner], RED) == 0
    missed, hit = reaching(1.3), reaching(0.01)
    assert missed.failed == pytest.approx(missed.passed)
    assert hit.failed is None
    assert count(FlightFilm([missed, hit]).still(4.0)[60:120], RED) == 0
    after_it = FlightFilm([missed, hit]).still(4.7)[60:120]
    assert count(after_it[:, :510], RED) > 2000
    assert count(after_it[:, 510:], RED) == 0


def test_a_flight_that_strays_beyond_all_bounds_is_drawn_all_the_same():
    panel = following()
    state = np.array(panel.run.episode.state)
    state[5:, :6] = 1e30
    strayed = dataclasses.replace(
        panel, run=Run(dataclasses.replace(panel.run.episode, state=state), False, np.full(11, 1e30))
    )
    for t in (0.45, 0.5, 1.0):
        assert FlightFilm([strayed, panel]).still(t).shape == FlightFilm([panel, panel]).still(t).shape
    assert FlightScales.of([strayed, panel]).far == FlightScales.of([panel]).far


def test_an_earlier_flight_is_drawn_beside_the_later_one():
    plain, earlier = following((0.0, 0.01, 0.0)), following((0.0, 0.05, 0.1))
    alone = FlightFilm([plain]).still(0.8)
    both = FlightFilm([dataclasses.replace(plain, earlier=earlier)]).still(0.8)
    assert (alone != both).any(-1).sum() > 500


def test_a_flight_of_one_row_is_a_picture():
    assert FlightFilm([following(rows=1)]).still(0.0).ndim == 3


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: FlightFilm([]).still(0.0), "at least one panel"),
        (lambda: FlightFilm([following(), reaching(0.1)]).still(0.0), "film them apart"),
        (lambda: following(rows=12), "12 rows, its reference only 11"),
        (
            lambda: dataclasses.replace(following(), task=cast(FlightTask, object())),
            "no picture is known of a task object",
        ),
        (
            lambda: dataclasses.replace(
                following(), run=Run(Episode(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 4))), True, np.zeros(3))
            ),
            "no states of a quadrotor",
        ),
    ],
)
def test_bad_input_is_one_clear_line(make, says: str):
    with pytest.raises(ValueError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a limit on the size of files")
def test_a_disk_that_fills_up_leaves_the_old_film(tmp_path: Path):
    """A limit on the size of a file stands for a full disk: ffmpeg is stopped in the middle of writing."""
    old = tmp_path / "film.mp4"
    old.write_bytes(b"the film of yesterday")
    code = (
        "import resource, sys; from tests.films.test_flight_film import *\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "try: FlightFilm([following(rows=1)]).write(sys.argv[1])\n"
        "except OSError as error: print(error); sys.exit(7)\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code, str(old)], cwd=root, capture_output=True, text=True)
    assert done.returncode == 7, done.stderr
    assert "was not written" in done.stdout
    assert len(done.stdout.strip().splitlines()) == 1
    assert old.read_bytes() == b"the film of yesterday"
    assert list(tmp_path.iterdir()) == [old]
