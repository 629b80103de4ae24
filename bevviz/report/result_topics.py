"""Boxes of result files (``--results``) as messages, for the bag of a report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.config import Config
from bevviz.datasets.dataset import make_connection
from bevviz.datasets.result_files import BOXES_2D, BOXES_3D, Labelled
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_boxes_2d, encode_boxes_3d
from bevviz.model.frame import Frame, LabelledBoxes3D
from bevviz.report.bag_window import MadeMessage
from bevviz.stages.robot_results import in_points_frame


def result_messages(source: BagSource) -> Iterator[MadeMessage]:
    """Yield the boxes of the result files for each selected frame, as messages of the topics of the files."""
    topics = {file.topic for file in source.results}
    for frame in source if topics else ():
        boxes: list[Labelled] = [*frame.robot_boxes, *frame.robot_detections]
        for labelled in boxes:
            if labelled.topic in topics:
                yield _message(frame, labelled)


def without_result_files(config: Config) -> Config:
    """Return the configuration of a bag that has the boxes of the result files as topics."""
    return config.model_copy(update={"source": config.source.model_copy(update={"results": {}})})


def _message(frame: Frame, labelled: Labelled) -> MadeMessage:
    """Return the boxes of a frame as a message that is received with its scan."""
    hypotheses = [[pair] for pair in zip(labelled.labels, labelled.scores.tolist(), strict=True)]
    if isinstance(labelled, LabelledBoxes3D):
        kind, boxes = BOXES_3D, in_points_frame(frame.pose, labelled)
        message = encode_boxes_3d(frame.stamp, frame.points_frame, boxes, hypotheses)
    else:
        frames = [c.image.frame_id for c in frame.cameras if c.image and c.name == labelled.camera]
        kind, frame_id = BOXES_2D, (frames or [""])[0]
        message = encode_boxes_2d(frame.stamp, frame_id, labelled.xyxy.astype(np.float64), hypotheses)
    connection = make_connection(0, labelled.topic, kind, 0)
    return MadeMessage(connection, frame.received, bytes(typestore().serialize_cdr(message, kind)))
