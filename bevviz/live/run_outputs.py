"""Outputs of a live run together: files, viewers, and the flight recorder. Each takes every packet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.files import BagSaver, RecordingSaver, free_names
from bevviz.live.flight_recorder import FlightRecorder
from bevviz.live.indexing import Indexer
from bevviz.live.outputs import BEHIND, LATE, Output, Viewer, remote, server, window
from bevviz.live.source_wrappers import RobotFrames
from bevviz.live.status import Notes
from bevviz.recording import entities
from bevviz.support.contexts import Closable


@dataclass(frozen=True, slots=True)
class Outputs:
    """Outputs that a user asks for, any number at once: files, window, web viewer, remote viewers."""

    save: Path | None = None
    window: bool = False
    serve: int | None = None
    bind: str = "127.0.0.1"
    connect: Sequence[str] = ()
    blueprint: str = "live"
    raw: Path | None = None  # .mcap file for the messages


class RunOutputs(Closable):
    """Opened outputs of a run.

    Args:
        wanted: outputs that the user asks for.
        settings: limits of files, buffers and queues.
        encoder: makes the packets.
        notes: takes messages to the user.
        source: source of the frames. Its problems take the viewers that are behind.

    Attributes:
        urls: addresses of the viewers in a browser.
        flight: the flight recorder.

    Raises:
        UserError: an output cannot be opened.
    """

    def __init__(
        self,
        wanted: Outputs,
        settings: ReloadableConfig,
        encoder: Encoder,
        notes: Notes,
        source: RobotFrames,
    ) -> None:
        self._encoder, self._notes, self._problems, raw = encoder, notes, source.problems, source.raw
        self._indexer, config = Indexer(), settings.config.live
        self.flight = FlightRecorder(settings, encoder, self._indexer, notes, raw)
        self.urls: list[str] = []
        programs = [remote(url, encoder.application, encoder.recording_id) for url in wanted.connect]
        if wanted.serve is not None:
            program, address = server(wanted.serve, wanted.bind, config.viewer_memory)
            programs.append(program)
            self.urls.append(address)
        if wanted.window:
            programs.append(window())
        self._outputs: list[Output] = []
        save, messages = free_names(wanted.save, wanted.raw, notes)
        self._recording: RecordingSaver | None = None
        if save is not None:
            self._recording = RecordingSaver(save, config, encoder, self._indexer, notes)
            self._outputs.append(self._recording)
        self._bag: BagSaver | None = None
        if messages is not None:
            if raw is None:
                raise UserError(f"--save {messages}: only a robot's messages can be saved")
            self._bag = BagSaver(messages, config, raw, notes, follows=self._recording is not None)
            if self._recording is not None:
                self._recording.on_part = self._bag.next_part
        sparse = config.viewer_rate is not None
        for program in programs:
            self.attach(Viewer(program, config.output_queue, encoder, notes, sparse=sparse))

    def attach(self, output: Output) -> None:
        """Add an output before the run. It is closed at the end of the run."""
        self._outputs.append(output)

    def put(self, packet: Packet) -> None:
        """Pass a packet to every output."""
        for output in self._outputs:
            output.put(packet)
        self.flight.put(packet)

    @property
    def lags(self) -> dict[str, float]:
        """Seconds that each viewer is behind, by name."""
        return {output.name: lag for output in self._outputs if (lag := output.lag) is not None}

    @property
    def scalars(self) -> dict[str, float]:
        """Lags of the viewers in ms and sizes of the buffers in MB, by entity path, for the health."""
        lags = {entities.VIEWER_LAG.path(name): 1e3 * lag for name, lag in self.lags.items()}
        return lags | self.flight.scalars

    @property
    def dropped(self) -> dict[str, int]:
        """Packets and messages that each output has dropped, by name."""
        dropped: dict[str, int] = {}
        for output in self._outputs:
            dropped[output.name] = dropped.get(output.name, 0) + output.dropped
        if self._bag is not None:
            dropped[self._bag.name] = self._bag.dropped
        return dropped

    @property
    def saved(self) -> list[Sequence[Path]]:
        """Parts of the recording, and parts of the bag, of those that were saved."""
        return [saver.paths for saver in (self._recording, self._bag) if saver is not None and saver.paths]

    def check(self) -> None:
        """Note each viewer that falls behind, until it keeps up again."""
        for output in self._outputs:
            name, lag = f"{output.name} viewer", output.lag
            if lag is None:
                continue
            behind = lag >= (LATE if self._problems.of(name) else BEHIND)
            missed = f"{output.dropped} frame{'' if output.dropped == 1 else 's'}"
            self._problems.set(
                "behind",
                name,
                f"the {name} is {lag:.1f} s behind" if behind else "",
                f"the {name} keeps up again; it has missed {missed} so far",
                "it gets the newest frames, the others it misses; --set live.viewer_points=20000 and --set "
                "live.viewer_rate=2 send it less",
            )

    def close(self) -> None:
        """Close all outputs and finish the recordings."""
        for output in self._outputs:
            output.close()
        if self._bag is not None:
            self._bag.close()
        self.flight.close()
        if self._indexer.close():
            self._notes.info("the recording gets its index in the background; it is complete already")
        self._encoder.close()
