"""Statistics of agents: scores, intervals and tests. Arrays go in, arrays and numbers come out.

Everything that a verdict rests on takes leading axes, so that a simulation can hand it thousands of
data sets at once: see tests/harness/statistics/test_simulation.py.
"""

from harness.statistics.aggregates import interquartile_mean, probability_of_improvement
from harness.statistics.correlation import permuted_correlations, rank_correlation, spearman
from harness.statistics.families import ALPHA, holm, shares_left
from harness.statistics.intervals import (
    Estimate,
    estimate_mean,
    half_width,
    interval_of_means,
    is_skewed,
)
from harness.statistics.scores import (
    early_psi,
    final_score,
    moved_together,
    training_psi,
    training_score,
    window_of,
)
from harness.statistics.signflips import (
    detectable_difference,
    sign_flip_interval,
    sign_flip_test,
    smallest_n,
)
from harness.statistics.success import (
    MIN_TRAINING_RUNS,
    compare_success,
    estimate_success,
    success_matrix,
)

__all__ = [
    "ALPHA",
    "MIN_TRAINING_RUNS",
    "Estimate",
    "compare_success",
    "detectable_difference",
    "early_psi",
    "estimate_mean",
    "estimate_success",
    "final_score",
    "half_width",
    "holm",
    "interquartile_mean",
    "interval_of_means",
    "is_skewed",
    "moved_together",
    "permuted_correlations",
    "probability_of_improvement",
    "rank_correlation",
    "shares_left",
    "sign_flip_interval",
    "sign_flip_test",
    "smallest_n",
    "spearman",
    "success_matrix",
    "training_psi",
    "training_score",
    "window_of",
]
