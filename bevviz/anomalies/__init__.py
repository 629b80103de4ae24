"""Detection of anomalies in a drive. Imports `stages` and below."""

from bevviz.anomalies.detector import KINDS, AnomalyDetector
from bevviz.anomalies.objects import label
from bevviz.anomalies.summary import AnomalySummary, FailureSummary, Onsets

__all__ = ["KINDS", "AnomalyDetector", "AnomalySummary", "FailureSummary", "Onsets", "label"]
