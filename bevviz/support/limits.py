"""Limits of what a file or a message of unknown origin may cost. docs/security.md names their tests.

A limit lies several times above usual data, and low enough that the work up to it takes seconds and less
than 2 GB. The limits of networks are in ``bevviz.stages.detector.session``.
"""

from __future__ import annotations

# --- counts ------------------------------------------------------------------------------------

MAX_TOPICS = 5_000  # topics of a recording; a large vehicle has about 1,000
MAX_CONNECTIONS = 10_000  # connections of a file: ROS 1 has one for each publisher
MAX_PROFILES = 100  # different QoS profiles of a file; each takes a millisecond, and drives have 10
MAX_PROFILE = 10_000  # characters of the QoS profiles of a topic; one has 300
MAX_NAME = 1_000  # characters of a topic's name, which every message and entity repeats; DDS allows 255
MAX_SENSORS = 64  # LiDARs or cameras, each of which adds work and a view to every frame; cars have 20
MAX_FRAMES = 4_000  # frames of the transforms; large robots have some hundreds
MAX_BOXES = 5_000  # boxes of a message or of a frame in a file, each with its own entity; usual are 100
MAX_LATCHED = 2_000  # latched transform messages that are read before a start in the middle of a drive
MAX_ATTACHMENTS = 1_000  # attachments of an MCAP file; bevviz writes one for each LiDAR
MAX_SETTINGS = 1_000  # values of a table in a configuration
MOST_DOTS = 1_000  # dots in a line of TOML: the time that tomllib needs grows with their square
MOST_VALUES = 1_000_000  # values of a YAML file; an alias counts as often as it is used
MOST_POINTS = 100_000_000  # points of a cloud
MOST_PIXELS = 100_000_000  # pixels of an image
MAX_REDIRECTS = 5  # redirects of one request for a remote bag

# --- bytes of a message or a part of a bag -----------------------------------------------------

MAX_MESSAGE = 1 << 28  # a message or cloud after unpacking: 8 million points of 32 bytes
MAX_OBJECTS = 1 << 24  # a message without points or pixels: up to 200 MB of Python objects, which take 1 s
MAX_DEFINITION = 1 << 20  # the text that defines a message type; usual are some kilobytes
MIN_CHUNK = 1 << 26  # a chunk may unpack to so much, even if it states less: the number may be damaged
MAX_CHUNK = 1 << 29  # a chunk after unpacking; recorders close one at 1 to 4 MB
MIN_CLOUD = 1 << 24  # a compressed cloud may unpack to so much, even if it states less
MAX_INDEX = 1 << 26  # index of a bag: that of 100 channels in 200 GB
MAX_ATTACHMENT = 1 << 26  # all attachments of an MCAP file that are read: calibrations of 100 kB each
MAX_PACKET = 1 << 18  # packet of a network capture: four times the longest one of IP
MAX_REQUEST = 1 << 28  # bytes asked for at once at an address; an index or a chunk has some megabytes
LONGEST_HEADER = 1 << 16  # header of a record of a ROS 1 bag; usual are 100 bytes

# --- bytes of a file ---------------------------------------------------------------------------

CONFIG_LIMIT = 1 << 20  # a configuration, a project file, a list of names: usually a few kilobytes
TEXT_LIMIT = 1 << 24  # a calibration, the labels or the stamps of a drive: usually at most a megabyte
TABLE_LIMIT = 1 << 27  # a table with a line for each pose: an hour at 200 Hz is 115 MB
LINE_LIMIT = 1 << 16  # characters of a line of a table
SENSOR_LIMIT = 1 << 30  # a scan or an image: 100 million points without colour
MAX_UNPACKED = 1 << 30  # a compressed PCD after unpacking, as SENSOR_LIMIT
JSON_LIMIT = 1 << 30  # results of a detector for a whole data set
MIN_FILE = 1 << 28  # a compressed bag may unpack to so much, whatever its size
MAX_RATIO = 200  # unpacked by packed bytes of a larger one; drives have 2 to 20
FREE_DISK = 1 << 30  # bytes of the disk that unpacking leaves free for other programs
