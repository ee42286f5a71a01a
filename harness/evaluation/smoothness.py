"""How smooth an episode's actions are: two measures of a sequence of actions, `[T, action_dim]`."""

from __future__ import annotations

import math

import numpy as np
import scipy.fft


def action_change(actions: np.ndarray) -> float:
    """Mean of |a_{t+1} - a_t| over time and over the action's dimensions.

    Args:
        actions: What was executed, `[T, action_dim]`.

    Returns:
        The mean, at least 0; NaN for a single action.
    """
    if len(actions) < 2:
        return math.nan
    return float(np.abs(np.diff(actions, axis=0)).mean())


def smoothness(actions: np.ndarray, rate: float) -> float:
    """Sm of Mysore et al. (2021, arXiv 2012.06644), averaged over the action's dimensions.

    Sm = 2 / (n f_s) · sum_i M_i f_i, where f_s is the sampling rate and f_i runs over the n
    frequencies 0, f_s / T, ..., up to f_s / 2, so n = T // 2 + 1. M_i is the single-sided amplitude
    at f_i: a sine of amplitude A whose frequency f is one of them has M = A there and 0 elsewhere,
    and so Sm = 2 A f / (n f_s). A constant action has 0; larger is less smooth.

    Each f_i is a multiple of f_s / T, so the unit of time cancels: Sm is the mean of M_i f_i with
    f_i in units of half the sampling rate. A sine has half the Sm in an episode of twice the
    length, so compare episodes of like length.

    Args:
        actions: What was executed, `[T, action_dim]`.
        rate: f_s, actions a second.

    Returns:
        Sm, at least 0; NaN for a single action.
    """
    steps = len(actions)
    if steps < 2:
        return math.nan

    # single-sided: a negative frequency adds to its positive one, 0 and f_s / 2 have no other
    amplitudes = np.abs(scipy.fft.rfft(actions, axis=0)) / steps
    amplitudes[1 : (steps + 1) // 2] *= 2

    frequencies = scipy.fft.rfftfreq(steps, 1 / rate)
    weighted = (amplitudes * frequencies[:, None]).sum(axis=0)
    return float((2 / (len(frequencies) * rate) * weighted).mean())
