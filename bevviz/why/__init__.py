"""Explanations of why an object was reported or missed. Imports `compare` and below."""

from bevviz.why.answer import Answer, FrameExplainer, why
from bevviz.why.chain import Step
from bevviz.why.hints import Hint
from bevviz.why.subject import Selection, Subject

__all__ = ["Answer", "FrameExplainer", "Hint", "Selection", "Step", "Subject", "why"]
