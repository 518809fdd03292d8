"""Scores of policies."""

from visadapt.evaluation.scoring import SCORE_SEED, CartPoleScore, FlightScore, RegulationScore, score

__all__ = ["SCORE_SEED", "CartPoleScore", "FlightScore", "RegulationScore", "score"]
