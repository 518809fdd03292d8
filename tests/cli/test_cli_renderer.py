from dataclasses import replace

import numpy as np
import pytest
import torch

import visadapt as va
from renderers import Camera, DrawnCartPole, load_renderer
from renderers.training import KEEP_EVERY
from tests.cli.commands import CAMERA, GUESS, refused, run, write_frames
from visadapt import progress
from visadapt.recordings import Episode, write_recording

OUT = ("--out", "r.safetensors")


def test_from_recorded_frames_and_states(here, capsys):
    write_frames(here / "a.h5")
    write_frames(here / "b.h5", names=("x", "x_dot", "theta", "theta_dot"))
    assert run("renderer", "a.h5", "b.h5", *GUESS, "--iterations", 60, *OUT) == 0
    said = capsys.readouterr().out
    assert "grey levels of 255 off where cart and pole are" in said
    assert "the pose is read, x 0.0" in said
    renderer = load_renderer(str(here / "r.safetensors"))
    assert renderer.size == (40, 48)
    # Nearer to the camera than the guess, 1.5 px to the left of it.
    assert abs(float(renderer.state_dict()["origin"][0]) - CAMERA.column) < 1.0
    assert not (here / "r.safetensors.unfinished").exists()


def test_of_a_video_it_is_said_what_is_right(here, capsys):
    (here / "film.mp4").write_bytes(b"film")
    assert "film.mp4: a video, which holds no states: an HDF5 file with" in refused(
        capsys, "renderer", "film.mp4", *GUESS, *OUT
    )


def test_from_what_an_environment_shows(here, capsys):
    arguments = ("--target", "rig:pushed", "--map", "map.toml", "--show", 50, "--within", "1.2,0.2")
    assert run("renderer", *arguments, *GUESS, "--iterations", 60, *OUT) == 0
    printed = capsys.readouterr()
    assert "in 5 frames left out" in printed.out
    assert "0.02 s between actions, from its tau" in printed.err
    assert load_renderer(here / "r.safetensors").size == (40, 48)


def test_interrupted_it_goes_on_to_the_same_renderer(here, monkeypatch, capsys):
    write_frames(here / "a.h5", 40)
    command = ("renderer", "a.h5", *GUESS, "--iterations", KEEP_EVERY + 10)
    assert run(*command, "--out", "whole.safetensors") == 0
    calls = []

    def log(self, stage, done, total, loss):
        calls.append(done)
        if len(calls) == KEEP_EVERY + 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(progress._Log, "__call__", log)
    assert run(*command, *OUT) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "visadapt: interrupted; run the same command to go on"
    assert not (here / "r.safetensors").exists()
    assert "r.safetensors.unfinished holds a run with other settings (seed)" in refused(
        capsys, *command, *OUT, "--seed", 1
    )
    assert run(*command, *OUT) == 0
    assert calls[-10:] == list(range(KEEP_EVERY + 1, KEEP_EVERY + 11))
    whole, resumed = (load_renderer(here / f"{name}.safetensors").state_dict() for name in ("whole", "r"))
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


def write_states(path):
    write_recording(path, [Episode(0.05 * np.arange(30), np.zeros((30, 1)), np.zeros((30, 4)))])


def write_degrees(path, exploration):
    """Frames of a pole that is kept upright, with its angle in degrees."""
    target = va.SyntheticTarget(camera=DrawnCartPole(CAMERA))
    policy = va.load_policy(va.shipped("cartpole_states"))
    runs = va.run(target, policy, 2, 60, torch.Generator().manual_seed(1), exploration)
    unit = np.array([1, 1, 180 / np.pi, 180 / np.pi])
    episodes = [replace(run.episode, state=run.episode.state * unit) for run in runs]
    write_recording(path, episodes, ["x", "x_dot", "theta", "theta_dot"], ["command"])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("none.h5",), "none.h5: there is no such file"),
        (("rig.py",), "rig.py: not a readable HDF5 file"),
        ((), "give recordings, or a gymnasium environment by --target and --map"),
        (("a.h5", "--target", "rig:states"), "give recordings, or a gymnasium environment"),
        (("--target", "rig:states"), "rig:states: cannot be put into chosen states"),
        (("few.h5",), "10 frames are too few"),
        (("states.h5",), "states.h5, episode 0: holds states alone; frames and states are needed"),
        (
            ("a.h5", "larger.h5"),
            "larger.h5, episode 0: frames of (100, 120) rows and columns; those before have (40, 48)",
        ),
        (("names.h5",), "names.h5: has no state 'theta'; it has x, v, phi, w"),
        (("a.h5", "--iterations", 2), "--iterations 2: at least 3"),
        (("degrees.h5",), "radians are right (these look like degrees)"),
        (("small.h5",), "answers the command as if in degrees; radians are right"),
    ],
)
def test_what_it_refuses(here, capsys, arguments, says):
    write_frames(here / "a.h5", 30)
    write_frames(here / "few.h5", 10)
    write_frames(here / "larger.h5", 30, Camera())
    write_frames(here / "names.h5", 30, names=("x", "v", "phi", "w"))
    write_states(here / "states.h5")
    write_degrees(here / "degrees.h5", exploration=0.3)
    write_degrees(here / "small.h5", exploration=0.15)
    assert says in refused(capsys, "renderer", *arguments, *GUESS, *OUT)
    assert not list(here.glob("r.safetensors*"))


def test_a_renderer_that_is_there_is_not_overwritten(here, capsys):
    write_frames(here / "a.h5", 30)
    (here / "r.safetensors").write_text("mine")
    assert "r.safetensors is there already" in refused(capsys, "renderer", "a.h5", *GUESS, *OUT)
    assert (here / "r.safetensors").read_text() == "mine"


@pytest.mark.parametrize("guess", [("--hinge", "22"), ("--hinge", "a,b"), ("--scale", "-1"), ("--scale", "nan")])
def test_guesses(here, capsys, guess):
    with pytest.raises(SystemExit) as caught:
        run("renderer", "a.h5", *GUESS, *guess, *OUT)
    assert caught.value.code == 2
    assert f"argument {guess[0]}" in capsys.readouterr().err


def test_a_hinge_far_outside_the_frames_is_refused(here, capsys):
    write_frames(here / "a.h5", 30)
    far = [text.replace("22,", "6000,") for text in GUESS]
    line = refused(capsys, "renderer", "a.h5", *far, *OUT)
    assert "--hinge 6000,28.5: more than a frame's size outside the frames, which are 48 px wide and 40 px high" in line


def test_lengths_in_mm_are_refused(here, capsys):
    path = write_frames(here / "a.h5", 30)
    for factor in (100, 1000):
        episodes = [replace(each, state=each.state * [factor, 1, 1, 1]) for each in va.read_recording(path)]
        write_recording(here / "other.h5", episodes)
        assert "frames 48 px wide; x in m is right" in refused(capsys, "renderer", "other.h5", *GUESS, *OUT)


def test_a_renderer_that_does_not_draw_the_pole_yet_is_refused(here, capsys):
    write_frames(here / "a.h5", 30)
    line = refused(capsys, "renderer", "a.h5", *GUESS, "--iterations", 3, *OUT)
    assert "has not learnt to draw these frames: where cart and pole are, it is 5" in line
    # Nothing is left of it, in whose place a better guess would be refused.
    assert not list(here.glob("r.safetensors*"))


def test_frames_in_which_nothing_moves_are_refused(here, capsys):
    path = write_frames(here / "a.h5", 30)
    dark = [replace(each, frame=np.zeros_like(each.frame)) for each in va.read_recording(path)]
    write_recording(here / "dark.h5", dark)
    line = refused(capsys, "renderer", "dark.h5", *GUESS, "--iterations", 3, *OUT)
    assert "no pixel of the frames changes by more than 20 grey levels of 255" in line


def test_states_without_names_are_refused(here, capsys):
    path = write_frames(here / "a.h5", 30)
    write_recording(here / "bare.h5", [replace(each, state=each.state[:, [0, 2]]) for each in va.read_recording(path)])
    assert "states of 2 columns, which are not named" in refused(capsys, "renderer", "bare.h5", *GUESS, *OUT)
