"""Evaluation against ground truth. Imports `pipeline` and below."""

from bevviz.evaluate.ground_truth import (
    MAX_DISTANCE,
    MIN_HITS,
    RANGE,
    Truth,
    own_truth,
    truth_in,
    truth_of,
    truth_source,
)
from bevviz.evaluate.matching import (
    Matches,
    ObjectScore,
    exemptions,
    judge,
    match,
    pair_in_order,
    position_text,
    rates,
)

__all__ = [
    "MAX_DISTANCE",
    "MIN_HITS",
    "RANGE",
    "Matches",
    "ObjectScore",
    "Truth",
    "exemptions",
    "judge",
    "match",
    "own_truth",
    "pair_in_order",
    "position_text",
    "rates",
    "truth_in",
    "truth_of",
    "truth_source",
]
