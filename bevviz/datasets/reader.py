"""Reader of a data set with the interface of a bag reader. Files become messages on demand."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, Dataset, describe_error
from bevviz.errors import UserError
from bevviz.messages.definitions import typestore
from bevviz.model.frame import I64

LAST_TIME = 2**63 - 1  # nanoseconds


class DatasetReader:
    """Messages of one drive in order of stamp. The stamp is also the log time."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._streams = [stream for stream in dataset.streams if len(stream.times)]
        self.connections = tuple(
            _connection(number, stream.topic, stream.type, len(stream.times))
            for number, stream in enumerate(self._streams)
        )
        self.compression = ""
        # By stream: reason for each row without a message, and for each row with a part of its points.
        self._lost, self._cut = defaultdict[int, dict[int, str]](dict), defaultdict[int, dict[int, str]](dict)

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        if not self._streams:
            return 0, 0
        return (
            min(int(stream.times[0]) for stream in self._streams),
            max(int(stream.times[-1]) for stream in self._streams) + 1,
        )

    @property
    def warnings(self) -> list[str]:
        """Warnings of the data set, unreadable files and cut files."""
        sentences = [*self._dataset.warnings]
        for reasons, description in ((self._lost, "cannot be read"), (self._cut, "are cut")):
            for number, rows in reasons.items():
                stream, first = self._streams[number], rows[min(rows)]
                several = f"{stream.topic}: {len(rows)} of {len(stream.times)} {description}; the first: "
                sentences.append(f"{several if len(rows) > 1 else ''}{first}")
        return list(dict.fromkeys(sentences))

    def messages(
        self, ids: Collection[int], start: int, stop: int
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Yield messages as ``bevviz.bags.reader.Reader`` does.

        An unreadable file gives an empty message and a line in ``warnings``.
        """
        times, numbers, rows = list[I64](), list[I64](), list[I64]()
        for number in sorted(ids):
            first, last = np.searchsorted(self._streams[number].times, [start, stop])
            times.append(self._streams[number].times[first:last])
            numbers.append(np.full(last - first, number, np.int64))
            rows.append(np.arange(first, last, dtype=np.int64))
        stamps, stream_of, row_of = (np.concatenate(parts) for parts in (times, numbers, rows))
        for i in np.lexsort((row_of, stream_of, stamps)).tolist():
            stream, at_row = self._streams[int(stream_of[i])], int(row_of[i])
            data: bytes | memoryview = b""
            try:
                message = stream.make(at_row)
                data = typestore().serialize_cdr(message, stream.type)
            except UserError as error:
                self._lost[int(stream_of[i])][at_row] = str(error)
            except NOT_AS_DOCUMENTED as error:
                self._dataset.warn(
                    f"{stream.topic}: not as {self._dataset.about} is documented ({describe_error(error)})"
                )
            else:
                if stream.files and (whole_points := len(message.data) // message.point_step) < message.width:
                    self._cut[int(stream_of[i])][at_row] = (
                        f"{stream.files[at_row]}: is cut: {whole_points} of {message.width} points are there"
                    )
            yield self.connections[int(stream_of[i])], int(stamps[i]), data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        times = np.sort(np.concatenate([self._streams[number].times for number in ids]))
        return times[(times >= start) & (times < stop)]

    def close(self) -> None:
        """Do nothing: no file stays open."""

    @property
    def aside(self) -> dict[str, str]:
        """Reason by topic why it gets no role by default."""
        return {stream.topic: stream.aside for stream in self._streams if stream.aside}


def _connection(number: int, topic: str, kind: str, count: int) -> Connection:
    text, digest = typestore().generate_msgdef(kind, ros_version=2)
    definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
    return Connection(number, topic, kind, definition, digest, count, ConnectionExtRosbag2("cdr", []), None)
