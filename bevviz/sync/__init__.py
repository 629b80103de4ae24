"""From messages to frames: what belongs to the time of a scan, and where everything is then."""
