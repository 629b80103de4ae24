"""Explanations of why an object was reported or missed. Imports `compare` and below."""

from bevviz.why.answer import Answer, Questioner, why
from bevviz.why.chain import Step
from bevviz.why.hints import Hint
from bevviz.why.subject import Selection, Subject

__all__ = ["Answer", "Hint", "Questioner", "Selection", "Step", "Subject", "why"]
