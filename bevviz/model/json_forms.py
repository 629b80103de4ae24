"""Forms of the JSON that commands write with ``--json``: the types that build it, and its schemas.

A text below a key is its description in the schema. ``docs/schemas`` keeps the schemas
(``python -m tools.make_schemas``). A key that is not in a form fails the tests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NotRequired

from pydantic import ConfigDict, TypeAdapter, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

_closed = with_config(ConfigDict(extra="forbid", use_attribute_docstrings=True))
_open = with_config(ConfigDict(extra="allow", use_attribute_docstrings=True))  # further keys are values

Matrix = Sequence[Sequence[float]]


# --- info --------------------------------------------------------------------------------------


@_closed
class TopicForm(TypedDict):
    """A topic of the bag or of the graph."""

    name: str
    type: str
    """package/msg/Name"""
    count: int | None
    """messages; null: nothing subscribes to it"""
    frame_id: str
    rate: float | None
    """Hz, between the first and the last message"""
    role: str
    """use of the topic; empty: none"""
    pause: float | None
    """longest time between two messages, seconds"""
    pause_at: float | None
    """start of the longest pause, seconds from the start of the bag"""
    size: float | None
    """mean bytes of a message; --live"""
    delay: float | None
    """seconds from the stamp to the receipt; --live"""


@_closed
class CameraForm(TypedDict):
    """A camera of one scan."""

    name: str
    """as options name it"""
    width: int | None
    """pixels"""
    height: int | None
    """pixels"""
    K: Matrix | None
    """3 x 3 intrinsics"""
    distortion_model: str | None
    """empty: none"""
    D: Sequence[float] | None
    """distortion in the order of ROS"""
    camera_from_points: Matrix | None
    """4 x 4 transform"""
    problems: Sequence[str]


@_closed
class InfoForm(TypedDict):
    """Topics, sensors and transforms, and what a full run lacks."""

    paths: NotRequired[Sequence[str]]
    """files of the bag"""
    formats: NotRequired[Sequence[str]]
    """format of each file"""
    size: NotRequired[int]
    """bytes on disk"""
    start: NotRequired[int]
    """first log time, nanoseconds since 1970"""
    end: NotRequired[int]
    """last log time, nanoseconds since 1970"""
    messages: NotRequired[int]
    domain: NotRequired[int]
    """ROS domain; --live"""
    middleware: NotRequired[str]
    """RMW; --live"""
    seconds: NotRequired[float]
    """time of listening; --live"""
    topics: Sequence[TopicForm]
    lidars: Sequence[str]
    """names of the LiDARs"""
    cameras: Sequence[CameraForm]
    transforms: Mapping[str, str]
    """parent of each frame"""
    points_frame: str
    """frame of the points"""
    world_frame: str
    """fixed frame; empty: none"""
    network: str
    """what the detector runs on, or why it does not; empty: no detector"""
    object_network: str
    """the same of a 3D detector"""
    configured: Sequence[str]
    """place: keys where parameters are stated"""
    missing: Sequence[str]
    """what a full run lacks, with the option that gives it"""
    warnings: Sequence[str]
    """faults of the bag"""


# --- why ---------------------------------------------------------------------------------------


@_open
class StepForm(TypedDict):
    """Result of one stage. Further keys are its numbers, by name."""

    stage: str
    text: str


@_closed
class HintForm(TypedDict):
    """Change of parameters that changes the verdict. It was run."""

    settings: Sequence[str]
    """key=value each"""
    text: str
    fixed: Sequence[str]
    """objects that are reported then"""
    added: Sequence[str]
    """further objects"""
    false: Sequence[str]
    """further objects that are false"""
    lost: Sequence[str]
    """lost objects"""
    right: Sequence[str]
    """lost objects that were false"""
    changed: int
    """number of other changes"""


@_closed
class TriedForm(TypedDict):
    """Change of parameters that was run and does not help."""

    settings: Sequence[str]
    """key=value each"""
    text: str
    """its result"""


@_closed
class AnswerForm(TypedDict):
    """Answer about one object or place."""

    kind: str
    """truth, detection, cluster, object, track, point, cell ..."""
    name: str
    label: str
    """class; empty: unknown"""
    row: int
    """row in the results; -1: none"""
    camera: str
    """name of the camera; empty: none"""
    image_box: Sequence[float] | None
    """x0, y0, x1, y1 in pixels"""
    position: Sequence[float] | None
    """centre in the frame of the points, metres"""
    distance: float | None
    """metres from the LiDAR, on the ground"""
    points: int
    """points in its box"""
    reported: bool
    reason: str
    """one of the reasons in docs/why.md"""
    verdict: str
    confidence: float | None
    """0 to 1, that the reason is right; null: ground truth tells it, or it is unknown"""
    likely: Sequence[str]
    """the two likely reasons where it cannot tell the reason"""
    folded: bool
    """no parameter can help"""
    false: bool
    """an object that no ground truth explains, or a doubtful one"""
    empty: bool
    """a place with nothing but ground or sky"""
    chain: Sequence[StepForm]
    """stages in order"""
    hints: Sequence[HintForm]
    """changes that help"""
    remark: str
    """the best hint in a sentence, or what was tried, or why nothing was"""
    tried: Sequence[TriedForm]


@_closed
class BesideForm(TypedDict):
    """Another object at the place."""

    name: str
    verdict: str


@_closed
class RobotStepForm(TypedDict):
    """What one of the robot's steps did with an object."""

    topic: str
    """topic that the step makes"""
    parent: str
    """topic that had the object before; empty: none is known"""
    state: str
    """kept, dropped, not made, message lost, moved, renamed or delayed"""
    text: str


@_closed
class RobotObjectForm(TypedDict):
    """An object of the robot."""

    text: str
    label: str
    center: Sequence[float]
    """metres, in the frame of the points"""
    step: str | None
    """topic of the first step that lost or changed it; null: none did"""
    state: str
    steps: Sequence[RobotStepForm]


@_closed
class RobotForm(TypedDict):
    """The robot's own chain."""

    chain: Sequence[str]
    """one sentence for each topic"""
    objects: Sequence[RobotObjectForm]


@_closed
class WhyForm(TypedDict):
    """Answers about one frame."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    preset: str
    summary: str
    """first line of the text"""
    answers: Sequence[AnswerForm]
    """worst first"""
    beside: Sequence[BesideForm]
    robot: NotRequired[RobotForm]
    """--robot"""


# --- calib -------------------------------------------------------------------------------------


@_closed
class CalibScoreForm(TypedDict):
    """Agreement of the edges of clouds and images."""

    stated: float | None
    corrected: float | None


@_closed
class AxisForm(TypedDict):
    """Error along one axis."""

    what: str
    unit: str
    """of offset and interval"""
    offset: float | None
    """the error"""
    interval: float | None
    """two standard deviations to either side of the offset"""
    finding: str
    """one of the findings in docs/calib.md"""
    reason: str


@_closed
class ExtrinsicsForm(TypedDict):
    """4 x 4 pose of the child in the parent."""

    stated: Matrix
    corrected: Matrix


@_closed
class CalibCameraForm(TypedDict):
    """Calibration of one camera."""

    camera: str
    answer: str
    frames: int
    """frames that were used"""
    edges: int
    """edges that were used"""
    score: CalibScoreForm
    axes: Mapping[str, AxisForm]
    """by name: rx, ry, rz, tx, ty, tz, dt"""
    parent: str
    """frame"""
    child: str
    """frame"""
    extrinsics: ExtrinsicsForm
    notes: Sequence[str]


@_closed
class CalibForm(TypedDict):
    """Errors of the mounting and the stamps of each camera."""

    cameras: Sequence[CalibCameraForm]


# --- sweep -------------------------------------------------------------------------------------


@_closed
class ClassCountsForm(TypedDict):
    """Counts of one class, over all frames."""

    tp: int
    """true objects"""
    fp: int
    """false objects"""
    fn: int
    """missed objects"""


@_closed
class SweepRunForm(TypedDict):
    """One combination of values."""

    values: Sequence[str]
    """in the order of the parameters"""
    frames: int
    metrics: Mapping[str, float | None]
    """mean of a frame; times: median in milliseconds; precision, recall and F1: of all frames"""
    classes: Mapping[str, ClassCountsForm]
    """with ground truth"""
    failures: int
    """failed stages"""


@_closed
class SweepForm(TypedDict):
    """Metrics of each combination of values."""

    parameters: Sequence[str]
    """their keys"""
    runs: Sequence[SweepRunForm]
    best: Sequence[str] | None
    """values with the greatest F1; null: none within the noise"""


# --- compare -----------------------------------------------------------------------------------


@_closed
class ImageDifferenceForm(TypedDict):
    """A detection that differs."""

    change: str
    class_a: str
    class_b: str
    camera: str
    text: str
    place: str


@_closed
class ObjectDifferenceForm(TypedDict):
    """An object that differs."""

    change: str
    class_a: str
    class_b: str
    x: float | None
    """metres in the frame of the points"""
    y: float | None
    z: float | None
    distance: float | None
    """metres between both sides"""
    iou: float | None
    text: str
    place: str


@_closed
class ComparedFrameForm(TypedDict):
    """Differences of one frame."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    number: int
    """differences"""
    fixed: Sequence[str]
    """labelled objects that only B finds"""
    broke: Sequence[str]
    """labelled objects that only A finds"""
    objects: Sequence[ObjectDifferenceForm]
    detections: Sequence[ImageDifferenceForm]


@_closed
class SidesForm(TypedDict):
    """A number for each side."""

    A: int
    B: int


@_closed
class JudgedForm(TypedDict):
    """Both sides against the ground truth."""

    classes: Mapping[str, Mapping[str, int]]
    """labelled objects: there, found by A and B, fixed and broken by B"""
    wrong: SidesForm
    """objects that are none"""


@_closed
class CompareForm(TypedDict):
    """Differences of two runs."""

    a: str
    b: str
    config: Mapping[str, str]
    """parameters that differ: before -> after"""
    objects: Mapping[str, Mapping[str, int]]
    """counts by class and change"""
    detections: Mapping[str, Mapping[str, int]]
    """counts by class and change"""
    clusters: SidesForm
    """number in all frames"""
    truth: JudgedForm | None
    """null: no ground truth"""
    frames: Sequence[ComparedFrameForm]


# --- evaluate ----------------------------------------------------------------------------------


@_closed
class WrongFrameForm(TypedDict):
    """Objects of a frame in words."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    true: Sequence[str]
    missed: Sequence[str]
    false: Sequence[str]


@_closed
class LimitForm(TypedDict):
    """A limit of the gate."""

    limit: str
    kept: bool
    reason: str
    """empty: it is kept"""


@_closed
class EvaluationForm(TypedDict):
    """Metrics against ground truth."""

    frames: int
    """judged frames"""
    frames_without_truth: int
    unusable_labels: int
    """labels that are left out"""
    unusable_examples: Sequence[str]
    """the first ten, with the reason"""
    metrics: Mapping[str, float | None]
    """metrics of docs/evaluate.md by name; null: not measured"""
    false_causes: Mapping[str, int]
    """false objects by cause"""
    worst: Sequence[WrongFrameForm]
    """frames with missed or false objects, the worst first"""


@_closed
class EvaluateForm(EvaluationForm):
    """Metrics against ground truth, and the gate."""

    limits: Sequence[LimitForm]


# --- causes ------------------------------------------------------------------------------------


@_closed
class ConditionForm(TypedDict):
    """Condition on one attribute: a value, or an interval."""

    attribute: str
    value: str | None
    low: float | None
    """null: open"""
    high: float | None
    """null: open"""


@_closed
class FindingForm(TypedDict):
    """One missed or false object, unexplained detection or anomaly."""

    kind: str
    recording: str
    frame: int
    reason: str
    label: str
    """class"""
    range_m: float | None
    text: str
    command: str
    """opens the frame in the workbench"""


@_closed
class CauseForm(TypedDict):
    """Findings with a condition in common."""

    kind: str
    """missed, false, unexplained or anomaly"""
    reason: str
    """empty: several reasons"""
    text: str
    """conditions in words"""
    conditions: Sequence[ConditionForm]
    count: int
    drives: int
    among: int
    """findings and what they are compared with, under the conditions"""
    lift: float
    """ratio to the usual rate"""
    reasons: Mapping[str, int]
    examples: Sequence[FindingForm]


@_closed
class ComparedCauseForm(TypedDict):
    """Cause of one batch, and its counts in the other."""

    state: str
    """new, gone or as before"""
    kind: str
    reason: str
    text: str
    count: int
    among: int
    other: int
    other_among: int


@_closed
class CausesForm(TypedDict):
    """Causes of a batch."""

    batch: str
    findings: Mapping[str, int]
    """number by kind"""
    causes: Sequence[CauseForm]
    """largest first"""
    rest: Mapping[str, Mapping[str, int]]
    """number of the other findings by kind and reason"""
    compared: NotRequired[Sequence[ComparedCauseForm]]
    """with --against"""


# --- fix ---------------------------------------------------------------------------------------


@_closed
class FixForm(TypedDict):
    """Changed parameters, and their effect on frames that were not used to choose them."""

    settings: Mapping[str, Any]
    """changed parameters; empty: none is better"""
    confirmed: bool
    """the whole interval is an improvement"""
    searched: Sequence[str]
    """parameters"""
    trials: int
    f1_before: float
    f1_after: float
    f1_change: Sequence[float]
    """95 % interval"""
    fixed: int
    """objects that were missed and are found"""
    missed: int
    """before"""
    broken: int
    """objects that were found and are missed"""
    found: int
    """before"""
    cause_fixed: int
    """in frames of the cause"""
    cause_missed: int
    false_before: int
    false_after: int
    frames: int
    """that confirm"""
    units: int
    """drives, or parts of drives, that the interval draws"""
    parts: bool
    """whether the units are parts of drives"""


FORMS: Mapping[str, type] = {
    "calib": CalibForm,
    "causes": CausesForm,
    "compare": CompareForm,
    "evaluate": EvaluateForm,
    "fix": FixForm,
    "info": InfoForm,
    "sweep": SweepForm,
    "why": WhyForm,
}
VERSION = 1  # of every form


def form_name(command: str) -> str:
    """Return the value of the key ``form`` in the JSON of a command."""
    return f"bevviz.{command}/{VERSION}"


def schema(command: str) -> dict[str, Any]:
    """Return the JSON schema of the output of a command."""
    tree = TypeAdapter(FORMS[command]).json_schema(mode="serialization")
    form = {"const": form_name(command), "type": "string"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **tree,
        "properties": {"form": form, **tree["properties"]},
        "required": ["form", *tree["required"]],
    }
