"""Explanations of why an object was reported or missed. Imports `evaluate` and below."""

from bevviz.why.answer import Answer, Hint
from bevviz.why.explainer import FrameExplainer, RunExplainer
from bevviz.why.selection import Selection
from bevviz.why.steps import Step
from bevviz.why.subject import Subject

__all__ = ["Answer", "FrameExplainer", "Hint", "RunExplainer", "Selection", "Step", "Subject"]
