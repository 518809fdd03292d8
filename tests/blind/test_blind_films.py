"""The blind films: their camera faults against the library's own, and the seal on their key."""

import hashlib
import json

import numpy as np
import pytest
import torch

import visadapt as va
from datasets.blind import films
from datasets.blind.camera_faults import CAMERA, FOREIGN_IN_FILMS, NOISE, clean, with_losses
from datasets.blind.films import IN_MOTION, MIX, Settings, calibration_path, main
from datasets.blind.scene import LOOKS
from visadapt.effects import EFFECTS, CameraEffect, Stage
from visadapt.estimation.camera_fit import through

PLACES = np.array([[0.2, 0.05], [-0.5, -0.2]])
BOX = {"left": 20.0, "top": 30.0, "right": 45.0, "bottom": 60.0, "grey": 0.35}


def frames(look="plain", **effects):
    return clean(effects, LOOKS[look], PLACES, np.array([0.0, 1.3]))


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("camera_shift", {"dx": 4.0, "dy": -3.0}),
        ("camera_rotation", {"angle": 0.1}),
        ("camera_zoom", {"scale": 1.15}),
        ("blur", {"sigma": 1.2}),
        ("gamma", {"exponent": 1.5}),
        ("brightness", {"gain": 0.8, "offset": 0.05}),
        ("occlusion", BOX),
    ],
)
def test_a_fault_is_what_the_catalogue_says(look, effect, values):
    usual, faulty = (frames(look, **own) for own in ({}, {effect: values}))
    fault = EFFECTS[effect](**values)
    assert isinstance(fault, CameraEffect)
    with torch.no_grad():
        seen = through(torch.from_numpy(usual), [fault]).numpy()
    inside = (slice(None), slice(15, 85), slice(18, 102))  # a camera that is moved sees more of the scene
    change = np.abs(faulty - usual)[inside]
    assert np.abs(faulty - seen)[inside].mean() < 0.15 * change.mean()


def test_every_effect_of_the_catalogue_that_a_film_can_show_is_drawn():
    shown = {kind.name for kind in CAMERA}
    assert shown == {name for name, effect in EFFECTS.items() if effect.stage is Stage.CAMERA}
    assert {EFFECTS[kind.name].stage.value for kind in IN_MOTION} == {"actuation", "dynamics", "sensing"}


@pytest.mark.parametrize("kind", FOREIGN_IN_FILMS, ids=lambda kind: kind.name)
def test_a_foreign_fault_shows_and_is_in_no_catalogue(kind):
    assert kind.name not in EFFECTS
    shape = kind.draw(np.random.default_rng(0), 25.0)
    change = frames(**{kind.name: kind.build(kind.high, shape)}) - frames()
    assert np.sqrt(np.mean(change**2)) > NOISE


def test_a_lost_frame_shows_the_last_one_again():
    shown = with_losses(np.arange(250, dtype=np.uint8).reshape(-1, 1, 1), 0.25, np.random.default_rng(0)).ravel()
    steps = np.diff(shown.astype(int))
    assert shown[0] == 0
    assert (steps == 0).mean() == pytest.approx(0.25, abs=0.06)
    assert set(shown) == set(shown[np.flatnonzero(steps) + 1]) | {0}


def test_the_key_is_sealed_and_kept_out_of_the_folder(tmp_path, capsys, monkeypatch):
    for name, few in (("ROWS", 160), ("CALIBRATION_FRAMES", 50)):
        monkeypatch.setattr(films, name, few)
    out = tmp_path / "films"
    main(Settings(out, "plain", count=2, seed=4))
    key = (tmp_path / "films.key.json").read_bytes()
    assert f"SHA-256 of the key: {hashlib.sha256(key).hexdigest()}" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["0000.h5", "0001.h5"]
    assert {one["kind"] for one in json.loads(key)["recordings"]} <= set(MIX)
    film = va.load_recording(out / "0000.h5", va.CartPole(), frames=True)
    assert film.episodes[0].state is None
    assert film.episodes[0].frame.shape[1:] == (100, 120)
    assert va.read_recording(calibration_path(out))[0].state.shape[1] == 2
