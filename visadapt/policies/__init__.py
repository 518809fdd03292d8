"""Policies and networks: from the last observations and actions to the next HORIZON actions."""

from visadapt.policies.base import AutoregressivePolicy, Policy
from visadapt.policies.cartpole import ImagePolicy, StatePolicy
from visadapt.policies.flight import FlightPolicy, FollowPolicy, ReachPolicy
from visadapt.policies.regulator import RegulatorPolicy, RegulatorResidualNetwork

__all__ = [
    "AutoregressivePolicy",
    "FlightPolicy",
    "FollowPolicy",
    "ImagePolicy",
    "Policy",
    "ReachPolicy",
    "RegulatorPolicy",
    "RegulatorResidualNetwork",
    "StatePolicy",
]
