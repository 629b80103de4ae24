// Types of the page's messages and elements, by 'python -m tools.make_page_types'.

/** The object is not in the frame. */
export interface Absent {
  id: number;
  frame: number;
  set: string[];
  type: "absent";
  text: string;
  pick: string;
}

/** Save a note. */
export interface AddNote {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "note";
  text: string;
  span?: Span | null;
}

/** An answer. ``cameras`` show its subject, the one with the largest part of it first. */
export interface AnswerMessage {
  kind: string;
  name: string;
  label: string;
  row: number;
  camera: string;
  image_box: number[] | null;
  position: number[] | null;
  distance: number | null;
  points: number;
  reported: boolean;
  reason: string;
  verdict: string;
  restored_by: string[][];
  likely: string[];
  folded: boolean;
  false: boolean;
  empty: boolean;
  chain: StepResult[];
  hints: HintResult[];
  remark: string;
  tried: TriedChange[];
  type: "answer";
  id: number;
  frame: number;
  set: string[];
  pick: string;
  found: string;
  beside: OtherObject[];
  labelled: boolean;
  cameras: string[];
}

/** A question about a pick, or about a click in the viewer. */
export interface Ask {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "ask";
  origin?: Origin | null;
  entity?: string;
  instance?: number | null;
  position?: (number | null)[] | null;
  view?: string;
}

export interface BeforeAfter {
  before: number | null;
  after: number | null;
}

/** Cancel a job. */
export interface Cancel {
  type: "cancel";
  id: number;
  what: "try" | "drive" | "fix" | "report";
}

/** Control of a parameter. */
export interface Control {
  key: string;
  value: any;
  unit: string;
  about: string;
  kind: "choice" | "list" | "switch" | "whole" | "number" | "text";
  low?: number;
  high?: number;
  choices?: string[];
}

export interface Controls {
  type: "controls";
  controls: Control[];
}

/** Draw a label of an object, and keep it. Without a box: the one that the object has or seems to have. */
export interface DrawLabel {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "draw";
  box?: LabelBox;
  keep?: boolean;
}

export interface Entries {
  type: "entries";
  entries: Entry[];
  gone: number[];
}

/** A group of findings as the page gets it, with the frames that the page does not have yet. Lists are in the order of ``rank``. ``reasons`` say why it comes early. */
export interface Entry {
  number: number;
  what: string;
  name: string;
  reasons: string[];
  rank: number[];
  sights: Sight[];
}

export interface Error {
  type: "error";
  id: number | null;
  text: string;
}

export interface Failed {
  type: "failed";
  text: string;
}

export interface FindFix {
  type: "fix";
  id: number;
}

/** A search of a fix, and its result in words. */
export interface FixEntry {
  number: number;
  settings: string[];
  asked_by: string;
  cancelled_by: string;
  state: string;
  error: string;
  done: number;
  total: number;
  text: string;
}

export interface FrameTime {
  stamp: string;
  frame: number;
}

export interface Frames {
  type: "frames";
  frames: FrameTime[];
}

/** A finding is done or ignored. With an empty state it is open again. */
export interface Handle {
  stamp: string;
  what: string;
  name: string;
  pick: string;
  distance: number | null;
  state: string;
  text: string;
  type: "handle";
  id: number;
}

/** A finding that the user has dealt with. */
export interface HandledEntry {
  stamp: string;
  what: string;
  name: string;
  pick: string;
  distance: number | null;
  state: string;
  text: string;
}

export interface Held {
  type: "held";
  frame: number;
  stamp: string;
}

/** Change of parameters that changes the verdict. It was run. */
export interface HintResult {
  settings: string[];
  text: string;
  fixed: string[];
  added: string[];
  false: string[];
  lost: string[];
  right: string[];
  false_gone: string[];
  changed: number;
  beside: number | null;
}

/** Hints of an answer. ``methods`` are settings of other methods of the stages that may have lost it. */
export interface Hints {
  id: number;
  frame: number;
  set: string[];
  remark: string;
  chip: "" | "hint" | "cannot tell" | "tried in vain";
  text: string;
  type: "hints";
  row_pick: string;
  hints: HintResult[];
  methods: string[];
}

export interface Hold {
  type: "hold";
  id: number;
  time: number;
}

/** A label is drawn. ``kept`` says where it is kept; empty: it is not. ``pick`` asks about it then. */
export interface Label {
  id: number;
  frame: number;
  set: string[];
  type: "label";
  box: LabelBox;
  points: number;
  pick: string;
  classes: string[];
  kept: string;
}

/** Label of an object: its class, and its box in the frame of the points, in metres and degrees. */
export interface LabelBox {
  label: string;
  center: number[];
  size: number[];
  yaw: number;
}

export interface ListHeld {
  type: "list";
  id: number;
}

/** Make a report of the seconds before and after the frame. */
export interface MakeReport {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "report";
  text: string;
  before: number;
  after: number;
}

export interface Mark {
  type: "mark";
  id: number;
  time: number;
  text: string;
}

/** A note of the user. */
export interface NoteEntry {
  stamp: string;
  received: string;
  text: string;
  about: string;
  pick: string;
  end: string;
  label: string;
  box: number[];
  points_frame: string;
}

export interface Noted {
  type: "noted";
  id: number;
  text: string;
}

/** All notes, and all findings that the user has dealt with. */
export interface Notes {
  type: "notes";
  notes: NoteEntry[];
  findings: HandledEntry[];
  error: string;
}

/** Answer to a click on something that cannot be asked about. */
export interface Nothing {
  id: number;
  frame: number;
  set: string[];
  type: "nothing";
  entity: string;
}

export interface Opening {
  type: "opening";
  stamp: string;
  first: string;
  demand: boolean;
}

export interface Origin {
  time: number;
  set: string[];
}

export interface OtherObject {
  pick: string;
  name: string;
  reported: boolean;
  reason: string;
}

export interface Problem {
  text: string;
  seconds: number;
}

/** Progress of the run and of all jobs. */
export interface Progress {
  done: number;
  total: number | null;
  over: boolean;
  error: string;
  warnings: string[];
  phase?: "overview" | "again" | "run";
  problems?: Problem[];
  held?: string[];
  type: "progress";
  reports: ReportEntry[];
  trials: TrialEntry[];
  fix: FixEntry | null;
}

/** Remark on a row of the list. */
export interface Remark {
  frame: number;
  pick: string;
  remark: string;
  chip: "" | "hint" | "cannot tell" | "tried in vain";
  text: string;
  type: "remark";
}

export interface Remarks {
  type: "remarks";
  id: number;
  rows: Row[];
}

export interface RemoveNote {
  type: "unnote";
  id: number;
  stamp: string;
  text: string;
}

/** A report. */
export interface ReportEntry {
  number: number;
  settings: string[];
  asked_by: string;
  cancelled_by: string;
  state: string;
  error: string;
  done: number;
  total: number;
  name: string;
  files: ReportFile[];
  folder: string;
}

export interface ReportFile {
  name: string;
  megabytes: number;
}

/** Account of the robot's nodes: their steps with the object. */
export interface Robot {
  id: number;
  frame: number;
  set: string[];
  text: string;
  steps: RobotStep[];
  notes: string[];
  type: "robot";
}

export interface RobotStep {
  about: string;
  text: string;
  changed: boolean;
}

export interface Row {
  frame: number;
  pick: string;
}

/** Run the drive, or a span of it, with the values. */
export interface RunDrive {
  type: "drive";
  id: number;
  set: string[];
  span?: Span | null;
}

export interface Said {
  type: "said";
  text: string;
  wrong?: boolean;
}

/** The page has stopped at a frame. */
export interface Settle {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "settle";
}

export interface Shown {
  type: "shown";
  id: number;
}

/** Effects of other values on a frame, as those of a hint. */
export interface SideEffects {
  fixed: string[];
  added: string[];
  false: string[];
  lost: string[];
  right: string[];
  false_gone: string[];
  changed: number;
}

/** A ``FindingFrame`` as the page gets it. The stamp is text: JavaScript numbers cannot hold it. */
export interface Sight {
  frame: number;
  stamp: string;
  distance: number | null;
  pick: string;
  tried: boolean;
  text: string;
  remark: string;
  in_way: boolean;
}

export interface Snap {
  type: "snap";
  id: number;
}

export interface Span {
  first: string;
  last: string;
}

/** Result of one stage. Further keys are its numbers, by name. */
export interface StepResult {
  stage: string;
  text: string;
  [key: string]: unknown;
}

export interface StripFrame {
  stamp: string;
  better: number;
  worse: number;
}

/** A run with other values. ``span`` is null for the whole drive. */
export interface TrialEntry {
  number: number;
  settings: string[];
  asked_by: string;
  cancelled_by: string;
  state: string;
  error: string;
  done: number;
  total: number;
  lane: string;
  span: Span | null;
  counts: Record<string, number>;
  f1: BeforeAfter | null;
  strip: StripFrame[];
}

/** A frame was tried with other values. */
export interface Tried {
  id: number;
  frame: number;
  set: string[];
  changes: Record<string, string>;
  effects: SideEffects;
  opinions: Record<string, BeforeAfter>;
  failures: string[];
  f1?: BeforeAfter;
  type: "tried";
  pieces: number;
}

/** Change of parameters that was run and does not help. */
export interface TriedChange {
  settings: string[];
  text: string;
}

/** Show the frame with the values. */
export interface Try {
  id: number;
  time: number;
  set?: string[];
  pick?: string;
  type: "try";
}

/** The first message: what is opened. */
export interface Welcome {
  type: "welcome";
  run: string;
  overlay: string;
  bag: string;
  truth: boolean;
  single: boolean;
  detector: boolean;
  opened: string;
  classes: Record<string, string>;
  controls: Control[];
  meanings: Record<string, string>;
}

export type ToPage = Welcome | Failed | Error | Opening | Frames | Entries | Notes | Progress | Nothing | Absent | Hints | Robot | Label | Remark | Tried | Controls | Noted | Held | Said | AnswerMessage;

export type FromPage = Ask | Try | Settle | MakeReport | AddNote | DrawLabel | RunDrive | Cancel | Handle | Remarks | Shown | FindFix | RemoveNote | Hold | ListHeld | Snap | Mark;

/** Elements of index.html by their ids. */
export interface Elements {
  "viewer": HTMLElementTagNameMap["main"];
  "transport": HTMLElementTagNameMap["div"];
  "play": HTMLElementTagNameMap["button"];
  "speed": HTMLElementTagNameMap["select"];
  "loop": HTMLElementTagNameMap["button"];
  "clock": HTMLElementTagNameMap["span"];
  "span": HTMLElementTagNameMap["span"];
  "span-text": HTMLElementTagNameMap["span"];
  "span-clear": HTMLElementTagNameMap["button"];
  "events": HTMLElementTagNameMap["canvas"];
  "thumbnail": HTMLElementTagNameMap["figure"];
  "share": HTMLElementTagNameMap["button"];
  "keys": HTMLElementTagNameMap["button"];
  "bag": HTMLElementTagNameMap["h1"];
  "run": HTMLElementTagNameMap["p"];
  "bar": HTMLElementTagNameMap["progress"];
  "detector": HTMLElementTagNameMap["p"];
  "shown": HTMLElementTagNameMap["p"];
  "shared": HTMLElementTagNameMap["p"];
  "linked": HTMLElementTagNameMap["p"];
  "gone": HTMLElementTagNameMap["p"];
  "robot": HTMLElementTagNameMap["section"];
  "said": HTMLElementTagNameMap["p"];
  "problems": HTMLElementTagNameMap["ul"];
  "hold": HTMLElementTagNameMap["button"];
  "follow": HTMLElementTagNameMap["button"];
  "snap": HTMLElementTagNameMap["button"];
  "past": HTMLElementTagNameMap["input"];
  "past-at": HTMLElementTagNameMap["span"];
  "list": HTMLElementTagNameMap["button"];
  "mark-text": HTMLElementTagNameMap["input"];
  "mark": HTMLElementTagNameMap["button"];
  "findings": HTMLElementTagNameMap["section"];
  "fixing": HTMLElementTagNameMap["p"];
  "fix": HTMLElementTagNameMap["button"];
  "found-title": HTMLElementTagNameMap["h2"];
  "kinds": HTMLElementTagNameMap["p"];
  "find": HTMLElementTagNameMap["input"];
  "class": HTMLElementTagNameMap["select"];
  "reason": HTMLElementTagNameMap["select"];
  "within": HTMLElementTagNameMap["select"];
  "previous": HTMLElementTagNameMap["button"];
  "next": HTMLElementTagNameMap["button"];
  "here": HTMLElementTagNameMap["input"];
  "grouped": HTMLElementTagNameMap["input"];
  "csv": HTMLElementTagNameMap["button"];
  "found-none": HTMLElementTagNameMap["p"];
  "found": HTMLElementTagNameMap["ol"];
  "answer": HTMLElementTagNameMap["section"];
  "verdict": HTMLElementTagNameMap["p"];
  "where": HTMLElementTagNameMap["p"];
  "of": HTMLElementTagNameMap["p"];
  "label": HTMLElementTagNameMap["form"];
  "label-class": HTMLElementTagNameMap["input"];
  "label-classes": HTMLElementTagNameMap["datalist"];
  "label-numbers": HTMLElementTagNameMap["p"];
  "label-cancel": HTMLElementTagNameMap["button"];
  "label-text": HTMLElementTagNameMap["p"];
  "steps": HTMLElementTagNameMap["div"];
  "hints": HTMLElementTagNameMap["div"];
  "chain": HTMLElementTagNameMap["ol"];
  "robot-title": HTMLElementTagNameMap["p"];
  "robot-chain": HTMLElementTagNameMap["ol"];
  "further": HTMLElementTagNameMap["div"];
  "beside-title": HTMLElementTagNameMap["p"];
  "beside": HTMLElementTagNameMap["ul"];
  "changed": HTMLElementTagNameMap["section"];
  "changed-title": HTMLElementTagNameMap["h2"];
  "effect": HTMLElementTagNameMap["p"];
  "try-cancel": HTMLElementTagNameMap["button"];
  "changes": HTMLElementTagNameMap["ul"];
  "flip": HTMLElementTagNameMap["button"];
  "undo": HTMLElementTagNameMap["button"];
  "reset": HTMLElementTagNameMap["button"];
  "copy": HTMLElementTagNameMap["button"];
  "save": HTMLElementTagNameMap["a"];
  "drive": HTMLElementTagNameMap["button"];
  "drive-span": HTMLElementTagNameMap["button"];
  "side": HTMLElementTagNameMap["span"];
  "fix-section": HTMLElementTagNameMap["section"];
  "fix-use": HTMLElementTagNameMap["button"];
  "fix-cancel": HTMLElementTagNameMap["button"];
  "fix-bar": HTMLElementTagNameMap["progress"];
  "fix-text": HTMLElementTagNameMap["p"];
  "trial": HTMLElementTagNameMap["section"];
  "runs": HTMLElementTagNameMap["table"];
  "trial-text": HTMLElementTagNameMap["p"];
  "trial-bar": HTMLElementTagNameMap["progress"];
  "strip": HTMLElementTagNameMap["canvas"];
  "trial-set": HTMLElementTagNameMap["span"];
  "drive-cancel": HTMLElementTagNameMap["button"];
  "trial-listed": HTMLElementTagNameMap["p"];
  "words": HTMLElementTagNameMap["input"];
  "note": HTMLElementTagNameMap["button"];
  "report": HTMLElementTagNameMap["button"];
  "before": HTMLElementTagNameMap["input"];
  "after": HTMLElementTagNameMap["input"];
  "of-span": HTMLElementTagNameMap["span"];
  "noted": HTMLElementTagNameMap["p"];
  "note-error": HTMLElementTagNameMap["p"];
  "reports": HTMLElementTagNameMap["ul"];
  "search": HTMLElementTagNameMap["input"];
  "controls": HTMLElementTagNameMap["div"];
  "help": HTMLElementTagNameMap["dialog"];
  "classes": HTMLElementTagNameMap["ul"];
}
