"""Measure and regularize the conditioning of reinforcement-learning policies."""

from condwrap.attach import attach
from condwrap.functional import clamping_penalty, conditioning_quotient
from condwrap.perturbation import gaussian, sphere, uniform
from condwrap.regularizer import Conditioning, ConditioningRegularizer
from condwrap.summary import summary

__version__ = "0.1.0"

__all__ = [
    "Conditioning",
    "ConditioningRegularizer",
    "attach",
    "clamping_penalty",
    "conditioning_quotient",
    "gaussian",
    "sphere",
    "summary",
    "uniform",
]
