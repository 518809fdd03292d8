import math
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from visadapt.films.cartpole_film import PANEL_WIDTH, SCENE_HEIGHT, UPRIGHT_RAD, CartPoleFilm, CartPolePanel
from visadapt.films.widgets import RED, TEAL
from visadapt.recordings import Episode
from visadapt.targets.rollout import Run

PERIOD, DUE = 0.05, 0.5


def panel(theta, x=0.0) -> CartPolePanel:
    """21 rows of a pole at angles theta, on a cart that goes from 0 to x at a steady speed."""
    time = np.arange(21) * PERIOD
    place = x * time / time[-1]
    state = np.stack([place, np.full(21, x), np.broadcast_to(theta, 21), np.zeros(21)], -1)
    run = Run(Episode(time, np.zeros((21, 1)), state), True, np.zeros(21))
    return CartPolePanel("a swing", run, angle_limit=math.inf)


def count(picture, colour) -> int:
    return int((np.abs(picture - 255 * np.array(to_rgb(colour))).max(-1) < 12).sum())


def scene(panels, t, due=DUE):
    """Of the first panel."""
    return CartPoleFilm(panels, PERIOD, due).still(t)[56 : 56 + SCENE_HEIGHT, 28 : 28 + PANEL_WIDTH]


def seen(film, point):
    """Column and row in the scene of a point in m, to the right and up from the hinge at x = 0."""
    zoom = PANEL_WIDTH / (2 * film.half_width)
    return np.floor(np.array([PANEL_WIDTH, SCENE_HEIGHT]) / 2 + zoom * point * (1, -1)).astype(int)


RISING = np.linspace(math.pi, 0.0, 21)


def test_the_film_has_a_frame_for_every_row(tmp_path: Path):
    panels = [panel(RISING), panel(0.0, 3.0), panel(-RISING, -1.0)]
    path = tmp_path / "film.mp4"
    done: list[tuple[int, int]] = []
    CartPoleFilm(panels, PERIOD, DUE).write(path, lambda now, total, _: done.append((now, total)))
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 21
    assert seconds == pytest.approx(21 * PERIOD)
    assert done[-1] == (21, 21)


@pytest.mark.parametrize("x", [0.0, 1.0, -6.0])
@pytest.mark.parametrize("angle", [0.1, -2.0, math.pi])
def test_the_pole_is_drawn_where_it_is_at_its_angle_however_far_the_cart_goes(x: float, angle: float):
    panels = [panel(angle, x)]
    film = CartPoleFilm(panels, PERIOD, DUE)
    picture = scene(panels, 20 * PERIOD, due=2.0)
    along = np.array([math.sin(angle), math.cos(angle)])
    for share in (0.3, 0.9):
        column, row = seen(film, np.array([x, 0.0]) + share * along)
        assert np.ptp(picture[row, column].astype(int)) > 60, "coloured, as only the pole is"
        column, row = seen(film, np.array([x, 0.0]) - 0.3 * share * along)
        assert np.ptp(picture[row, column].astype(int)) < 60


def test_pole_and_cone_turn_teal_within_ten_degrees_to_either_side():
    for sign in (-1, 1):
        assert count(scene([panel(sign * 0.9 * UPRIGHT_RAD)], 0.0), TEAL) > 300
        assert count(scene([panel(sign * 1.1 * UPRIGHT_RAD)], 0.0), TEAL) == 0


def test_it_is_up_since_it_was_last_outside_the_cone_however_often_it_turned():
    theta = np.full(21, 2 * math.pi)
    theta[:4] = 1.0
    theta[6] = 2 * math.pi - 1.2 * UPRIGHT_RAD
    assert panel(theta).up_from == 7
    assert panel(0.0).up_from == 0
    assert panel(math.pi).up_from == 21


def test_a_pole_that_is_not_up_when_it_is_due_or_falls_later_is_marked():
    falling = np.zeros(21)
    falling[-1] = 0.3
    for theta in (RISING, falling):
        assert count(scene([panel(theta)], DUE - PERIOD), RED) == 0
        assert count(scene([panel(theta)], DUE), RED) > 2000
    assert count(scene([panel(0.0)], 20 * PERIOD), RED) == 0


def test_a_swing_up_that_ends_before_another_stays_at_its_last_frame():
    short = panel(0.0)
    episode = short.run.episode
    cut = Episode(episode.time[:9], episode.action[:9], episode.state[:9])
    ended = CartPolePanel("short", Run(cut, True, np.zeros(9)), angle_limit=math.inf)
    assert np.array_equal(scene([ended, short], 0.4), scene([ended, short], 1.0))
