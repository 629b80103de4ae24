"""Findings about the input of a run: what is suspicious about a topic, file, sensor or frame."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Remedy:
    """Change that would end a finding.

    Attributes:
        text: what to do, with the setting or option in it.
        settings: ``key=value`` settings that do it, if settings can.
        tried: what the change gave on the data that was read. Empty: it was not tried.
    """

    text: str
    settings: tuple[str, ...] = ()
    tried: str = ""

    def __str__(self) -> str:
        return f"{self.text} ({self.tried})" if self.tried else self.text


@dataclass(frozen=True, slots=True)
class InputFinding:
    """One suspicious property of the input.

    Attributes:
        kind: word for the kind, such as ``calibration`` or ``clock``.
        subject: topic, file, sensor or frame that it is about.
        text: one sentence that names the subject.
        remedy: change that would end it, if one is known.
    """

    kind: str
    subject: str
    text: str
    remedy: Remedy | None = None

    def __str__(self) -> str:
        """Return the sentence and the remedy."""
        return self.text if self.remedy is None else f"{self.text}: {self.remedy}"
