"""Why an object was reported, or was not: its chain through the stages, with numbers."""

from bevviz.why.answer import Answer, Questioner, why
from bevviz.why.chain import Step
from bevviz.why.subject import Selection, Subject
from bevviz.why.whatif import Hint

__all__ = ["Answer", "Hint", "Questioner", "Selection", "Step", "Subject", "why"]
