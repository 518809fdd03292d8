"""Standard deviations of a fit: as Fisher's information has them where the model is right, larger where it is not."""

import torch

from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Gust, PositionOffset, ViscousFriction
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.covariance import deviations
from visadapt.estimation.fit_states import posterior
from visadapt.systems import CartPole

FRICTION = ViscousFriction(coefficient=0.8)


def ratio(effects) -> float:
    """Deviation of the friction over that by Fisher's information, fitted alone."""
    rows = prepare(record(effects), CartPole()).rows
    fits = Search(CartPole(), rows, [ViscousFriction]).single(ViscousFriction).fits
    fisher = torch.linalg.inv(posterior((ViscousFriction,), fits)[1]).diagonal().sqrt()
    return float(deviations(CandidateModel(CartPole(), (ViscousFriction,), rows), fits) / fisher)


def test_where_the_model_is_right():
    assert 1 <= ratio([FRICTION]) < 1.3


def test_the_range_of_a_parameter_is_no_knowledge_of_it():
    """The most likely offset of the position, which data hardly show, is not drawn in by a prior."""
    rows = prepare(record([FRICTION]), CartPole()).rows
    fits = Search(CartPole(), rows, [PositionOffset]).single(PositionOffset).fits
    deviation = float(deviations(CandidateModel(CartPole(), (PositionOffset,), rows), fits))
    assert deviation > 0.999 * float(fits.information[0, 0, 0]) ** -0.5


def test_where_a_gust_is_not_modelled():
    assert ratio([FRICTION, Gust(start=1.0, end=2.0, force=1.5)]) > 1.3
