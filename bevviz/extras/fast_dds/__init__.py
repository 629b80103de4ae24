"""Message types of packages that are not installed, for the middleware Fast DDS."""
