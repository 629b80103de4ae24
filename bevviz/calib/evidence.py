"""Uncertainty of a calibration: how wide the peak of the score is, and whether another peak is as good.

The edges of one border have the same error, and so have the edges of one object in many frames: thirty images
of one place are worth one image. So nothing here counts edges. The data is divided into frames and into parts
of the image, and both are weighted at random, independently (Owen and Eckles 2012, "Bootstrapping data arrays
of arbitrary order"). The weight of a frame varies more if other frames are like it: the weights of eight
copies of a frame add up to the weight of one unique frame. If all frames are the same, the result is the
scatter between the parts of one image.
"""

from __future__ import annotations

import numpy as np

from bevviz.calib.score import Scorer
from bevviz.calib.search import Peak, climb
from bevviz.model.frame import F64, Bool

REPLICATES = 24
SETTLED = 0.05  # pixels, last step of the climb of a replicate
VIEW = 6.0  # hidden variance of a view, as a multiple of the variance of its parts (docs/calib.md)
LEAD = 2.0  # standard errors by which the best peak must be higher than another


def scatter(scorer: Scorer, peak: Peak, free: Bool) -> F64:
    """Return the (7,) standard deviation of a peak, from climbs with random weights of the data."""
    rng = np.random.default_rng(0)
    frames, parts = peak.sums.score.shape
    shape = independent_views(peak) / frames
    replicates = []
    for _ in range(REPLICATES):
        weight = np.outer(rng.gamma(shape, 1 / shape, frames), rng.exponential(size=parts))
        replicates.append(climb(scorer, peak.offsets, free, peak, weight / weight.mean(), SETTLED).offsets)
    return np.asarray(np.sqrt(((np.stack(replicates) - peak.offsets) ** 2).mean(0)), np.float64)


def caution_factor(peak: Peak) -> float:
    """Return the factor that widens a standard deviation. Few views have errors that they do not show."""
    return float(np.sqrt(1 + VIEW / independent_views(peak)))


def independent_views(peak: Peak) -> float:
    """Return how many frames have independent errors: 1 for the same frame thirty times.

    This is the participation ratio of the gradients of the frames' parts at the peak, correlated frame with
    frame.
    """
    values, vectors = np.linalg.eigh(peak.metric)
    pull = peak.sums.gradient @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    pull = pull.reshape(len(pull), -1)
    pull = pull[np.linalg.norm(pull, axis=1) > 0]
    if not len(pull):
        return 1.0
    correlation = np.corrcoef(pull) if len(pull) > 1 else np.ones((1, 1))
    return float(len(pull) ** 2 / (correlation**2).sum())


def lead(best: Peak, rival: Peak) -> tuple[float, float]:
    """Return by how much the best peak is higher than another, and by how much it must be.

    The comparison goes part by part and frame by frame, as that of Vuong 1989, "Likelihood Ratio Tests for
    Model Selection and Non-Nested Hypotheses", goes sample by sample.
    """
    ahead = best.sums.score - rival.sums.score
    by_frame, by_part = ahead.sum(1), ahead.sum(0)
    n = len(by_frame)
    between = float(((by_frame - by_frame.mean()) ** 2).sum()) * n / (n - 1) if n > 1 else 0.0
    return float(ahead.sum()), LEAD * float(np.sqrt(max(between, float((by_part**2).sum()))))
