"""Question which of the robot's own nodes lost or changed an object: `bevviz why --robot`, and the page."""
