"""Live runs beside a robot. Every module that imports rclpy is here. Imports `compare` and below.

- A message arrives: `node` has the ROS nodes, `graph` the published topics and the subscriptions.
- It becomes a frame: `source` receives it, `inputs` knows its role, and `live_message` decodes it.
- It is recorded as received: `raw_recorder` holds the last seconds, and `files` writes bags.
- The frame is processed and logged: `runtime` runs the stages, and `encoder` makes the bytes for all outputs:
  `files`, viewers (`outputs`), and the last seconds (`flight_recorder`).
- Results are published: `publish` for the robot's nodes, and `status` for its monitor and the user.
- A request comes: `requests`, from `bevviz snap` or a ROS node.
"""
