"""How right the results are, where it is known what is really there."""

from bevviz.evaluate.score import Matches, Score, judge, match, pair_in_order
from bevviz.evaluate.truth import MAX_DISTANCE, MIN_HITS, RANGE, Truth, truth_in, truth_of, truth_source

__all__ = [
    "MAX_DISTANCE",
    "MIN_HITS",
    "RANGE",
    "Matches",
    "Score",
    "Truth",
    "judge",
    "match",
    "pair_in_order",
    "truth_in",
    "truth_of",
    "truth_source",
]
