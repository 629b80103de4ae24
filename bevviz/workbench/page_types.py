"""Messages between the server and the page, of which ``python -m tools.make_page_types`` makes types.

A stamp is text: JavaScript numbers cannot hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NotRequired, TypeAlias

from pydantic import Field, TypeAdapter
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.config.parameters import Kind
from bevviz.findings.finding_list import Entry
from bevviz.pipeline.notes import HandledFinding, Note
from bevviz.support.json_form import json_form
from bevviz.why.answer_results import AnswerResult, HintResult
from bevviz.why.robot_questions import RobotSteps
from bevviz.workbench.fix_search import FixJob
from bevviz.workbench.growing_drive import RunProgress, Span
from bevviz.workbench.reports import ReportJob
from bevviz.workbench.trials import Trial, TriedEffects

# --- parts of messages -------------------------------------------------------------------------


FrameTime = TypedDict("FrameTime", {"stamp": str, "frame": int})
Row = TypedDict("Row", {"frame": int, "pick": str})  # an object in a frame
Origin = TypedDict("Origin", {"time": float, "set": tuple[str, ...]})  # where a pick is valid
Chip = Literal["", "hint", "cannot tell", "tried in vain"]
RowRemark = TypedDict("RowRemark", {"remark": str, "chip": Chip, "text": str})  # text: the reason
OtherObject = TypedDict("OtherObject", {"pick": str, "name": str, "reported": bool, "reason": str})


class Control(TypedDict):
    """Control of a parameter."""

    key: str
    value: Any
    unit: str
    about: str
    kind: Kind
    low: float | None
    high: float | None
    choices: list[str]


class LabelBox(TypedDict):
    """Label of an object: its class, and its box in the frame of the points, in metres and degrees."""

    label: str
    center: list[float]
    size: list[float]
    yaw: float


# --- messages to the page ----------------------------------------------------------------------


class Welcome(TypedDict):
    """The first message: what is opened."""

    type: Literal["welcome"]
    run: str
    overlay: str
    bag: str
    truth: bool
    single: bool
    detector: bool
    opened: str
    classes: dict[str, str]
    controls: list[Control]
    meanings: dict[str, str]


Failed = TypedDict("Failed", {"type": Literal["failed"], "text": str})  # The drive cannot be opened.
Error = TypedDict("Error", {"type": Literal["error"], "id": int | None, "text": str})
Opening = TypedDict("Opening", {"type": Literal["opening"], "stamp": str, "first": str, "demand": bool})
Frames = TypedDict("Frames", {"type": Literal["frames"], "frames": list[FrameTime]})  # new ones
# Groups with their new frames, and numbers of the groups that are gone.
Entries = TypedDict("Entries", {"type": Literal["entries"], "entries": list[Entry], "gone": list[int]})
Controls = TypedDict("Controls", {"type": Literal["controls"], "controls": list[Control]})
Noted = TypedDict("Noted", {"type": Literal["noted"], "id": int, "text": str})
Held = TypedDict("Held", {"type": Literal["held"], "frame": int, "stamp": str})
Said = TypedDict("Said", {"type": Literal["said"], "text": str})


class Notes(TypedDict):
    """All notes, and all findings that the user has dealt with."""

    type: Literal["notes"]
    notes: list[Note]
    findings: list[HandledFinding]
    error: str


class Progress(RunProgress):
    """Progress of the run and of all jobs."""

    type: Literal["progress"]
    reports: list[ReportJob]
    trials: list[Trial]
    fix: FixJob | None


class Reply(TypedDict):
    """Head of a reply to a question about a frame with other values."""

    id: int
    frame: int
    set: Sequence[str]


@json_form
@dataclass(frozen=True)
class AnswerMessage(AnswerResult):
    """An answer. ``cameras`` show its subject, the one with the largest part of it first.

    ``place``: it is about a place, not an object.
    """

    type: Literal["answer"]
    id: int
    frame: int
    set: Sequence[str]
    pick: str
    place: bool
    found: str
    beside: Sequence[OtherObject]
    labelled: bool
    cameras: Sequence[str]


class Nothing(Reply):
    """Answer to a click on something that cannot be asked about."""

    type: Literal["nothing"]
    entity: str


class Absent(Reply):
    """The object is not in the frame."""

    type: Literal["absent"]
    text: str
    pick: str


class Hints(Reply, RowRemark):
    """Hints of an answer. ``methods`` are settings of other methods of the stages that may have lost it."""

    type: Literal["hints"]
    row_pick: str
    hints: list[HintResult]
    methods: Sequence[str]


class Remark(Row, RowRemark):
    """Remark on a row of the list."""

    type: Literal["remark"]


class Label(Reply):
    """A label is drawn. ``kept`` says where it is kept; empty: it is not. ``pick`` asks about it then."""

    type: Literal["label"]
    box: LabelBox
    points: int
    pick: str
    classes: Sequence[str]
    kept: str


class Robot(Reply, RobotSteps):
    """Account of the robot's nodes: their steps with the object."""

    type: Literal["robot"]


class Tried(Reply, TriedEffects):
    """A frame was tried with other values."""

    type: Literal["tried"]


ToPage: TypeAlias = (
    Welcome | Failed | Error | Opening | Frames | Entries | Notes | Progress | Nothing | Absent | Hints
) | (Robot | Label | Remark | Tried | Controls | Noted | Held | Said)  # fmt: skip

# --- messages from the page --------------------------------------------------------------------


class AboutFrame(TypedDict):
    """A message about the frame at a time, with other values, and about an object."""

    id: int
    time: float
    set: NotRequired[tuple[str, ...]]
    pick: NotRequired[str]


class Ask(AboutFrame):
    """A question about a pick, or about a click in the viewer."""

    type: Literal["ask"]
    origin: NotRequired[Origin | None]
    entity: NotRequired[str]
    instance: NotRequired[int | None]
    position: NotRequired[list[float | None] | None]
    view: NotRequired[str]


class Try(AboutFrame):
    """Show the frame with the values."""

    type: Literal["try"]


class Settle(AboutFrame):
    """The page has stopped at a frame."""

    type: Literal["settle"]


class MakeReport(AboutFrame):
    """Make a report of the seconds before and after the frame."""

    type: Literal["report"]
    text: str
    before: float
    after: float


class AddNote(AboutFrame):
    """Save a note."""

    type: Literal["note"]
    text: str
    span: NotRequired[Span | None]


class DrawLabel(AboutFrame):
    """Draw a label of an object, and keep it. Without a box: the one that the object has or seems to have."""

    type: Literal["draw"]
    box: NotRequired[LabelBox]
    keep: NotRequired[bool]


class RunDrive(TypedDict):
    """Run the drive, or a span of it, with the values."""

    type: Literal["drive"]
    id: int
    set: tuple[str, ...]
    span: NotRequired[Span | None]


class Cancel(TypedDict):
    """Cancel a job."""

    type: Literal["cancel"]
    id: int
    what: Literal["try", "drive", "fix", "report"]


class Handle(TypedDict):
    """A finding is done or ignored. With an empty state it is open again."""

    type: Literal["handle"]
    id: int
    finding: HandledFinding


Remarks = TypedDict("Remarks", {"type": Literal["remarks"], "id": int, "rows": list[Row]})
Shown = TypedDict("Shown", {"type": Literal["shown"], "id": int})  # The page has drawn its first frame.
FindFix = TypedDict("FindFix", {"type": Literal["fix"], "id": int})
RemoveNote = TypedDict("RemoveNote", {"type": Literal["unnote"], "id": int, "stamp": str, "text": str})
Hold = TypedDict("Hold", {"type": Literal["hold"], "id": int, "time": float})  # of a robot, as those below
ListHeld = TypedDict("ListHeld", {"type": Literal["list"], "id": int})
Snap = TypedDict("Snap", {"type": Literal["snap"], "id": int})
Mark = TypedDict("Mark", {"type": Literal["mark"], "id": int, "time": float, "text": str})
FromPage: TypeAlias = (
    Ask | Try | Settle | MakeReport | AddNote | DrawLabel | RunDrive | Cancel | Handle | Remarks | Shown
) | (FindFix | RemoveNote | Hold | ListHeld | Snap | Mark)  # fmt: skip

AnyToPage: TypeAlias = Annotated[ToPage | AnswerMessage, Field(discriminator="type")]
FROM_PAGE: TypeAdapter[Any] = TypeAdapter(Annotated[FromPage, Field(discriminator="type")])
