"""One step of training: Adam, Muon, and the settings of a step over time."""
