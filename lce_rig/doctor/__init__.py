"""Whether a computer and its sensors are fit to collect: a function a check, which yields its findings."""
