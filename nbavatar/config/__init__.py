"""Configuration: one dataclass a stage, one for a whole run, and the sheets. Standard library only."""
