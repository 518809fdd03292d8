"""Scores, and the tables that hold them."""

from visadapt.evaluation.cartpole_score import CartPoleScore
from visadapt.evaluation.flight_score import FlightScore
from visadapt.evaluation.scoring import SCORE_SEED, kept_score, score

__all__ = ["SCORE_SEED", "CartPoleScore", "FlightScore", "kept_score", "score"]
