"""One step of training: Adam, and the settings of a step over time."""
