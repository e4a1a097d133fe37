"""Every numerical kernel driven to its limits, one condition at a time, against an oracle of higher precision."""
