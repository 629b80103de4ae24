"""Why an object was reported, or was not: its chain through the stages, with numbers."""

from bevviz.why.answer import Answer, Step, why
from bevviz.why.subject import Selection, Subject
from bevviz.why.whatif import Hint

__all__ = ["Answer", "Hint", "Selection", "Step", "Subject", "why"]
