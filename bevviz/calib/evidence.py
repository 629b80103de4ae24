"""How far the data is to be believed: how wide the peak is, and whether another is as good.

The edges of one border err together, and so do those of a thing that stands in many frames: thirty pictures
of one place are one. So nothing here counts edges. The data is divided twice, into frames and into parts of
the image, and both are weighted at random, independently (Owen and Eckles 2012, "Bootstrapping data arrays of
arbitrary order"). A frame's weight varies the more, the more frames are like it: those of a frame that comes
eight times add up to what that of a frame of its own would be. Where all frames are the same, what is left is
how the parts of one image scatter.
"""

from __future__ import annotations

import numpy as np

from bevviz.calib.score import Scorer
from bevviz.calib.search import Peak, climb
from bevviz.model.frame import F64, Bool

REPLICATES = 24
SETTLED = 0.05  # pixels, of the climb of a replicate
VIEW = 6.0  # variance of a single view beyond what its parts let on, as multiple of that (docs/calib.md)
LEAD = 2.0  # standard errors by which the best peak must be higher than another


def scatter(scorer: Scorer, peak: Peak, free: Bool) -> F64:
    """(7,) standard deviation of the offsets of a peak, from climbs with the data weighted at random."""
    rng = np.random.default_rng(0)
    frames, parts = peak.sums.score.shape
    own = views(peak) / frames
    found = []
    for _ in range(REPLICATES):
        weight = np.outer(rng.gamma(own, 1 / own, frames), rng.exponential(size=parts))
        found.append(climb(scorer, peak.offsets, free, peak, weight / weight.mean(), SETTLED).offsets)
    return np.asarray(np.sqrt(((np.stack(found) - peak.offsets) ** 2).mean(0)), np.float64)


def caution(peak: Peak) -> float:
    """By how much a standard deviation is to be widened: a few views err in ways that they do not show."""
    return float(np.sqrt(1 + VIEW / views(peak)))


def views(peak: Peak) -> float:
    """How many frames there are that do not err alike: 1 for the same frame thirty times.

    The participation ratio of how the frames' parts pull at the peak, correlated frame with frame.
    """
    values, vectors = np.linalg.eigh(peak.metric)
    pull = peak.sums.gradient @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    pull = pull.reshape(len(pull), -1)
    pull = pull[np.linalg.norm(pull, axis=1) > 0]
    if not len(pull):
        return 1.0
    alike = np.corrcoef(pull) if len(pull) > 1 else np.ones((1, 1))
    return float(len(pull) ** 2 / (alike**2).sum())


def lead(best: Peak, rival: Peak) -> tuple[float, float]:
    """By how much the best peak is higher than another, and by how much it must be to be believed.

    Part by part and frame by frame, as Vuong 1989, "Likelihood Ratio Tests for Model Selection and Non-Nested
    Hypotheses", does sample by sample.
    """
    ahead = best.sums.score - rival.sums.score
    by_frame, by_part = ahead.sum(1), ahead.sum(0)
    n = len(by_frame)
    between = float(((by_frame - by_frame.mean()) ** 2).sum()) * n / (n - 1) if n > 1 else 0.0
    return float(ahead.sum()), LEAD * float(np.sqrt(max(between, float((by_part**2).sum()))))
